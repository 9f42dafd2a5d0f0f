//! What others are told, read by their own programs (`tests/peers/outlets.py`): a recording's
//! tracks in each format beside the table that `export` writes, and live ones over each kind of
//! network.

#![allow(
    clippy::unwrap_used,
    clippy::print_stderr,
    reason = "a test that cannot set itself up has failed, and one that is skipped says so"
)]

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpListener, UdpSocket};
use std::process::Command;
use std::time::{Duration, Instant};

use crossfix_geometry::{Geodetic, LocalFrame};
use crossfix_tests::{PATIENCE, Process, Site, now_seconds, succeed};
use nalgebra::Point3;
use serde_json::Value;
use tempfile::TempDir;

/// Where the recordings' sites are put on Earth.
const ANCHOR: &str = "48.3538,11.7861,490";
/// The exit code by which a checker says that it is not there.
const NOT_THERE: i32 = 77;
/// What one snapshot is after the other, s.
const PERIOD_S: f64 = 0.5;
/// Length of the scene that a live site's agents play at twice its speed, s: a minute, as long as
/// tests wait. With half of it a reader that starts slowly on a loaded machine may find them gone.
const PLAYED_S: f64 = 120.0;

fn repository(path: &str) -> String {
    format!("{}/../{path}", env!("CARGO_MANIFEST_DIR"))
}

/// What a program of others reads; `None`, and a clear word, where it is not installed.
fn read_by_others(arguments: &[&str]) -> Option<Value> {
    let python = std::env::var("CROSSFIX_CHECKERS").unwrap_or_else(|_| "python3".to_owned());
    let output =
        Command::new(python).arg(repository("tests/peers/outlets.py")).args(arguments).output();
    let Ok(output) = output else {
        eprintln!("SKIPPED: needs Python");
        return None;
    };
    let said = String::from_utf8_lossy(&output.stdout);
    if output.status.code() == Some(NOT_THERE) {
        eprintln!("{said}");
        return None;
    }
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "refused: {said}\n{errors}");
    Some(serde_json::from_str(said.lines().last().unwrap()).unwrap())
}

/// A fused recording, and a file that is made of it.
struct Exported {
    folder: TempDir,
}

impl Exported {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let exported = Self { folder };
        let recording = repository("recordings/two-uavs.mcap");
        succeed(&["replay", &recording, "--fuse", "-o", &exported.path("tracks.mcap")]);
        exported
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).display().to_string()
    }

    /// Exports in a format and has it read.
    fn read(&self, format: &str, more: &[&str]) -> Option<Value> {
        let (option, file) = (format!("--{format}"), self.path(format));
        let tracks = self.path("tracks.mcap");
        let rate = PERIOD_S.recip().to_string();
        let fixed = ["export", &tracks, "--anchor", ANCHOR, "--rate-hz", &rate, &option, &file];
        succeed(&[&fixed, more].concat());
        read_by_others(&[if format == "foxglove" { "mcap" } else { format }, &file])
    }

    /// The tracks at times as the table has them: by time and number, the state and the standard
    /// deviation of the place.
    fn table(&self, times: impl Iterator<Item = f64>) -> BTreeMap<(i64, u64), Row> {
        let asked: String = times.map(|time| format!("{time:.9}\n")).collect();
        std::fs::write(self.path("times.csv"), format!("t\n{asked}")).unwrap();
        let (tracks, csv, times) =
            (self.path("tracks.mcap"), self.path("tracks.csv"), self.path("times.csv"));
        succeed(&["export", &tracks, "--csv", &csv, "--times", &times, "--all"]);
        let mut reader = csv::Reader::from_path(csv).unwrap();
        let rows = reader.deserialize::<Row>().map(Result::unwrap);
        rows.map(|row| ((milliseconds(row.t), row.track_id), row)).collect()
    }
}

fn milliseconds(seconds: f64) -> i64 {
    (seconds * 1e3).floor() as i64
}

#[derive(Clone, Debug, serde::Deserialize)]
struct Row {
    t: f64,
    track_id: u64,
    x: f64,
    y: f64,
    z: f64,
    vx: f64,
    vy: f64,
    vz: f64,
    sd_m: f64,
}

impl Row {
    fn place(&self) -> Point3<f64> {
        Point3::new(self.x, self.y, self.z)
    }
}

