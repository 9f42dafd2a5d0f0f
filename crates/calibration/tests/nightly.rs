//! Another flight, of which there is no log, by what an earlier calibration says.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{Truth, flight, labels_of, pointing_error_mrad};
use crossfix_calibration::{
    CameraLabels, SiteCalibration, Survey, calibrate_flight, compare_sites,
};
use crossfix_geometry::{Camera, Pose};
use nalgebra::{Point3, Rotation3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// What flew last night, another way through the same air.
fn last_night(t: f64) -> Point3<f64> {
    Point3::new(
        24.0 * (0.13 * t + 2.0).sin() + 7.0 * (0.49 * t).cos(),
        22.0 * (0.19 * t).sin() + 5.0 * (0.67 * t).cos(),
        34.0 + 10.0 * (0.21 * t + 1.0).sin(),
    )
}

fn of_last_night(truths: &[Truth], seed: u64) -> Vec<CameraLabels> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    truths.iter().map(|truth| labels_of(truth, last_night, &mut random)).collect()
}

/// The calibration by a flight with a log.
fn earlier() -> (Vec<Truth>, SiteCalibration) {
    let (truths, labels, log) = flight(31);
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    (truths, SiteCalibration::from(&result))
}

#[test]
fn anybodys_flight_leaves_a_calibrated_site_where_it_is_in_place_and_time() {
    let (truths, site) = earlier();
    let survey = Survey::default().with_known(site.clone());
    let result = calibrate_flight(&of_last_night(&truths, 32), None, &survey).unwrap();
    assert_eq!(result.cameras.len(), 3, "{:?}", result.refused);
    for (index, truth) in truths.iter().enumerate() {
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 0.25, "{}: {error} mrad", truth.name);
        let clock = &result.cameras[index].clock;
        let middle = clock.knots[clock.knots.len() / 2];
        let off_s = middle.ahead_s - truth.offset_s;
        assert!(off_s.abs() < 0.01, "{}: {off_s} s", truth.name);
    }
    let comparison = compare_sites(&site, &SiteCalibration::from(&result)).unwrap();
    for camera in &comparison.cameras {
        assert!(camera.deviations < 2.5, "{}: {}", camera.name, camera.deviations);
    }
    let (before, after) = (site.datum().unwrap(), result.datum.as_ref().unwrap());
    assert_eq!(before.covariance.view((0, 0), (7, 7)), after.covariance.view((0, 0), (7, 7)));
    // Of its time no more is known than the clocks have kept.
    assert!(after.covariance[(7, 7)] > before.covariance[(7, 7)]);
}

#[test]
fn a_camera_that_was_moved_since_is_proposed_where_it_is_now() {
    const TURN_RAD: f64 = 0.02;
    let (mut truths, site) = earlier();
    let old = &truths[1].camera;
    let turned = Rotation3::new(Vector3::new(0.0, 0.0, TURN_RAD)) * old.pose().rotation();
    let pose = Pose::new(*turned.matrix(), old.pose().position()).unwrap();
    truths[1].camera = Camera::new(*old.model().intrinsics(), pose).unwrap();
    let survey = Survey::default().with_known(site.clone());
    let result = calibrate_flight(&of_last_night(&truths, 33), None, &survey).unwrap();
    let comparison = compare_sites(&site, &SiteCalibration::from(&result)).unwrap();
    let apart: Vec<f64> = comparison.cameras.iter().map(|camera| camera.deviations).collect();
    assert!(apart[1] > 5.0 && apart[1] > 3.0 * apart[0].max(apart[2]), "{apart:?}");
    let error = pointing_error_mrad(&truths[1], &result, 1);
    let turn = result.cameras[1].pose_covariance.fixed_view::<3, 3>(0, 0).trace().sqrt() * 1e3;
    assert!(error < 2.0 && error < 4.0 * turn, "{error} mrad are left, {turn} are said");
}

/// A straight way at one height, which tells no poses by itself: from any place on a circle it
/// looks the same.
fn straight(t: f64) -> Point3<f64> {
    Point3::new(-25.0 + 0.42 * t, 12.0 - 0.17 * t, 38.0)
}

/// As last night, but at one height.
fn level(t: f64) -> Point3<f64> {
    let place = last_night(t);
    Point3::new(place.x, place.y, 36.0)
}

/// What was known tells what two cameras and a flight do not: how they stand, and that nothing has
/// changed.
#[test]
fn two_cameras_and_a_flight_that_tells_no_poses_leave_what_was_known() {
    let (truths, site) = earlier();
    type Way = fn(f64) -> Point3<f64>;
    for (name, way) in [("all round", last_night as Way), ("level", level), ("straight", straight)]
    {
        let mut random = ChaCha8Rng::seed_from_u64(34);
        let two = [0, 2].map(|k| labels_of(&truths[k], way, &mut random));
        let survey = Survey::default().with_known(site.clone());
        let result =
            calibrate_flight(&two, None, &survey).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(result.cameras.len(), 2, "{name}: {:?}", result.refused);
        let comparison = compare_sites(&site, &SiteCalibration::from(&result)).unwrap();
        for (index, camera) in comparison.cameras.iter().enumerate() {
            assert!(camera.deviations < 2.5, "{name}, {}: {}", camera.name, camera.deviations);
            let error = pointing_error_mrad(&truths[2 * index], &result, index);
            assert!(error < 0.5, "{name}, {}: {error} mrad", camera.name);
        }
    }
}
