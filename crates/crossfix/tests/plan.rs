//! `crossfix plan` on the site to copy.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::path::Path;

use assert_cmd::Command;
use serde_json::Value;

/// The site to copy.
const SITE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/site");
/// Options of a small volume, with cells that are quick to compute.
const VOLUME: [&str; 6] = ["--min", "-60,-40,20", "--max", "60,40,100", "--step", "20"];

fn plan(arguments: &[&str]) -> Command {
    let mut command = Command::new(assert_cmd::cargo::cargo_bin!("crossfix"));
    command.arg("plan").args(arguments);
    command
}

fn json(arguments: &[&str]) -> Value {
    let output = plan(&[SITE, "--json"]).args(VOLUME).args(arguments).output().unwrap();
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn layers_cameras_and_one_more_camera_are_reported() {
    let output = plan(&[SITE, "--target-size", "1"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}");
    for word in ["altitude [m]", "\nall ", "\neast ", "camera 4 helps most at", "smallest target"] {
        assert!(text.contains(word), "no `{word}` in:\n{text}");
    }
}

#[test]
fn a_small_target_is_fixed_in_fewer_cells_and_a_better_pose_gives_better_fixes() {
    let median = |report: &Value| report["whole"]["position_sd_median_m"].as_f64().unwrap();
    let fixed = |report: &Value| report["whole"]["fixed"].as_f64().unwrap();
    let (large, small) = (json(&["--target-size", "1"]), json(&["--target-size", "0.5"]));
    assert!(
        fixed(&large) > 0.8 && fixed(&small) < 0.5 * fixed(&large),
        "{} {}",
        fixed(&large),
        fixed(&small)
    );
    for cell in large["cells"].as_array().unwrap() {
        let seen = cell["cameras"].as_array().unwrap().len();
        assert_eq!(cell["accuracy"].is_null(), seen < 2, "{cell}");
    }
    let exact = json(&[
        "--target-size",
        "1",
        "--rotation-sd-deg",
        "0",
        "--position-sd",
        "0",
        "--clock-sd",
        "0",
    ]);
    assert!(median(&exact) < 0.5 * median(&large), "{} {}", median(&exact), median(&large));
    let late = json(&["--target-size", "1", "--clock-sd", "0.1"]);
    assert!(
        median(&late) > 0.8 && median(&late) < 1.2,
        "1.5 m along the flight in each camera: {}",
        median(&late)
    );
}

#[test]
fn the_map_is_geojson_with_its_corners_where_they_belong() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("plan.geojson");
    let map = ["--geojson", path.to_str().unwrap(), "--anchor", "0,0,0"];
    plan(&[SITE, "--target-size", "1"]).args(VOLUME).args(map).assert().success();
    let map: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    assert_eq!(map["type"], "FeatureCollection");
    let features = map["features"].as_array().unwrap();
    let of = |kind: &str| features.iter().filter(|f| f["properties"]["kind"] == kind).count();
    assert_eq!((of("cell"), of("camera"), of("candidate")), (6 * 4 * 4, 3, 120));

    let first = &features[0];
    assert_eq!(first["properties"]["altitude_m"], 30.0);
    let ring = first["geometry"]["coordinates"][0].as_array().unwrap();
    assert_eq!(ring.len(), 5);
    assert_eq!(ring[0], ring[4], "closed");
    let corner =
        |index: usize| [ring[index][0].as_f64().unwrap(), ring[index][1].as_f64().unwrap()];
    // On the equator 30 m up: east by the equator's radius, north by the meridian's, 6 335 439 m.
    let east = (-60.0 / (6_378_137.0 + 30.0_f64)).to_degrees();
    let north = (-40.0 / (6_335_439.3 + 30.0_f64)).to_degrees();
    let [longitude, latitude] = corner(0);
    assert!((longitude - east).abs() < 2e-8, "{longitude} against {east}");
    assert!((latitude - north).abs() < 2e-8, "{latitude} against {north}");
    // Anticlockwise: south-east and north-west follow.
    assert!(corner(1)[0] > longitude && corner(3)[1] > latitude);
}

#[test]
fn a_map_without_an_anchor_is_misuse_that_names_the_option() {
    let output = plan(&[SITE, "--geojson", "plan.geojson"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8(output.stderr).unwrap().contains("--anchor <LAT,LON,HEIGHT>"));
    assert!(!Path::new("plan.geojson").exists());
}

#[test]
fn a_site_is_planned_before_it_has_videos_and_a_network() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["north", "east"] {
        for extension in ["toml", "yaml"] {
            let file = format!("{name}.{extension}");
            std::fs::copy(Path::new(SITE).join(&file), folder.path().join(&file)).unwrap();
        }
    }
    let picture = folder.path().join("plan.rrd");
    let site = folder.path().to_str().unwrap();
    plan(&[site, "--target-size", "1", "--save", picture.to_str().unwrap()]).assert().success();
    assert!(picture.metadata().unwrap().len() > 10_000);
}

#[test]
fn what_cannot_be_planned_is_said_in_a_line() {
    let says = |arguments: &[&str], code: i32, words: &str| {
        let output = plan(arguments).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(code), "{stderr}");
        assert!(stderr.contains(words), "no `{words}` in:\n{stderr}");
    };
    says(&[SITE, "--min", "0,0,0", "--max", "10,-10,10"], 2, "is empty");
    says(&[SITE, "--min", "0,0,0", "--max", "9000,9000,9000", "--step", "1"], 2, "larger step");
    says(&[SITE, "--min", "0,0,0"], 2, "--max");
    says(&[SITE, "--pixel-sd", "0"], 2, "it must be from 0.01 to 1000 px");
    says(&[concat!(env!("CARGO_MANIFEST_DIR"), "/src")], 1, "holds no camera file");
}
