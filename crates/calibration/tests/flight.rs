//! Flights that were made up: what is found must be what was put in, to within what is said of it.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{
    LOG, SECONDS, Truth, cameras, flight, flight_of, labels_of, pointing_error_mrad, way,
};
use crossfix_calibration::{
    FlightError, FlightResult, LogErrors, Refusal, SiteCalibration, Survey, SurveyedPlace,
    TapedDistance, calibrate_flight,
};
use crossfix_geometry::{Camera, Distortion, Intrinsics, Pixel, Pose};
use nalgebra::{Matrix6, Point3, Rotation3, Vector3, Vector6};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

#[test]
fn poses_clocks_and_lenses_are_found_from_nothing_but_labels_and_a_log() {
    let (truths, labels, log) = flight(1);
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    assert!(result.refused.is_empty());
    for (index, truth) in truths.iter().enumerate() {
        let found = &result.cameras[index];
        // One label errs by 0.37 mrad; the file's lens is off by up to 6 mrad at the image's
        // border.
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 0.25, "{}: {error} mrad", truth.name);
        let ratio = truth.camera.model().intrinsics().fx / truth.file.fx;
        let off = (found.focal_ratio - ratio) / found.focal_ratio_sd;
        assert!(off.abs() < 4.0 && found.focal_ratio_sd < 2e-3, "{}: {off} SD", truth.name);
        let middle = found.clock.knots[found.clock.knots.len() / 2];
        let ahead = truth.offset_s + truth.rate * (middle.time_s + truth.offset_s - SECONDS / 2.0);
        assert!((middle.ahead_s - ahead).abs() < 4.0 * middle.sd_s.max(1e-4), "{}", truth.name);
        assert!((0.25..0.6).contains(&found.noise.lasting_px), "{:?}", found.noise);
        assert!((0.2..1.2).contains(&found.noise.lasting_s), "{:?}", found.noise);
    }
}

/// The covariance is that of the pose where the lens is as it was found: the part of the pose's
/// error that follows from the lens's is taken off, and what is left has a squared distance of six.
#[test]
fn the_poses_covariance_is_honest() {
    const FLIGHTS: u64 = 6;
    let mut squares = Vec::new();
    for seed in 0..FLIGHTS {
        let (truths, mut labels, mut log) = flight(100 + seed);
        // Over two minutes of the 200 s that it lasts the drift is as good as a shift.
        let mut random = ChaCha8Rng::seed_from_u64(200 + seed);
        let drift = Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut random) });
        log.samples.iter_mut().for_each(|sample| sample.position += drift * LOG.drift_sd_m);
        for (truth, camera) in truths.iter().zip(&mut labels) {
            camera.intrinsics = *truth.camera.model().intrinsics();
        }
        let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
        for (truth, found) in truths.iter().zip(&result.cameras) {
            let (pose, real) = (found.camera.pose(), truth.camera.pose());
            let turn = Rotation3::from_matrix_unchecked(
                pose.rotation().matrix().transpose() * real.rotation().matrix(),
            );
            let lens = lens_error(truth, found.intrinsics());
            let mut error = Vector6::zeros();
            error.fixed_rows_mut::<3>(0).copy_from(&turn.scaled_axis());
            error.fixed_rows_mut::<3>(3).copy_from(&(real.position() - pose.position()));
            error -= &found.lens.pose_by_lens * lens;
            let of_site = of_site(&result, &found.camera);
            let inverse = (found.pose_covariance + of_site).try_inverse().unwrap();
            squares.push(error.dot(&(inverse * error)));
        }
    }
    let mean = squares.iter().sum::<f64>() / squares.len() as f64;
    // 18 draws of six: a standard error of 0.8, and more as the log's drift is common to the three
    // cameras of a flight. The whitening errs towards caution.
    assert!((2.0..9.0).contains(&mean), "{mean}: {squares:?}");
}

/// The part of a camera's pose that is off with the whole site: turned by w about its middle, it
/// turns by R'w about its own axes.
fn of_site(result: &FlightResult, camera: &Camera) -> Matrix6<f64> {
    let datum = result.datum.as_ref().unwrap();
    let arm = camera.pose().position() - datum.middle;
    let mut by_datum = nalgebra::SMatrix::<f64, 6, 9>::zeros();
    let turn = camera.pose().rotation().matrix().transpose();
    by_datum.fixed_view_mut::<3, 3>(0, 3).copy_from(&turn);
    by_datum.fixed_view_mut::<3, 3>(3, 0).fill_with_identity();
    by_datum.fixed_view_mut::<3, 3>(3, 3).copy_from(&-arm.cross_matrix());
    by_datum.fixed_view_mut::<3, 1>(3, 6).copy_from(&arm);
    by_datum * datum.covariance * by_datum.transpose()
}

