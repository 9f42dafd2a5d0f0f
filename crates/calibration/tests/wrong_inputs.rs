//! Flights of which something is wrong: it is named, and nothing that looks good is made of it.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{Truth, cameras, flight, flight_of, labels, labels_of, log, pointing_error_mrad, way};
use crossfix_calibration::{
    Axis, FlightError, FlightLog, Refusal, Survey, SurveyedPlace, WouldFit, calibrate_flight,
};
use crossfix_geometry::{Camera, Intrinsics, Pixel};
use nalgebra::{Point3, Vector3};
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

/// Another drone's way, through the same air.
fn other_way(t: f64) -> Point3<f64> {
    Point3::new(
        25.0 * (0.09 * t).cos() - 20.0,
        20.0 * (0.13 * t + 1.0).sin(),
        40.0 + 10.0 * (0.19 * t).sin(),
    )
}

#[test]
fn a_second_drone_is_left_out_however_long_it_is_followed() {
    let alone = flight(13);
    let alone = calibrate_flight(&alone.1, Some(&alone.2), &Survey::default()).unwrap();
    for share in [0.3, 1.0] {
        let (truths, mut seen, log) = flight(13);
        let mut random = ChaCha8Rng::seed_from_u64(14);
        for (truth, camera) in truths.iter().zip(&mut seen) {
            let second = labels_of(truth, other_way, &mut random).labels;
            let followed = (share * second.len() as f64) as usize;
            camera.labels.extend(&second[..followed]);
            camera.labels.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        }
        let result = calibrate_flight(&seen, Some(&log), &Survey::default()).unwrap();
        assert_eq!(result.cameras.len(), 3, "{:?}", result.refused);
        for (index, truth) in truths.iter().enumerate() {
            let [with, without] =
                [&result, &alone].map(|result| pointing_error_mrad(truth, result, index));
            assert!(with < without + 0.05, "{}: {with} and {without} mrad", truth.name);
            let found = &result.cameras[index];
            assert_eq!(found.labels, seen[index].labels.len());
            assert!(found.used <= alone.cameras[index].labels, "{} labels", found.used);
        }
    }
}

#[test]
fn a_flight_that_hovers_or_goes_straight_says_that_it_tells_no_pose() {
    let hovers =
        |t: f64| Point3::new(2.0 + 0.3 * (0.5 * t).sin(), 3.0, 30.0 + 0.2 * (0.3 * t).cos());
    let straight = |t: f64| Point3::new(0.5 * t - 30.0, 0.1 * t, 30.0);
    let flights: [fn(f64) -> Point3<f64>; 2] = [hovers, straight];
    for (way, seed) in flights.into_iter().flat_map(|way| (20..23).map(move |seed| (way, seed))) {
        let (_, labels, log) = flight_of(way, seed);
        match calibrate_flight(&labels, Some(&log), &Survey::default()) {
            Err(error) => assert!(matches!(error, FlightError::NoCamera { .. }), "{error}"),
            Ok(result) => {
                for camera in &result.cameras {
                    let turn = camera.pose_covariance.fixed_view::<3, 3>(0, 0).trace().sqrt();
                    // What the command's verdict refuses.
                    assert!(turn > 0.05, "{} by seed {seed}: {turn} rad", camera.name);
                }
            }
        }
    }
}

#[test]
fn a_flight_at_one_height_does_with_a_log() {
    let (truths, labels, log) = flight_of(|t| Point3::new(way(t).x, way(t).y, 30.0), 24);
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    for (truth, found) in truths.iter().zip(&result.cameras) {
        let off = (found.camera.pose().position() - truth.camera.pose().position()).norm();
        assert!(off < 0.1, "{}: {off} m", truth.name);
    }
}

#[test]
fn a_log_of_one_place_a_second_does() {
    let (truths, labels, log) = flight(25);
    let samples = log.samples.into_iter().step_by(5).collect();
    let log = FlightLog { samples, errors: log.errors };
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    for (index, truth) in truths.iter().enumerate() {
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 0.4, "{}: {error} mrad", truth.name);
    }
}

#[test]
fn heights_over_another_sea_move_the_site_from_its_survey_as_a_whole() {
    let (truths, labels, _) = flight(26);
    let raised = Vector3::new(0.0, 0.0, 20.0);
    let log = log(&mut ChaCha8Rng::seed_from_u64(26), |place| place + raised);
    let place = |truth: &Truth| SurveyedPlace {
        camera: truth.name.parse().unwrap(),
        position: truth.camera.pose().position(),
        sd_m: Vector3::repeat(0.05),
    };
    let survey = Survey { places: truths.iter().map(place).collect(), ..Survey::default() };
    let result = calibrate_flight(&labels, Some(&log), &survey).unwrap();
    for (truth, found) in truths.iter().zip(&result.cameras) {
        let beside = found.camera.pose().position() - truth.camera.pose().position();
        assert!((beside - raised).norm() < 0.2, "{}: {beside}", truth.name);
    }
}

#[test]
fn north_east_down_turns_the_cameras_over() {
    let (_, labels, _) = flight(27);
    let log =
        log(&mut ChaCha8Rng::seed_from_u64(27), |place| Point3::new(place.y, place.x, -place.z));
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    for camera in &result.cameras {
        // Its image's rows go up: what the command's verdict refuses.
        assert!(camera.camera.pose().rotation().matrix()[(2, 1)] > 0.5, "{}", camera.name);
    }
}
