//! A site in a temporary folder: its files, its processes, and an ear on its network.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that is skipped says so"
)]

pub mod video;

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crossfix_calibration::intrinsics_to_yaml;
use crossfix_message::{CameraName, Channel};
use crossfix_recording::{Entry, RecordingReader};
use crossfix_simulation::{Scene, World};
use crossfix_transport::{Area, Link, Mode, NetworkConfig, Role};
use tempfile::TempDir;

/// How long a test waits for what must come.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// The program under test, which `cargo test --workspace` builds beside the tests.
pub fn program() -> PathBuf {
    let tests = std::env::current_exe().unwrap();
    // target/<profile>/deps/<test> -> target/<profile>/crossfix
    let program = tests.parent().and_then(Path::parent).unwrap().join("crossfix");
    assert!(program.exists(), "{} is not built: run `cargo test --workspace`", program.display());
    program
}

/// A row of the table of `crossfix track`: a target in a frame, or a frame without one.
#[derive(Clone, Copy, Debug, PartialEq, serde::Deserialize)]
pub struct FollowedRow {
    /// Number of the frame, from 0.
    pub frame: u64,
    /// Left edge of the box, px.
    pub x: Option<f64>,
    /// Upper edge.
    pub y: Option<f64>,
    /// Columns.
    pub w: Option<f64>,
    /// Rows.
    pub h: Option<f64>,
    /// 1 while the target is measured or shortly predicted.
    pub ok: u8,
    /// Time that all targets of the frame took, us.
    pub us: f64,
    /// The target.
    pub id: Option<u64>,
    /// Probability that it is there.
    pub certainty: Option<f64>,
    /// Standard deviation of its place, px.
    pub sd_x: Option<f64>,
    /// The same on the other axis.
    pub sd_y: Option<f64>,
    /// Velocity, px/s.
    pub vx: Option<f64>,
    /// The same on the other axis.
    pub vy: Option<f64>,
}

impl FollowedRow {
    /// The middle of the box, where pixels cover a whole number to the next.
    pub fn middle(&self) -> Option<[f64; 2]> {
        Some([self.x? + self.w? / 2.0, self.y? + self.h? / 2.0])
    }
}

/// Reads the table of `crossfix track`.
pub fn followed_rows(path: &Path) -> Vec<FollowedRow> {
    let mut reader = csv::Reader::from_path(path).unwrap();
    assert_eq!(
        reader.headers().unwrap().iter().collect::<Vec<_>>().join(","),
        "frame,x,y,w,h,ok,us,id,certainty,sd_x,sd_y,vx,vy,contrast,flicker,straightness"
    );
    reader.deserialize().map(Result::unwrap).collect()
}

/// Runs the program to its end.
pub fn crossfix(arguments: &[&str]) -> Output {
    Command::new(program()).args(arguments).output().unwrap()
}

/// Runs the program and wants it to succeed; returns its stdout.
pub fn succeed(arguments: &[&str]) -> String {
    let output = crossfix(arguments);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "crossfix {}: {stderr}", arguments.join(" "));
    String::from_utf8(output.stdout).unwrap()
}

/// Seconds since the Unix epoch.
pub fn now_seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64()
}

/// The folder of real data, or `None` and a clear word that the test is skipped.
pub fn real_data() -> Option<PathBuf> {
    let data = std::env::var_os("CROSSFIX_DATA").map(PathBuf::from);
    if data.is_none() {
        eprintln!("SKIPPED: set CROSSFIX_DATA to the folder of real data");
    }
    data
}

/// Runs commands of a shell in a network of their own and returns what they print; `None` and a
/// clear word where that is not to be had, or what they need: a command that succeeds where it is.
pub fn alone(needed: &str, commands: &str) -> Option<String> {
    let shell =
        |commands: &str| Command::new("unshare").args(["-n", "sh", "-c", commands]).output();
    if !shell(needed).is_ok_and(|tried| tried.status.success()) {
        eprintln!("SKIPPED: needs root, and `{needed}`");
        return None;
    }
    let output = shell(&format!("set -eu\nip link set lo up\n{commands}")).unwrap();
    Some(String::from_utf8(output.stdout).unwrap())
}

/// All messages of a recording on one channel.
pub fn messages(recording: &Path, wanted: impl Fn(&Channel) -> bool) -> Vec<Entry> {
    let mut entries = Vec::new();
    let report = RecordingReader::open(recording)
        .unwrap()
        .for_each(|entry| {
            if wanted(&entry.key.channel) {
                entries.push(entry);
            }
            Ok::<_, std::convert::Infallible>(())
        })
        .unwrap();
    assert_eq!(report.damage, None, "{}", recording.display());
    entries
}

fn start(arguments: &[&str], log: Stdio) -> Process {
    let child = Command::new(program())
        .args(arguments)
        .arg("--stop-with-stdin")
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .unwrap();
    Process(child)
}

