//! What comes from outside and should not be: each is reported and survived.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::{Duration, Instant};

use crossfix_message::{
    BearingFrame, BearingTrack, CameraName, Channel, Health, ImageTrackState, Key, Payload,
    Vector3, Version, decode,
};
use crossfix_recording::{Entry, RecordingWriter};
use crossfix_tests::{PATIENCE, Site, crossfix, messages, now_seconds, succeed};
use crossfix_transport::{Link, Role};

fn frame(camera: &str, sequence: u64, time_s: f64, bearing: Vector3) -> BearingFrame {
    BearingFrame {
        camera: camera.into(),
        sequence,
        capture_time_ns: (time_s * 1e9) as i64,
        tracks: vec![BearingTrack {
            track_id: 1,
            bearing: Some(bearing),
            covariance_xx: 1e-6,
            covariance_yy: 1e-6,
            state: ImageTrackState::Tracking.into(),
            ..Default::default()
        }],
        ..Default::default()
    }
}

/// The fusion centre's counters, as it says them.
fn counters(
    ear: &crossfix_transport::Subscription,
    until: impl Fn(&BTreeMap<String, u64>) -> bool,
) -> BTreeMap<String, u64> {
    let deadline = Instant::now() + PATIENCE;
    let mut last = BTreeMap::new();
    while Instant::now() < deadline {
        let Some(received) = ear.next(Duration::from_millis(100)) else { continue };
        let health: Health = decode(&received.data).unwrap();
        last = health.counters.into_iter().map(|c| (c.name, c.value)).collect();
        if until(&last) {
            break;
        }
    }
    last
}

#[test]
fn hostile_messages_are_counted_and_the_fusion_centre_goes_on() {
    let site = Site::new(2.0);
    // A network that knows one camera more than the fusion centre listens to.
    let cameras = "cameras = [\"north\", \"east\", \"west\"]\n";
    site.write("fusion.toml", &format!("network = \"network.toml\"\n{cameras}"));
    let fusion = site.start_fusion();
    let link = Link::open(site.network(), &Role::Cameras { and_fusion: false }).unwrap();
    let ear = site.ear();
    let health =
        ear.subscribe(&[Key::new(ear.site().clone(), Channel::FusionHealth).to_string()]).unwrap();
    link.wait_for(&[Channel::FusionAlive], PATIENCE, || true).unwrap();
    std::thread::sleep(Duration::from_millis(500));

    let key = |channel| Key::new(link.site().clone(), channel);
    let bearings = |camera: &str| key(Channel::Bearings(camera.parse().unwrap()));
    for camera in site.world().cameras() {
        let message = crossfix_message::CameraCalibration::new(
            camera.name(),
            camera.camera(),
            crossfix_message::Timestamp::EPOCH,
        );
        link.put(&key(Channel::Calibration(camera.name().clone())), message.encode()).unwrap();
    }
    let ahead = Vector3 { x: 0.0, y: 0.0, z: 1.0 };
    let start = now_seconds();
    let put = |camera: &str, data: Vec<u8>| link.put(&bearings(camera), data).unwrap();
    put("north", frame("north", 0, start, ahead).encode());
    put("east", frame("east", 0, start, ahead).encode());
    put("north", frame("north", 1, start + 0.1, Vector3 { x: f64::NAN, y: 0.0, z: 1.0 }).encode());
    put("north", frame("north", 2, start + 0.2, Vector3 { x: 0.0, y: 0.0, z: 2.0 }).encode());
    put("west", frame("west", 0, start + 1e6, ahead).encode());
    put("nobody", frame("nobody", 0, start, ahead).encode());
    put("north", vec![0xff; 40]);
    let newer = BearingFrame {
        version: Some(Version { major: 9, minor: 0 }),
        ..frame("north", 3, start, ahead)
    };
    put("north", newer.encode_unstamped());

    let counted = counters(&health, |c| c.get("received_newer_version").is_some_and(|n| *n > 0));
    let count = |name: &str| counted.get(name).copied().unwrap_or(0);
    assert_eq!(count("rejected_bearing"), 2, "{counted:?}");
    assert_eq!(count("rejected_future"), 1, "{counted:?}");
    assert_eq!(count("received_foreign_camera"), 1, "{counted:?}");
    assert_eq!(count("received_malformed"), 1, "{counted:?}");
    assert_eq!(count("received_newer_version"), 1, "{counted:?}");
    assert!(fusion.stop(), "it is alive and ends well");
}

#[test]
fn no_message_of_any_size_costs_much_memory() {
    let site = Site::new(2.0);
    let fusion = site.start_fusion();
    let recorder = site.start_recorder("live.mcap");
    let link = Link::open(site.network(), &Role::Cameras { and_fusion: false }).unwrap();
    let ear = site.ear();
    let health =
        ear.subscribe(&[Key::new(ear.site().clone(), Channel::FusionHealth).to_string()]).unwrap();
    link.wait_for(&[Channel::FusionAlive, Channel::RecorderAlive], PATIENCE, || true).unwrap();
    std::thread::sleep(Duration::from_millis(500));
    let before = [&fusion, &recorder].map(|process| process.peak_memory());
    let north = Key::new(link.site().clone(), Channel::Bearings("north".parse().unwrap()));
    // Empty tracks: two bytes each here, 180 there.
    for length in [1 << 20, 7 << 20, 12 << 20, 50 << 20, 150 << 20] {
        link.put(&north, [0x42, 0x00].repeat(length / 2)).unwrap();
    }
    let counted = counters(&health, |counted| {
        ["received_too_large", "received_too_long"]
            .iter()
            .filter_map(|name| counted.get(*name))
            .sum::<u64>()
            >= 3
    });
    assert!(counted["received_too_large"] >= 2, "{counted:?}");
    std::thread::sleep(Duration::from_secs(1));
    for (what, process, before) in [("fuse", &fusion, before[0]), ("record", &recorder, before[1])]
    {
        let (Some(before), Some(after)) = (before, process.peak_memory()) else {
            eprintln!("SKIPPED: this system does not say how much memory a process has");
            continue;
        };
        println!("{what}: {} MiB before, {} MiB at most", before >> 20, after >> 20);
        assert!(after - before < 64 << 20, "{what}: {before} and {after} bytes");
    }
    assert!(fusion.stop() && recorder.stop());
}

