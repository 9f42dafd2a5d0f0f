//! Files of cameras and networks with typing errors, or that were never meant to be such files.

use crossfix_geometry::ImageSize;
use proptest::prelude::*;
use proptest::sample::{Index, select};

use super::*;

/// Camera files of each kind.
const CAMERAS: &[&str] = &[
    include_str!("../../../../configs/site/north.toml"),
    include_str!("../../../../configs/drone-tracking/sonyG.toml"),
    r#"
name = "gate"
network = "network.toml"
calibration = "calibration.toml"
takes_cues = true
source = { kind = "stream", url = "rtsp://eye:secret@10.0.0.5/stream1", transport = "udp", user = "eye", password_file = "p" }
clock = { source = "camera", sd_s = 0.02, offset_s = -0.1, drift_ppm = 3.0 }
preview = { rate_hz = 4.0, divisor = 2 }
"#,
    r#"
name = "roof"
network = "network.toml"
intrinsics = "lens.yaml#cam1"
boxes = [[10.0, 20.0, 30.0, 40.0]]
[pose]
position_m = [1.0, 2.0, 3.0]
rotation = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
rotation_sd_mrad = 1.0
position_sd_m = 0.05
[source]
kind = "usb"
device = "/dev/video0"
rate_hz = 30.0
latency_s = 0.02
"#,
    r#"
name = "mast"
network = "network.toml"
source = { kind = "gige", address = "10.0.0.7", rate_hz = 20.0 }
"#,
    r#"
name = "dome"
network = "network.toml"
[mount]
azimuth_deg = [-170.0, 170.0]
elevation_deg = [-5.0, 85.0]
angle_sd_mrad = 0.5
[mount.onvif]
pan_deg = [180.0, -180.0]
tilt_deg = [-90.0, 90.0]
url = "http://10.0.0.9/onvif/device_service"
user = "eye"
password_file = "dome.password"
[source]
kind = "gstreamer"
pipeline = "videotestsrc ! video/x-raw"
"#,
];

/// Network files with every kind of entry.
const NETWORKS: &[&str] = &[
    include_str!("../../../../configs/site/network.toml"),
    r#"
site = "field"
mode = "client"
routers = ["tls/10.0.0.1:7447"]
[anchor]
latitude_deg = 48.35
longitude_deg = 11.78
height_m = 490.0
[security]
certificates = "certificates"
revoked = { camera-north = 1 }
[cameras]
north = "tcp/10.0.0.2:7451"
east = "tcp/10.0.0.3:7451"
[areas.near]
fusion = "tcp/10.0.0.4:7450"
cameras = ["north", "east"]
"#,
];

/// Wrong values as people and accidents write them.
const ODD: &[&str] = &[
    "nan",
    "-inf",
    "1e308",
    "-1",
    "0",
    "18446744073709551616",
    "\"\"",
    "\"\\u0000\"",
    "\"..\"",
    "[]",
    "[[]]",
    "{}",
    "true",
    "1979-05-27",
    "\n[source]\n",
    "\u{e9}\u{202e}",
    "=",
];

/// Reads and checks a file as far as that goes without opening a source.
fn read(kind: FileKind, text: &str) -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("file.toml");
    std::fs::write(&path, text)?;
    if kind == FileKind::Network {
        let network = load_network(&path)?;
        for (area, _) in network.centres() {
            let _ = network.cameras_of(area.as_ref());
        }
        network.cameras.keys().for_each(|camera| drop(network.centres_of(camera)));
        return Ok(());
    }
    let file = CameraFile::load(&path, &[])?;
    let size = Some(ImageSize { width: 640, height: 480 });
    let _ = (file.lens(&path), file.live(size), file.calibrated(), file.boxes().count());
    file.described(&path).map(|_| ())
}

fn any_file() -> impl Strategy<Value = (FileKind, &'static str)> {
    let cameras = CAMERAS.iter().map(|text| (FileKind::Camera, *text));
    let networks = NETWORKS.iter().map(|text| (FileKind::Network, *text));
    select(cameras.chain(networks).collect::<Vec<_>>())
}

#[test]
fn each_is_read_as_far_as_the_other_files_are_there() {
    for text in NETWORKS {
        read(FileKind::Network, text).unwrap();
    }
    for text in CAMERAS {
        let words = format!("{:#}", read(FileKind::Camera, text).unwrap_err());
        let lacks = ["cannot read", "cannot open", "give both `intrinsics`", "key `calibration`"];
        assert!(lacks.iter().any(|lack| words.contains(lack)), "{words}");
    }
}

proptest! {
    #[test]
    fn a_value_of_another_kind_is_survived((kind, text) in any_file(), odd in select(ODD), place: Index) {
        let values: Vec<usize> = text.match_indices(" = ").map(|(at, _)| at + 3).collect();
        let begin = *place.get(&values);
        let end = text[begin..].find(['\n', ',', '}']).map_or(text.len(), |length| begin + length);
        let _ = read(kind, &[&text[..begin], odd, &text[end..]].concat());
    }

    #[test]
    fn other_text_in_the_place_of_any_is_survived(
        (kind, text) in any_file(),
        cut: [Index; 2],
        other in "\\PC{0,12}",
    ) {
        let places: Vec<usize> = text.char_indices().map(|(at, _)| at).collect();
        let [a, b] = cut.map(|index| *index.get(&places));
        let _ = read(kind, &[&text[..a.min(b)], &other, &text[a.max(b)..]].concat());
    }

    #[test]
    fn any_text_is_survived(text in "\\PC{0,200}") {
        prop_assert!(read(FileKind::Camera, &text).is_err() && read(FileKind::Network, &text).is_err());
    }
}
