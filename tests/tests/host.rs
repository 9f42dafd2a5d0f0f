//! What whoever looks after a host meets: metrics, a file that is read again, an agent that dies, a
//! clock that is set.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that is skipped says so"
)]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, ClockSource, Health, Payload, decode,
};
use crossfix_tests::{PATIENCE, Process, Site, alone, messages, now_seconds, program};
use crossfix_transport::Subscription;

fn free_address() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

/// Waits for a message on a channel that is as it is wanted.
fn hear<M: Payload>(
    heard: &Subscription,
    channel: &Channel,
    patience: Duration,
    wanted: impl Fn(&M) -> bool,
) -> Option<M> {
    let until = Instant::now() + patience;
    while Instant::now() < until {
        if let Some(received) = heard.next(Duration::from_millis(20))
            && received.key.channel == *channel
        {
            let message: M = decode(&received.data).unwrap();
            if wanted(&message) {
                return Some(message);
            }
        }
    }
    None
}

/// A camera's file whose camera is nowhere.
fn write_nowhere(site: &Site, name: &str, more: &str) {
    site.write_camera(name, "kind = \"stream\"\nurl = \"rtsp://127.0.0.1:1/a\"", more);
}

/// Starts the program as a service is: nobody's terminal, its log in a file.
fn serve(site: &Site, arguments: &[&str], log: &str) -> Child {
    let log = std::fs::File::create(site.path(log)).unwrap();
    let mut command = Command::new(program());
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::null()).stderr(log);
    command.spawn().unwrap()
}

fn signal(child: &Child, signal: &str) {
    let pid = child.id().to_string();
    assert!(Command::new("kill").args([signal, &pid]).status().unwrap().success());
}

fn ends_well(mut child: Child) -> bool {
    signal(&child, "-TERM");
    child.wait().unwrap().success()
}

#[test]
fn an_agent_that_dies_is_missed_within_two_seconds_and_one_that_is_stopped_is_not() {
    let site = Site::new(1.0);
    for name in ["north", "east"] {
        write_nowhere(&site, name, "");
    }
    let fusion = site.start_fusion();
    let agents = ["north", "east"]
        .map(|name| site.start(&["agent", "-c", &site.path(&format!("{name}.toml"))]));
    let ear = site.ear();
    let heard = ear.subscribe(&["**".to_owned()]).unwrap();
    let health = |seconds: f64, wanted: &dyn Fn(&Health) -> bool| {
        hear(&heard, &Channel::FusionHealth, Duration::from_secs_f64(seconds), wanted)
    };
    assert!(health(20.0, &|health| health.present == ["east", "north"]).is_some());
    let [north, east] = agents;
    assert!(east.stop());
    north.crash();
    let died = Instant::now();
    let is_gone = |health: &Health, name: &str| {
        let words = format!("camera `{name}` is gone");
        health.problems.iter().any(|problem| problem.starts_with(&words))
    };
    let missed = health(10.0, &|health| is_gone(health, "north")).unwrap();
    assert!(died.elapsed() < Duration::from_secs(2), "{:?}", died.elapsed());
    assert!(!is_gone(&missed, "east"), "{missed:?}");
    assert!(fusion.stop());
}

#[test]
fn every_part_of_a_site_has_metrics_that_prometheus_takes() {
    let site = Site::new(1.0);
    write_nowhere(&site, "north", "");
    let [fusion, network, north, file] =
        ["fusion.toml", "network.toml", "north.toml", "r.mcap"].map(|file| site.path(file));
    for arguments in [
        &["fuse", "-c", &fusion][..],
        &["record", "-c", &network, "-o", &file],
        &["agent", "-c", &north],
    ] {
        let address = free_address();
        let part = site.start(&[arguments, &["--metrics", &address]].concat());
        let text = metrics(&address, arguments[0]);
        for name in [
            "crossfix_handled_total{",
            "crossfix_problems{",
            "crossfix_process_memory_bytes{",
            "crossfix_process_cores{",
        ] {
            assert!(text.lines().any(|line| line.starts_with(name)), "{arguments:?}: {text}");
        }
        taken_by_prometheus(&text);
        assert!(part.stop());
    }
}

