//! Landmarks in the cameras' pictures beside a flight that was made up.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{Truth, flight, pointing_error_mrad};
use crossfix_calibration::{
    Click, FlightError, LandmarkPlace, LogErrors, Survey, SurveyedLandmark, calibrate_flight,
};
use crossfix_geometry::Pixel;
use nalgebra::{Matrix3, Point3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

const PLACE_SD_M: f64 = 0.05;
const CLICK_SD_PX: f64 = 1.0;
/// Masts and roofs about the volume.
const PLACES: [[f64; 3]; 8] = [
    [20.0, 15.0, 40.0],
    [-20.0, 20.0, 30.0],
    [10.0, -25.0, 35.0],
    [-15.0, -15.0, 45.0],
    [0.0, 30.0, 20.0],
    [25.0, -10.0, 22.0],
    [-5.0, 5.0, 30.0],
    [12.0, 8.0, 18.0],
];

/// Landmarks as a survey has them and as hands click them in the pictures of the cameras that see
/// them, of these.
fn clicked(truths: &[Truth], of: &[usize], seed: u64) -> Vec<SurveyedLandmark> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let mut landmark = |(k, place): (usize, [f64; 3])| {
        let place = Point3::from(place);
        let surveyed = place + Vector3::from_fn(|_, _| normal()) * PLACE_SD_M;
        let seen = of.iter().map(|&index| &truths[index]).filter(|truth| truth.camera.sees(place));
        let click = |truth: &Truth| {
            let pixel = truth.camera.project(place).unwrap();
            let [x, y] = [pixel.x(), pixel.y()].map(|at| at + CLICK_SD_PX * normal());
            Click {
                camera: truth.name.parse().unwrap(),
                pixel: Pixel::new(x, y),
                sd_px: CLICK_SD_PX,
            }
        };
        SurveyedLandmark {
            name: format!("mark {k}"),
            at: LandmarkPlace::Place { position: surveyed, sd_m: Vector3::repeat(PLACE_SD_M) },
            clicks: seen.map(click).collect(),
        }
    };
    PLACES.into_iter().enumerate().map(&mut landmark).collect()
}

fn survey(landmarks: Vec<SurveyedLandmark>) -> Survey {
    Survey { landmarks, ..Survey::default() }
}

/// Neither a log nor a place of a camera: two cameras that see marks bring the third, which sees
/// none, to where they are.
#[test]
fn an_unknown_flight_and_landmarks_in_two_pictures_place_all_cameras() {
    let (truths, labels, _) = flight(21);
    let survey = survey(clicked(&truths, &[0, 1], 210));
    assert!(survey.landmarks.iter().filter(|mark| mark.clicks.len() == 2).count() >= 4);
    let result = calibrate_flight(&labels, None, &survey).unwrap();
    assert_eq!(result.cameras.len(), 3);
    for (index, truth) in truths.iter().enumerate() {
        let off = result.cameras[index].camera.pose().position() - truth.camera.pose().position();
        assert!(off.norm() < 0.3, "{}: {off}", truth.name);
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 2.5, "{}: {error} mrad", truth.name);
    }
    let sd = result.datum.as_ref().unwrap().sd();
    assert!((0.005..0.1).contains(&sd[0]) && sd[5] < 5e-3 && sd[6] < 5e-3, "{sd:?}");
    let clicks: usize = survey.landmarks.iter().map(|mark| mark.clicks.len()).sum();
    assert_eq!(result.landmarks.len(), clicks);
    assert!(
        result.landmarks.iter().all(|misfit| misfit.deviations < 4.5),
        "{:?}",
        result.landmarks
    );
}

/// The site's place errs by what the datum says: the squared distance of three numbers.
#[test]
fn what_the_datum_says_of_a_site_by_landmarks_is_true() {
    const FLIGHTS: u64 = 12;
    let mut squares = Vec::new();
    for seed in 0..FLIGHTS {
        let (truths, labels, _) = flight(300 + seed);
        let survey = survey(clicked(&truths, &[0, 1, 2], 310 + seed));
        let result = calibrate_flight(&labels, None, &survey).unwrap();
        let datum = result.datum.as_ref().unwrap();
        let off = |index: usize| {
            result.cameras[index].camera.pose().position() - truths[index].camera.pose().position()
        };
        let shift = (off(0) + off(1) + off(2)) / 3.0;
        // What each camera is off by beside the site moves their middle, too.
        let of_cameras = result.cameras.iter().map(|camera| {
            let lens = &camera.lens;
            let of_lens = &lens.pose_by_lens * &lens.covariance * lens.pose_by_lens.transpose();
            (camera.pose_covariance + of_lens).fixed_view::<3, 3>(3, 3).into_owned() / 9.0
        });
        let of_site = datum.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let covariance = of_site + of_cameras.sum::<Matrix3<f64>>();
        squares.push(shift.dot(&(covariance.try_inverse().unwrap() * shift)));
    }
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    // Twelve draws of three: a standard error of 0.7 about 3.
    assert!((1.6..5.1).contains(&mean), "{mean}: {squares:?}");
}

#[test]
fn a_landmark_clicked_beside_itself_is_named_and_moves_nothing() {
    let (truths, labels, _) = flight(22);
    let mut landmarks = clicked(&truths, &[0, 1, 2], 220);
    let wrong = &mut landmarks[6].clicks[1];
    wrong.pixel = Pixel::new(wrong.pixel.x() + 60.0, wrong.pixel.y());
    let camera = wrong.camera.clone();
    let result = calibrate_flight(&labels, None, &survey(landmarks)).unwrap();
    for (index, truth) in truths.iter().enumerate() {
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 2.5, "{}: {error} mrad", truth.name);
    }
    let worst =
        result.landmarks.iter().max_by(|a, b| a.deviations.total_cmp(&b.deviations)).unwrap();
    assert_eq!((worst.landmark.as_str(), &worst.camera), ("mark 6", &camera));
    assert!(worst.deviations > 10.0 && worst.residual_px.unwrap().x > 40.0, "{worst:?}");
}