fn lens_error(truth: &Truth, found: &Intrinsics) -> nalgebra::DVector<f64> {
    let numbers = |lens: &Intrinsics| {
        let Distortion::BrownConrady(k) = lens.distortion else { unreachable!() };
        let first = [lens.fx.ln(), (lens.fy / lens.fx).ln(), lens.cx, lens.cy];
        nalgebra::DVector::from_iterator(9, first.into_iter().chain(k))
    };
    numbers(truth.camera.model().intrinsics()) - numbers(found)
}

#[test]
fn a_camera_that_saw_nothing_is_refused_and_the_others_are_calibrated() {
    let (_, mut labels, log) = flight(3);
    labels[1].labels.truncate(10);
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    assert_eq!(result.cameras.len(), 2);
    assert_eq!(result.refused, [(labels[1].name.clone(), Refusal::FewLabels { labels: 10 })]);
}

#[test]
fn a_label_of_another_year_costs_its_camera_and_neither_memory_nor_time() {
    let (_, mut labels, mut log) = flight(6);
    labels[0].labels.last_mut().unwrap().time_s = 3e9;
    let result = calibrate_flight(&labels[..2], Some(&log), &Survey::default()).unwrap();
    assert!(matches!(result.refused[..], [(_, Refusal::LongFlight { .. })]));
    log.samples.last_mut().unwrap().time_s = 3e9;
    let error = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap_err();
    assert!(matches!(error, FlightError::LongLog { .. }), "{error}");
}

#[test]
fn labels_whose_rows_put_the_later_first_are_adjusted() {
    let (_, mut labels, log) = flight(7);
    // A frame counted twice with the target at the other end of the image.
    for k in (50..labels[0].labels.len()).step_by(50) {
        labels[0].labels[k].time_s = labels[0].labels[k - 1].time_s;
        labels[0].labels[k].pixel = Pixel::new(900.0, -200_000.0);
    }
    assert_eq!(
        calibrate_flight(&labels[..1], Some(&log), &Survey::default()).unwrap().cameras.len(),
        1
    );
}

#[test]
fn jumps_of_the_log_and_birds_among_the_labels_do_not_move_the_cameras() {
    let (truths, mut labels, mut log) = flight(4);
    for sample in log.samples.iter_mut().skip(200).step_by(40).take(8) {
        sample.position.x += 2.0;
    }
    for label in labels[0].labels.iter_mut().step_by(20) {
        label.pixel = Pixel::new(300.0, 200.0);
    }
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    for (index, truth) in truths.iter().enumerate() {
        let error = pointing_error_mrad(truth, &result, index);
        assert!(error < 0.2, "{}: {error} mrad", truth.name);
    }
    assert!(result.cameras[0].used < result.cameras[0].labels);
}

#[test]
fn what_is_found_survives_its_file_and_a_torn_file_is_named() {
    let (_, labels, log) = flight(5);
    let result = calibrate_flight(&labels[..1], Some(&log), &Survey::default()).unwrap();
    let site = SiteCalibration::from(&result);
    let text = site.to_toml();
    let again = SiteCalibration::from_toml(&text).unwrap();
    let (one, two) = (&site.cameras()[0], &again.cameras()[0]);
    assert_eq!(one.clock, two.clock);
    let pixel = Pixel::new(1000.0, 500.0);
    let [one, two] = [one, two].map(|camera| camera.bearing(pixel).unwrap().direction());
    assert!((one.into_inner() - two.into_inner()).norm() < 1e-12);
    assert!(SiteCalibration::from_toml(&text.replace("form = 1", "form = 2")).is_err());
    assert!(SiteCalibration::from_toml(&text[..text.len() / 2]).is_err());
    // One camera alone is off by all that the site is.
    assert!(again.datum().is_none() && one_sd(&again) > 0.01);
    let nan = text.replace("range_m = ", "range_m = -");
    assert!(SiteCalibration::from_toml(&nan).unwrap_err().to_string().contains("range_m"));
}

/// How sure the first camera's place is, m.
fn one_sd(site: &SiteCalibration) -> f64 {
    site.cameras()[0].pose_covariance.fixed_view::<3, 3>(3, 3).trace().sqrt()
}

