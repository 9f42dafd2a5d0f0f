//! Nothing that was recorded is destroyed, and what is lacking is said.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, Health, Key, Payload, Preview, Timestamp, TrackFrame,
    Version, decode,
};
use crossfix_recording::{Entry, RecordingInfo, RecordingReader, RecordingWriter};
use crossfix_tests::{PATIENCE, Site, crossfix, messages, now_seconds, program, succeed};
use crossfix_transport::{Delivery, Link, Role};

fn stderr(arguments: &[&str], code: i32) -> String {
    let output = crossfix(arguments);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(code), "crossfix {}: {stderr}", arguments.join(" "));
    stderr
}

#[test]
fn a_recorder_that_is_started_again_goes_on_under_a_new_name() {
    let site = Site::new(2.0);
    site.write("today.mcap", "what was recorded before");
    let recorder = site.start_recorder("today.mcap");
    let second = site.path("today-2.mcap");
    let deadline = Instant::now() + PATIENCE;
    while !Path::new(&second).exists() {
        assert!(Instant::now() < deadline, "no second recording");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(recorder.stop());
    assert_eq!(site.text("today.mcap"), "what was recorded before");
    RecordingReader::open(Path::new(&second)).unwrap();

    // Who means it says so.
    let overwritten = site.start(&[
        "record",
        "-c",
        &site.path("network.toml"),
        "-o",
        &site.path("today.mcap"),
        "--overwrite",
    ]);
    std::thread::sleep(Duration::from_secs(1));
    assert!(overwritten.stop());
    RecordingReader::open(Path::new(&site.path("today.mcap"))).unwrap();
}

/// The recordings of a folder that begin so, by their names.
fn recordings_in(folder: &Path, begin: &str) -> Vec<String> {
    let names = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name());
    let names = names.map(|name| name.into_string().unwrap());
    let mut recordings: Vec<String> =
        names.filter(|name| name.starts_with(begin) && name.ends_with(".mcap")).collect();
    recordings.sort();
    recordings
}

fn recordings(site: &Site, begin: &str) -> Vec<String> {
    recordings_in(&folder_of(site), begin)
}

fn folder_of(site: &Site) -> PathBuf {
    Path::new(&site.path("network.toml")).parent().unwrap().to_owned()
}

/// All that can be read of a recording, whole or torn.
fn entries(recording: &Path) -> Vec<Entry> {
    let mut entries = Vec::new();
    let take = |entry| {
        entries.push(entry);
        Ok::<_, std::convert::Infallible>(())
    };
    RecordingReader::open(recording).unwrap().for_each(take).unwrap();
    entries
}

