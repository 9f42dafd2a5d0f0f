//! Whoever is asked to stop does so within two seconds, whatever comes in, and leaves whole files.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test that cannot set itself up has failed"
)]

use std::path::Path;
use std::process::Output;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crossfix_message::{BearingFrame, CameraCalibration, CameraName, Channel, Payload, Timestamp};
use crossfix_tests::{PATIENCE, Process, Site, free_network, messages, now_seconds};
use crossfix_transport::{Delivery, Link, NetworkConfig, Role};

/// What a person, and systemd, are told that it takes.
const LIMIT: Duration = Duration::from_secs(2);

/// Threads that publish as cameras do until they are dropped.
struct Traffic {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Traffic {
    /// Frames of every camera of a network, at the camera's rate.
    fn new(network: &NetworkConfig, site: &Site, rate_hz: f64) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let link = Arc::new(Link::open(network, &Role::Cameras { and_fusion: false }).unwrap());
        let template = site.world().cameras()[0].camera().clone();
        let publish = |name: &CameraName| {
            let (stop, link, name, camera) =
                (Arc::clone(&stop), Arc::clone(&link), name.clone(), template.clone());
            std::thread::spawn(move || {
                let alive = link.declare_alive(Channel::Alive(name.clone())).unwrap();
                let bearings =
                    link.publisher(Channel::Bearings(name.clone()), Delivery::Queued).unwrap();
                let calibrations =
                    link.publisher(Channel::Calibration(name.clone()), Delivery::Queued).unwrap();
                let calibration = CameraCalibration::new(&name, &camera, Timestamp::EPOCH).encode();
                for sequence in 0.. {
                    if stop.load(Ordering::Relaxed) {
                        break;
                    }
                    if sequence % 50 == 0 {
                        calibrations.put(calibration.clone()).unwrap();
                    }
                    let time = Timestamp::from_seconds(now_seconds());
                    let frame = BearingFrame {
                        camera: name.to_string(),
                        sequence,
                        capture_time_ns: time.nanos(),
                        ..Default::default()
                    };
                    bearings.put(frame.encode()).unwrap();
                    std::thread::sleep(Duration::from_secs_f64(1.0 / rate_hz));
                }
                drop(alive);
            })
        };
        let threads = network.cameras.keys().map(publish).collect();
        Self { stop, threads }
    }
}