fn frame() -> LocalFrame {
    let numbers: Vec<f64> = ANCHOR.split(',').map(|number| number.parse().unwrap()).collect();
    LocalFrame::at(Geodetic::from_degrees(numbers[0], numbers[1], numbers[2]).unwrap())
}

/// A place as others read it, in the site's axes.
fn local(latitude: f64, longitude: f64, height: f64) -> Point3<f64> {
    frame().local(Geodetic::from_degrees(latitude, longitude, height).unwrap())
}

fn number(value: &Value, pointer: &str) -> f64 {
    let found = value.pointer(pointer).unwrap_or_else(|| panic!("{pointer} of {value}"));
    found.as_f64().or_else(|| found.as_str()?.parse().ok()).unwrap()
}

/// A place that somebody has read, with whose it is and when.
struct Seen {
    time_s: f64,
    id: u64,
    place: Point3<f64>,
}

/// Compares what was read with the table: at least a number of places, none off by more.
fn assert_places(exported: &Exported, read: &[Seen], least: usize, off_m: f64) {
    let table = exported.table(read.iter().map(|read| read.time_s));
    let mut held = 0;
    for Seen { time_s, id, place } in read {
        let Some(row) = table.get(&(milliseconds(*time_s), *id)) else { continue };
        let off = (row.place() - place).norm();
        assert!(off < off_m, "track {id} at {time_s}: {off} m beside the table");
        held += 1;
    }
    assert!(held >= least, "{held} of {} are in the table", read.len());
}

#[test]
fn cursor_on_target_is_what_the_table_says() {
    let exported = Exported::new();
    let Some(read) = exported.read("cot", &["--cot-type", "a-u-A-M-H-Q"]) else { return };
    let events = read["events"].as_array().unwrap();
    let place = |event: &Value| Seen {
        time_s: number(event, "/time") * 1e-9,
        id: event["uid"].as_str().unwrap().rsplit('.').next().unwrap().parse().unwrap(),
        place: local(number(event, "/lat"), number(event, "/lon"), number(event, "/hae")),
    };
    let places: Vec<Seen> = events.iter().map(place).collect();
    // A centimetre by each of the three; the time is cut to milliseconds, in which it flies as far.
    assert_places(&exported, &places, 80, 0.03);
    for event in events {
        assert_eq!(event["type"], "a-u-A-M-H-Q");
        assert!(number(event, "/stale") > number(event, "/start"));
    }
    // The circular error lies between the horizontal deviations' root mean square and their sum.
    let table = exported.table(places.iter().map(|read| read.time_s));
    for (event, read) in events.iter().zip(&places) {
        let Some(row) = table.get(&(milliseconds(read.time_s), read.id)) else { continue };
        let (circular, linear) = (number(event, "/ce"), number(event, "/le"));
        assert!(circular <= row.sd_m + 0.015 && linear <= row.sd_m + 0.015, "{event}");
        assert!(circular.hypot(circular).hypot(linear) >= row.sd_m - 0.03, "{event}");
        let speed = row.vx.hypot(row.vy).hypot(row.vz);
        assert!((number(event, "/speed") - speed).abs() < 0.02, "{event}");
    }
}

#[test]
fn sapient_is_what_the_table_says() {
    let exported = Exported::new();
    let Some(read) = exported.read("sapient", &[]) else { return };
    let messages = read["messages"].as_array().unwrap();
    let kinds: Vec<&str> = messages.iter().filter_map(|message| message["kind"].as_str()).collect();
    assert_eq!(kinds[0].to_lowercase(), "registration");
    let detections: Vec<&Value> =
        messages.iter().filter(|message| message.get("object_id").is_some()).collect();
    let place = |message: &&Value| Seen {
        time_s: number(message, "/time") * 1e-9,
        id: message["id"].as_str().unwrap().parse().unwrap(),
        place: local(
            number(message, "/location/y"),
            number(message, "/location/x"),
            number(message, "/location/z"),
        ),
    };
    let places: Vec<Seen> = detections.iter().map(place).collect();
    assert_places(&exported, &places, 80, 1e-3);
    let table = exported.table(places.iter().map(|read| read.time_s));
    for (message, read) in detections.iter().zip(&places) {
        let Some(row) = table.get(&(milliseconds(read.time_s), read.id)) else { continue };
        let sd_m =
            (number(message, "/location/x_error") * 111_320.0 * 48.35_f64.to_radians().cos())
                .hypot(number(message, "/location/y_error") * 111_320.0)
                .hypot(number(message, "/location/z_error"));
        assert!((sd_m / row.sd_m - 1.0).abs() < 0.02, "{sd_m} and {}", row.sd_m);
        assert!((number(message, "/enu_velocity/up_rate") - row.vz).abs() < 1e-3);
    }
}

