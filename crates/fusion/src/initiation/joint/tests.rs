use std::f64::consts::PI;

use crossfix_filter::KinematicState;
use nalgebra::{Matrix6, SMatrix, SVector, Vector6};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;
use crate::spatial::TimedLine;
use crate::spatial::tests_support::{line_at, noisy_line_at, orthogonal_cameras};
use crate::uncertainty::PoseUncertainty;

const NAMES: [&str; 3] = ["a", "b", "c"];
/// Standard deviation of a camera's rotation, rad: seven times that of its lines.
const TURNED_SD: f64 = 5e-3;

/// A camera whose pose is known to [`TURNED_SD`].
fn turned() -> CameraUncertainty {
    let rotation = TURNED_SD.powi(2);
    let pose = Matrix6::from_diagonal(&[rotation, rotation, rotation, 0.0, 0.0, 0.0].into());
    CameraUncertainty { pose: Some(PoseUncertainty::new(pose)), ..CameraUncertainty::of_time(0.0) }
}

/// A state of these standard deviations of place (m) and velocity (m/s).
fn state(mean: Vector6<f64>, place_sd: f64, speed_sd: f64) -> KinematicState {
    let [place, speed] = [place_sd.powi(2), speed_sd.powi(2)];
    let covariance = Matrix6::from_diagonal(&[place, place, place, speed, speed, speed].into());
    KinematicState { mean, covariance }
}

fn see(
    joint: &mut JointFilter,
    camera: usize,
    seen: &TimedLine,
    uncertainty: &CameraUncertainty,
) -> Option<f64> {
    let camera: CameraName = NAMES[camera].parse().unwrap();
    let bearing = TrackBearing { camera: &camera, time: seen.time, line: &seen.line, uncertainty };
    joint.predict(seen.time, 0.0);
    joint.see(&bearing, 1.0)
}

fn draws(seed: u64) -> impl FnMut() -> f64 {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    move || StandardNormal.sample(&mut random)
}

/// Where a target that had this state at time 0 is later.
fn place_at(state: &Vector6<f64>, time_s: f64) -> Point3<f64> {
    let [place, velocity] = [0, 3].map(|first| state.fixed_rows::<3>(first).into_owned());
    (place + velocity * time_s).into()
}

/// A wrong pose counts once, however many lines a camera gives: the densities of the lines one
/// after the other are the density of them all.
#[test]
fn the_lines_one_after_the_other_are_as_likely_as_all_at_once() {
    const LINES: usize = 24;
    const POSE: usize = 2;
    const ALL: usize = STATE + POSE * NAMES.len();
    let mut normal = draws(1);
    let mean = Vector6::new(30.0, 40.0, 60.0, 3.0, -2.0, 1.0);
    let start = state(mean, 0.05, 0.05);
    let camera = turned();
    let mut joint = JointFilter::of_state(&start, Timestamp::EPOCH);
    let mut sum = 0.0;
    // z = G [x e]' + noise, in all rows.
    let mut by = SMatrix::<f64, { 2 * LINES }, ALL>::zeros();
    let mut residuals = SVector::<f64, { 2 * LINES }>::zeros();
    let mut spread = SMatrix::<f64, { 2 * LINES }, { 2 * LINES }>::zeros();
    for line in 0..LINES {
        let (index, time_s) = (line % 3, line as f64 * 0.1);
        let truth = mean + Vector6::repeat(0.03);
        let seen = noisy_line_at(
            orthogonal_cameras()[index],
            place_at(&truth, time_s),
            time_s,
            &mut normal,
        );
        sum += see(&mut joint, index, &seen, &camera).unwrap();

        let model = BearingModel::new(seen.line.origin, place_at(&mean, time_s)).unwrap();
        let row = 2 * line;
        by.fixed_view_mut::<2, 3>(row, 0).copy_from(&model.by_position());
        by.fixed_view_mut::<2, 3>(row, 3).copy_from(&(model.by_position() * time_s));
        let shifts = camera.shifts(&model, Vector3::zeros());
        let first = STATE + POSE * index;
        by.fixed_view_mut::<2, POSE>(row, first).copy_from(&shifts.fixed_columns::<POSE>(0));
        residuals.fixed_rows_mut::<2>(row).copy_from(&model.residual(&seen.line).unwrap());
        let noise = model.covariance_of(&seen.line);
        spread.fixed_view_mut::<2, 2>(row, row).copy_from(&noise);
    }
    let mut prior = SMatrix::<f64, ALL, ALL>::identity();
    prior.fixed_view_mut::<STATE, STATE>(0, 0).copy_from(&start.covariance);
    let spread = (spread + by * prior * by.transpose()).cholesky().unwrap();
    let squares = residuals.dot(&spread.solve(&residuals));
    let log_root: f64 = spread.l().diagonal().map(f64::ln).sum();
    let at_once = -squares / 2.0 - log_root - LINES as f64 * (2.0 * PI).ln();
    // What the linearisation leaves out of it.
    assert!((sum - at_once).abs() < 0.05, "{sum} {at_once}");
}

