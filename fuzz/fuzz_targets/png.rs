//! A folder with one picture of any bytes.
#![no_main]

use crossfix_video::{FrameClock, open};

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::write(folder.path().join("0.png"), data).expect("room for it");
    let Ok(mut source) = open(folder.path(), FrameClock::default()) else { return };
    let _ = source.next_frame();
});