#[test]
fn asterix_is_what_the_table_says() {
    let exported = Exported::new();
    let Some(read) = exported.read("asterix", &["--asterix-source", "25,10"]) else { return };
    let records = read["records"].as_array().unwrap();
    let place = |record: &Value| Seen {
        time_s: number(record, "/I070/ToT/val"),
        id: number(record, "/I040/TrkN/val") as u64,
        place: local(
            number(record, "/I105/Lat/val"),
            number(record, "/I105/Lon/val"),
            number(record, "/I130/Alt/val") * 0.3048,
        ),
    };
    let places: Vec<Seen> = records.iter().map(place).collect();
    // The time is told to 1/128 s, so the table is asked for what is nearest: a target of 20 m/s
    // flies 8 cm meanwhile. The place is told to 0.6 m, the height to 1.9 m.
    let tracks = exported.table((0..300).map(|tenth| 0.1 * f64::from(tenth)));
    assert!(records.len() > 80);
    for read in &places {
        let near = tracks.values().filter(|row| row.track_id == read.id);
        let off = near
            .filter(|row| (row.t - read.time_s).abs() < 0.11)
            .map(|row| {
                let ahead = read.time_s - row.t;
                let flown = nalgebra::Vector3::new(row.vx, row.vy, row.vz) * ahead;
                (row.place() + flown - read.place).norm()
            })
            .reduce(f64::min);
        assert!(off.is_none_or(|off| off < 1.6), "track {} at {}: {off:?}", read.id, read.time_s);
    }
    let height_sd_m = number(&records[40], "/I500/AGA/AGA_Acc/val") * 0.3048;
    assert!((1.9..2.0).contains(&height_sd_m), "one step, as a few centimetres are less");
}

#[test]
fn flights_are_what_the_table_says() {
    let exported = Exported::new();
    let Some(geojson) = exported.read("geojson", &[]) else { return };
    let Some(kml) = exported.read("kml", &["--geoid", "45"]) else { return };
    let features = geojson["features"].as_array().unwrap();
    let placemarks = kml["placemarks"].as_array().unwrap();
    assert_eq!((features.len(), placemarks.len()), (2, 2));
    for (feature, placemark) in features.iter().zip(placemarks) {
        let line = feature["geometry"]["coordinates"].as_array().unwrap();
        let coordinates = placemark["coordinates"].as_array().unwrap();
        assert!(line.len() > 40 && line.len() == coordinates.len());
        let id: u64 = feature["id"].as_str().unwrap().parse().unwrap();
        let first = local(number(&line[0], "/1"), number(&line[0], "/0"), number(&line[0], "/2"));
        let at = 1.3;
        assert_places(&exported, &[Seen { time_s: at, id, place: first }], 1, 0.03);
        let above_sea = number(&coordinates[0], "/2");
        assert!((number(&line[0], "/2") - 45.0 - above_sea).abs() < 0.011, "{above_sea}");
    }
}

#[test]
fn a_recording_opens_in_the_schemas_of_foxglove() {
    let exported = Exported::new();
    let Some(read) = exported.read("foxglove", &[]) else { return };
    let schemas = &read["schemas"];
    assert!(number(schemas, "/foxglove.LocationFix") > 100.0, "{schemas}");
    for (schema, count) in [("CameraCalibration", 3.0), ("FrameTransform", 3.0)] {
        assert_eq!(number(schemas, &format!("/foxglove.{schema}")), count, "{schemas}");
    }
    assert_eq!(number(schemas, "/crossfix.v1.BearingFrame"), 1875.0, "ours are there as before");
    let lens = &read["topics"]["/camera/north/calibration"]["last_message"];
    assert_eq!(lens["frame_id"], "north");
}

/// A site whose agents play, told by an outlet; what came of it is read from `socket`.
struct Told {
    site: Site,
    _processes: Vec<Process>,
    outlet: Process,
}