/// To learn afterwards that a target is slow is the same as to have known it.
#[test]
fn slowed_is_as_if_it_had_been_slow_from_the_beginning() {
    const SPEED: f64 = 20.0;
    let truth = Vector6::new(30.0, 40.0, 60.0, 1.0, -0.5, 0.5);
    let mean = Vector6::new(30.0, 40.0, 60.0, 0.0, 0.0, 0.0);
    for share in [0.02, 0.1, 0.5] {
        let mut normal = draws(2);
        let begin = |speed| JointFilter::of_state(&state(mean, 0.5, speed), Timestamp::EPOCH);
        let (mut fast, mut slow) = (begin(SPEED), begin(share * SPEED));
        let (mut of_fast, mut of_slow) = (0.0, 0.0);
        for line in 0..9 {
            let time_s = line as f64 * 0.02;
            let origin = orthogonal_cameras()[line % 3];
            let seen = noisy_line_at(origin, place_at(&truth, time_s), time_s, &mut normal);
            of_fast += see(&mut fast, line % 3, &seen, &turned()).unwrap();
            of_slow += see(&mut slow, line % 3, &seen, &turned()).unwrap();
        }
        let (slowed, log_ratio) = fast.slowed(share, SPEED).unwrap();
        assert!(
            (log_ratio - (of_slow - of_fast)).abs() < 0.05,
            "{log_ratio} {}",
            of_slow - of_fast
        );
        let near = (&slowed.mean - &slow.mean).amax();
        assert!(near < 0.05, "{share}: {near}");
        let alike = (slowed.covariance.diagonal() - slow.covariance.diagonal()).abs();
        assert!(alike.component_div(&slow.covariance.diagonal()).amax() < 0.05, "{share}: {alike}");
    }
}

/// What is at rest has no speed, and no line makes it move.
#[test]
fn what_stands_has_no_speed() {
    let mean = Vector6::new(30.0, 40.0, 60.0, 0.0, 0.0, 0.0);
    let joint = JointFilter::of_state(&state(mean, 0.5, 20.0), Timestamp::EPOCH);
    let (mut resting, log_ratio) = joint.slowed(0.0, 20.0).unwrap();
    // Before any line, both are as likely.
    assert!(log_ratio.abs() < 1e-9, "{log_ratio}");
    let seen = line_at(orthogonal_cameras()[0], Point3::new(31.0, 41.0, 59.0), 5.0);
    see(&mut resting, 0, &seen, &turned()).unwrap();
    assert!(resting.velocity().norm() < 1e-9);
    assert!(resting.covariance.fixed_view::<3, 3>(3, 3).amax() < 1e-9);
}

/// A fast target seen once a second has flown a sixth of its distance before it is seen again.
#[test]
fn what_flies_far_between_two_exposures_is_where_it_is_said_to_be() {
    const RUNS: u32 = 200;
    let (mut nees, mut squares, mut far) = (0.0, 0.0, 0);
    for seed in 0..RUNS {
        let mut normal = draws(u64::from(seed));
        let mean = Vector6::new(30.0, 40.0, 60.0, 0.0, 0.0, 0.0);
        let mut truth = mean;
        for axis in 0..3 {
            truth[axis] += normal() * 0.05;
            truth[axis + 3] += normal() * 15.0;
        }
        let mut joint = JointFilter::of_state(&state(mean, 0.05, 15.0), Timestamp::EPOCH);
        for (camera, origin) in orthogonal_cameras().into_iter().enumerate() {
            let seen = noisy_line_at(origin, place_at(&truth, 1.0), 1.0, &mut normal);
            // Of lines that are as likely as they should be, one in 10 000 is less likely.
            far += usize::from(see(&mut joint, camera, &seen, &turned()).unwrap() < -10.0);
        }
        let error = joint.place() - place_at(&truth, 1.0);
        let covariance = joint.covariance.fixed_view::<3, 3>(0, 0).into_owned();
        squares += error.norm_squared();
        nees += error.dot(&(covariance.try_inverse().unwrap() * error));
    }
    assert_eq!(far, 0);
    let nees = nees / f64::from(RUNS);
    // Cameras are exact here, though 5 mrad are said: less than the three of honest deviations.
    assert!(nees < 3.0, "{nees}");
    // Three exact lines at 150 m meet within a decimetre or two; it flies 26 m.
    let rmse = (squares / f64::from(RUNS)).sqrt();
    assert!(rmse < 0.3, "{rmse} m");
}

