//! Recorders behind five kilobytes a second, and behind a cable that is pulled, in network
//! namespaces of their own.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that measures says what it found"
)]

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crossfix_message::{Channel, Health, decode};
use crossfix_tests::{Site, messages, program, succeed};

/// How long the site is played: `CROSSFIX_SLOW_S` asks for more. What waits for the slow one fills
/// its queues within the first twelve seconds; then its sessions are lost, as a whole batch takes
/// longer than a peer may be silent, and are made again within three to twenty, behind what was on
/// the way. After that it can count.
const PLAYED_S: f64 = 60.0;
/// How long the site is played where a cable is pulled, s.
const PLAYED_TO_PULL_S: f64 = 15.0;
/// When the cable is pulled. A receiver is given up 3 s later.
const PULLED_AFTER: Duration = Duration::from_secs(5);
/// More receivers than Zenoh has threads to receive on by default.
const PULLED_RECORDERS: usize = 3;
/// Where the site is.
const ADDRESS: &str = "10.213.0.1";

/// Two namespaces joined by a link, the way from the first to the second of which is slow. They
/// vanish with this.
struct Namespaces {
    site: String,
    far: String,
}

fn ip(arguments: &str) -> bool {
    let run = Command::new("ip").args(arguments.split_whitespace()).stderr(Stdio::null()).status();
    run.is_ok_and(|status| status.success())
}

impl Namespaces {
    /// `None` where this may not be done: only root may, and only with `ip` and `tc`.
    fn new() -> Option<Self> {
        let id = std::process::id();
        let names = Self { site: format!("cf{id}a"), far: format!("cf{id}b") };
        let Self { site, far } = &names;
        let steps = [
            format!("netns add {site}"),
            format!("netns add {far}"),
            format!("-n {site} link set lo up"),
            format!("-n {far} link set lo up"),
            format!("link add cf{id}x netns {site} type veth peer name cf{id}y netns {far}"),
            format!("-n {site} addr add {ADDRESS}/24 dev cf{id}x"),
            format!("-n {far} addr add 10.213.0.2/24 dev cf{id}y"),
            format!("-n {site} link set cf{id}x up"),
            format!("-n {far} link set cf{id}y up"),
            format!(
                "netns exec {site} tc qdisc add dev cf{id}x root tbf rate 40kbit burst 4kb latency 200ms"
            ),
        ];
        steps.iter().all(|step| ip(step)).then_some(names)
    }

    /// Nothing passes any more, and nobody is told.
    fn pull_the_cable(&self) {
        assert!(ip(&format!("-n {} link set cf{}y down", self.far, std::process::id())));
    }

    /// Starts the program in one of them.
    fn start(&self, namespace: &str, arguments: &[&str]) -> Running {
        let child = Command::new("ip")
            .args(["netns", "exec", namespace])
            .arg(program())
            .arg("-q")
            .args(arguments)
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        Running(child)
    }
}

impl Drop for Namespaces {
    fn drop(&mut self) {
        ip(&format!("netns del {}", self.site));
        ip(&format!("netns del {}", self.far));
    }
}

/// `ip netns exec` becomes the program itself, so its process is the program's.
struct Running(Child);

