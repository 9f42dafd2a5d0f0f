//! Cameras calibrated by one half of a real flight, and the other half fused with that.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::path::{Path, PathBuf};

use crossfix_calibration::{CalibratedCamera, SiteCalibration};
use crossfix_geometry::{Camera, Pose};
use crossfix_tests::{crossfix, real_data, succeed};
use nalgebra::{Point3, Rotation3, Vector3};
use serde_json::Value;

struct Flight {
    folder: tempfile::TempDir,
    data: String,
    dataset: &'static str,
    cameras: &'static str,
}

impl Flight {
    fn new(data: &Path, dataset: &'static str, cameras: &'static str) -> Self {
        let data = data.join("eth-multiview-drone").display().to_string();
        Self { folder: tempfile::tempdir().unwrap(), data, dataset, cameras }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn named(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    /// Imports a part of the flight as the cameras recorded it.
    fn import(&self, part: &str) -> String {
        let recording = self.named(&format!("{part}.mcap"));
        let log = self.named(&format!("{part}.csv"));
        let source = ["import", "drone-tracking-datasets", &self.data, "--dataset", self.dataset];
        let what = ["--cameras", self.cameras, "--part", part, "--raw", "--log-out", &log];
        succeed(&[&source[..], &what, &["-o", &recording]].concat());
        recording
    }

    /// Calibrates by one part, fuses the other, and says how good that is.
    fn figures(&self, min_cameras: &str) -> Value {
        let (flight, test) = (self.import("calibration"), self.import("test"));
        let (log, file) = (self.named("calibration.csv"), self.named("calibration.toml"));
        let calibrate = ["calibrate", "flight", &flight, "--log", &log, "--log-kind", "rtk"];
        succeed(&[&calibrate[..], &["-o", &file]].concat());
        self.fused(&test, &file, min_cameras)
    }

    /// Fuses a recording by a calibration, and says how good that is.
    fn fused(&self, recording: &str, calibration: &str, min_cameras: &str) -> Value {
        let tracks = self.named("tracks.mcap");
        succeed(&["replay", recording, "--fuse", "--calibration", calibration, "-o", &tracks]);
        let question = ["--min-cameras", min_cameras, "--truth-sd", "0.02", "--json"];
        let evaluated = succeed(&[&["evaluate", &tracks][..], &question].concat());
        serde_json::from_str(&evaluated).unwrap()
    }
}

/// The bounds are those that the project asks for. Six is honest for the NEES; less is caution.
fn check(figures: &Value, most_position_m: f64, most_velocity_mps: f64) {
    let number = |name: &str| figures[name].as_f64().unwrap();
    assert!(number("position_rmse_m") <= most_position_m, "{figures:#}");
    assert!(number("velocity_rmse_mps") <= most_velocity_mps, "{figures:#}");
    assert!(number("completeness") >= 0.995, "{figures:#}");
    let nees = figures["nees"]["mean"].as_f64().unwrap();
    assert!((3.0..12.0).contains(&nees), "{figures:#}");
}

#[test]
fn three_cameras_that_nobody_has_surveyed_place_the_drone_to_five_centimetres() {
    let Some(data) = real_data() else { return };
    let figures = Flight::new(&data, "3", "gopro3,sony5100,sonyG").figures("3");
    check(&figures, 0.055, 0.28);
}

#[test]
fn phones_whose_clocks_wander_are_calibrated_too() {
    let Some(data) = real_data() else { return };
    let cameras = "iphone6,p20pro,sonyG,sony5n_1920x1080";
    check(&Flight::new(&data, "1", cameras).figures("3"), 0.090, 0.29);
}

/// The other half of the flight, of which no log is read, by what the first half knew; also of a
/// recording that was made with a calibration, which another file than that is not taken for.
#[test]
fn a_night_later_the_site_is_at_least_as_good_without_a_log() {
    let Some(data) = real_data() else { return };
    let flight = Flight::new(&data, "1", "iphone6,p20pro,sonyG,sony5n_1920x1080");
    let before = flight.figures("3");
    let (test, known) = (flight.named("test.mcap"), flight.named("calibration.toml"));
    let proposed = flight.named("proposed.toml");
    let nightly = |recording: &str, prior: &str| {
        let options = ["--prior", prior, "-o", &proposed];
        crossfix(&[&["calibrate", "flight", recording][..], &options].concat()).status.success()
    };
    assert!(nightly(&test, &known));
    let after = flight.fused(&test, &proposed, "3");
    check(&after, 0.09, 0.29);
    let rmse = |figures: &Value| figures["position_rmse_m"].as_f64().unwrap();
    assert!(rmse(&after) < rmse(&before), "{} and {}", rmse(&after), rmse(&before));
    let corrected = flight.named("corrected.mcap");
    succeed(&["replay", &test, "--fuse", "--calibration", &known, "-o", &corrected]);
    let other = flight.named("other.toml");
    std::fs::copy(&proposed, &other).unwrap();
    assert!(!nightly(&corrected, &other));
    assert!(nightly(&corrected, &known));
    let again = flight.fused(&test, &proposed, "3");
    assert!((rmse(&again) - rmse(&after)).abs() < 0.01, "{} and {}", rmse(&again), rmse(&after));
}

/// Half of what was flown is held out, and what it is worth is said; a sheet of plots of each
/// camera and a picture for Rerun are written, and fit the figures.
#[test]
fn a_flight_is_shown_and_half_of_it_held_out() {
    let Some(data) = real_data() else { return };
    let flight = Flight::new(&data, "3", "gopro3,sony5100,sonyG");
    let recording = flight.import("calibration");
    let [log, file, plots, picture] =
        ["calibration.csv", "calibration.toml", "plots", "flight.rrd"].map(|n| flight.named(n));
    let calibrate = ["calibrate", "flight", &recording, "--log", &log, "--log-kind", "rtk"];
    let shown = ["--hold-out", "half", "--plots", &plots, "--save", &picture];
    let said = succeed(&[&calibrate[..], &shown, &["-o", &file, "--json"]].concat());
    let figures: Value = serde_json::from_str(&said).unwrap();
    // Two and a half minutes teach less than five: the whole part's bound is 0.055 m root mean
    // square.
    let held_out = &figures["held_out"]["against_log"];
    let number = |name: &str| held_out[name].as_f64().unwrap();
    assert!(number("found") > 0.99 && number("median_m") < 0.06, "{held_out:#}");
    assert!((0.5..5.0).contains(&number("median_nees")), "{held_out:#}");
    for camera in ["gopro3", "sony5100", "sonyG"] {
        let sheet = std::fs::read_to_string(flight.path("plots").join(format!("{camera}.svg")));
        let sheet = sheet.unwrap();
        assert!(sheet.starts_with("<svg") && sheet.trim_end().ends_with("</svg>"));
        // Labels are dots in several panels, evenly chosen ones of many.
        let cameras = figures["cameras"].as_array().unwrap();
        let own = cameras.iter().find(|own| own["name"] == camera).unwrap();
        let dots = sheet.matches("<circle").count() as f64;
        assert!(dots > 0.1 * own["used"].as_f64().unwrap(), "{camera}: {dots} dots");
    }
    assert!(std::fs::read(flight.path("flight.rrd")).unwrap().starts_with(b"RRF2"));
}

/// One half of the flight with its log says where the cameras stand; the other half, of which
/// nothing is known, must find them there by three places alone, with clocks that agree among
/// themselves.
#[test]
fn an_unknown_flight_finds_cameras_where_a_known_one_did() {
    let Some(data) = real_data() else { return };
    let flight = Flight::new(&data, "3", "gopro3,sony5100,sonyG");
    let (known, unknown) = (flight.import("calibration"), flight.import("test"));
    let (log, file) = (flight.named("calibration.csv"), flight.named("known.toml"));
    let log = ["--log", &log, "--log-kind", "rtk"];
    let said = succeed(&[&["calibrate", "flight", &known][..], &log, &["-o", &file]].concat());
    assert!(said.contains("rests on the log alone"), "{said}");
    let read =
        |file: &str| SiteCalibration::from_toml(&std::fs::read_to_string(file).unwrap()).unwrap();
    let by_log = read(&file);
    let row = |camera: &CalibratedCamera| {
        let place = camera.camera.pose().position();
        format!("{},{},{},{},0.05\n", camera.name, place.x, place.y, place.z)
    };
    let rows: String = by_log.cameras().iter().map(row).collect();
    let survey = flight.named("survey.csv");
    std::fs::write(&survey, format!("camera,east_m,north_m,up_m,sd_m\n{rows}")).unwrap();
    let file = flight.named("unknown.toml");
    let said = succeed(&["calibrate", "flight", &unknown, "--positions", &survey, "-o", &file]);
    assert!(!said.contains("rests on the log alone"), "{said}");
    let by_places = read(&file);
    let drone = Point3::new(40.0, 0.0, 20.0);
    let mut ahead = Vec::new();
    for known in by_log.cameras() {
        let found = by_places.camera(&known.name).unwrap();
        let towards = |camera: &CalibratedCamera| {
            let pose = camera.camera.pose();
            (drone - pose.position(), camera.camera.project(drone))
        };
        let ((arm, Some(before)), (_, Some(after))) = (towards(known), towards(found)) else {
            continue;
        };
        let focal_px = known.camera.model().intrinsics().fx;
        let aside = (before.x() - after.x()).hypot(before.y() - after.y()) / focal_px;
        // 5 cm of three places, seen from as far.
        assert!(aside * arm.norm() < 0.25, "{}: {aside} rad", known.name);
        let middle_s = found.clock.knots_s[found.clock.knots_s.len() / 2][0];
        ahead.push(known.clock.at(middle_s).ahead_s - found.clock.at(middle_s).ahead_s);
    }
    assert_eq!(ahead.len(), 3, "the drone was in the middle of all three");
    let (least, most) =
        ahead.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, m), a| (l.min(*a), m.max(*a)));
    assert!(most - least < 0.02, "{ahead:?}");
}

