//! Flights of which something is wrong: it is named, and nothing that looks good is made of it.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{Truth, cameras, flight, labels, log, pointing_error_mrad};
use crossfix_calibration::{
    Axis, FlightError, FlightLog, Refusal, Survey, WouldFit, calibrate_flight,
};
use crossfix_geometry::{Camera, Intrinsics, Pixel};
use nalgebra::Point3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What would make the first camera fit that does not, by a log with other axes.
fn with_axes(axes: impl Fn(Point3<f64>) -> Point3<f64>) -> (Option<WouldFit>, String) {
    let (_, labels, _) = flight(2);
    let log = log(&mut ChaCha8Rng::seed_from_u64(2), axes);
    let error = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap_err();
    let FlightError::NoCamera { why: Refusal::Misfit { would_fit, .. }, .. } = &error else {
        panic!("{error}");
    };
    (would_fit.clone(), error.to_string())
}

#[test]
fn a_mirrored_log_is_refused_and_said_to_be_one() {
    let (would_fit, text) = with_axes(|place| Point3::new(place.y, place.x, place.z));
    assert_eq!(would_fit, Some(WouldFit::MirrorImage));
    assert!(text.contains("east and north are exchanged"), "{text}");
    let (would_fit, _) = with_axes(|place| Point3::new(place.x, place.y, -place.z));
    assert_eq!(would_fit, Some(WouldFit::MirrorImage));
}

#[test]
fn heights_in_feet_and_unscaled_longitudes_are_named() {
    let stretched = |would_fit: Option<WouldFit>| match would_fit {
        Some(WouldFit::Stretched { axis, times }) => (axis, times),
        other => panic!("{other:?}"),
    };
    let (would_fit, text) = with_axes(|place| Point3::new(place.x, place.y, 3.2808 * place.z));
    let (axis, times) = stretched(would_fit);
    assert!(axis == Axis::Up && (times / 3.2808 - 1.0).abs() < 0.05, "{axis:?} {times}");
    assert!(text.contains("feet for metres"), "{text}");
    let (would_fit, text) = with_axes(|place| Point3::new(1.5 * place.x, place.y, place.z));
    let (axis, times) = stretched(would_fit);
    assert!(axis == Axis::East && (times / 1.5 - 1.0).abs() < 0.05, "{axis:?} {times}");
    assert!(text.contains("degrees of longitude"), "{text}");
}

#[test]
fn a_lens_file_of_another_resolution_is_named_and_the_others_are_calibrated() {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let truths = with_a_long_lens(1, 1.2);
    let mut seen: Vec<_> = truths.iter().map(|truth| labels(truth, &mut random)).collect();
    let log = log(&mut random, |place| place);
    let file = seen[1].intrinsics;
    seen[1].intrinsics = Intrinsics { fx: file.fx / 1.5, fy: file.fy / 1.5, ..file };
    let result = calibrate_flight(&seen, Some(&log), &Survey::default()).unwrap();
    assert_eq!(result.cameras.len(), 2);
    let [(name, Refusal::Misfit { would_fit: Some(WouldFit::Focal { times }), .. })] =
        &result.refused[..]
    else {
        panic!("{:?}", result.refused);
    };
    assert_eq!(*name, seen[1].name);
    assert!((times / 1.5 - 1.0).abs() < 0.05, "{times}");
}

/// The cameras, of which one has a lens so many times as long.
fn with_a_long_lens(index: usize, times: f64) -> Vec<Truth> {
    let mut truths = cameras();
    let long = |lens: &Intrinsics| Intrinsics { fx: lens.fx * times, fy: lens.fy * times, ..*lens };
    let truth = &mut truths[index];
    truth.file = long(&truth.file);
    let pose = *truth.camera.pose();
    truth.camera = Camera::new(long(truth.camera.model().intrinsics()), pose).unwrap();
    truths
}

#[test]
fn two_cameras_whose_names_are_exchanged_are_named() {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let truths = with_a_long_lens(1, 1.3);
    let mut seen: Vec<_> = truths.iter().map(|truth| labels(truth, &mut random)).collect();
    let log = log(&mut random, |place| place);
    let lens = seen[0].intrinsics;
    seen[0].intrinsics = seen[1].intrinsics;
    seen[1].intrinsics = lens;
    let result = calibrate_flight(&seen, Some(&log), &Survey::default()).unwrap();
    let name = |index: usize| seen[index].name.clone();
    let lent: Vec<_> = result
        .refused
        .iter()
        .map(|(camera, why)| match why {
            Refusal::Misfit { would_fit: Some(WouldFit::LensOf { camera: other }), .. } => {
                (camera.clone(), other.clone())
            }
            other => panic!("{other:?}"),
        })
        .collect();
    assert!(lent.contains(&(name(0), name(1))), "{lent:?}");
    // The third has the first one's lens, too.
    assert!(lent.iter().any(|(camera, _)| *camera == name(1)), "{lent:?}");
}

