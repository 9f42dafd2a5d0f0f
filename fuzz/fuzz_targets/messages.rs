//! A message of the wire of any bytes, and what others are told of it.
#![no_main]

#[path = "../../crates/outlet/tests/hostile/driver.rs"]
mod driver;

libfuzzer_sys::fuzz_target!(|data: &[u8]| driver::drive(data));
