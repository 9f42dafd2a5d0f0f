//! A site's calibration, or a lens's, of any text.

#![no_main]

#[path = "../../crates/calibration/tests/hostile/driver.rs"]
mod driver;

libfuzzer_sys::fuzz_target!(|data: &[u8]| driver::drive(data));
