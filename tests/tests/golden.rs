//! The tracks of a recording, byte for byte as they were when they were last looked at.
//!
//! `tests/golden/two-uavs.csv` has a line each second of `recordings/two-uavs.mcap`: how many track
//! frames, the digest of their bytes, and where the tracks were. Whoever changes what the fusion
//! makes of the same bearings sees it here, and writes the file anew when that was meant:
//! `CROSSFIX_GOLDEN=write cargo nextest run -p crossfix-tests --test golden`.
//!
//! With `CROSSFIX_GOLDEN=exact` (`.ci/run`) the bytes must be the same. Without it a machine whose
//! system has other sines and cosines in the last bit passes with places that agree to a
//! micrometre.
#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and what it finds is said"
)]

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use crossfix_message::{Channel, Timestamp, TrackFrame, TrackNumber, decode};
use crossfix_tests::{messages, succeed};
use sha2::{Digest, Sha256};

/// Places may differ by this much where the bytes do, m.
const SAME_M: f64 = 1e-6;

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// What a second of a recording holds.
#[derive(Clone, Debug, Default, PartialEq)]
struct Second {
    frames: usize,
    digest: String,
    /// Where each track was last, by its number.
    places: BTreeMap<String, [f64; 3]>,
}

/// The seconds of a recording's tracks.
fn seconds(recording: &Path) -> BTreeMap<i64, Second> {
    let mut seconds: BTreeMap<i64, (Second, Sha256)> = BTreeMap::new();
    for entry in messages(recording, |channel| *channel == Channel::Tracks) {
        let frame: TrackFrame = decode(&entry.data).unwrap();
        let at = Timestamp::from_nanos(frame.time_ns).seconds().floor() as i64;
        let (second, digest) = seconds.entry(at).or_default();
        digest.update(&entry.data);
        second.frames += 1;
        for track in &frame.tracks {
            if let Some(place) = track.position {
                second
                    .places
                    .insert(TrackNumber(track.id).to_string(), [place.x, place.y, place.z]);
            }
        }
    }
    let finished = seconds.into_iter().map(|(at, (second, digest))| {
        let digest = digest.finalize().iter().fold(String::new(), |mut text, byte| {
            write!(text, "{byte:02x}").unwrap();
            text
        });
        (at, Second { digest, ..second })
    });
    finished.collect()
}

fn written(seconds: &BTreeMap<i64, Second>) -> String {
    let mut text = String::from("second,frames,sha256,places\n");
    for (at, Second { frames, digest, places }) in seconds {
        let places: Vec<String> = places
            .iter()
            .map(|(number, [x, y, z])| format!("{number}:{x:.9}:{y:.9}:{z:.9}"))
            .collect();
        writeln!(text, "{at},{frames},{digest},{}", places.join(" ")).unwrap();
    }
    text
}

fn read(text: &str) -> BTreeMap<i64, Second> {
    let line = |line: &str| {
        let fields: Vec<&str> = line.split(',').collect();
        let place = |text: &str| {
            let parts: Vec<&str> = text.split(':').collect();
            let number = |index: usize| parts[index].parse::<f64>().unwrap();
            (parts[0].to_owned(), [number(1), number(2), number(3)])
        };
        let second = Second {
            frames: fields[1].parse().unwrap(),
            digest: fields[2].to_owned(),
            places: fields[3].split_whitespace().map(place).collect(),
        };
        (fields[0].parse().unwrap(), second)
    };
    text.lines().skip(1).map(line).collect()
}

/// Whether two seconds say the same to a micrometre.
fn agree(one: &Second, other: &Second) -> bool {
    let near = |a: &[f64; 3], b: &[f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < SAME_M);
    let same = |(number, place): (&String, &[f64; 3])| {
        other.places.get(number).is_some_and(|there| near(place, there))
    };
    one.frames == other.frames
        && one.places.len() == other.places.len()
        && one.places.iter().all(same)
}

#[test]
fn the_tracks_of_a_recording_are_what_they_were() {
    let folder = tempfile::tempdir().unwrap();
    let tracks = folder.path().join("tracks.mcap");
    let recording = repository("recordings/two-uavs.mcap");
    succeed(&[
        "replay",
        &recording.display().to_string(),
        "--fuse",
        "-o",
        &tracks.display().to_string(),
    ]);
    let found = seconds(&tracks);
    let golden = repository("tests/golden/two-uavs.csv");
    let mode = std::env::var("CROSSFIX_GOLDEN").unwrap_or_default();
    if mode == "write" {
        std::fs::write(&golden, written(&found)).unwrap();
    }
    let kept = read(&std::fs::read_to_string(&golden).unwrap());
    assert_eq!(found.keys().collect::<Vec<_>>(), kept.keys().collect::<Vec<_>>());
    let mut others = 0;
    for (at, second) in &found {
        let kept = &kept[at];
        if second.digest == kept.digest {
            continue;
        }
        others += 1;
        assert!(agree(second, kept), "second {at}: {second:?}, and it was {kept:?}");
    }
    assert!(mode != "exact" || others == 0, "{others} seconds are the same in other bytes");
    if others > 0 {
        eprintln!("{others} seconds differ in the last bits: another machine's sines and cosines");
    }
}
