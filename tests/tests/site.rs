//! Real processes joined by Zenoh over loopback.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a test that cannot set itself up has failed"
)]

use std::path::Path;
use std::time::{Duration, Instant};

use crossfix_message::{Channel, Key, TrackFrame, TrackState, decode};
use crossfix_recording::Entry;
use crossfix_simulation::Scene;
use crossfix_tests::{PATIENCE, Site, followed_rows, messages, now_seconds, succeed};

fn tracks(recording: &str) -> Vec<Entry> {
    messages(Path::new(recording), |channel| *channel == Channel::Tracks)
}

fn bytes(entries: &[Entry]) -> Vec<&[u8]> {
    entries.iter().map(|entry| &entry.data[..]).collect()
}

#[test]
fn live_and_offline_fusion_give_the_same_bytes() {
    let site = Site::new(6.0);
    let recorder = site.start_recorder("live.mcap");
    let fusion = site.start_fusion();
    let mut agents = site.start_agents(now_seconds() + 3.0, &["--wait-for-recorder"]);
    assert!(agents.iter_mut().all(|agent| agent.wait()));
    assert!(fusion.stop());
    assert!(recorder.stop());

    let is_bearing = |channel: &Channel| matches!(channel, Channel::Bearings(_));
    let sent = messages(Path::new(&site.path("source.mcap")), is_bearing);
    let mut recorded = messages(Path::new(&site.path("live.mcap")), is_bearing);
    recorded.sort_by_key(|entry| (entry.data_time, entry.key.clone()));
    assert_eq!(recorded.len(), sent.len(), "nothing is lost on the way");

    let replay = |output: &str| {
        let (live, fusion) = (site.path("live.mcap"), site.path("fusion.toml"));
        succeed(&["-q", "replay", &live, "--fuse", "-c", &fusion, "-o", &site.path(output)]);
        tracks(&site.path(output))
    };
    let live = tracks(&site.path("live.mcap"));
    let (once, twice) = (replay("once.mcap"), replay("twice.mcap"));
    assert!(live.len() > 200, "{} track frames", live.len());
    assert_eq!(bytes(&once), bytes(&twice), "offline twice");
    assert_eq!(bytes(&live), bytes(&once), "live and offline");
}

#[test]
fn a_screen_shows_how_a_site_does() {
    let site = Site::new(60.0);
    let fusion = site.start_fusion();
    let mut agents = site.start_agents(now_seconds() + 2.0, &[]);
    std::thread::sleep(Duration::from_secs(5));
    let network = site.path("network.toml");
    let said = succeed(&["status", "-c", &network, "--json"]);
    let status: serde_json::Value = serde_json::from_str(&said).unwrap();
    let parts = status["parts"].as_array().unwrap();
    let named: Vec<&str> = parts.iter().map(|part| part["name"].as_str().unwrap()).collect();
    assert_eq!(named, ["east", "north", "west", "fusion"], "{said}");
    for part in parts {
        assert!(part["state"] == "good" && part["rate_hz"].as_f64().unwrap() > 5.0, "{said}");
    }
    assert!(status["confirmed"].as_u64().unwrap() >= 1, "{said}");
    agents.remove(0).crash();
    let text = succeed(&["status", "-c", &network]);
    assert!(text.contains("site `test`") && text.contains("confirmed tracks"), "{text}");
    // The fusion centre says who is gone, and one who is gone says nothing.
    assert!(
        text.lines().any(|line| line.contains("silent") || line.contains("not heard")),
        "{text}"
    );
    assert!(text.lines().any(|line| line.starts_with("fusion: ")), "{text}");
    assert!(fusion.stop());
}

