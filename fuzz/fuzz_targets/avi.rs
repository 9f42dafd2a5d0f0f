//! An AVI file of any bytes: its headers, and what of its frames can be decoded.
#![no_main]

use std::io::Write;

use crossfix_video::{FrameClock, open};

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let mut file = tempfile::Builder::new().suffix(".avi").tempfile().expect("a temporary file");
    file.write_all(data).expect("room for it");
    let Ok(mut source) = open(file.path(), FrameClock::default()) else { return };
    // A few frames show what there is to see.
    for _ in 0..20 {
        match source.next_frame() {
            Ok(None) => return,
            Err(error) if !error.is_one_frame() => return,
            Ok(Some(_)) | Err(_) => {}
        }
    }
});