/// A running part of a site; it is ended when this is dropped.
pub struct Process(Child);

impl Process {
    /// Asks it to stop and waits; says whether it ended well.
    pub fn stop(mut self) -> bool {
        drop(self.0.stdin.take());
        self.wait()
    }

    /// Waits until it ends by itself; says whether it ended well.
    pub fn wait(&mut self) -> bool {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status.success();
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("the process does not end");
    }

    /// The most memory that it has had, bytes; `None` where the system does not say.
    pub fn peak_memory(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.0.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        line.split_whitespace().next()?.parse::<u64>().ok().map(|kilobytes| kilobytes << 10)
    }

    /// The processor time that it has had, s; `None` where the system does not say.
    pub fn processor_s(&self) -> Option<f64> {
        /// Of Linux, in what `/proc` counts.
        const TICKS_A_SECOND: f64 = 100.0;
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.0.id())).ok()?;
        // The name, in brackets, may hold spaces; user and system time are the 12th and 13th after
        // it.
        let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
        let ticks = |index: usize| fields.get(index)?.parse::<f64>().ok();
        Some((ticks(11)? + ticks(12)?) / TICKS_A_SECOND)
    }

    /// Sends it SIGTERM, as systemd does, and says how long it took to end, and its exit code.
    pub fn terminate(mut self) -> (Duration, Option<i32>) {
        let begun = Instant::now();
        let pid = self.0.id().to_string();
        assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
        loop {
            if let Some(status) = self.0.try_wait().unwrap() {
                return (begun.elapsed(), status.code());
            }
            assert!(begun.elapsed() < PATIENCE, "the process does not end");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits until it ends by itself and returns its exit code.
    pub fn exit_code(&mut self) -> Option<i32> {
        let _ = self.wait();
        self.0.wait().unwrap().code()
    }

    /// Ends it at once, as a crash does.
    pub fn crash(mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A site whose cameras play a simulated recording.
pub struct Site {
    folder: TempDir,
    network: NetworkConfig,
    world: World,
}

impl Site {
    /// The demo's scene for `duration_s` seconds.
    pub fn new(duration_s: f64) -> Self {
        let mut scene: Scene =
            toml::from_str(include_str!("../../configs/demo/scene.toml")).unwrap();
        scene.duration_s = duration_s;
        Self::of(&scene)
    }

    /// A scene, each camera's agent playing its bearings twice as fast as life.
    pub fn of(scene: &Scene) -> Self {
        let world = scene.build().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let network = free_network(world.cameras().iter().map(|camera| camera.name().clone()));
        let site = Self { folder, network, world };
        site.write("network.toml", &toml::to_string(&site.network).unwrap());
        site.write("scene.toml", &toml::to_string(scene).unwrap());
        site.write("fusion.toml", "network = \"network.toml\"\n[event_time]\nlateness_s = 3.0\n");
        succeed(&["simulate", &site.path("scene.toml"), "-o", &site.path("source.mcap")]);
        for camera in site.world.cameras() {
            let name = camera.name().as_str();
            let lens = camera.camera().model().intrinsics();
            site.write(&format!("{name}.yaml"), &intrinsics_to_yaml(name, lens));
            site.write_camera(
                name,
                "kind = \"recording\"\npath = \"source.mcap\"\nspeed = 2.0",
                "",
            );
        }
        site
    }

    /// Gives the site certificates, and whatever `enroll` is told beside that.
    pub fn enroll(&mut self, options: &[&str]) -> String {
        let file = self.path("network.toml");
        let said = succeed(&[&["enroll", "-c", &file], options].concat());
        self.read_network();
        said
    }

    /// Puts a router between all parts of the site.
    pub fn route(&mut self) {
        self.network.mode = Mode::Client;
        self.network.routers = vec![free_endpoints(1).remove(0)];
        self.write("network.toml", &toml::to_string(&self.network).unwrap());
    }

    /// Gives the site several fusion centres, each with its own file: `fusion-west.toml` of area
    /// `west`. What follows is in each of these files.
    pub fn divide(&mut self, areas: &[(&str, &[&str])], settings: &str) {
        self.network.fusion = None;
        for ((area, cameras), fusion) in areas.iter().zip(free_endpoints(areas.len())) {
            let cameras = cameras.iter().map(|name| name.parse().unwrap()).collect();
            self.network.areas.insert(area.parse().unwrap(), Area { fusion, cameras });
            let file = format!("network = \"network.toml\"\narea = \"{area}\"\n{settings}");
            self.write(&format!("fusion-{area}.toml"), &file);
        }
        self.write("network.toml", &toml::to_string(&self.network).unwrap());
    }

    fn read_network(&mut self) {
        self.network = toml::from_str(&self.text("network.toml")).unwrap();
        if let Some(security) = &mut self.network.security {
            security.certificates = self.folder.path().join(&security.certificates);
        }
    }

    /// Writes a camera's file with a source and more.
    pub fn write_camera(&self, name: &str, source: &str, more: &str) {
        let description = self.world.camera(name).unwrap().description().clone();
        self.write(
            &format!("{name}.toml"),
            &format!(
                "name = \"{name}\"\nnetwork = \"network.toml\"\nintrinsics = \"{name}.yaml\"\n{more}\n\
                 [pose]\nposition_m = {:?}\nlook_at_m = {:?}\n[source]\n{source}\n",
                description.position_m, description.look_at_m
            ),
        );
    }

    /// A file of the site.
    pub fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    /// Writes a file of the site.
    pub fn write(&self, name: &str, text: &str) {
        std::fs::write(self.folder.path().join(name), text).unwrap();
    }

    /// The site's network.
    pub fn network(&self) -> &NetworkConfig {
        &self.network
    }

    /// The scene that its cameras play.
    pub fn world(&self) -> &World {
        &self.world
    }

    /// Starts the program; its logs go to the test's stderr.
    pub fn start(&self, arguments: &[&str]) -> Process {
        start(arguments, Stdio::inherit())
    }

    /// Starts the program; its logs go to a file of the site.
    pub fn start_logged(&self, arguments: &[&str], log: &str) -> Process {
        start(arguments, std::fs::File::create(self.path(log)).unwrap().into())
    }

    /// What a file of the site says.
    pub fn text(&self, name: &str) -> String {
        std::fs::read_to_string(self.path(name)).unwrap()
    }

    /// Waits until a log of the site says something.
    pub fn wait_for_line(&self, log: &str, words: &str, patience: Duration) -> bool {
        self.wait_for_lines(log, words, 1, patience)
    }

    /// Waits until words were logged so many times.
    pub fn wait_for_lines(&self, log: &str, words: &str, times: usize, patience: Duration) -> bool {
        let deadline = Instant::now() + patience;
        while Instant::now() < deadline {
            if self.text(log).matches(words).count() >= times {
                return true;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        false
    }

    /// Starts the fusion centre.
    pub fn start_fusion(&self) -> Process {
        self.start(&["fuse", "-c", &self.path("fusion.toml")])
    }

    /// Starts the recorder.
    pub fn start_recorder(&self, file: &str) -> Process {
        self.start(&["record", "-c", &self.path("network.toml"), "-o", &self.path(file)])
    }

    /// Starts all agents, to begin together at a time.
    pub fn start_agents(&self, start_at: f64, options: &[&str]) -> Vec<Process> {
        let begin = format!("{start_at:.3}");
        let start = |camera: &crossfix_simulation::SimulatedCamera| {
            let file = self.path(&format!("{}.toml", camera.name()));
            let mut arguments = vec!["agent", "-c", &file, "--start-at", &begin];
            arguments.extend(options);
            self.start(&arguments)
        };
        self.world.cameras().iter().map(start).collect()
    }

    /// A session that hears everything.
    pub fn ear(&self) -> Link {
        Link::open(&self.network, &Role::Observer).unwrap()
    }
}

/// Ports below those that the system gives to whoever asks for none.
const PORTS: std::ops::Range<u32> = 10_240..32_000;
/// Distance of the first ports of tests whose processes follow one another.
const PORTS_PER_PROCESS: u32 = 131;

/// `count` endpoints on this machine that nobody uses now. They are listened at later, so those
/// that the system gives would be given again meanwhile; here no test gives one twice, and another
/// test hardly the same.
pub fn free_endpoints(count: usize) -> Vec<String> {
    /// Number of ports that this process has given.
    static GIVEN: AtomicU32 = AtomicU32::new(0);
    let begin = std::process::id().wrapping_mul(PORTS_PER_PROCESS);
    let ports = std::iter::repeat_with(|| {
        let place = begin.wrapping_add(GIVEN.fetch_add(1, Ordering::Relaxed));
        PORTS.start + place % PORTS.len() as u32
    });
    let is_free = |port: &u32| TcpListener::bind(("127.0.0.1", *port as u16)).is_ok();
    ports.filter(is_free).take(count).map(|port| format!("tcp/127.0.0.1:{port}")).collect()
}

/// A network of some cameras at endpoints on this machine that nobody uses now.
pub fn free_network(cameras: impl IntoIterator<Item = CameraName>) -> NetworkConfig {
    let cameras: Vec<_> = cameras.into_iter().collect();
    let mut endpoints = free_endpoints(cameras.len() + 1);
    NetworkConfig {
        site: "test".parse().unwrap(),
        mode: Mode::Peer,
        routers: Vec::new(),
        unsecured: false,
        security: None,
        anchor: None,
        fusion: Some(endpoints.remove(0)),
        areas: BTreeMap::new(),
        cameras: cameras.into_iter().zip(endpoints).collect(),
    }
}