/// Where the cameras stand, as a survey to 5 cm has it.
fn survey(truths: &[Truth], random: &mut ChaCha8Rng) -> Survey {
    const SD_M: f64 = 0.05;
    let mut aside = || Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(random) }) * SD_M;
    let place = |truth: &Truth| SurveyedPlace {
        camera: truth.name.parse().unwrap(),
        position: truth.camera.pose().position() + aside(),
        sd_m: Vector3::repeat(SD_M),
    };
    Survey { places: truths.iter().map(place).collect(), ..Survey::default() }
}

/// With nothing but where the cameras stand: their clocks differ by seconds, nobody knows where
/// they look or where the target was.
#[test]
fn an_unknown_flight_and_three_surveyed_places_give_poses_clocks_and_lenses() {
    let (truths, labels, _) = flight(8);
    let survey = survey(&truths, &mut ChaCha8Rng::seed_from_u64(80));
    let result = calibrate_flight(&labels, None, &survey).unwrap();
    assert!(result.refused.is_empty());
    let clock = |index: usize| &result.cameras[index].clock.knots[0];
    let ahead = |index: usize| clock(index).ahead_s - clock(0).ahead_s;
    for (index, truth) in truths.iter().enumerate() {
        let error = pointing_error_mrad(truth, &result, index);
        // 5 cm at 60 m are 0.8 mrad, and three places 60 to 120 m apart turn the site by as much.
        assert!(error < 1.6, "{}: {error} mrad", truth.name);
        let found = result.cameras[index].camera.pose().position();
        let off = found - truth.camera.pose().position();
        assert!(off.norm() < 0.25, "{}: {off}", truth.name);
        // Rates of 2e-5 and 4e-5 count from the middle of the flight.
        let between = truth.offset_s - truths[0].offset_s;
        assert!((ahead(index) - between).abs() < 0.01, "{}: {}", truth.name, ahead(index));
    }
    let sd = result.datum.as_ref().unwrap().sd();
    assert!((0.01..0.1).contains(&sd[0]) && sd[6] < 2e-3 && sd[7] > 100.0, "{sd:?}");
}

#[test]
fn an_unknown_flight_in_a_plane_is_known_from_three_surveyed_places_too() {
    let ways: [fn(f64) -> Point3<f64>; 2] = [
        |t| Point3::new(way(t).x, way(t).y, 30.0),
        |t| Point3::new(way(t).x, way(t).y, 35.0 + 0.2 * way(t).x - 0.15 * way(t).y),
    ];
    for (way, seed) in ways.into_iter().flat_map(|way| (40..42).map(move |seed| (way, seed))) {
        let (truths, labels, _) = flight_of(way, seed);
        let survey = survey(&truths, &mut ChaCha8Rng::seed_from_u64(seed));
        let result = calibrate_flight(&labels, None, &survey).unwrap();
        assert_eq!(result.cameras.len(), 3, "{:?}", result.refused);
        for (truth, found) in truths.iter().zip(&result.cameras) {
            let off = (found.camera.pose().position() - truth.camera.pose().position()).norm();
            assert!(off < 0.3, "{} by seed {seed}: {off} m", truth.name);
        }
    }
}

#[test]
fn of_a_flight_in_a_plane_two_cameras_alone_say_that_it_fits_two_ways_or_are_right() {
    let ways: [fn(f64) -> Point3<f64>; 5] = [
        |t| Point3::new(way(t).x, way(t).y, 30.0),
        |t| Point3::new(way(t).x, way(t).y, 35.0 + 0.4 * way(t).x),
        |t| Point3::new(way(t).x, 0.3 * way(t).x + 5.0, way(t).z),
        |t| Point3::new(0.4 * way(t).x, 0.4 * way(t).y, 30.0),
        |t| Point3::new(0.4 * way(t).x, 0.4 * way(t).y, 45.0 + 0.8 * way(t).x),
    ];
    let mut right = 0;
    for (way, seed) in ways.into_iter().flat_map(|way| (43..45).map(move |seed| (way, seed))) {
        let (truths, labels, _) = flight_of(way, seed);
        let survey = survey(&truths[..2], &mut ChaCha8Rng::seed_from_u64(seed));
        match calibrate_flight(&labels[..2], None, &survey) {
            Err(error) => {
                let is_said = matches!(error, FlightError::TwoWays | FlightError::NoPair);
                assert!(is_said, "{error}");
                println!("{error}");
            }
            Ok(result) => {
                for (found, truth) in result.cameras.iter().zip(&truths) {
                    let turn = truth.camera.pose().rotation();
                    let off = found.camera.pose().rotation().angle_to(turn);
                    // Two places and level pictures hold the site itself.
                    assert!(off < 0.03, "{} by seed {seed}: {off} rad", found.name);
                }
                right += 1;
            }
        }
    }
    assert!(right >= 4, "{right} of ten");
}

