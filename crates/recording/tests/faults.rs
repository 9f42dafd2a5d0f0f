//! Torn files, foreign files and full disks.
#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::convert::Infallible;
use std::io::{self, Cursor, Seek, SeekFrom, Write};
use std::path::Path;

use crossfix_message::{BearingFrame, Channel, Key, Payload, Timestamp};
use crossfix_recording::{Entry, ReadFailure, ReadReport, RecordingError, RecordingReader, RecordingWriter};
use proptest::prelude::*;

fn entry(sequence: u64) -> Entry {
    let time = Timestamp::from_seconds(sequence as f64 * 0.1);
    let frame = BearingFrame { camera: "north".into(), sequence, ..Default::default() };
    Entry {
        key: Key::new("field".parse().unwrap(), Channel::Bearings("north".parse().unwrap())),
        data_time: time,
        arrival: time,
        data: frame.encode(),
    }
}

/// A recording of `count` messages, flushed after every ten.
fn recording(count: u64) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = RecordingWriter::new(&mut bytes).unwrap();
    for sequence in 0..count {
        writer.write(&entry(sequence)).unwrap();
        if sequence % 10 == 9 {
            writer.flush().unwrap();
        }
    }
    writer.finish().unwrap();
    bytes.into_inner()
}

fn read(bytes: &[u8]) -> Result<(Vec<Entry>, ReadReport), ReadFailure<Infallible>> {
    let mut entries = Vec::new();
    let report = RecordingReader::new(bytes, Path::new("test.mcap")).for_each(|entry| {
        entries.push(entry);
        Ok(())
    })?;
    Ok((entries, report))
}

#[test]
fn what_was_written_is_read() {
    let (entries, report) = read(&recording(25)).unwrap();
    assert_eq!(entries, (0..25).map(entry).collect::<Vec<_>>());
    assert_eq!(report, ReadReport { messages: 25, foreign: 0, damage: None });
}

#[test]
fn a_torn_file_gives_everything_up_to_the_tear_and_says_so() {
    let bytes = recording(100);
    let (entries, report) = read(&bytes[..bytes.len() / 2]).unwrap();
    assert!(entries.len() >= 20, "{}", entries.len());
    assert!(report.damage.is_some());
}

#[test]
fn a_file_that_is_no_mcap_is_named() {
    let error = read(b"GIF89a, not a recording at all").unwrap_err();
    assert!(matches!(error, ReadFailure::Recording(RecordingError::NotMcap { .. })), "{error:?}");
}

/// A disk with room for so many bytes.
struct SmallDisk {
    bytes: Cursor<Vec<u8>>,
    room: u64,
}

impl Write for SmallDisk {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        if self.bytes.position() + data.len() as u64 > self.room {
            return Err(io::Error::from(io::ErrorKind::StorageFull));
        }
        self.bytes.write(data)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for SmallDisk {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.bytes.seek(to)
    }
}

#[test]
fn a_full_disk_is_an_error_and_what_was_flushed_is_readable() {
    let mut disk = SmallDisk { bytes: Cursor::new(Vec::new()), room: 12_000 };
    let mut writer = RecordingWriter::new(&mut disk).unwrap();
    let failed =
        (0..10_000).find_map(|sequence| writer.write(&entry(sequence)).and_then(|()| writer.flush()).err());
    assert!(matches!(failed, Some(RecordingError::Write(_))));
    drop(writer);
    let (entries, report) = read(disk.bytes.get_ref()).unwrap();
    assert!(!entries.is_empty());
    assert!(report.damage.is_some());
}

proptest! {
    #[test]
    fn any_damage_is_survived(at in 0usize..4000, value in any::<u8>(), cut in 0usize..4000) {
        let mut bytes = recording(30);
        let length = bytes.len();
        bytes[at % length] ^= value;
        bytes.truncate(length - cut % length);
        let _ = read(&bytes);
    }
}
