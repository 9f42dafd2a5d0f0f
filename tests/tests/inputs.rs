//! What is read is checked: tables that do not agree, times that do not meet, names that cannot be.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::path::Path;

use crossfix_message::{Channel, TruthFrame, decode};
use crossfix_message::{Key, Payload};
use crossfix_recording::{Entry, RecordingWriter};
use crossfix_tests::{Site, crossfix, messages, succeed};

/// What a command that fails says.
fn refused(arguments: &[&str]) -> String {
    let output = crossfix(arguments);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "crossfix {}: {said}", arguments.join(" "));
    said
}

/// Copies a recording, each message changed.
fn changed(from: &str, to: &str, change: impl Fn(Entry) -> Entry) {
    let mut writer = RecordingWriter::create(Path::new(to)).unwrap();
    for entry in messages(Path::new(from), |_| true) {
        writer.write(&change(entry)).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn a_scenario_of_which_a_part_is_missing_is_no_recording() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (scenario, output) = (path("crowd"), path("crowd.mcap"));
    let made = ["simulate", "--scenario", &scenario, "--seconds", "1", "--targets", "2"];
    succeed(&made);
    let import = ["import", "scenario", &scenario, "-o", &output];
    succeed(&import);
    std::fs::remove_file(&output).unwrap();
    for (table, from, to, words) in [
        ("detections.csv", "\n0.0,0,0,0,", "\n0.0,0,9999,0,", "n is"),
        ("detections.csv", "\n0.0,0,0,0,", "\n7.5,0,0,0,", "and 7.5 in detections.csv"),
        ("detections.csv", ",0.0005,", ",5,", "sigma_rad is 5"),
        ("exposures.csv", "\n0.0,0,0,", "\nnan,0,0,", "t is NaN"),
        ("exposures.csv", "\n0.0,0,0,", "\n0.0,77,0,", "no such camera"),
        ("truth.csv", "\n0.0,0,", "\n0.0,0,nan,", "truth.csv"),
        ("scenario.json", "\"id\": 1", "\"id\": 0", "two cameras have the id 0"),
    ] {
        let file = format!("{scenario}/{table}");
        let before = std::fs::read_to_string(&file).unwrap();
        assert!(before.contains(from), "{table} has no {from}");
        std::fs::write(&file, before.replacen(from, to, 1)).unwrap();
        let said = refused(&import);
        assert!(said.contains(words), "{table}, {to}: {said}");
        assert!(!Path::new(&output).exists());
        std::fs::write(&file, before).unwrap();
    }
    succeed(&import);
}

#[test]
fn tracks_are_not_compared_with_a_truth_of_another_time_or_of_no_numbers() {
    let site = Site::new(8.0);
    let path = |name: &str| site.path(name);
    succeed(&["-q", "replay", &path("source.mcap"), "--fuse", "-o", &path("tracks.mcap")]);
    let truth = |name: &str, change: &dyn Fn(&mut TruthFrame)| {
        changed(&path("source.mcap"), &path(name), |entry| match entry.key.channel {
            Channel::Truth => {
                let mut frame: TruthFrame = decode(&entry.data).unwrap();
                change(&mut frame);
                Entry { data: frame.encode_unstamped(), ..entry }
            }
            _ => entry,
        });
        refused(&["evaluate", &path("tracks.mcap"), "--truth", &path(name)])
    };
    let later = truth("later.mcap", &|frame| frame.time_ns += 1_790_000_000_000_000_000);
    assert!(later.contains("they have no time in common"), "{later}");
    let nowhere = truth("nowhere.mcap", &|frame| {
        let places = frame.targets.iter_mut().filter_map(|target| target.position.as_mut());
        places.for_each(|place| place.x = f64::NAN);
    });
    assert!(nowhere.contains("no number"), "{nowhere}");
}

#[test]
fn two_sites_are_not_fused_as_one() {
    let site = Site::new(2.0);
    let (source, both) = (site.path("source.mcap"), site.path("both.mcap"));
    changed(&source, &both, |entry| {
        let is_other = entry.key.channel.camera().is_some_and(|camera| camera.as_str() == "east");
        let other = "elsewhere".parse().unwrap();
        let key = if is_other { Key::new(other, entry.key.channel.clone()) } else { entry.key };
        Entry { key, ..entry }
    });
    let said = refused(&["replay", &both, "--fuse", "-o", &site.path("tracks.mcap")]);
    assert!(said.contains("is of two sites"), "{said}");
}