/// Each camera has marks of its own, so nothing but their own pictures says where two cameras are.
#[test]
fn a_wrong_click_among_the_landmarks_of_one_picture_alone_stops_nothing() {
    let (truths, labels, _) = flight(25);
    let mut landmarks = clicked(&truths, &[0], 250);
    let of_east = clicked(&truths, &[1], 251).into_iter().map(|mut landmark| {
        landmark.name.push_str(" of east");
        landmark
    });
    landmarks.extend(of_east);
    let wrong = landmarks.iter_mut().flat_map(|mark| &mut mark.clicks).next().unwrap();
    wrong.pixel = Pixel::new(wrong.pixel.x() + 60.0, wrong.pixel.y());
    let result = calibrate_flight(&labels, None, &survey(landmarks)).unwrap();
    for (index, truth) in truths.iter().enumerate() {
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 2.5, "{}: {error} mrad", truth.name);
    }
    let beside = result.landmarks.iter().filter(|misfit| misfit.deviations > 10.0);
    assert!(beside.map(|misfit| misfit.landmark.as_str()).eq(["mark 0"]), "{:?}", result.landmarks);
}

/// A place with a wrong sign lies tens of metres off: the site must not be begun with it.
#[test]
fn one_wrong_place_of_five_turns_nothing_over() {
    let (truths, labels, _) = flight(26);
    let mut landmarks = clicked(&truths, &[0, 1, 2], 260);
    landmarks.truncate(5);
    let LandmarkPlace::Place { position, .. } = &mut landmarks[0].at else { unreachable!() };
    position.x = -position.x;
    let result = calibrate_flight(&labels, None, &survey(landmarks)).unwrap();
    for (index, truth) in truths.iter().enumerate() {
        let off = result.cameras[index].camera.pose().position() - truth.camera.pose().position();
        assert!(off.norm() < 0.5, "{}: {off}", truth.name);
    }
    let beside = result.landmarks.iter().filter(|misfit| misfit.deviations > 10.0);
    assert!(beside.map(|misfit| misfit.landmark.as_str()).all(|name| name == "mark 0"));
}

/// A consumer's log lies metres beside; landmarks say where the site is.
#[test]
fn landmarks_hold_a_site_whose_log_lies_beside() {
    let (truths, labels, mut log) = flight(23);
    let mut random = ChaCha8Rng::seed_from_u64(230);
    log.errors = LogErrors { sd_m: 1.5, drift_sd_m: 2.0, drift_time_s: 200.0 };
    for sample in &mut log.samples {
        let noise = Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut random) });
        sample.position += Vector3::new(2.0, -1.5, 2.5) + noise * log.errors.sd_m;
    }
    let alone = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    let survey = survey(clicked(&truths, &[0, 1], 231));
    let held = calibrate_flight(&labels, Some(&log), &survey).unwrap();
    let off = |result: &crossfix_calibration::FlightResult| {
        let position = |index: usize| result.cameras[index].camera.pose().position();
        (0..3)
            .map(|k| (position(k) - truths[k].camera.pose().position()).norm())
            .fold(0.0, f64::max)
    };
    assert!(off(&alone) > 2.0 && off(&held) < 0.3, "{} {}", off(&alone), off(&held));
    assert!(held.datum.as_ref().unwrap().sd()[0] < 0.1);
}

#[test]
fn landmarks_that_tell_no_size_are_said_to() {
    let (truths, labels, _) = flight(24);
    let mut landmarks = clicked(&truths, &[0], 240);
    landmarks.truncate(3);
    let error = calibrate_flight(&labels, None, &survey(landmarks)).unwrap_err();
    assert!(matches!(error, FlightError::NoSize { .. }), "{error}");
    assert!(error.to_string().contains("--landmarks"));
    // Nor do four of one camera whose clicks do not fit one another.
    let mut landmarks = clicked(&truths, &[0], 241);
    landmarks.truncate(5);
    landmarks.iter_mut().zip([0.0, 90.0, -70.0, 0.0, 60.0]).for_each(|(landmark, aside)| {
        let click = &mut landmark.clicks[0];
        click.pixel = Pixel::new(click.pixel.x() + aside, click.pixel.y() - aside);
    });
    let error = calibrate_flight(&labels, None, &survey(landmarks)).unwrap_err().to_string();
    assert!(error.contains("`north`: its landmarks do not fit one another"), "{error}");
}

/// Landmarks of a camera that took no part, or one in each of three pictures, say nothing.
#[test]
fn only_landmarks_that_tell_something_are_counted() {
    let (truths, _, _) = flight(27);
    let all = survey(clicked(&truths, &[0, 1], 270));
    let names = truths.iter().map(|truth| truth.name.parse().unwrap()).collect::<Vec<_>>();
    let of = |indices: &[usize]| indices.iter().map(|k| &names[*k]).collect::<Vec<_>>();
    assert!(all.determines_size(&of(&[0, 1, 2])) && all.determines_size(&of(&[0])));
    assert!(!all.determines_size(&of(&[2])));
    let mut one_each = clicked(&truths, &[0, 1, 2], 271);
    one_each.truncate(3);
    for (index, landmark) in one_each.iter_mut().enumerate() {
        landmark.clicks.retain(|click| click.camera == names[index]);
    }
    assert!(!survey(one_each).determines_size(&of(&[0, 1, 2])));
}
