//! The image tracker on any pictures, boxes and times.

#![no_main]

#[path = "../../crates/vision/tests/hostile/driver.rs"]
mod driver;

libfuzzer_sys::fuzz_target!(|data: &[u8]| driver::drive(data));