impl Told {
    fn start(format: &str, options: &[&str]) -> Self {
        let site = Site::new(PLAYED_S);
        let anchor =
            "[anchor]\nlatitude_deg = 48.3538\nlongitude_deg = 11.7861\nheight_m = 490.0\n";
        site.write("network.toml", &format!("{}{anchor}", site.text("network.toml")));
        let network = site.path("network.toml");
        let mut processes = vec![site.start_fusion()];
        let fixed = ["outlet", format, "-c", &network, "--rate-hz", "5"];
        let outlet = site.start(&[&fixed, options].concat());
        processes.extend(site.start_agents(now_seconds() + 1.0, &[]));
        Self { site, _processes: processes, outlet }
    }
}

/// What comes over a connection until it has said so much, or the patience ends.
fn hear(stream: &mut impl Read, enough: impl Fn(&[u8]) -> bool) -> Vec<u8> {
    let (mut heard, deadline) = (Vec::new(), Instant::now() + PATIENCE);
    let mut buffer = vec![0; 65_536];
    while !enough(&heard) && Instant::now() < deadline {
        match stream.read(&mut buffer) {
            Ok(0) => break,
            Ok(length) => heard.extend(&buffer[..length]),
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {}
            Err(error) => panic!("{error}"),
        }
    }
    heard
}

/// Number of whole Cursor-on-Target events that have come.
fn events(heard: &[u8]) -> usize {
    String::from_utf8_lossy(heard).matches("</event>").count()
}

#[test]
fn live_tracks_go_out_as_datagrams() {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    let address = format!("udp://{}", socket.local_addr().unwrap());
    let told = Told::start("cot", &["--to", &address]);
    let mut datagram = vec![0; 65_536];
    let mut heard = Vec::new();
    while events(&heard) < 10 {
        let length = socket.recv(&mut datagram).unwrap();
        assert_eq!(events(&datagram[..length]), 1, "one event a datagram");
        heard.extend(&datagram[..length]);
    }
    assert!(told.outlet.stop());
    let file = told.site.path("live.cot");
    std::fs::write(&file, heard).unwrap();
    if let Some(read) = read_by_others(&["cot", &file]) {
        assert_eq!(read["events"].as_array().unwrap().len(), 10);
    }
}

#[test]
fn live_tracks_go_out_over_a_connection_that_is_made_again() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp://{}", listener.local_addr().unwrap());
    let told = Told::start("cot", &["--to", &address]);
    for _ in 0..2 {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        let heard = hear(&mut stream, |heard| events(heard) >= 4);
        assert!(events(&heard) >= 4);
    }
    assert!(told.outlet.stop());
}

#[test]
fn tracks_of_a_fusion_centre_that_has_died_are_said_no_more() {
    let site = Site::new(PLAYED_S);
    let anchor = "[anchor]\nlatitude_deg = 48.3538\nlongitude_deg = 11.7861\nheight_m = 490.0\n";
    site.write("network.toml", &format!("{}{anchor}", site.text("network.toml")));
    let (network, file) = (site.path("network.toml"), site.path("live.jsonl"));
    let fusion = site.start_fusion();
    let outlet =
        site.start(&["outlet", "geojson", "-c", &network, "--rate-hz", "5", "--to", &file]);
    let _agents = site.start_agents(now_seconds() + 1.0, &[]);
    let features = || -> Vec<usize> {
        let text = std::fs::read_to_string(&file).unwrap_or_default();
        let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
        lines.map(|line| line["features"].as_array().unwrap().len()).collect()
    };
    let deadline = Instant::now() + PATIENCE;
    while features().last() != Some(&2) && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(100));
    }
    fusion.crash();
    std::thread::sleep(Duration::from_secs(4));
    assert_eq!(features().last(), Some(&0), "nothing is left");
    assert!(features().iter().filter(|count| **count == 2).count() < 40);
    assert!(outlet.stop());
}

#[test]
fn sapient_waits_until_its_registration_is_taken_and_then_tells() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("tcp://{}", listener.local_addr().unwrap());
    let told = Told::start("sapient", &["--to", &address]);
    let (mut stream, _) = listener.accept().unwrap();
    stream.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
    let frames = |heard: &[u8]| {
        let (mut count, mut rest) = (0, heard);
        while let Some((head, more)) = rest.split_first_chunk::<4>()
            && let Some(next) = more.get(u32::from_le_bytes(*head) as usize..)
        {
            (count, rest) = (count + 1, next);
        }
        count
    };
    let registration = hear(&mut stream, |heard| frames(heard) >= 1);
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(frames(&registration), 1, "nothing before the answer");
    // An acknowledgement: SapientMessage.registration_ack (field 5) with acceptance (field 1).
    stream.write_all(&[4, 0, 0, 0, 0x2a, 2, 0x08, 1]).unwrap();
    let heard = hear(&mut stream, |heard| frames(heard) >= 6);
    assert!(frames(&heard) >= 6, "{}", frames(&heard));
    assert!(told.outlet.stop());
}

