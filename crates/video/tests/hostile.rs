//! Network cameras that answer what no camera should.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a test that cannot set itself up has failed"
)]

#[path = "hostile/driver.rs"]
mod driver;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use crossfix_message::Timestamp;
use crossfix_video::{H264Encoder, RtspServer};
use proptest::prelude::*;

fn corpus() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/rtsp")
}

/// What a camera says to one who watches four small pictures of it, as the driver wants it.
fn session() -> Vec<u8> {
    let mut server = RtspServer::bind("127.0.0.1:0".parse().unwrap(), None).unwrap();
    let mount = server.mount("live");
    let mut caller = TcpStream::connect(server.address()).unwrap();
    caller.set_read_timeout(Some(Duration::from_millis(300))).unwrap();
    let url = format!("rtsp://{}/live", server.address());
    let requests = [
        format!("DESCRIBE {url} RTSP/1.0\r\nCSeq: 1\r\n\r\n"),
        format!(
            "SETUP {url}/video RTSP/1.0\r\nCSeq: 2\r\nTransport: RTP/AVP/TCP;interleaved=0-1\r\n\r\n"
        ),
        format!("PLAY {url} RTSP/1.0\r\nCSeq: 3\r\n\r\n"),
    ];
    let mut said = Vec::new();
    for request in requests {
        caller.write_all(request.as_bytes()).unwrap();
        let mut buffer = [0; 4096];
        let length = caller.read(&mut buffer).unwrap();
        let reply = String::from_utf8(buffer[..length].to_vec()).unwrap();
        // Where it stands is nobody's.
        let lines = reply.split_inclusive("\r\n").filter(|line| !line.starts_with("Content-Base"));
        said.extend(lines.flat_map(str::bytes));
        said.extend(b"\n---\n");
    }
    said.truncate(said.len() - 5);
    while !mount.is_watched() {
        std::thread::yield_now();
    }
    let mut encoder = H264Encoder::new(10.0).unwrap();
    for k in 0_u8..4 {
        let brightness = vec![40 * k; 48 * 32];
        let unit = encoder.encode(&brightness, 48, 32).unwrap();
        mount.send(&unit, 9000 * u32::from(k));
        mount.report(Timestamp::from_seconds(1.79e9 + 0.1 * f64::from(k)), 9000 * u32::from(k));
    }
    let mut packets = Vec::new();
    // It ends with the caller's patience.
    let _ = caller.read_to_end(&mut packets);
    said.extend(packets);
    said
}

#[test]
fn what_a_camera_says_is_seen_and_the_fuzzer_begins_from_it() {
    let said = session();
    if std::env::var_os("CROSSFIX_GENERATE").is_some() {
        std::fs::write(corpus().join("session"), &said).unwrap();
    }
    assert_eq!(driver::drive(&said).0, 4);
    let mut shown = 0;
    for entry in std::fs::read_dir(corpus()).unwrap() {
        shown += driver::drive(&std::fs::read(entry.unwrap().path()).unwrap()).0;
    }
    assert!(shown >= 4, "a session's frames: {shown}");
}

#[test]
fn a_description_that_its_reader_panics_at_is_a_stream_that_is_wrong() {
    let said = std::fs::read(corpus().join("line_without_value")).unwrap();
    let (frames, error) = driver::drive(&said);
    let words = error.unwrap().to_string();
    assert!(frames == 0 && words.contains("cannot be read"), "{words}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn a_session_with_other_bytes_in_it_is_survived(
        places in proptest::collection::vec((any::<proptest::sample::Index>(), any::<u8>()), 1..8),
    ) {
        let mut said = std::fs::read(corpus().join("session")).unwrap();
        for (place, byte) in places {
            *place.get_mut(&mut said) = byte;
        }
        driver::drive(&said);
    }

    #[test]
    fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        prop_assert_eq!(driver::drive(&bytes).0, 0);
    }
}