/// Errors that last fade, those of a pose and a clock stay.
#[test]
fn errors_that_last_fade() {
    let mut camera = turned();
    camera.time_sd_s = 0.01;
    camera.lasting = crate::uncertainty::CorrelatedNoise { sd_rad: 2e-3, time_s: 1.0 };
    let mean = Vector6::new(30.0, 40.0, 60.0, 10.0, 5.0, 2.0);
    let mut joint = JointFilter::of_state(&state(mean, 1e-3, 1e-3), Timestamp::EPOCH);
    let seen = line_at(orthogonal_cameras()[0], Point3::new(30.0, 40.3, 60.3), 0.0);
    see(&mut joint, 0, &seen, &camera).unwrap();
    assert_eq!(joint.mean.len(), STATE + SHARED);
    let before = joint.mean.clone();
    joint.predict(Timestamp::from_seconds(1.0), 0.0);
    for error in 0..SHARED {
        let kept = joint.mean[STATE + error] / before[STATE + error];
        let left = if error < LASTING { 1.0 } else { (-1.0_f64).exp() };
        assert!((kept - left).abs() < 1e-9, "{error}: {kept}");
    }
}

/// Once it is known how fast a target flies, its lines tell how far a clock is off, and lines of
/// cameras whose clocks differ are one target's as much as those of exact ones.
#[test]
fn clocks_that_are_off_are_found_with_the_target() {
    const RUNS: u32 = 40;
    const CLOCK_SD_S: f64 = 0.03;
    let unsure = CameraUncertainty::of_time(CLOCK_SD_S);
    let exact = CameraUncertainty::of_time(0.0);
    let (mut squares, mut lost) = (0.0, 0.0);
    for seed in 0..RUNS {
        let mut normal = draws(u64::from(seed));
        let mean = Vector6::new(30.0, 40.0, 60.0, 0.0, 0.0, 0.0);
        let mut truth = mean;
        (0..3).for_each(|axis| truth[axis + 3] = normal() * 10.0);
        let ahead: [f64; 3] = std::array::from_fn(|_| normal() * CLOCK_SD_S);
        let begin = || JointFilter::at(place_at(&mean, 0.0), 50.0, 20.0, Timestamp::EPOCH);
        let (mut joint, mut known) = (begin(), begin());
        for line in 0..75 {
            let (camera, time_s) = (line % 3, line as f64 * 0.02);
            let origin = orthogonal_cameras()[camera];
            // What the camera sees is where the target was when its clock said so.
            let place = place_at(&truth, time_s - ahead[camera]);
            let seen = noisy_line_at(origin, place, time_s, &mut normal);
            let corrected =
                TimedLine { time: Timestamp::from_seconds(time_s - ahead[camera]), ..seen.clone() };
            lost += see(&mut known, camera, &corrected, &exact).unwrap()
                - see(&mut joint, camera, &seen, &unsure).unwrap();
        }
        // What all clocks have in common is not to be seen.
        let found = |camera: usize| joint.mean[STATE + camera] * CLOCK_SD_S;
        for camera in 1..3 {
            let error = (found(camera) - found(0)) - (ahead[camera] - ahead[0]);
            squares += error.powi(2) / f64::from(2 * RUNS);
        }
    }
    // Before any line it is 42 ms.
    assert!(squares.sqrt() < 0.005, "{} s", squares.sqrt());
    // Each of two differences is in the end known to a hundredth of what it may be (ln 100 = 4.6),
    // which lines of exact clocks need not tell. As much again is lost by the first line of each
    // camera, which counts for little while the velocity is not known.
    let lost = lost / f64::from(RUNS);
    assert!((0.0..22.0).contains(&lost), "{lost}");
}

/// Of an exact pose there is nothing to estimate, however it was declared.
#[test]
fn an_exact_pose_has_no_errors() {
    let exact = CameraUncertainty {
        pose: Some(PoseUncertainty::new(Matrix6::zeros())),
        ..CameraUncertainty::of_time(0.0)
    };
    let mean = Vector6::new(30.0, 40.0, 60.0, 0.0, 0.0, 0.0);
    let mut joint = JointFilter::of_state(&state(mean, 0.1, 0.1), Timestamp::EPOCH);
    let seen = line_at(orthogonal_cameras()[0], Point3::new(30.0, 40.1, 60.1), 0.0);
    see(&mut joint, 0, &seen, &exact).unwrap();
    assert_eq!(joint.mean.len(), STATE);
}