#[test]
fn agents_wait_for_the_fusion_centre_and_a_new_one_picks_them_up() {
    let site = Site::new(40.0);
    let ear = site.ear();
    let keys = [Key::new(ear.site().clone(), Channel::Tracks).to_string()];
    let subscription = ear.subscribe(&keys).unwrap();
    // The agents are up first.
    let _agents = site.start_agents(now_seconds() + 2.0, &[]);
    std::thread::sleep(Duration::from_secs(1));
    let confirmed_within = |patience: Duration| -> Option<Vec<u64>> {
        let deadline = Instant::now() + patience;
        while Instant::now() < deadline {
            let Some(received) = subscription.next(Duration::from_millis(50)) else { continue };
            let frame: TrackFrame = decode(&received.data).unwrap();
            if frame.tracks.iter().any(|track| track.state() == TrackState::Confirmed) {
                return Some(frame.tracks.iter().map(|track| track.id).collect());
            }
        }
        None
    };
    let first = site.start_fusion();
    let before = confirmed_within(PATIENCE).expect("the first fusion centre has tracks");
    first.crash();
    while subscription.next(Duration::from_millis(200)).is_some() {}
    let second = site.start_fusion();
    let after = confirmed_within(Duration::from_secs(5)).expect("the second has tracks within 5 s");
    assert!(
        after.iter().all(|id| !before.contains(id)),
        "{before:?} and {after:?}: no track is another's"
    );
    assert!(second.stop());
}

#[test]
fn the_agent_follows_what_the_track_command_follows() {
    let site = Site::new(4.0);
    // The target is there from the first frame on.
    let mut scene: Scene =
        toml::from_str(&std::fs::read_to_string(site.path("scene.toml")).unwrap()).unwrap();
    scene.targets.iter_mut().for_each(|target| target.appears_s = 0.0);
    std::fs::write(site.path("scene.toml"), toml::to_string(&scene).unwrap()).unwrap();
    succeed(&["simulate", &site.path("scene.toml"), "--video", &site.path("video")]);
    let world = scene.build().unwrap();
    let camera = world.camera("north").unwrap();
    let target = world.truth(camera.true_time(0))[0].position;
    let middle = camera.camera().project(target).unwrap();
    let (left, top) = (middle.x() - 9.5, middle.y() - 6.5);
    let place = format!("{left},{top},20,14");
    let source =
        "kind = \"video\"\npath = \"video/north.y4m\"\nspeed = 0.0\n[preview]\nrate_hz = 0.0";
    site.write_camera("north", source, &format!("boxes = [[{left:.6}, {top:.6}, 20.0, 14.0]]"));
    let recorder = site.start_recorder("live.mcap");
    let fusion = site.start_fusion();
    let mut agent = site.start(&["agent", "-c", &site.path("north.toml"), "--wait-for-recorder"]);
    assert!(agent.wait());
    assert!(fusion.stop() && recorder.stop());
    let (video, table) = (site.path("video/north.y4m"), site.path("north.csv"));
    succeed(&["track", &video, "--box", &place, "--csv", &table]);

    let rows = followed_rows(Path::new(&table));
    let frames =
        messages(Path::new(&site.path("live.mcap")), |c| matches!(c, Channel::Bearings(_)));
    assert_eq!(frames.len(), 120);
    let mut compared = 0;
    for (entry, row) in frames.iter().zip(rows) {
        let frame: crossfix_message::BearingFrame = decode(&entry.data).unwrap();
        let index = row.frame;
        assert_eq!(frame.sequence, index);
        let track = &frame.tracks[0];
        // The table has the filter's estimate, the wire the measurement: of a target that is seen,
        // they agree to a measurement's noise.
        let [cx, cy] = row.middle().unwrap().map(|middle| middle - 0.5);
        assert!((track.pixel_x - cx).hypot(track.pixel_y - cy) < 0.5, "frame {index}: {track:?}");
        compared += 1;
    }
    assert_eq!(compared, 120);
}

#[test]
fn the_demo_finds_both_targets() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().display().to_string();
    let report = succeed(&["-q", "demo", "--duration", "8", "--json", "--output", &output]);
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    for target in report["targets"].as_array().unwrap() {
        assert_eq!(target["detected"], true, "{report}");
        assert!(target["position_rmse_m"].as_f64().unwrap() < 0.5, "{report}");
    }
    assert_eq!(report["false_tracks"], 0, "{report}");
    assert!(folder.path().join("demo.rrd").metadata().unwrap().len() > 10_000);
}
