//! A network camera that answers with any bytes.
#![no_main]

#[path = "../../crates/video/tests/hostile/driver.rs"]
mod driver;

libfuzzer_sys::fuzz_target!(
    // What panics where a stream is opened or received is caught and no finding, so it must not end
    // the fuzzer; what panics where its frames are made is not caught, and does.
    init: std::panic::set_hook(Box::new(|_| {})),
    |data: &[u8]| {
        driver::drive(data);
    }
);
