//! A Y4M file of any bytes.
#![no_main]

mod video_file;

libfuzzer_sys::fuzz_target!(|data: &[u8]| video_file::drive(".y4m", data));
