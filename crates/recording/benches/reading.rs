//! Reading a recording, beside the mcap crate's own stream of the same bytes, which checks no
//! damage and hands out no keys. Seventy hundredths of its speed are asked for.
//!
//! `cargo bench -p crossfix-recording`
#![allow(clippy::unwrap_used, reason = "a bench that cannot set itself up has nothing to say")]

use std::convert::Infallible;
use std::io::Cursor;
use std::path::Path;

use crossfix_message::{BearingFrame, BearingTrack, Channel, Key, Payload, Timestamp, Vector3};
use crossfix_recording::{Entry, RecordingReader, RecordingWriter};
use divan::counter::ItemsCount;
use divan::{Bencher, black_box};

/// Ten minutes of three cameras at 30 Hz.
const MESSAGES: usize = 3 * 30 * 600;

fn main() {
    divan::main();
}

/// A recording of bearings of ten targets.
fn recording() -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut writer = RecordingWriter::new(Cursor::new(&mut bytes)).unwrap();
    for index in 0..MESSAGES {
        let camera = ["north", "east", "west"][index % 3];
        let time = Timestamp::from_seconds(index as f64 / 90.0);
        let tracks = (0..10)
            .map(|track_id| BearingTrack {
                track_id,
                bearing: Some(Vector3 {
                    x: (index as f64 * 0.001 + track_id as f64).sin(),
                    y: 0.1,
                    z: 1.0,
                }),
                covariance_xx: 1e-7,
                covariance_yy: 1e-7,
                ..Default::default()
            })
            .collect();
        let frame = BearingFrame {
            camera: camera.to_owned(),
            sequence: index as u64 / 3,
            capture_time_ns: time.nanos(),
            tracks,
            ..Default::default()
        };
        let key = Key::new("field".parse().unwrap(), Channel::Bearings(camera.parse().unwrap()));
        let entry = Entry { key, data_time: time, arrival: time, data: frame.encode() };
        writer.write(&entry).unwrap();
    }
    writer.finish().unwrap();
    bytes
}

#[divan::bench]
fn ours(bencher: Bencher) {
    let bytes = recording();
    bencher.counter(ItemsCount::new(MESSAGES)).bench_local(|| {
        let reader = RecordingReader::new(Cursor::new(&bytes), Path::new("bench")).unwrap();
        let mut read = 0_usize;
        let report = reader
            .for_each(|entry| {
                read += entry.data.len();
                Ok::<_, Infallible>(())
            })
            .unwrap();
        assert_eq!(report.messages, MESSAGES as u64);
        black_box(read)
    });
}

#[divan::bench]
fn the_librarys_stream(bencher: Bencher) {
    let bytes = recording();
    bencher.counter(ItemsCount::new(MESSAGES)).bench_local(|| {
        let stream = mcap::MessageStream::new(&bytes).unwrap();
        let read: usize = stream.map(|message| message.unwrap().data.len()).sum();
        black_box(read)
    });
}
