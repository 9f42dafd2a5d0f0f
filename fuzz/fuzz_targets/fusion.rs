//! The fusion centre on any stream of calibrations and frames.

#![no_main]

#[path = "../../crates/fusion/tests/hostile/driver.rs"]
mod driver;

libfuzzer_sys::fuzz_target!(|data: &[u8]| driver::drive(data));
