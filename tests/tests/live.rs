//! Network cameras: a site of them, what becomes of an agent whose camera fails, and cameras that
//! others have made.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that measures says what it found"
)]

use std::net::TcpListener;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use crossfix_message::{BearingFrame, Channel, ClockSource, Health, decode};
use crossfix_tests::{Process, Site, crossfix, messages, now_seconds, program, succeed};

/// An address of this machine that nobody uses now.
fn free_address() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

/// A site whose cameras are network cameras at an address, that find targets by themselves.
fn live_site(duration_s: f64, address: &str) -> Site {
    let site = Site::new(duration_s);
    site.write("fusion.toml", "network = \"network.toml\"\n");
    for camera in site.world().cameras() {
        let (name, clock) = (camera.name(), &camera.description().clock);
        let (offset_s, drift_ppm) = (clock.offset_s, clock.drift_ppm);
        site.write_camera(
            name.as_str(),
            &format!("kind = \"stream\"\nurl = \"rtsp://eye:hunter2@{address}/{name}\""),
            &format!("clock = {{ offset_s = {offset_s}, drift_ppm = {drift_ppm} }}"),
        );
    }
    site
}

fn cameras(site: &Site, address: &str, more: &[&str]) -> Process {
    let scene = site.path("scene.toml");
    site.start(&[&["simulate", &scene, "--rtsp", address], more].concat())
}

fn agent(site: &Site, name: &str) -> Process {
    let file = site.path(&format!("{name}.toml"));
    site.start_logged(&["agent", "-c", &file], &format!("{name}.log"))
}

/// What an agent said of itself, second by second.
fn healths(site: &Site, recording: &str, name: &str) -> Vec<Health> {
    let of_camera = |channel: &Channel| *channel == Channel::CameraHealth(name.parse().unwrap());
    let entries = messages(Path::new(&site.path(recording)), of_camera);
    entries.iter().map(|entry| decode(&entry.data).unwrap()).collect()
}

fn bearings(site: &Site, recording: &str, name: &str) -> Vec<BearingFrame> {
    let of_camera = |channel: &Channel| *channel == Channel::Bearings(name.parse().unwrap());
    let entries = messages(Path::new(&site.path(recording)), of_camera);
    entries.iter().map(|entry| decode(&entry.data).unwrap()).collect()
}

fn counter(health: &Health, name: &str) -> u64 {
    health.counters.iter().find(|counter| counter.name == name).unwrap().value
}

#[test]
fn three_network_cameras_are_a_site() {
    let address = free_address();
    let site = live_site(16.0, &address);
    let fusion = site.start_logged(&["fuse", "-c", &site.path("fusion.toml")], "fusion.log");
    let recorder = site.start_recorder("live.mcap");
    let agents: Vec<Process> = ["north", "east", "west"].map(|name| agent(&site, name)).into();
    let begins = format!("{:.3}", now_seconds() + 2.0);
    let truth = site.path("truth.mcap");
    let mut playing = cameras(&site, &address, &["--start-at", &begins, "-o", &truth]);
    assert!(playing.wait());
    assert!(agents.into_iter().all(Process::stop));
    assert!(fusion.stop() && recorder.stop());

    for name in ["north", "east", "west"] {
        let frames = bearings(&site, "live.mcap", name);
        let of = |source| frames.iter().filter(|f| f.clock_source() == source).count();
        let (arrival, camera) = (of(ClockSource::Arrival), of(ClockSource::Camera));
        assert!(arrival > 20 && camera > 200 && arrival + camera == frames.len(), "{name}");
        // When the cameras have ended and an agent still asks, nothing tells it the time.
        let healths = healths(&site, "live.mcap", name);
        assert!(healths.iter().filter(|health| counter(health, "synchronised") == 1).count() >= 8);
        let last = healths.last().unwrap();
        assert!(counter(last, "stream_opened") >= 1, "{last:?}");
        assert_eq!(counter(last, "bad_frames"), 0, "{last:?}");
        assert!(!site.text(&format!("{name}.log")).contains("hunter2"));
    }
    // That a clock became known in the flight turns no camera.
    assert!(!site.text("fusion.log").contains("has been moved"), "{}", site.text("fusion.log"));
    let live = site.path("live.mcap");
    let found = succeed(&["evaluate", &live, "--truth", &truth, "--skip-s", "4", "--json"]);
    let found: serde_json::Value = serde_json::from_str(&found).unwrap();
    println!("{found:#}");
    let of = |key: &str| found[key].as_f64().unwrap();
    assert!(of("position_rmse_m") < 0.15 && of("completeness") > 0.99, "{found:#}");
    assert!(found["nees"]["mean"].as_f64().unwrap() < 12.0, "{found:#}");
}

