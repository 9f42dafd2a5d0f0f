//! Torn files, foreign files and full disks.
#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::convert::Infallible;
use std::io::{self, Cursor, Seek, SeekFrom, Write};
use std::path::Path;

use crossfix_message::{
    BearingFrame, Channel, Key, MOST_MESSAGE_BYTES, Payload, Timestamp, decode,
};
use crossfix_recording::{
    Entry, ReadFailure, ReadReport, RecordingError, RecordingReader, RecordingWriter, Source,
};
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
    let reader = RecordingReader::new(Cursor::new(bytes), Path::new("test.mcap"));
    let report = reader.map_err(ReadFailure::Recording)?.for_each(|entry| {
        entries.push(entry);
        Ok(())
    })?;
    Ok((entries, report))
}

#[test]
fn what_was_written_is_read() {
    let (entries, report) = read(&recording(25)).unwrap();
    assert_eq!(entries, (0..25).map(entry).collect::<Vec<_>>());
    assert_eq!(report, ReadReport { messages: 25, ..Default::default() });
}

#[test]
fn a_torn_file_gives_everything_up_to_the_tear_and_says_so() {
    let bytes = recording(100);
    let (entries, report) = read(&bytes[..bytes.len() / 2]).unwrap();
    assert!(entries.len() >= 20, "{}", entries.len());
    assert!(report.damage.is_some());
}

/// Every message that lies in the file of 100 but not in the given ten.
fn but(lost: std::ops::Range<u64>) -> Vec<u64> {
    (0..100).filter(|sequence| !lost.contains(sequence)).collect()
}

fn sequences(entries: &[Entry]) -> Vec<u64> {
    entries.iter().map(|entry| decode::<BearingFrame>(&entry.data).unwrap().sequence).collect()
}

/// Where each chunk of a recording begins and ends, by its index.
fn chunks(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
    let summary = mcap::Summary::read(bytes).unwrap().unwrap();
    let range = |chunk: &mcap::records::ChunkIndex| {
        let start = chunk.chunk_start_offset as usize;
        start..start + chunk.chunk_length as usize
    };
    summary.chunk_indexes.iter().map(range).collect()
}

#[test]
fn one_wrong_bit_anywhere_costs_one_chunk_at_most_and_is_said() {
    let whole = recording(100);
    let chunks = chunks(&whole);
    assert_eq!(chunks.len(), 10);
    // Every byte of heads and of what lies between the chunks, and some of the packed records.
    let (first, last) = (chunks[0].start, chunks[9].end);
    for at in (0..whole.len()).filter(|at| !(first..last).contains(at) || at % 5 == 0) {
        let mut bytes = whole.clone();
        bytes[at] ^= 1 << (at % 8);
        let (entries, report) = read(&bytes).unwrap();
        let lost = chunks.iter().position(|chunk| chunk.contains(&at));
        let left = lost.map_or(0..0, |chunk| 10 * chunk as u64..10 * (chunk as u64 + 1));
        let torn = entries.iter().filter(|e| decode::<BearingFrame>(&e.data).is_err()).count();
        assert_eq!(torn, 0, "byte {at} of {}, chunks {chunks:?}: {report:?}", whole.len());
        let got = sequences(&entries);
        assert!(got == but(left.clone()) || got == but(0..0), "byte {at}: {got:?}");
        // A chunk's times, which nobody needs to read it, have no checksum.
        assert!(got.len() == 100 || report.damage.is_some(), "byte {at}");
    }
}

/// As other programs may write it.
fn unpacked(bytes: &[u8]) -> Vec<u8> {
    let mut copy = Cursor::new(Vec::new());
    let unpacked = mcap::WriteOptions::new().compression(None).calculate_chunk_crcs(false);
    let mut writer = unpacked.create(&mut copy).unwrap();
    for message in mcap::MessageStream::new(bytes).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    copy.into_inner()
}

#[test]
fn a_record_that_is_longer_than_its_unpacked_chunk_costs_that_chunk_and_is_said() {
    let mut bytes = unpacked(&recording(10));
    assert_eq!(read(&bytes).unwrap().0, (0..10).map(entry).collect::<Vec<_>>());
    // Heads of chunk and record, times, size, checksum, no name of a compression.
    let length = chunks(&bytes)[0].start + 9 + 24 + 4 + 4 + 8 + 1;
    bytes[length + 1] += 0x40;
    let (entries, report) = read(&bytes).unwrap();
    assert_eq!(entries, []);
    assert!(report.damage.is_some());
}

