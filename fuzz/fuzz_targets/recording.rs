//! A recording of any bytes.
#![no_main]

use std::io::Cursor;
use std::path::Path;

use crossfix_recording::RecordingReader;

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    if let Ok(reader) = RecordingReader::new(Cursor::new(data), Path::new("fuzzed.mcap")) {
        let _ = reader.for_each(|entry| {
            let _ = crossfix_message::glance(&entry.key.channel, &entry.data);
            Ok::<_, std::convert::Infallible>(())
        });
    }
});