#[test]
fn an_agent_whose_camera_fails_says_so_and_sees_again_when_it_is_back() {
    let address = free_address();
    let site = live_site(60.0, &address);
    let recorder = site.start_recorder("live.mcap");
    let agent = agent(&site, "north");
    let says = |words: &str, times: usize| {
        site.wait_for_lines("north.log", words, times, Duration::from_secs(10))
    };
    // There is no camera yet.
    assert!(says("Connection refused", 1));
    let first = cameras(&site, &address, &[]);
    assert!(says("sees again", 1));
    std::thread::sleep(Duration::from_secs(4));
    let losses = site.text("north.log").matches("going on").count();
    first.crash();
    assert!(says("going on", losses + 1), "{}", site.text("north.log"));
    std::thread::sleep(Duration::from_secs(3));
    let second = cameras(&site, &address, &[]);
    assert!(says("sees again", 2), "{}", site.text("north.log"));
    std::thread::sleep(Duration::from_secs(4));
    let losses = site.text("north.log").matches("going on").count();
    second.crash();
    // The agent has noticed before it is told to end, however busy this machine is.
    assert!(says("going on", losses + 1), "{}", site.text("north.log"));
    assert!(agent.stop() && recorder.stop());
    assert!(!site.text("north.log").contains("hunter2"));

    let frames = bearings(&site, "live.mcap", "north");
    let interval_s =
        |f: &[BearingFrame]| (f[1].capture_time_ns - f[0].capture_time_ns) as f64 * 1e-9;
    let longest = frames.windows(2).max_by(|a, b| interval_s(a).total_cmp(&interval_s(b)));
    let longest = longest.unwrap();
    assert!((2.0..9.0).contains(&interval_s(longest)), "{}", interval_s(longest));
    assert_eq!(longest[1].sequence, longest[0].sequence + 2, "the gap is seen");
    assert!(frames.len() > 150, "{}", frames.len());
    let healths = healths(&site, "live.mcap", "north");
    let sees_nothing = |health: &Health| {
        health.problems.iter().any(|problem| problem.starts_with("sees nothing: "))
    };
    assert!(sees_nothing(healths.last().unwrap()), "{:?}", healths.last());
    let changes = healths.windows(2).filter(|h| sees_nothing(&h[0]) != sees_nothing(&h[1])).count();
    assert!(changes >= 3, "it is away at the end, came back, was away: {changes}");
    assert!(healths.iter().all(|health| !format!("{health:?}").contains("hunter2")));
}

#[test]
fn a_stream_that_the_lens_is_not_for_is_said_and_nothing_is_made_of_it() {
    let address = free_address();
    let site = live_site(60.0, &address);
    let lens = site.text("north.yaml").replace("image_width: 640", "image_width: 1280");
    site.write("north.yaml", &lens);
    let recorder = site.start_recorder("live.mcap");
    let (agent, playing) = (agent(&site, "north"), cameras(&site, &address, &[]));
    let says = |words: &str| site.wait_for_line("north.log", words, Duration::from_secs(10));
    assert!(says("its intrinsics are for 1280x480"));
    std::thread::sleep(Duration::from_secs(2));
    assert!(!agent.stop(), "an agent that has made nothing of what it saw has failed");
    assert!(playing.stop() && recorder.stop());
    assert!(bearings(&site, "live.mcap", "north").is_empty());
    let last = healths(&site, "live.mcap", "north").pop().unwrap();
    assert!(last.problems.iter().any(|problem| problem.contains("1280x480")), "{last:?}");
    assert!(counter(&last, "bad_frames") > 20, "{last:?}");
}

#[test]
fn the_doctor_says_what_a_live_site_lacks() {
    let address = free_address();
    let site = live_site(60.0, &address);
    let doctor = |file: &str| {
        let output = crossfix(&["doctor", "-c", &site.path(file), "--json"]);
        let found: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let verdict = |what: &str| {
            let finding = found.as_array().unwrap().iter().find(|f| f["what"] == what).unwrap();
            let verdict = finding["verdict"].as_str().unwrap().to_owned();
            assert_eq!(verdict == "pass", finding["mend"].is_null(), "{finding}");
            verdict
        };
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(!said.contains("hunter2"), "{said}");
        println!("{said}");
        (["camera", "north", "fusion centre", "lens", "camera clock", "decoder", "endpoint"])
            .map(|what| said.contains(&format!("\"{what}\"")).then(|| verdict(what)))
    };
    let fail = || Some("fail".to_owned());
    let pass = || Some("pass".to_owned());
    assert_eq!(doctor("north.toml")[0], fail(), "there is no camera");
    let playing = cameras(&site, &address, &[]);
    std::thread::sleep(Duration::from_secs(1));
    let [camera, .., lens, clock, _, endpoint] = doctor("north.toml");
    assert_eq!([camera, lens, clock, endpoint], [pass(), pass(), pass(), pass()]);
    let fusion = site.start_fusion();
    std::thread::sleep(Duration::from_secs(2));
    let [_, north, fusion_centre, ..] = doctor("fusion.toml");
    assert_eq!([north, fusion_centre], [fail(), pass()]);
    assert!(fusion.stop() && playing.stop());
}