#[test]
fn two_cameras_on_one_side_of_a_flight_in_a_plane_may_stand_in_two_ways() {
    let mut truths = cameras();
    truths.truncate(2);
    for (truth, place) in truths.iter_mut().zip([[100.0, 30.0, 1.5], [80.0, -30.0, 2.0]]) {
        let pose = Pose::looking_at(place.into(), Point3::new(0.0, 0.0, 30.0)).unwrap();
        truth.camera = Camera::new(*truth.camera.model().intrinsics(), pose).unwrap();
    }
    let small = |t: f64| Point3::new(0.3 * way(t).x, 0.3 * way(t).y, 40.0);
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let labels: Vec<_> = truths.iter().map(|truth| labels_of(truth, small, &mut random)).collect();
    let found = calibrate_flight(&labels, None, &survey(&truths, &mut random));
    assert!(matches!(found.err(), Some(FlightError::TwoWays)));
}

#[test]
fn a_taped_distance_gives_the_size_and_level_cameras_which_way_is_up() {
    let (truths, labels, _) = flight(9);
    let place = |index: usize| truths[index].camera.pose().position();
    let distance = TapedDistance {
        between: [labels[0].name.clone(), labels[2].name.clone()],
        metres: (place(0) - place(2)).norm(),
        sd_m: 0.05,
    };
    let survey = Survey { distances: vec![distance], ..Survey::default() };
    let result = calibrate_flight(&labels, None, &survey).unwrap();
    let found = |index: usize| result.cameras[index].camera.pose().position();
    let ratio = (found(0) - found(1)).norm() / (place(0) - place(1)).norm();
    assert!((ratio - 1.0).abs() < 2e-3, "{ratio}");
    // A gauge of tens of metres is nobody's knowledge.
    let sd = result.datum.as_ref().unwrap().sd();
    assert!(sd[0] > 100.0 && sd[5] > 0.5, "{sd:?}");
    for camera in &result.cameras {
        let across = camera.camera.pose().rotation() * Vector3::x();
        assert!(across.z.abs() < 0.02, "{across}");
    }
    let error = calibrate_flight(&labels, None, &Survey::default()).unwrap_err();
    assert!(matches!(error, FlightError::NoSize { .. }), "{error}");
    let error = calibrate_flight(&labels[..1], None, &survey).unwrap_err();
    assert!(matches!(error, FlightError::NoPair), "{error}");
}

/// A log that lies metres beside puts the whole site beside and leaves the cameras where they are
/// to one another; the datum says so, the cameras' covariances do not.
#[test]
fn a_log_beside_itself_moves_the_datum_and_not_the_cameras_to_one_another() {
    const BESIDE: [f64; 3] = [1.6, -2.3, 1.1];
    let errors = LogErrors { sd_m: 1.5, drift_sd_m: 2.0, drift_time_s: 200.0 };
    let (truths, labels, mut log) = flight(10);
    let mut random = ChaCha8Rng::seed_from_u64(100);
    for sample in &mut log.samples {
        let noise = Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut random) });
        sample.position += Vector3::from(BESIDE) + noise * errors.sd_m;
    }
    log.errors = errors;
    let result = calibrate_flight(&labels, Some(&log), &Survey::default()).unwrap();
    let off = |index: usize| {
        result.cameras[index].camera.pose().position() - truths[index].camera.pose().position()
    };
    let sd = result.datum.as_ref().unwrap().sd();
    for (axis, beside) in BESIDE.into_iter().enumerate() {
        let mean = (0..3).map(|index| off(index)[axis]).sum::<f64>() / 3.0;
        assert!((1.0..3.0).contains(&sd[axis]) && mean.abs() < 2.5 * sd[axis], "{mean} {sd:?}");
        assert!((mean - beside).abs() < 1.0, "{mean} for {beside}");
    }
    for (index, camera) in result.cameras.iter().enumerate() {
        let beside_the_others = off(index) - off((index + 1) % 3);
        assert!(beside_the_others.norm() < 1.0, "{beside_the_others}");
        let stated = camera.pose_covariance.fixed_view::<3, 3>(3, 3).trace().sqrt();
        assert!(stated < 0.3, "{}: {stated} m", camera.name);
    }
}
