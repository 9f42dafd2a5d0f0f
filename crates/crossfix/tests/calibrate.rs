//! The command `calibrate` on files as people write them.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::path::Path;

use assert_cmd::Command;
use crossfix_calibration::SiteCalibration;
use crossfix_geometry::{Camera, Pose};
use nalgebra::Point3;

/// The file of a camera.
const NORTH: &str = r#"
name = "north"
network = "network.toml"
intrinsics = "north.yaml"
[source]
kind = "video"
path = "videos/north"
start_s = 0.0
rate_hz = 25.0
[clock]
source = "ntp"
sd_s = 0.002
"#;

/// The file of its lens.
const LENS: &str = "image_width: 1920\nimage_height: 1080\ncamera_name: north\n\
    camera_matrix: {rows: 3, cols: 3, data: [1460.0, 0.0, 959.5, 0.0, 1460.0, 539.5, 0.0, 0.0, 1.0]}\n\
    distortion_model: plumb_bob\n\
    distortion_coefficients: {rows: 1, cols: 5, data: [-0.01, 0.05, 0.0, 0.0, 0.0]}\n";

/// Places round a camera at (15, 120, 3) m, and how far beside the first is clicked.
fn landmarks(beside_px: f64) -> String {
    let intrinsics = crossfix_calibration::intrinsics_from_yaml(LENS).unwrap();
    let pose =
        Pose::looking_at(Point3::new(15.0, 120.0, 3.0), Point3::new(0.0, 0.0, 46.0)).unwrap();
    let camera = Camera::new(intrinsics, pose).unwrap();
    let places = [
        [-20.0, 40.0, 12.0],
        [25.0, 20.0, 60.0],
        [5.0, 60.0, 30.0],
        [-30.0, -10.0, 55.0],
        [30.0, 50.0, 20.0],
        [0.0, 80.0, 10.0],
    ];
    let row = |(k, [x, y, z]): (usize, [f64; 3])| {
        let pixel = camera.project(Point3::new(x, y, z)).unwrap();
        let beside = if k == 0 { beside_px } else { 0.0 };
        format!("mark {k},{},{},{x},{y},{z},0.05\n", pixel.x() + beside, pixel.y())
    };
    let rows: String = places.into_iter().enumerate().map(row).collect();
    format!("landmark,x_px,y_px,east_m,north_m,up_m,sd_m\n{rows}")
}

fn site(landmarks: &str) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    write("north.toml", NORTH);
    write("north.yaml", LENS);
    write("points.csv", landmarks);
    folder
}

/// Exit code, stdout and stderr of `calibrate landmarks` for a camera of the site.
fn by_landmarks(folder: &Path, camera: &str) -> (Option<i32>, String, String) {
    let file = |name: &str| folder.join(name).display().to_string();
    let output = Command::new(assert_cmd::cargo::cargo_bin!("crossfix"))
        .args(["calibrate", "landmarks", &file("north.toml"), "--camera", camera])
        .args(["--landmarks", &file("points.csv"), "-o", &file("calibration.toml")])
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn landmarks_give_a_pose_and_a_second_camera_stands_beside_the_first() {
    let folder = site(&landmarks(0.0));
    let (code, said, log) = by_landmarks(folder.path(), "north");
    assert!(code == Some(0) && said.contains("good"), "{said}{log}");
    let read = || {
        let text = std::fs::read_to_string(folder.path().join("calibration.toml")).unwrap();
        SiteCalibration::from_toml(&text).unwrap()
    };
    let place = read().cameras()[0].camera.pose().position();
    assert!((place - Point3::new(15.0, 120.0, 3.0)).norm() < 1e-3, "{place}");
    let south = NORTH.replace("name = \"north\"", "name = \"south\"");
    std::fs::write(folder.path().join("north.toml"), south).unwrap();
    let (code, said, log) = by_landmarks(folder.path(), "south");
    assert!(code == Some(0) && said.contains("beside north"), "{said}{log}");
    assert_eq!(read().cameras().len(), 2);
}

/// A picture tells nothing of a clock: what a flight has told of it stays.
#[test]
fn a_new_pose_leaves_the_clock_of_a_flight() {
    let folder = site(&landmarks(0.0));
    let (code, said, log) = by_landmarks(folder.path(), "north");
    assert!(code == Some(0), "{said}{log}");
    let file = folder.path().join("calibration.toml");
    let text = std::fs::read_to_string(&file).unwrap();
    let flown = text
        .replace("knots_s = []", "knots_s = [[0.0, -29.8, 0.001], [60.0, -29.8, 0.001]]")
        .replace("lasting_px = 0.5", "lasting_px = 0.9");
    assert_ne!(text, flown);
    std::fs::write(&file, flown).unwrap();
    let (code, said, log) = by_landmarks(folder.path(), "north");
    assert!(code == Some(0), "{said}{log}");
    let site = SiteCalibration::from_toml(&std::fs::read_to_string(&file).unwrap()).unwrap();
    assert_eq!(site.cameras()[0].clock.at(30.0).ahead_s, -29.8);
    assert_eq!(site.cameras()[0].noise.lasting_px, 0.9);
}

#[test]
fn a_calibration_is_compared_with_itself_and_not_with_another_site_s() {
    let folder = site(&landmarks(0.0));
    by_landmarks(folder.path(), "north");
    let compare = |other: &str| {
        let file = |name: &str| folder.path().join(name).display().to_string();
        Command::new(assert_cmd::cargo::cargo_bin!("crossfix"))
            .args(["calibrate", "compare", &file("calibration.toml"), &file(other)])
            .output()
            .unwrap()
    };
    let same = compare("calibration.toml");
    let said = String::from_utf8(same.stdout).unwrap();
    assert!(same.status.success() && said.contains("north"), "{said}");
    let text = std::fs::read_to_string(folder.path().join("calibration.toml")).unwrap();
    let other = text.replace("\"north\"", "\"south\"");
    std::fs::write(folder.path().join("other.toml"), other).unwrap();
    let refused = compare("other.toml");
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8(refused.stderr).unwrap().contains("no camera in common"));
}