/// What `crossfix sources` finds of streams of cameras by GStreamer, in a network namespace of
/// their own; `None` where there can be none, and a clear word.
fn peers(login: &str, tried: &[&str]) -> Option<Vec<serde_json::Value>> {
    let python = "/usr/bin/python3";
    let imports = "import gi; gi.require_version('GstRtspServer', '1.0'); \
                   gi.require_version('Gst', '1.0'); from gi.repository import Gst; \
                   Gst.init(None); assert Gst.ElementFactory.find('x264enc'); \
                   assert Gst.ElementFactory.find('x265enc')";
    let works = |program: &str, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).output();
        output.is_ok_and(|output| output.status.success())
    };
    if !works("unshare", &["-n", "true"]) || !works(python, &["-c", imports]) {
        eprintln!(
            "SKIPPED: cameras by GStreamer need root, `unshare` and apt-get install \
             gir1.2-gst-rtsp-server-1.0 python3-gi gstreamer1.0-plugins-base \
             gstreamer1.0-plugins-good gstreamer1.0-plugins-bad gstreamer1.0-plugins-ugly"
        );
        return None;
    }
    let server = concat!(env!("CARGO_MANIFEST_DIR"), "/peers/rtsp_server.py");
    let crossfix = program();
    let tries: Vec<String> = tried
        .iter()
        .map(|arguments| format!("{} sources --json {arguments}\necho ,\n", crossfix.display()))
        .collect();
    let script = format!(
        "ip link set lo up\n{python} {server} 8554 {login} > server.log 2>&1 &\n\
         for i in $(seq 100); do grep -q ready server.log && break; sleep 0.1; done\n\
         {}kill $!\n",
        tries.concat()
    );
    let folder = tempfile::tempdir().unwrap();
    let output = Command::new("unshare")
        .args(["-n", "sh", "-c", &script])
        .current_dir(folder.path())
        .output()
        .unwrap();
    let said = String::from_utf8(output.stdout).unwrap();
    println!("{said}{}", String::from_utf8_lossy(&output.stderr));
    let list = format!("[{}]", said.trim_end().trim_end_matches(','));
    Some(serde_json::from_str(&list).unwrap())
}

#[test]
fn cameras_that_others_have_made_are_watched() {
    let url = "rtsp://127.0.0.1:8554";
    let tries = [
        format!("{url}/h264 --seconds 6"),
        format!("{url}/h264 --seconds 6 --udp"),
        format!("{url}/reordered --seconds 6"),
        format!("{url}/jpeg --seconds 6"),
        format!("{url}/h265 --seconds 2"),
        format!("{url}/none --seconds 2"),
    ];
    let Some(found) = peers("none", &tries.each_ref().map(String::as_str)) else { return };
    for tried in &found[..4] {
        let of = |key: &str| tried[key].as_f64().unwrap();
        assert_eq!((of("width"), of("height")), (640.0, 480.0));
        assert!((28.0..32.0).contains(&of("rate_hz")), "{tried}");
        assert_eq!((of("bad_frames"), of("left_out")), (0.0, 0.0));
        assert!(of("frames") > 120.0, "{tried}");
        // They are as truthful as this host, and pictures come after their exposure.
        let late_s = of("arrival_after_capture_s");
        assert!((0.0..0.6).contains(&late_s), "{tried}");
    }
    let trouble = |tried: &serde_json::Value| tried["troubles"][0].as_str().unwrap().to_owned();
    assert!(trouble(&found[4]).contains("set the camera to H.264"), "{found:?}");
    assert!(trouble(&found[5]).contains("no stream at this path"), "{found:?}");
}

#[test]
fn cameras_that_others_have_made_are_logged_in_to() {
    for kind in ["basic", "digest"] {
        let [right, wrong] = ["eye:secret", "eye:hunter2"]
            .map(|who| format!("rtsp://{who}@127.0.0.1:8554/h264 --seconds 2"));
        let Some(found) = peers(kind, &[&right, &wrong]) else { return };
        assert!(found[0]["frames"].as_u64().unwrap() > 20, "{kind}: {found:?}");
        let trouble = found[1]["troubles"][0].as_str().unwrap();
        assert!(trouble.contains("user or password are wrong"), "{kind}: {trouble}");
        assert!(!trouble.contains("hunter2"));
    }
}

#[test]
fn a_stream_that_is_none_is_refused_before_anything_starts() {
    let site = live_site(1.0, "127.0.0.1:1");
    for (source, says) in [
        ("url = \"http://eye:hunter2@10.0.0.5/\"", "it does not begin with rtsp://"),
        ("url = \"rtsp://10.0.0.5/\"\nuser = \"eye\"", "password_file"),
        ("url = \"rtsp://10.0.0.5/\"\nlatency_s = -1.0", "from 0 to 10 s"),
        ("url = \"rtsp://10.0.0.5/\"\ntransport = \"tpc\"", "expected `tcp` or `udp`"),
    ] {
        site.write_camera("north", &format!("kind = \"stream\"\n{source}"), "");
        let output = crossfix(&["check", "-c", &site.path("north.toml")]);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && said.contains(says), "{said}");
        assert!(!said.contains("hunter2"), "{said}");
    }
}