/// What `calibrate check` says of a recording by a calibration: its exit code, and the verdict on
/// each camera.
fn checked(recording: &str, calibration: &str) -> (Option<i32>, Vec<(String, String)>) {
    let output = crossfix(&["calibrate", "check", recording, "-c", calibration, "--json"]);
    let cameras: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
    let text = |camera: &Value, key: &str| camera[key].as_str().unwrap().to_owned();
    let verdicts = cameras.iter().map(|camera| (text(camera, "name"), text(camera, "verdict")));
    (output.status.code(), verdicts.collect())
}

#[test]
fn a_camera_turned_since_the_calibration_flight_is_named_and_no_other() {
    let Some(data) = real_data() else { return };
    let flight = Flight::new(&data, "3", "mate10,sony5100,sony5n_1440x1080,sonyG");
    let (known, later) = (flight.import("calibration"), flight.import("test"));
    let (log, file) = (flight.named("calibration.csv"), flight.named("calibration.toml"));
    succeed(&["calibrate", "flight", &known, "--log", &log, "--log-kind", "rtk", "-o", &file]);
    for recording in [&known, &later] {
        let (code, verdicts) = checked(recording, &file);
        assert_eq!(code, Some(0), "{verdicts:?}");
        assert!(verdicts.iter().all(|(_, verdict)| verdict == "fits"), "{verdicts:?}");
    }
    let site = SiteCalibration::from_toml(&std::fs::read_to_string(&file).unwrap()).unwrap();
    for camera in site.cameras() {
        let mut turned = camera.clone();
        let pose = camera.camera.pose();
        let about_up = Rotation3::from_axis_angle(&Vector3::z_axis(), 2e-3) * pose.rotation();
        let pose = Pose::new(about_up.into_inner(), pose.position()).unwrap();
        turned.camera = Camera::new(*camera.camera.model().intrinsics(), pose).unwrap();
        let mut elsewhere = site.clone();
        elsewhere.put(turned);
        let wrong = flight.named("turned.toml");
        std::fs::write(&wrong, elsewhere.to_toml()).unwrap();
        let (code, verdicts) = checked(&later, &wrong);
        assert_eq!(code, Some(1), "{}: {verdicts:?}", camera.name);
        let moved: Vec<&str> = verdicts
            .iter()
            .filter(|(_, verdict)| verdict == "moved")
            .map(|(name, _)| name.as_str())
            .collect();
        assert_eq!(moved, [camera.name.as_str()], "{verdicts:?}");
    }
}