#[test]
fn a_click_outside_of_the_image_is_refused() {
    let text = landmarks(0.0);
    let row = text.lines().nth(1).unwrap();
    let outside = text.replace(row, "mark 0,-200,300,-20,40,12,0.05");
    let (code, said, log) = by_landmarks(site(&outside).path(), "north");
    assert_eq!(code, Some(1), "{said}{log}");
    assert!(log.contains("`mark 0`") && log.contains("outside"), "{log}");
}

#[test]
fn a_wrong_click_is_named_and_nothing_is_written() {
    let folder = site(&landmarks(40.0));
    let (code, said, log) = by_landmarks(folder.path(), "north");
    assert_eq!(code, Some(1), "{said}{log}");
    assert!(said.contains("without `mark 0`") && log.contains("nothing is written"), "{said}{log}");
    assert!(!folder.path().join("calibration.toml").exists());
}

/// The recording has two targets, so nothing is adjusted here: what is wrong of the landmarks is
/// said before.
#[test]
fn landmarks_of_a_flight_are_of_its_cameras_and_in_their_images() {
    let recording = concat!(env!("CARGO_MANIFEST_DIR"), "/../../recordings/two-uavs.mcap");
    let said = |rows: &str| {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name).display().to_string();
        let head = "camera,landmark,x_px,y_px,east_m,north_m,up_m,sd_m\n";
        std::fs::write(file("points.csv"), format!("{head}{rows}")).unwrap();
        let output = Command::new(assert_cmd::cargo::cargo_bin!("crossfix"))
            .args(["calibrate", "flight", recording, "--landmarks", &file("points.csv")])
            .args(["-o", &file("calibration.toml")])
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(1));
        assert!(!Path::new(&file("calibration.toml")).exists());
        String::from_utf8(output.stderr).unwrap()
    };
    let unknown = said("nort,mast,10,20,1,2,3,0.1\n");
    assert!(unknown.contains("`nort`") && unknown.contains("north"), "{unknown}");
    let outside = said("north,mast,5000,20,1,2,3,0.1\n");
    assert!(outside.contains("outside of the image"), "{outside}");
    let two_places = said("north,mast,10,20,1,2,3,0.1\neast,mast,10,20,9,2,3,0.1\n");
    assert!(two_places.contains("another place"), "{two_places}");
}

#[test]
fn too_few_landmarks_are_told_what_helps() {
    let all = landmarks(0.0);
    let few: String = all.split_inclusive('\n').take(3).collect();
    let (code, said, log) = by_landmarks(site(&few).path(), "north");
    assert_eq!(code, Some(1), "{said}{log}");
    assert!(log.contains("--positions"), "{log}");
}

/// What `calibrate check` does with a recording that is shipped: exit code, stdout and stderr.
fn checked(more: &[&str]) -> (Option<i32>, String, String) {
    let recording = concat!(env!("CARGO_MANIFEST_DIR"), "/../../recordings/two-uavs.mcap");
    let output = Command::new(assert_cmd::cargo::cargo_bin!("crossfix"))
        .args(["calibrate", "check", recording])
        .args(more)
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code(), text(output.stdout), text(output.stderr))
}

#[test]
fn cameras_of_a_recording_that_stand_as_they_say_fit() {
    let (code, said, log) = checked(&[]);
    assert_eq!(code, Some(0), "{said}{log}");
    for camera in ["east", "north", "west"] {
        assert!(
            said.lines().any(|line| line.starts_with(camera) && line.ends_with("fits")),
            "{said}"
        );
    }
}

#[test]
fn a_site_without_a_calibration_is_told_what_to_do() {
    let folder = site("");
    let (code, _, log) = checked(&["-c", &folder.path().display().to_string()]);
    assert_eq!(code, Some(1));
    assert!(log.contains("holds no calibration.toml: without -c"), "{log}");
}