#[test]
fn a_camera_that_is_knocked_in_mid_flight_is_named_with_the_moment() {
    let (_, mut labels, log) = flight(4);
    let middle_s = labels[2].labels[labels[2].labels.len() / 2].time_s;
    for label in labels[2].labels.iter_mut().filter(|label| label.time_s > middle_s) {
        label.pixel = Pixel::new(label.pixel.x() + 8.0, label.pixel.y() - 6.0);
    }
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    let moved = result.cameras[2].moved.unwrap();
    assert!((moved.by_px - 10.0).abs() < 3.0 && moved.deviations > 5.0, "{moved:?}");
    assert!((moved.time_s - middle_s).abs() < 2.0, "{moved:?} {middle_s}");
    for still in &result.cameras[..2] {
        let moved = still.moved.unwrap();
        assert!(moved.by_px < 1.0 && moved.deviations < 2.5, "{}: {moved:?}", still.name);
    }
}

#[test]
fn birds_that_are_taken_for_the_target_for_seconds_bend_no_start() {
    let (truths, mut labels, log) = flight(6);
    let mut random = ChaCha8Rng::seed_from_u64(6);
    for camera in &mut labels {
        for chunk in camera.labels.chunks_mut(60) {
            if random.random_bool(0.15) {
                let mut at =
                    [random.random_range(100.0..1800.0), random.random_range(100.0..900.0)];
                let speed = [random.random_range(-4.0..4.0), random.random_range(-2.0..2.0)];
                for label in chunk {
                    at = [at[0] + speed[0], at[1] + speed[1]];
                    label.pixel = Pixel::new(at[0], at[1]);
                }
            }
        }
    }
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    assert_eq!(result.cameras.len(), 3, "{:?}", result.refused);
    for (index, truth) in truths.iter().enumerate() {
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 0.3, "{}: {error} mrad", truth.name);
        let found = &result.cameras[index];
        assert!(found.used < found.labels, "{} of {}", found.used, found.labels);
    }
}

#[test]
fn jumps_of_the_log_are_left_out_and_counted() {
    let (_, labels, mut log) = flight(7);
    for sample in log.samples.iter_mut().skip(100).step_by(40).take(9) {
        sample.position.y += 2.0;
    }
    let fit = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap().log.unwrap();
    assert!((9..=12).contains(&fit.left_out), "{fit:?}");
    assert!(fit.residual_m < 0.03, "{fit:?}");
}

#[test]
fn a_log_in_feet_gives_a_site_in_feet_and_no_contradiction() {
    const FEET: f64 = 3.2808;
    let (truths, labels, _) = flight(8);
    let log = log(&mut ChaCha8Rng::seed_from_u64(8), |place| place * FEET);
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    let apart = |one: Point3<f64>, other: Point3<f64>| (one - other).norm();
    let place = |index: usize| result.cameras[index].camera.pose().position();
    let truth = |index: usize| truths[index].camera.pose().position();
    let times = apart(place(0), place(1)) / apart(truth(0), truth(1));
    assert!((times / FEET - 1.0).abs() < 0.01, "{times}");
}

#[test]
fn fifteen_seconds_of_a_log_are_refused_or_said_to_be_weak() {
    let (_, labels, log) = flight(9);
    let samples = log.samples.into_iter().filter(|s| (50.0..65.0).contains(&s.time_s)).collect();
    let log = FlightLog { samples, errors: log.errors };
    match calibrate_flight(&labels, Some(&log), &Survey::default()) {
        Err(error) => assert!(matches!(error, FlightError::NoCamera { .. }), "{error}"),
        Ok(result) => {
            for camera in &result.cameras {
                let spread = camera.pose_covariance.fixed_view::<3, 3>(3, 3).trace().sqrt();
                // What half a metre is: see the command's verdict.
                assert!(spread > 0.5, "{}: {spread} m", camera.name);
            }
        }
    }
}
