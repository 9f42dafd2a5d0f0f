//! A file of video of any bytes: its headers or index, and what of its frames can be decoded.

use std::io::Write;

use crossfix_video::{FrameClock, open};

/// Opens the bytes as a file of a kind and reads the first frames.
pub fn drive(suffix: &str, data: &[u8]) {
    let mut file = tempfile::Builder::new().suffix(suffix).tempfile().expect("a temporary file");
    file.write_all(data).expect("room for it");
    let Ok(mut source) = open(file.path(), FrameClock::default()) else { return };
    // Each frame may be read many times over, as a hostile index says; a few show what there is to
    // see.
    for _ in 0..20 {
        match source.next_frame() {
            Ok(None) => return,
            Err(error) if !error.is_one_frame() => return,
            Ok(Some(_)) | Err(_) => {}
        }
    }
}
