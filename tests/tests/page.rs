//! The site's page, as a browser without a screen shows it.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that is skipped says so"
)]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::Command;
use std::time::{Duration, Instant};

use crossfix_tests::{PATIENCE, Site, now_seconds};
use serde_json::Value;

fn free_address() -> String {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string()
}

/// A connection to a page that has been asked for a path.
fn ask(address: &str, path: &str) -> TcpStream {
    let deadline = Instant::now() + PATIENCE;
    let mut stream = loop {
        match TcpStream::connect(address) {
            Ok(stream) => break stream,
            Err(error) => assert!(Instant::now() < deadline, "{error}"),
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n").unwrap();
    stream
}

/// What the page is told, once it is as it is wanted.
fn told(address: &str, wanted: impl Fn(&Value) -> bool) -> Value {
    let (mut stream, deadline) = (ask(address, "/events"), Instant::now() + PATIENCE);
    let (mut text, mut buffer) = (String::new(), [0; 65_536]);
    while Instant::now() < deadline {
        let length = stream.read(&mut buffer).unwrap();
        text += &String::from_utf8_lossy(&buffer[..length]);
        let whole = text.rsplit_once("\n\n").map_or("", |(whole, _)| whole);
        let last = whole.rsplit("data: ").next().and_then(|json| serde_json::from_str(json).ok());
        if let Some(value) = last.filter(&wanted) {
            return value;
        }
    }
    panic!("never as it is wanted: {text}");
}

/// What a browser shows once the page says something (`tests/peers/page.mjs`); `None` and a clear
/// word where there is none.
fn browsed(address: &str, says: &str, picture: &str) -> Option<Value> {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/peers/page.mjs");
    let url = format!("http://{address}/");
    let output = Command::new("node").args([script, &url, says, picture]).output();
    let Ok(output) = output else {
        eprintln!("SKIPPED: needs node");
        return None;
    };
    let said = String::from_utf8_lossy(&output.stdout);
    if output.status.code() == Some(77) {
        eprintln!("{said}");
        return None;
    }
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    Some(serde_json::from_str(&said).unwrap())
}

#[test]
fn a_browser_shows_how_a_site_does_with_its_plan_and_tracks() {
    let site = Site::new(40.0);
    let network = site.path("network.toml");
    let fusion = site.start_fusion();
    let address = free_address();
    let page = site.start(&["status", "-c", &network, "--page", &address]);
    let _agents = site.start_agents(now_seconds() + 1.0, &[]);
    let told = told(&address, |shown| shown["status"]["confirmed"] == 2);
    assert_eq!(told["plan"]["cameras"].as_array().unwrap().len(), 3, "{told}");
    let events = told["plan"]["events"].as_array().unwrap();
    assert!(events.iter().any(|event| event["what"] == "track 1 confirmed"), "{told}");
    // `north` looks to the south-west, over the targets.
    let north = &told["plan"]["cameras"][1];
    assert_eq!(north["name"], "north");
    if let Some(seen) = browsed(&address, "2 confirmed", &site.path("page.png")) {
        let text = seen["text"].as_str().unwrap();
        for shown in ["east\tgood", "2 confirmed", "track 2 confirmed", "live"] {
            assert!(text.contains(shown), "{shown} in {text}");
        }
        assert_eq!(seen["errors"].as_array().unwrap().len(), 0, "{seen}");
        // The cameras' views alone cover a tenth of the plan.
        assert!(seen["drawn"].as_u64().unwrap() > 50_000, "{seen}");
    }
    assert!(page.stop() && fusion.stop());
}

#[test]
fn a_page_shows_nothing_else_and_runs_nothing_from_elsewhere() {
    let site = Site::new(1.0);
    let address = free_address();
    let page = site.start(&["status", "-c", &site.path("network.toml"), "--page", &address]);
    let whole = |path: &str| {
        let mut text = String::new();
        ask(&address, path).read_to_string(&mut text).unwrap();
        text
    };
    let shown = whole("/");
    assert!(shown.starts_with("HTTP/1.1 200"), "{shown}");
    assert!(shown.contains("content-security-policy: default-src 'none'"), "{shown}");
    assert!(!shown.contains("http://") && !shown.contains("https://"), "nothing from elsewhere");
    assert!(whole("/../etc/passwd").starts_with("HTTP/1.1 404"));
    // However many only look on and take nothing, there is room to ask.
    let held: Vec<TcpStream> = (0..40).map(|_| ask(&address, "/events")).collect();
    std::thread::sleep(Duration::from_millis(500));
    assert!(whole("/").starts_with("HTTP/1.1 200"));
    let mut elsewhere = TcpStream::connect(&address).unwrap();
    write!(elsewhere, "GET / HTTP/1.1\r\nHost: evil.example:80\r\n\r\n").unwrap();
    let mut answer = String::new();
    elsewhere.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 421"), "{answer}");
    drop(held);
    assert!(page.stop());
}