/// The metrics at an address, once there are some.
fn metrics(address: &str, part: &str) -> String {
    let until = Instant::now() + PATIENCE;
    while Instant::now() < until {
        if let Ok(mut stream) = TcpStream::connect(address) {
            stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: a\r\n\r\n").unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).unwrap();
            let (_, text) = answer.split_once("\r\n\r\n").unwrap();
            if text.contains("crossfix") {
                return text.to_owned();
            }
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    panic!("{part} has no metrics")
}

fn taken_by_prometheus(text: &str) {
    let checker = Command::new("promtool")
        .args(["check", "metrics"])
        .stdin(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn();
    let Ok(mut checker) = checker else {
        eprintln!("SKIPPED: promtool is not installed (apt-get install prometheus)");
        return;
    };
    checker.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
    let output = checker.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

#[test]
fn a_file_that_is_read_again_holds_from_then_on_but_for_what_cannot() {
    let site = Site::new(1.0);
    write_nowhere(&site, "north", "");
    let agent = serve(&site, &["agent", "-c", &site.path("north.toml")], "north.log");
    let ear = site.ear();
    let heard = ear.subscribe(&["**".to_owned()]).unwrap();
    let channel = Channel::Calibration("north".parse().unwrap());
    let calibration = |wanted: &dyn Fn(&CameraCalibration) -> bool| {
        hear(&heard, &channel, Duration::from_secs(20), wanted)
    };
    let first = calibration(&|_| true).unwrap();
    let height_m = |calibration: &CameraCalibration| calibration.position.unwrap().z;

    // It was moved, and is another camera of another network by mistake.
    let text = site.text("north.toml");
    let position_m =
        format!("{:?}", site.world().camera("north").unwrap().description().position_m);
    let moved = text.replace(&position_m, "[1.0, 2.0, 33.0]").replace(":1/a", ":1/b");
    assert!(moved.contains("33.0"), "{text}");
    site.write("north.toml", &moved);
    signal(&agent, "-HUP");
    let second = calibration(&|said| height_m(said) == 33.0).unwrap();
    assert!(second.valid_from_ns > first.valid_from_ns);
    let says = |words: &str| site.wait_for_line("north.log", words, Duration::from_secs(5));
    assert!(says("what it says of source holds once the agent is started again"));

    // A mistake changes nothing.
    site.write("north.toml", "name = \"north\"\nnonsense = 1\n");
    signal(&agent, "-HUP");
    assert!(says("goes on as it was"));
    assert!(height_m(&calibration(&|_| true).unwrap()) == 33.0);
    assert!(ends_well(agent));

    // Those who read theirs at their start alone say so, and go on.
    let [fusion, network, file] =
        ["fusion.toml", "network.toml", "r.mcap"].map(|file| site.path(file));
    for (arguments, log) in [
        (&["fuse", "-c", &fusion][..], "fusion.log"),
        (&["record", "-c", &network, "-o", &file], "recorder.log"),
    ] {
        let part = serve(&site, arguments, log);
        assert!(site.wait_for_line(log, "run ", Duration::from_secs(20)), "{}", site.text(log));
        signal(&part, "-HUP");
        assert!(site.wait_for_line(log, "restart it", Duration::from_secs(5)), "{log}");
        assert!(ends_well(part));
    }
}

#[test]
fn the_doctor_asks_chrony_how_good_the_hosts_clock_is() {
    let site = Site::new(1.0);
    // chronyc as the doctor finds it asks the chronyd of the test.
    site.write("chronyc", "#!/bin/sh\nexec /usr/bin/chronyc -h \"$ASKED\" \"$@\"\n");
    let commands = format!(
        r#"
chmod +x {folder}/chronyc
dir=$(mktemp -d)
chown _chrony:_chrony "$dir"
chmod 770 "$dir"
own() {{ printf 'cmdport 0\nbindcmdaddress %s/%s.sock\npidfile %s/%s.pid\n' "$dir" "$1" "$dir" "$1"; }}
{{ own server; printf 'local stratum 3\nallow 127.0.0.0/8\nport 11123\n'; }} > "$dir/server.conf"
{{ own kept; printf 'server 127.0.0.1 port 11123 minpoll 0 maxpoll 1 iburst trust\nport 0\n'; }} > "$dir/kept.conf"
{{ own lost; printf 'server 127.0.0.1 port 9 iburst\nport 0\n'; }} > "$dir/lost.conf"
for one in server kept lost; do chronyd -x -d -f "$dir/$one.conf" >/dev/null 2>&1 & done
for _ in $(seq 100); do
  /usr/bin/chronyc -h "$dir/kept.sock" -c tracking 2>/dev/null |
    awk -F, '$2 == "127.0.0.1" && $12 < 0.001 {{ kept = 1 }} END {{ exit !kept }}' && break
  sleep 0.2
done
for one in kept lost; do
  ASKED="$dir/$one.sock" PATH="{folder}:$PATH" {program} doctor -c {camera} --json 2>/dev/null || true
done
kill $(cat "$dir"/*.pid)
rm -r "$dir""#,
        folder = site.path(""),
        program = program().display(),
        camera = site.path("north.toml"),
    );
    let Some(said) = alone("chronyd --version", &commands) else { return };
    let said = serde_json::Deserializer::from_str(&said).into_iter::<serde_json::Value>();
    let clocks: Vec<[String; 2]> = said
        .map(|findings| {
            let findings = findings.unwrap();
            let clock = findings.as_array().unwrap().iter().find(|f| f["what"] == "host clock");
            ["verdict", "found"].map(|key| clock.unwrap()[key].as_str().unwrap().to_owned())
        })
        .collect();
    let [kept, lost] = &clocks[..] else { panic!("{clocks:?}") };
    assert!(kept[0] == "pass" && kept[1].starts_with("by 127.0.0.1, within"), "{kept:?}");
    assert_eq!(lost[..], ["fail", "chrony runs, and has no time server"]);
}

/// A shared object that lets a test set the clock of one program; `None` and a clear word where it
/// is not installed.
fn clock_setter() -> Option<String> {
    let found = ["x86_64-linux-gnu", "aarch64-linux-gnu"]
        .map(|machine| format!("/usr/lib/{machine}/faketime/libfaketime.so.1"))
        .into_iter()
        .find(|path| Path::new(path).exists());
    if found.is_none() {
        eprintln!("SKIPPED: libfaketime is not installed (apt-get install faketime)");
    }
    found
}

#[test]
fn a_host_whose_clock_jumps_by_an_hour_sees_on_at_the_cameras_time() {
    let Some(setter) = clock_setter() else { return };
    let (site, address) = (Site::new(30.0), free_address());
    site.write_camera("north", &format!("kind = \"stream\"\nurl = \"rtsp://{address}/north\""), "");
    site.write("clock", "+0\n");
    let recorder = site.start_recorder("live.mcap");
    let cameras: Process = site.start(&["simulate", &site.path("scene.toml"), "--rtsp", &address]);
    let log = std::fs::File::create(site.path("north.log")).unwrap();
    let agent = Command::new(program())
        .args(["agent", "-c", &site.path("north.toml")])
        .env("LD_PRELOAD", setter)
        .env("FAKETIME_TIMESTAMP_FILE", site.path("clock"))
        .env("FAKETIME_NO_CACHE", "1")
        .env("FAKETIME_DONT_FAKE_MONOTONIC", "1")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(log)
        .spawn()
        .unwrap();
    std::thread::sleep(Duration::from_secs(8));
    let jumped = now_seconds();
    site.write("clock", "+3600\n");
    std::thread::sleep(Duration::from_secs(8));
    assert!(ends_well(agent));
    cameras.crash();
    assert!(recorder.stop());

    let frames: Vec<BearingFrame> = recorded(&site, &Channel::Bearings("north".parse().unwrap()));
    let time_s = |frame: &BearingFrame| frame.capture_time_ns as f64 * 1e-9;
    let after: Vec<&BearingFrame> =
        frames.iter().filter(|frame| time_s(frame) > jumped + 1.0).collect();
    assert!(after.len() > 100, "{} of {}", after.len(), frames.len());
    for pair in frames.windows(2) {
        let step_s = time_s(&pair[1]) - time_s(&pair[0]);
        assert!((0.0..0.5).contains(&step_s), "{step_s} at {}", pair[1].sequence);
    }
    assert!(after.iter().all(|frame| frame.clock_source() == ClockSource::Camera));
    assert!(after.iter().all(|frame| time_s(frame) < jumped + 20.0));
    // The program's clock was set indeed: by it, images of now are of an hour ago.
    let healths: Vec<Health> = recorded(&site, &Channel::CameraHealth("north".parse().unwrap()));
    let last = healths.iter().rev().find(|health| !health.ended).unwrap();
    let age = last.counters.iter().find(|c| c.name == "exposure_to_bearings_p99_us").unwrap();
    assert!(age.value > 900_000_000, "{last:?}");
}

/// What was recorded on a channel.
fn recorded<M: Payload>(site: &Site, wanted: &Channel) -> Vec<M> {
    let entries = messages(Path::new(&site.path("live.mcap")), |channel| channel == wanted);
    entries.iter().map(|entry| decode(&entry.data).unwrap()).collect()
}