#[test]
fn a_full_disk_ends_the_recorder_with_a_clear_word() {
    if !Path::new("/dev/full").exists() {
        eprintln!("SKIPPED: this system has no /dev/full");
        return;
    }
    let site = Site::new(2.0);
    let output = crossfix(&["record", "-c", &site.path("network.toml"), "-o", "/dev/full"]);
    assert_eq!(output.status.code(), Some(1));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(
        stderr.contains("cannot write the recording") && stderr.contains("No space left"),
        "{stderr}"
    );
}

#[test]
fn a_torn_recording_is_fused_up_to_the_tear() {
    let site = Site::new(4.0);
    let bytes = std::fs::read(site.path("source.mcap")).unwrap();
    std::fs::write(site.path("torn.mcap"), &bytes[..bytes.len() * 2 / 3]).unwrap();
    let output =
        crossfix(&["replay", &site.path("torn.mcap"), "--fuse", "-o", &site.path("tracks.mcap")]);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && stderr.contains("is damaged"), "{stderr}");
}

#[test]
fn configurations_with_mistakes_are_explained_before_anything_starts() {
    let site = Site::new(2.0);
    let good = std::fs::read_to_string(site.path("north.toml")).unwrap();
    let yaml = std::fs::read_to_string(site.path("north.yaml")).unwrap();
    let check = |what: &str, words: &[&str]| {
        let output = crossfix(&["check", "-c", what]);
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        for word in words {
            assert!(stderr.contains(word), "`{word}` is missing in:\n{stderr}");
        }
    };
    let north = site.path("north.toml");
    site.write("north.toml", &good.replace("look_at_m", "look_at"));
    check(&north, &["north.toml", "unknown field `look_at`", "did you mean `look_at_m`?"]);
    site.write("north.toml", &good.replace("source.mcap", "gone.mcap"));
    check(&north, &["north.toml", "source.path", "gone.mcap", "not there"]);
    let skewed = good
        .lines()
        .map(|line| {
            if line.starts_with("look_at_m") {
                "rotation = [[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]"
            } else {
                line
            }
        })
        .collect::<Vec<_>>()
        .join("\n");
    site.write("north.toml", &skewed);
    check(&north, &["north.toml", "rotation", "not orthonormal"]);
    site.write("north.toml", &good);
    site.write("north.yaml", &yaml.replacen("620.0", "-620.0", 1));
    check(&north, &["north.yaml", "fx", "positive"]);
    site.write("north.yaml", &yaml);
    site.write("zwilling.toml", &good);
    check(
        &site.path(""),
        &["two cameras are called `north`", "zwilling.toml", "change the key `name`"],
    );
}

#[test]
fn a_replay_counts_as_published_only_what_the_site_can_use() {
    let site = Site::new(2.0);
    let mut entries = messages(Path::new(&site.path("source.mcap")), |_| true);
    let usable = entries.len();
    let last = entries
        .iter()
        .rfind(|entry| matches!(entry.key.channel, Channel::Bearings(_)))
        .unwrap()
        .clone();
    let foreign = Channel::Bearings("nobody".parse().unwrap());
    let foreign_key = Key { channel: foreign, ..last.key.clone() };
    let newer = BearingFrame {
        version: Some(Version { major: 9, minor: 0 }),
        ..decode(&last.data).unwrap()
    };
    entries.extend([
        Entry { key: foreign_key.clone(), ..last.clone() },
        Entry { key: foreign_key, ..last.clone() },
        Entry { data: newer.encode_unstamped(), ..last },
    ]);
    let mut writer = RecordingWriter::create(Path::new(&site.path("mixed.mcap"))).unwrap();
    entries.iter().for_each(|entry| writer.write(entry).unwrap());
    writer.finish().unwrap();

    let network = site.path("network.toml");
    let replayed =
        |file: &str| succeed(&["replay", &site.path(file), "--network", &network, "--speed", "0"]);
    assert_eq!(replayed("source.mcap").trim(), format!("{usable} messages published"));
    let said = replayed("mixed.mcap");
    assert!(said.starts_with(&format!("{usable} messages published; left out: 2 of")), "{said}");
    assert!(said.contains(", 1 that cannot be read"), "{said}");
}

#[test]
fn who_listens_to_a_replay_from_its_middle_hears_the_calibrations() {
    let site = Site::new(8.0);
    let (source, network) = (site.path("source.mcap"), site.path("network.toml"));
    let replay = std::thread::spawn(move || succeed(&["replay", &source, "--network", &network]));
    std::thread::sleep(Duration::from_secs(4));
    let recorder = site.start_recorder("late.mcap");
    replay.join().unwrap();
    assert!(recorder.stop());
    let cameras = |file: &str| -> BTreeSet<CameraName> {
        let calibrations = |channel: &Channel| matches!(channel, Channel::Calibration(_));
        let entries = messages(Path::new(&site.path(file)), calibrations);
        entries.iter().filter_map(|entry| entry.key.channel.camera().cloned()).collect()
    };
    assert_eq!(cameras("late.mcap"), cameras("source.mcap"));
}