#[test]
fn recordings_that_follow_one_another_are_each_whole_and_nothing_is_lost_between_them() {
    let site = Site::new(16.0);
    let (network, output) = (site.path("network.toml"), site.path("rolling.mcap"));
    let recorder = site.start(&["record", "-c", &network, "-o", &output, "--rotate-min", "0.05"]);
    let fusion = site.start_fusion();
    let mut agents = site.start_agents(now_seconds() + 3.0, &["--wait-for-recorder"]);
    assert!(agents.iter_mut().all(|agent| agent.wait()));
    assert!(fusion.stop() && recorder.stop());

    let files = recordings(&site, "rolling-");
    assert!(files.len() >= 3, "{files:?}");
    let is_bearing = |channel: &Channel| matches!(channel, Channel::Bearings(_));
    let mut recorded = Vec::new();
    for (place, file) in files.iter().enumerate() {
        let path = site.path(file);
        let info = RecordingInfo::of(Path::new(&path)).unwrap();
        assert!(info.damage.is_none() && info.source.is_some(), "{file}: {info:?}");
        let bearings = messages(Path::new(&path), is_bearing);
        if place > 0 && !bearings.is_empty() {
            // Whoever opens this one alone has the cameras before their first bearing.
            let begins = messages(Path::new(&path), |_| true);
            let first = begins.iter().position(|entry| is_bearing(&entry.key.channel)).unwrap();
            let known: BTreeSet<&Channel> =
                begins[..first].iter().map(|entry| &entry.key.channel).collect();
            let calibrated = known.iter().filter(|one| matches!(one, Channel::Calibration(_)));
            assert_eq!(calibrated.count(), 3, "{file}: {known:?}");
            assert!(known.contains(&Channel::FusionHealth), "{file}: {known:?}");
        }
        recorded.extend(bearings);
    }
    let sent = messages(Path::new(&site.path("source.mcap")), is_bearing);
    let ordered = |mut entries: Vec<Entry>| -> Vec<(Key, Vec<u8>)> {
        entries.sort_by_key(|entry| (entry.data_time, entry.key.clone()));
        entries.into_iter().map(|entry| (entry.key, entry.data)).collect()
    };
    let topics = |entries: &[(Key, Vec<u8>)]| -> Vec<Channel> {
        entries.iter().map(|(key, _)| key.channel.clone()).collect()
    };
    let (recorded, sent) = (ordered(recorded), ordered(sent));
    assert!(topics(&recorded) == topics(&sent), "{} of {}", recorded.len(), sent.len());

    // Those of earlier runs go first.
    let again = site.start(&[
        "record",
        "-c",
        &network,
        "-o",
        &output,
        "--rotate-min",
        "60",
        "--quota-gb",
        "1e-9",
    ]);
    let deadline = Instant::now() + PATIENCE;
    while recordings(&site, "rolling-").iter().any(|file| files.contains(file)) {
        assert!(Instant::now() < deadline, "{:?}", recordings(&site, "rolling-"));
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(again.stop());
    assert_eq!(recordings(&site, "rolling-").len(), 1, "that which was written stays");
    assert!(Path::new(&site.path("source.mcap")).exists());
}

#[test]
fn a_disk_without_room_loses_pictures_and_says_so() {
    let site = Site::new(8.0);
    let (network, output) = (site.path("network.toml"), site.path("live.mcap"));
    // What no disk has is to be left free, so that a tenth of it is not there either.
    let arguments = ["record", "-c", &network, "-o", &output, "--leave-free-gb", "1e9"];
    let recorder = site.start_logged(&arguments, "recorder.log");
    let mut agents = site.start_agents(now_seconds() + 3.0, &["--wait-for-recorder"]);
    assert!(agents.iter_mut().all(|agent| agent.wait()));
    assert!(recorder.stop());
    assert!(
        site.text("recorder.log").contains("the disk is full"),
        "{}",
        site.text("recorder.log")
    );
    let counted = |wanted: &dyn Fn(&Channel) -> bool| {
        messages(Path::new(&output), |channel| wanted(channel)).len()
    };
    let sent = messages(Path::new(&site.path("source.mcap")), |channel| {
        matches!(channel, Channel::Bearings(_))
    });
    assert_eq!(counted(&|channel| matches!(channel, Channel::Bearings(_))), sent.len());
    let info = succeed(&["info", &output]);
    assert!(info.contains("received_no_room") && info.contains("the disk is full"), "{info}");
}

/// Full before anybody looked: what was recorded first goes, and it goes on.
#[test]
fn a_disk_that_is_full_at_once_costs_the_oldest_recording() {
    let unshared = Command::new("unshare").args(["-m", "true"]).status();
    if !unshared.is_ok_and(|status| status.success()) {
        eprintln!("SKIPPED: no disk of one's own can be mounted here (unshare -m, as root)");
        return;
    }
    let site = Site::new(16.0);
    let folder = folder_of(&site);
    ["disk", "out"].iter().for_each(|name| std::fs::create_dir(folder.join(name)).unwrap());
    // A disk of its own, with two recordings of before and next to no room.
    let script = r#"
        mount -t tmpfs -o size=1m tmpfs disk
        head -c 480000 /dev/zero > disk/site-20200101T000000Z.mcap
        head -c 480000 /dev/zero > disk/site-20200102T000000Z.mcap
        "$0" record -c network.toml -o disk/site.mcap --rotate-min 60 --leave-free-gb 0 &
        recorder=$!
        trap 'kill -TERM $recorder' TERM
        wait $recorder
        wait $recorder
        ended=$?
        cp disk/*.mcap out/
        exit $ended
    "#;
    let log = std::fs::File::create(site.path("recorder.log")).unwrap();
    let mut recorder = Command::new("unshare")
        .args(["-m", "bash", "-c", script])
        .arg(program())
        .current_dir(&folder)
        .stderr(log)
        .spawn()
        .unwrap();
    assert!(site.wait_for_line("recorder.log", "recording `test`", PATIENCE));
    let mut agents = site.start_agents(now_seconds() + 1.0, &["--no-wait"]);
    assert!(agents.iter_mut().all(|agent| agent.wait()));
    Command::new("kill").arg(recorder.id().to_string()).status().unwrap();
    assert!(recorder.wait().unwrap().success(), "{}", site.text("recorder.log"));

    let files = recordings_in(&folder.join("out"), "site-");
    assert_eq!(files[0], "site-20200102T000000Z.mcap", "{}", site.text("recorder.log"));
    assert_eq!(files.len(), 3, "one that was torn, and one after it: {files:?}");
    let is_bearing = |entry: &Entry| matches!(entry.key.channel, Channel::Bearings(_));
    let recorded = files[1..].iter().flat_map(|file| entries(&folder.join("out").join(file)));
    let recorded = recorded.filter(is_bearing).count();
    let sent = entries(&folder.join("source.mcap")).into_iter().filter(is_bearing).count();
    // What was written in the second before is lost, twice as much in these times.
    assert!(recorded > sent - sent * 3 / 16, "{recorded} of {sent}");
    assert!(site.text("recorder.log").contains("is removed to make room"));
}

#[test]
fn what_is_left_of_a_torn_recording_becomes_a_whole_one() {
    // Some chunks.
    let site = Site::new(90.0);
    let whole = std::fs::read(site.path("source.mcap")).unwrap();
    let mut hurt = whole[..whole.len() * 2 / 3].to_vec();
    // Damaged in the middle, too.
    let middle = hurt.len() / 2;
    hurt[middle..middle + 40].fill(0x5a);
    std::fs::write(site.path("hurt.mcap"), &hurt).unwrap();
    let (from, to) = (site.path("hurt.mcap"), site.path("whole.mcap"));
    let said = succeed(&["recover", &from, "-o", &to]);
    assert!(said.contains("read back; damaged at byte"), "{said}");
    let info = RecordingInfo::of(Path::new(&to)).unwrap();
    assert!(info.damage.is_none(), "{info:?}");
    assert_eq!(info.source.unwrap().command, "recover of simulate");
    let all = |file: &str| entries(Path::new(&site.path(file)));
    assert!(all("whole.mcap") == all("hurt.mcap") && all("whole.mcap").len() > 100);
    // What was there stays if there is nothing to recover.
    site.write("nothing.mcap", "no recording");
    stderr(&["recover", &site.path("nothing.mcap"), "-o", &to], 1);
    stderr(&["recover", &to, "-o", &to], 1);
    assert!(all("whole.mcap") == all("hurt.mcap"));
}

#[test]
fn a_recorder_that_cannot_record_touches_no_file() {
    let site = Site::new(2.0);
    site.write("today.mcap", "dear");
    let network = site.text("network.toml").replace("tcp/127.0.0.1", "nonsense/127.0.0.1");
    site.write("network.toml", &network);
    let arguments =
        ["record", "-c", &site.path("network.toml"), "-o", &site.path("today.mcap"), "--overwrite"];
    stderr(&arguments, 1);
    assert_eq!(site.text("today.mcap"), "dear");
}

#[test]
fn no_command_writes_onto_what_it_reads() {
    let site = Site::new(2.0);
    let source = site.path("source.mcap");
    let before = std::fs::read(&source).unwrap();
    for arguments in [
        vec!["replay", &source, "--fuse", "-o", &source],
        vec!["view", &source, "--save", &source],
        vec!["export", &source, "--csv", &source],
        vec!["track", &source, "--csv", &source],
    ] {
        let said = stderr(&arguments, 1);
        assert!(arguments[0] != "replay" || said.contains("is what is read"), "{said}");
        assert_eq!(std::fs::read(&source).unwrap(), before, "{arguments:?}");
    }
}

#[test]
fn a_failed_fusion_leaves_the_earlier_tracks_and_no_half_file() {
    let site = Site::new(2.0);
    site.write("tracks.mcap", "earlier tracks");
    site.write("empty.mcap", "");
    let (empty, tracks) = (site.path("empty.mcap"), site.path("tracks.mcap"));
    let said = stderr(&["replay", &empty, "--fuse", "-o", &tracks], 1);
    assert!(said.contains("is empty"), "{said}");
    assert_eq!(site.text("tracks.mcap"), "earlier tracks");
    let left = std::fs::read_dir(site.path("")).unwrap().map(|file| file.unwrap().path());
    assert_eq!(left.filter(|path| path.extension().is_some_and(|e| e == "part")).count(), 0);
}

#[test]
fn what_a_file_lacks_is_said_and_an_unanswered_question_fails() {
    let site = Site::new(20.0);
    let path = |name: &str| site.path(name);
    succeed(&["-q", "replay", &path("source.mcap"), "--fuse", "-o", &path("tracks.mcap")]);
    let whole = std::fs::read(path("tracks.mcap")).unwrap();
    site.write("empty.mcap", "");
    std::fs::write(path("torn.mcap"), &whole[..whole.len() / 2]).unwrap();
    // A file of a newer version: all its messages are there, and none can be read.
    let mut newer = RecordingWriter::create(Path::new(&path("newer.mcap"))).unwrap();
    for entry in messages(Path::new(&path("tracks.mcap")), |c| *c == Channel::Tracks) {
        let mut frame: TrackFrame = decode(&entry.data).unwrap();
        frame.version = Some(Version { major: 9, minor: 0 });
        newer.write(&Entry { data: frame.encode_unstamped(), ..entry }).unwrap();
    }
    newer.finish().unwrap();

    let (csv, rrd) = (path("out.csv"), path("out.rrd"));
    for (file, words) in [("empty.mcap", "is empty"), ("newer.mcap", "update this side")] {
        let file = path(file);
        for arguments in [
            vec!["export", &file, "--csv", &csv],
            vec!["evaluate", &file],
            vec!["view", &file, "--save", &rrd],
        ] {
            let said = stderr(&arguments, 1);
            assert!(said.contains(words), "{arguments:?}: {said}");
        }
        assert!(!Path::new(&csv).exists() && !Path::new(&rrd).exists());
    }
    stderr(&["info", &path("empty.mcap")], 1);
    assert!(stderr(&["info", &path("newer.mcap")], 1).contains("they are of a newer version"));
    let evaluate = ["evaluate", &path("tracks.mcap"), "--truth", &path("source.mcap")];
    let late = [&evaluate[..], &["--skip-s", "1000"]].concat();
    assert!(stderr(&late, 1).contains("none is at least 1000 s after the first"));
    // A sky with nothing in it: the recording is written, and the question is not answered.
    let mut empty_sky = RecordingWriter::create(Path::new(&path("sky.mcap"))).unwrap();
    for entry in messages(Path::new(&path("source.mcap")), |_| true) {
        let data = match entry.key.channel {
            Channel::Bearings(_) => {
                let frame: BearingFrame = decode(&entry.data).unwrap();
                BearingFrame { tracks: Vec::new(), ..frame }.encode_unstamped()
            }
            _ => entry.data.clone(),
        };
        empty_sky.write(&Entry { data, ..entry }).unwrap();
    }
    empty_sky.finish().unwrap();
    let said = stderr(&["replay", &path("sky.mcap"), "--fuse", "-o", &path("none.mcap")], 1);
    assert!(said.contains("no target found in"), "{said}");
    assert!(succeed(&["info", &path("none.mcap")]).contains("complete"));
    for arguments in [
        vec!["export", &path("torn.mcap"), "--csv", &csv],
        vec!["evaluate", &path("torn.mcap"), "--truth", &path("source.mcap")],
        vec!["view", &path("torn.mcap"), "--save", &rrd],
    ] {
        let said = stderr(&arguments, 0);
        assert!(said.contains("torn.mcap is damaged at byte"), "{arguments:?}: {said}");
    }
    let info = succeed(&["info", &path("torn.mcap")]);
    assert!(info.contains("damaged at byte"), "{info}");
    assert!(stderr(&["info", &csv], 1).contains("is no MCAP file"));
}

#[test]
fn a_range_without_data_is_an_error() {
    let site = Site::new(4.0);
    let (source, tracks) = (site.path("source.mcap"), site.path("tracks.mcap"));
    let replay = |options: &[&str], code: i32| {
        stderr(&[&["replay", &source, "--fuse", "-o", &tracks], options].concat(), code)
    };
    assert!(replay(&["--from", "3", "--to", "2"], 2).contains("is not before"));
    assert!(replay(&["--from", "1000"], 1).contains("behind the end"));
    for bad in ["nan", "-1", "1e400"] {
        assert!(replay(&["--from", bad], 2).contains("invalid value"), "{bad}");
    }
    let onto = |network: &str, speed: &str, code: i32| {
        stderr(&["replay", &source, "--network", network, "--speed", speed], code)
    };
    for bad in ["-1", "1e-300"] {
        assert!(onto(&site.path("network.toml"), bad, 2).contains("0, or from 0.01 to 1000"));
    }
    // A network of other cameras.
    let foreign = site.path("foreign.toml");
    let cameras = "fusion = \"tcp/127.0.0.1:3\"\n[cameras]\nfar = \"tcp/127.0.0.1:1\"\nfarther = \"tcp/127.0.0.1:2\"\n";
    std::fs::write(&foreign, format!("site = \"elsewhere\"\nunsecured = true\n{cameras}")).unwrap();
    let said = onto(&foreign, "0", 1);
    assert!(said.contains("the network of site `elsewhere` lacks cameras of"), "{said}");
}

#[test]
fn a_fused_recording_keeps_previews_health_and_where_calibrations_change() {
    let site = Site::new(4.0);
    let source = site.path("source.mcap");
    // The same flight with pictures and health, and a camera that is moved by a metre after two
    // seconds.
    let mut writer = RecordingWriter::create(Path::new(&site.path("rich.mcap"))).unwrap();
    let mut entries = messages(Path::new(&source), |_| true);
    let name = site.world().cameras()[0].name().clone();
    let first = entries
        .iter()
        .find(|entry| entry.key.channel == Channel::Calibration(name.clone()))
        .unwrap();
    let mut moved: CameraCalibration = decode(&first.data).unwrap();
    let at = Timestamp::from_seconds(2.0);
    moved.valid_from_ns = at.nanos();
    moved.position.as_mut().unwrap().x += 1.0;
    let key = |channel| Key { channel, ..first.key.clone() };
    let preview =
        Preview { camera: name.to_string(), capture_time_ns: at.nanos(), ..Default::default() };
    let health = Health { component: name.to_string(), time_ns: at.nanos(), ..Default::default() };
    let more = [
        (Channel::Calibration(name.clone()), moved.encode()),
        (Channel::Preview(name.clone()), preview.encode()),
        (Channel::CameraHealth(name.clone()), health.encode()),
    ]
    .map(|(channel, data)| Entry { key: key(channel), data_time: at, arrival: at, data });
    entries.extend(more.clone());
    entries.sort_by_key(|entry| entry.data_time);
    entries.iter().for_each(|entry| writer.write(entry).unwrap());
    writer.finish().unwrap();
    succeed(&["-q", "replay", &site.path("rich.mcap"), "--fuse", "-o", &site.path("tracks.mcap")]);

    let kept = messages(Path::new(&site.path("tracks.mcap")), |_| true);
    for entry in &more {
        assert_eq!(kept.iter().filter(|other| *other == entry).count(), 1, "{}", entry.key);
    }
    assert!(kept.iter().any(|entry| entry.key.channel == Channel::FusionHealth));
    // Before the camera was moved, the tracks are those of a flight in which it never was.
    succeed(&["-q", "replay", &source, "--fuse", "-o", &site.path("unmoved.mcap")]);
    let before = |file: &str| -> Vec<Vec<u8>> {
        let tracks = messages(Path::new(&site.path(file)), |channel| *channel == Channel::Tracks);
        tracks.into_iter().filter(|entry| entry.data_time < at).map(|entry| entry.data).collect()
    };
    assert!(before("tracks.mcap").len() > 20);
    assert_eq!(before("tracks.mcap"), before("unmoved.mcap"));
}

#[test]
fn the_recorder_says_what_it_did_not_get_and_nothing_lies_in_1970() {
    let site = Site::new(2.0);
    let recorder = site.start_recorder("live.mcap");
    let link = Link::open(site.network(), &Role::Cameras { and_fusion: false }).unwrap();
    let health_key = Key::new(link.site().clone(), Channel::RecorderHealth).to_string();
    let health = link.subscribe(&[health_key]).unwrap();
    link.wait_for(&[Channel::RecorderAlive], PATIENCE, || true).unwrap();
    std::thread::sleep(Duration::from_millis(500));

    let camera = &site.world().cameras()[0];
    let name = camera.name().clone();
    let key = |channel: Channel| Key::new(link.site().clone(), channel);
    // Said before any data, and valid since long ago.
    let calibration = CameraCalibration::new(&name, camera.camera(), Timestamp::EPOCH).encode();
    link.put(&key(Channel::Calibration(name.clone())), calibration).unwrap();
    link.put(&key(Channel::CameraHealth(name.clone())), Health::default().encode()).unwrap();
    let bearings = link.publisher(Channel::Bearings(name.clone()), Delivery::Queued).unwrap();
    let begun = now_seconds();
    let frame = |sequence: u64| BearingFrame {
        camera: name.to_string(),
        sequence,
        capture_time_ns: Timestamp::from_seconds(begun + 0.1 * sequence as f64).nanos(),
        ..Default::default()
    };
    for sequence in 0..10 {
        bearings.put(frame(sequence).encode()).unwrap();
    }
    let newer = BearingFrame { version: Some(Version { major: 9, minor: 0 }), ..frame(10) };
    bearings.put(newer.encode_unstamped()).unwrap();
    link.put(&key(Channel::Bearings(name.clone())), vec![0xff; 40]).unwrap();
    // As many names as a file has room for, and more: none of them is one of the site's.
    for number in 0..70_000 {
        let stranger = format!("stranger-{number}").parse().unwrap();
        link.put(&key(Channel::Bearings(stranger)), frame(0).encode()).unwrap();
    }
    // A second program under the name of the first.
    let second = Link::open(site.network(), &Role::Cameras { and_fusion: true });
    assert!(second.is_err(), "its endpoint is taken");
    let counted = |health: &Health, name: &str| {
        health
            .counters
            .iter()
            .find(|counter| counter.name == name)
            .map_or(0, |counter| counter.value)
    };
    let deadline = Instant::now() + PATIENCE;
    let mut said = Health::default();
    let last = loop {
        assert!(Instant::now() < deadline, "the recorder's health does not say it: {said:?}");
        let Some(received) = health.next(Duration::from_millis(100)) else { continue };
        let health: Health = decode(&received.data).unwrap();
        said.clone_from(&health);
        let foreign =
            counted(&health, "received_foreign_camera") + counted(&health, "received_dropped");
        if foreign >= 70_000 {
            break health;
        }
    };
    assert_eq!(counted(&last, "received_malformed"), 1);
    assert_eq!(counted(&last, "received_newer_version"), 1);
    assert!(last.run != 0 && !last.host.is_empty());
    let (took, code) = recorder.terminate();
    assert!(took < Duration::from_secs(2) && code == Some(0), "{took:?}");

    let recorded = messages(Path::new(&site.path("live.mcap")), |_| true);
    let frames =
        recorded.iter().filter(|entry| matches!(entry.key.channel, Channel::Bearings(_))).count();
    assert_eq!(frames, 11, "the newer one is kept");
    let early =
        recorded.iter().filter(|entry| entry.data_time < Timestamp::from_seconds(begun - 1.0));
    assert_eq!(early.map(|entry| entry.key.to_string()).collect::<Vec<_>>(), Vec::<String>::new());
    let info = succeed(&["info", &site.path("live.mcap")]);
    assert!(info.contains("written by crossfix") && info.contains("record, run "), "{info}");
    assert!(info.contains("`recorder` counted") && info.contains("received_malformed 1"), "{info}");
}