#[test]
fn a_chunk_that_says_it_is_something_else_is_known_by_its_shape() {
    let whole = recording(100);
    for (chunk, bit) in
        chunks(&whole).into_iter().flat_map(|chunk| (0..8).map(move |bit| (chunk.clone(), bit)))
    {
        let mut bytes = whole.clone();
        bytes[chunk.start] ^= 1 << bit;
        let (entries, report) = read(&bytes).unwrap();
        assert!(entries.len() >= 90, "byte {}, bit {bit}: {}", chunk.start, entries.len());
        assert!(report.damage.is_some(), "byte {}, bit {bit}", chunk.start);
    }
}

#[test]
fn a_torn_file_whose_first_chunk_is_damaged_keeps_the_rest() {
    let whole = recording(100);
    let chunks = chunks(&whole);
    let mut bytes = whole[..chunks[8].start + 20].to_vec();
    bytes[chunks[0].start + 100] ^= 0x10;
    let (entries, report) = read(&bytes).unwrap();
    assert_eq!(sequences(&entries), (10..80).collect::<Vec<_>>());
    assert!(report.damage.unwrap().places >= 2);
}

#[test]
fn a_message_that_no_reader_takes_is_not_written() {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = RecordingWriter::new(&mut bytes).unwrap();
    writer.write(&entry(0)).unwrap();
    let long = Entry { data: vec![0; MOST_MESSAGE_BYTES + 1], ..entry(1) };
    assert!(matches!(writer.write(&long), Err(RecordingError::TooLong { .. })));
    let longest = Entry { data: vec![7; MOST_MESSAGE_BYTES], ..entry(2) };
    writer.write(&longest).unwrap();
    writer.write(&entry(3)).unwrap();
    writer.finish().unwrap();
    let (entries, report) = read(bytes.get_ref()).unwrap();
    assert_eq!(entries, [entry(0), longest, entry(3)]);
    assert!(report.damage.is_none());
}

#[test]
fn who_wrote_a_file_is_in_it() {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = RecordingWriter::new(&mut bytes).unwrap();
    let source = Source { command: "record".into(), run: "00c0ffee".into(), ..Default::default() };
    writer.sign(&source).unwrap();
    writer.write(&entry(0)).unwrap();
    writer.finish().unwrap();
    assert_eq!(read(bytes.get_ref()).unwrap().1.source, Some(source));
}

#[test]
fn an_existing_file_is_not_replaced_unless_it_is_meant() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    RecordingWriter::create_new(&path).unwrap().finish().unwrap();
    assert!(matches!(RecordingWriter::create_new(&path), Err(RecordingError::Exists { .. })));
    RecordingWriter::create(&path).unwrap().finish().unwrap();
}

#[test]
fn an_empty_file_is_named() {
    assert!(matches!(read(b"").unwrap_err(), ReadFailure::Recording(RecordingError::Empty { .. })));
}

#[test]
fn a_file_that_only_claims_to_hold_chunks_is_given_up_in_time() {
    // A chunk of the whole file every 54 bytes.
    let size = 1_u64 << 20;
    let mut bytes = b"\x89MCAP0\r\n".to_vec();
    while (bytes.len() as u64) < size {
        let length = size - bytes.len() as u64 - 9;
        bytes.push(6);
        bytes.extend(length.to_le_bytes());
        bytes.extend([0; 28]);
        bytes.extend(b"\x04\0\0\0zstd");
        bytes.extend((length - 44).to_le_bytes());
        if length < 200 {
            break;
        }
    }
    bytes.resize(size as usize, 0);
    let (entries, report) = read(&bytes).unwrap();
    assert!(entries.is_empty());
    // Read in full as often, it would be 20 000 places.
    assert!(report.damage.unwrap().places < 100);
}

#[test]
fn a_file_that_is_no_mcap_is_named() {
    let error = read(b"GIF89a, not a recording at all").unwrap_err();
    assert!(matches!(error, ReadFailure::Recording(RecordingError::NotMcap { .. })), "{error:?}");
}

/// A disk with room for a number of bytes.
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
    let failed = (0..10_000)
        .find_map(|sequence| writer.write(&entry(sequence)).and_then(|()| writer.flush()).err());
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