impl Running {
    fn stop(mut self) {
        Command::new("kill").args(["-TERM", &self.0.id().to_string()]).status().unwrap();
        let _ = self.0.wait();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What is on the far side of the link.
enum Far {
    Nobody,
    SlowRecorder,
    /// The cable is pulled in mid-play.
    LostRecorders,
}

/// Plays the site in the namespaces and returns the 99th percentile of bearing to track, ms, as a
/// recorder beside the fusion centre sees it.
fn p99_ms(names: &Namespaces, site: &Site, far: &Far) -> f64 {
    let network = site.path("network.toml");
    let near = site.path("near.mcap");
    let record = |namespace: &str, file: &str| {
        names.start(namespace, &["record", "-c", &network, "-o", file, "--overwrite"])
    };
    let fusion = names.start(&names.site, &["fuse", "-c", &site.path("fusion.toml")]);
    let recorder = record(&names.site, &near);
    let far_files: Vec<String> = match far {
        Far::Nobody => Vec::new(),
        Far::SlowRecorder => vec![site.path("slow.mcap")],
        Far::LostRecorders => {
            (0..PULLED_RECORDERS).map(|n| site.path(&format!("lost{n}.mcap"))).collect()
        }
    };
    let observers: Vec<Running> = far_files.iter().map(|file| record(&names.far, file)).collect();
    let mut replay =
        names.start(&names.site, &["replay", &site.path("source.mcap"), "--network", &network]);
    if matches!(far, Far::LostRecorders) {
        std::thread::sleep(PULLED_AFTER);
        names.pull_the_cable();
    }
    assert!(replay.0.wait().unwrap().success());
    std::thread::sleep(Duration::from_millis(500));
    recorder.stop();
    fusion.stop();
    observers.into_iter().for_each(Running::stop);
    let evaluation: serde_json::Value =
        serde_json::from_str(&succeed(&["evaluate", &near, "--json"])).unwrap();
    evaluation["latency"]["p99_ms"].as_f64().unwrap()
}

/// A site of some seconds whose addresses are in the namespaces; `None`, and a clear word, where
/// there can be none.
fn site(played_s: f64) -> Option<(Namespaces, Site)> {
    let Some(names) = Namespaces::new() else {
        eprintln!(
            "SKIPPED: network namespaces need root, `ip` and `tc` (apt-get install iproute2)"
        );
        return None;
    };
    let site = Site::new(played_s);
    let mut network = site.network().clone();
    network.unsecured = true;
    for endpoint in network.cameras.values_mut().chain(&mut network.fusion) {
        *endpoint = endpoint.replace("127.0.0.1", ADDRESS);
    }
    site.write("network.toml", &toml::to_string(&network).unwrap());
    site.write("fusion.toml", "network = \"network.toml\"\n");
    Some((names, site))
}

/// Who waits for the far side stalls for seconds; this is the machine's own noise.
fn assert_nobody_waited(alone: f64, beside: f64) {
    println!("bearing to track p99 {alone:.1} ms alone, {beside:.1} ms beside them");
    assert!(beside < 2.0 * alone + 100.0, "p99 {beside:.1} ms instead of {alone:.1} ms");
}

#[test]
fn a_recorder_behind_a_slow_link_loses_and_counts_and_nobody_else_waits() {
    let played_s =
        std::env::var("CROSSFIX_SLOW_S").ok().and_then(|s| s.parse().ok()).unwrap_or(PLAYED_S);
    let Some((names, site)) = site(played_s) else { return };
    let alone = p99_ms(&names, &site, &Far::Nobody);
    let beside = p99_ms(&names, &site, &Far::SlowRecorder);
    assert_nobody_waited(alone, beside);

    let frames =
        |file: &str| messages(Path::new(&site.path(file)), |c| *c == Channel::Tracks).len();
    let (near, slow) = (frames("near.mcap"), frames("slow.mcap"));
    let health = messages(Path::new(&site.path("slow.mcap")), |c| *c == Channel::RecorderHealth);
    let last: Health = decode(&health.last().unwrap().data).unwrap();
    let counted = |name: &str| last.counters.iter().find(|c| c.name == name).map_or(0, |c| c.value);
    println!(
        "{slow} of {near} track frames reached it; it counted {} missing",
        counted("received_missing")
    );
    assert!(slow < near && counted("received_missing") > 0, "{slow} of {near}: {last:?}");
}

#[test]
fn recorders_whose_cable_is_pulled_hold_nobody_up() {
    let Some((names, site)) = site(PLAYED_TO_PULL_S) else { return };
    let alone = p99_ms(&names, &site, &Far::Nobody);
    let beside = p99_ms(&names, &site, &Far::LostRecorders);
    assert_nobody_waited(alone, beside);
}