impl Drop for Traffic {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

fn wait_until_recorded(path: &str, bytes: u64) {
    let deadline = Instant::now() + PATIENCE;
    while Path::new(path).metadata().map_or(0, |file| file.len()) < bytes {
        assert!(Instant::now() < deadline, "nothing is recorded");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Stops the recorder and the fusion centre in the middle of the traffic of several cameras.
fn stop_under_traffic(cameras: usize, rate_hz: f64) {
    let site = Site::new(2.0);
    let names = (0..cameras).map(|number| format!("camera-{number}").parse().unwrap());
    let network = free_network(names);
    site.write("network.toml", &toml::to_string(&network).unwrap());
    let recorder = site.start_recorder("live.mcap");
    let fusion = site.start_fusion();
    let traffic = Traffic::new(&network, &site, rate_hz);
    wait_until_recorded(&site.path("live.mcap"), 50_000);
    let stop = |what: &str, process: Process| {
        let (took, code) = process.terminate();
        println!("{what}, {cameras} cameras at {rate_hz} Hz: ended after {took:?}");
        assert!(took < LIMIT, "{what} took {took:?} while {cameras} cameras published");
        assert_eq!(code, Some(0), "{what}");
    };
    stop("record", recorder);
    stop("fuse", fusion);
    drop(traffic);
    // Whole, with its index: `messages` wants no damage.
    let recorded =
        messages(Path::new(&site.path("live.mcap")), |c| matches!(c, Channel::Bearings(_)));
    assert!(recorded.len() > 10 * cameras, "{} frames of {cameras} cameras", recorded.len());
}

#[test]
fn record_and_fuse_end_while_three_cameras_publish() {
    stop_under_traffic(3, 30.0);
}

#[test]
fn record_and_fuse_end_while_64_cameras_publish() {
    stop_under_traffic(64, 10.0);
}

#[test]
fn a_fusion_centre_whose_router_is_not_there_says_so_and_ends_when_asked() {
    let site = Site::new(2.0);
    let mut network = site.network().clone();
    network.mode = crossfix_transport::Mode::Client;
    network.routers = network.fusion.clone().into_iter().collect();
    site.write("network.toml", &toml::to_string(&network).unwrap());
    let fusion = site.start_logged(&["fuse", "-c", &site.path("fusion.toml")], "fuse.log");
    let router = network.routers[0].as_str();
    assert!(
        site.wait_for_line("fuse.log", router, Duration::from_secs(5)),
        "{}",
        site.text("fuse.log")
    );
    assert!(site.text("fuse.log").contains("no Zenoh router answers"));
    let (took, _) = fusion.terminate();
    assert!(took < LIMIT, "{took:?}");
}

/// Files of a folder.
fn files_of(folder: &Path) -> Vec<std::path::PathBuf> {
    std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect()
}

/// A command that is asked to stop half a second after it began to listen for that, and how long it
/// took from then on; `before` is called before it is asked.
fn terminated(arguments: &[&str], before: impl FnOnce()) -> (Output, Duration) {
    let command = std::process::Command::new(crossfix_tests::program())
        .args(arguments)
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    wait_until_it_listens(command.id());
    std::thread::sleep(Duration::from_millis(500));
    before();
    let pid = command.id().to_string();
    std::process::Command::new("kill").args(["-TERM", &pid]).status().unwrap();
    let asked = Instant::now();
    (command.wait_with_output().unwrap(), asked.elapsed())
}

/// Waits until the process has a handler for SIGTERM, signal 15, as Linux tells.
fn wait_until_it_listens(pid: u32) {
    let deadline = Instant::now() + Duration::from_secs(30);
    loop {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:")).unwrap();
        if u64::from_str_radix(caught.trim(), 16).unwrap() & 1 << 14 != 0 {
            return;
        }
        assert!(Instant::now() < deadline, "it does not listen for SIGTERM");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_tracker_that_is_asked_to_stop_keeps_the_rows_so_far() {
    let folder = tempfile::tempdir().unwrap();
    let video = folder.path().join("video");
    std::fs::create_dir(&video).unwrap();
    let picture = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/demo.png");
    for frame in 0..5000 {
        std::os::unix::fs::symlink(picture, video.join(format!("{frame:05}.png"))).unwrap();
    }
    let [video, table] = ["video", "rows.csv"].map(|name| folder.path().join(name));
    let [video_name, table_name] = [&video, &table].map(|path| path.to_str().unwrap());
    let (ended, took) =
        terminated(&["track", video_name, "--box", "100,100,20,20", "--csv", table_name], || ());
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert!(took < LIMIT && ended.status.success(), "{took:?}: {said}");
    let rows = std::fs::read_to_string(&table).unwrap();
    assert!((2..4000).contains(&rows.lines().count()) && rows.ends_with('\n'), "{rows}");
    let mut left = files_of(folder.path());
    left.sort();
    assert_eq!(left, [table, video]);
}

/// One that waits for the system and cannot look whether it is asked to stop.
#[test]
fn a_command_that_hangs_ends_when_it_is_asked_to_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let [silent, table] = ["times.csv", "rows.csv"].map(|name| folder.path().join(name));
    // Nobody will ever write to this pipe.
    assert!(std::process::Command::new("mkfifo").arg(&silent).status().unwrap().success());
    let [silent_name, table_name] = [&silent, &table].map(|path| path.to_str().unwrap());
    let bearings = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/two-uavs.mcap");
    let elsewhere = tempfile::tempdir().unwrap();
    let tracks = elsewhere.path().join("tracks.mcap").to_str().unwrap().to_owned();
    let fused = std::process::Command::new(crossfix_tests::program())
        .args(["-q", "replay", bearings, "--fuse", "-o", &tracks])
        .output()
        .unwrap();
    assert!(fused.status.success(), "{}", String::from_utf8_lossy(&fused.stderr));
    let export = ["export", &tracks, "--csv", table_name, "--times", silent_name];
    let (ended, took) = terminated(&export, || {
        // The table has been begun.
        assert_eq!(files_of(folder.path()).len(), 2, "{:?}", files_of(folder.path()));
    });
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert!(took < LIMIT, "{took:?}");
    assert_eq!(ended.status.code(), Some(1), "{said}");
    assert!(said.contains("asked to stop"), "{said}");
    assert_eq!(files_of(folder.path()), [silent]);
}

#[test]
fn a_simulation_that_is_asked_to_stop_leaves_no_half_files() {
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/demo/scene.toml");
    let long = ["--set", "duration_s=3600"];
    for (to, source) in [
        ("--scenario", &["simulate", "--seconds", "100000"][..]),
        ("--video", &["simulate", scene, long[0], long[1]]),
        ("-o", &["simulate", scene, long[0], long[1]]),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let mut output = folder.path().to_owned();
        if to == "-o" {
            output.push("a.mcap");
        }
        let output = output.to_str().unwrap().to_owned();
        let arguments: Vec<&str> = source.iter().copied().chain([to, &output]).collect();
        let (ended, took) = terminated(&arguments, || ());
        assert!(took < LIMIT, "{to}: {took:?}");
        let said = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert_eq!(ended.status.code(), Some(1), "{to}: {said}");
        assert!(said.contains("asked to stop"), "{to}: {said}");
        assert_eq!(files_of(folder.path()), Vec::<std::path::PathBuf>::new(), "{to}");
    }
}

#[test]
fn an_interrupted_replay_leaves_a_whole_file_that_ends_early() {
    let site = Site::new(60.0);
    let (source, tracks) = (site.path("source.mcap"), site.path("tracks.mcap"));
    let replay = std::process::Command::new(crossfix_tests::program())
        .args(["-q", "replay", &source, "--fuse", "-o", &tracks])
        .spawn()
        .unwrap();
    // It writes beside its output until that is whole. Stopped at its first tracks it has most of
    // them to go.
    let part = format!("{tracks}.{}.part", replay.id());
    wait_until_recorded(&part, 10_000);
    let pid = replay.id().to_string();
    std::process::Command::new("kill").args(["-INT", &pid]).status().unwrap();
    let output = replay.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(1), "it did not do what it was asked");
    let all = messages(Path::new(&source), |c| matches!(c, Channel::Bearings(_))).len();
    let done = messages(Path::new(&tracks), |c| matches!(c, Channel::Bearings(_))).len();
    assert!(0 < done && done < all, "{done} of {all}");
}
