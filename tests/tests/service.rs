//! The program as systemd runs it.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crossfix_tests::{Site, program, succeed};

/// What a program tells systemd.
struct Told(UnixDatagram);

impl Told {
    /// Whether it says a line within a time from now.
    fn says(&self, line: &str, patience: Duration) -> bool {
        let until = Instant::now() + patience;
        let mut bytes = [0; 4096];
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            self.0.set_read_timeout(Some(left)).unwrap();
            let length = self.0.recv(&mut bytes).unwrap_or(0);
            let said = String::from_utf8_lossy(&bytes[..length]).into_owned();
            if said.lines().any(|said| said == line) {
                return true;
            }
        }
    }
}

fn start(site: &Site, arguments: &[&str]) -> (Told, Child) {
    let socket = site.path("notify");
    let told = Told(UnixDatagram::bind(&socket).unwrap());
    let child = Command::new(program())
        .args(arguments)
        .env("NOTIFY_SOCKET", socket)
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    (told, child)
}

fn signal(child: &Child, signal: &str) {
    let pid = child.id().to_string();
    assert!(Command::new("kill").args([signal, &pid]).status().unwrap().success());
}

#[test]
fn every_part_of_a_site_says_when_it_is_up_that_it_goes_round_and_when_it_stops() {
    for part in ["fuse", "record", "agent", "live"] {
        let site = Site::new(1.0);
        // It has nobody to talk to, and a camera that is not there.
        site.write_camera("north", "kind = \"stream\"\nurl = \"rtsp://127.0.0.1:1/north\"", "");
        let [fusion, network, east, north, file] =
            ["fusion.toml", "network.toml", "east.toml", "north.toml", "r.mcap"]
                .map(|file| site.path(file));
        let arguments: &[&str] = match part {
            "fuse" => &["fuse", "-c", &fusion],
            "record" => &["record", "-c", &network, "-o", &file],
            "agent" => &["agent", "-c", &east],
            _ => &["agent", "-c", &north],
        };
        let (told, mut child) = start(&site, arguments);
        let within = |line: &str, seconds: u64| told.says(line, Duration::from_secs(seconds));
        assert!(within("READY=1", 20), "{part}");
        assert!(within("WATCHDOG=1", 3) && within("WATCHDOG=1", 3), "{part}");
        // One that hangs says nothing, once what it had said is heard.
        signal(&child, "-STOP");
        let hung = Instant::now();
        while told.says("WATCHDOG=1", Duration::from_millis(200)) {
            assert!(hung.elapsed() < Duration::from_secs(5), "{part} hangs and says it does not");
        }
        assert!(!within("WATCHDOG=1", 2), "{part}");
        signal(&child, "-CONT");
        signal(&child, "-TERM");
        assert!(within("STOPPING=1", 5), "{part}");
        assert!(child.wait().unwrap().success(), "{part}");
    }
}

#[test]
fn the_units_start_what_there_is() {
    let units = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../configs/systemd"));
    let mut seen = 0;
    for unit in std::fs::read_dir(units).unwrap() {
        let text = std::fs::read_to_string(unit.unwrap().path()).unwrap();
        let line = text.lines().find_map(|line| line.strip_prefix("ExecStart=")).unwrap();
        let words: Vec<&str> = line.split(' ').collect();
        assert_eq!(words[0], "/usr/bin/crossfix");
        let help = succeed(&[words[1], "--help"]);
        for option in words[2..].iter().filter(|word| word.starts_with('-')) {
            let is_long = option.starts_with("--");
            let shown = if is_long { format!("{option} ") } else { format!("{option}, --") };
            assert!(help.contains(&shown), "{line}");
        }
        assert!(text.contains("Type=notify") && text.contains("WatchdogSec="), "{line}");
        seen += 1;
    }
    assert_eq!(seen, 3);
}