#[test]
fn what_takes_no_more_ends_the_command_and_a_receiver_that_refuses_does_not() {
    let told = Told::start("geojson", &["--to", "/dev/full"]);
    let mut outlet = told.outlet;
    assert_eq!(outlet.exit_code(), Some(1));
    let refused = crossfix_tests::crossfix(&[
        "outlet",
        "sapient",
        "-c",
        &told.site.path("network.toml"),
        "--to",
        "udp://127.0.0.1:9",
    ]);
    let said = String::from_utf8(refused.stderr).unwrap();
    assert!(said.contains("SAPIENT waits for an answer"), "{said}");
}

#[test]
fn foxglove_connects_to_a_live_site() {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let address = format!("127.0.0.1:{port}");
    let site = Site::new(PLAYED_S);
    let network = site.path("network.toml");
    let fusion = site.start_fusion();
    let server = site.start(&["outlet", "foxglove", "-c", &network, "--listen", &address]);
    let _agents = site.start_agents(now_seconds() + 1.0, &[]);
    std::thread::sleep(Duration::from_secs(3));
    if let Some(read) = read_by_others(&["foxglove", &address, "100"]) {
        let channels = read["channels"].as_object().unwrap();
        assert_eq!(channels["/crossfix/test/fusion/tracks"], "crossfix.v1.TrackFrame", "{read}");
        assert_eq!(channels["/camera/north/calibration"], "foxglove.CameraCalibration", "{read}");
    }
    assert!(server.stop() && fusion.stop());
}

#[test]
fn an_outlet_without_a_place_on_earth_says_what_it_needs() {
    let site = Site::new(1.0);
    let output = crossfix_tests::crossfix(&["outlet", "cot", "-c", &site.path("network.toml")]);
    assert_eq!(output.status.code(), Some(1));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.contains("section [anchor] with latitude_deg"), "{said}");
}

#[test]
fn a_recording_of_two_runs_is_told_whole_though_the_second_is_of_an_earlier_time() {
    use crossfix_message::{
        Channel, Key, Payload, Timestamp, Track, TrackFrame, TrackState, Vector3,
    };
    use crossfix_recording::{Entry, RecordingWriter};

    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let mut writer = RecordingWriter::create(path("runs.mcap").as_ref()).unwrap();
    for (id, begin_s) in [(1, 1000.0), (2, 0.0)] {
        for tenth in 0..50 {
            let time = Timestamp::from_seconds(begin_s + 0.1 * f64::from(tenth));
            let track = Track {
                id,
                state: TrackState::Confirmed.into(),
                position: Some(Vector3 { x: f64::from(tenth), y: 0.0, z: 30.0 }),
                velocity: Some(Vector3 { x: 10.0, y: 0.0, z: 0.0 }),
                covariance: (0..36).map(|k| if k % 7 == 0 { 0.01 } else { 0.0 }).collect(),
                ..Default::default()
            };
            let frame =
                TrackFrame { time_ns: time.nanos(), tracks: vec![track], ..Default::default() };
            let key = Key::new("test".parse().unwrap(), Channel::Tracks);
            let entry = Entry { key, data_time: time, arrival: time, data: frame.encode() };
            writer.write(&entry).unwrap();
        }
    }
    writer.finish().unwrap();
    let (runs, file) = (path("runs.mcap"), path("flights.geojson"));
    succeed(&["export", &runs, "--anchor", ANCHOR, "--rate-hz", "10", "--geojson", &file]);
    let told: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    let lengths: Vec<usize> = told["features"]
        .as_array()
        .unwrap()
        .iter()
        .map(|feature| feature["geometry"]["coordinates"].as_array().unwrap().len())
        .collect();
    assert_eq!(lengths.len(), 2, "{told}");
    assert!(lengths.iter().all(|length| *length >= 45), "{lengths:?}");
}
