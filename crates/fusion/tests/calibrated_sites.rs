//! Sites whose calibrations err by what they say: tracks must be as sure as they are right.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]
#![allow(clippy::print_stdout, reason = "docs/calibration.md has the figures")]
#![allow(dead_code, reason = "each test uses what it needs of the common scene")]

mod common;

use std::collections::BTreeMap;

use common::{Eye, Path, Scene, eye, straight};
use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_geometry::{Camera, Pose, tangent_basis};
use crossfix_message::{
    BearingFrame, CameraCalibration, LastingNoise, Timestamp, TrackFrame, TrackState,
};
use nalgebra::{Matrix6, Point3, Rotation3, Unit, Vector2, Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// What a calibration by minutes of flight says of its cameras: turns (rad) and places (m) per
/// axis, and how far the two are tied, as a place that is off is looked at from another side.
const TURN_SD: f64 = 3e-4;
const SHIFT_SD: f64 = 0.02;
const TIED: f64 = 0.7;
/// Of each clock, s.
const CLOCK_SD_S: f64 = 1e-3;
/// A tracker sits beside a target's middle for a while.
const LASTING: LastingNoise = LastingNoise { sd_rad: 3e-4, time_s: 0.7 };
/// How long a flight lasts, and after which time tracks are asked.
const FLIGHT_S: f64 = 12.0;
const SETTLED_S: f64 = 3.0;

/// A site of three to six cameras somewhere round the air that they watch.
fn drawn_site(random: &mut ChaCha8Rng) -> Vec<Eye> {
    let count = random.random_range(3..=6);
    let first: f64 = random.random_range(0.0..std::f64::consts::TAU);
    let eye = |k: u32| {
        // Not all on one side, nor evenly.
        let even = std::f64::consts::TAU * f64::from(k) / f64::from(count);
        let azimuth = first + even + random.random_range(-0.4..0.4);
        let away = random.random_range(80.0..180.0);
        let at = [away * azimuth.sin(), away * azimuth.cos(), random.random_range(1.0..10.0)];
        eye(&format!("camera{k}"), at, [0.0, 0.0, 40.0], random.random_range(0.0..0.04))
    };
    (0..count).map(eye).collect()
}

/// The covariance that is said of a pose.
fn said() -> Matrix6<f64> {
    let sd = Vector6::new(TURN_SD, TURN_SD, TURN_SD, SHIFT_SD, SHIFT_SD, SHIFT_SD);
    let mut correlation = Matrix6::identity();
    for (turn, shift) in [(0, 4), (1, 3)] {
        correlation[(turn, shift)] = TIED;
        correlation[(shift, turn)] = TIED;
    }
    Matrix6::from_diagonal(&sd) * correlation * Matrix6::from_diagonal(&sd)
}

/// A calibration that is off by what it says.
fn calibration(eye: &Eye, random: &mut ChaCha8Rng) -> CameraCalibration {
    let root = said().cholesky().unwrap().l();
    let error = root * Vector6::from_fn(|_, _| -> f64 { StandardNormal.sample(random) });
    let pose = eye.camera.pose();
    let turn = Rotation3::new(error.fixed_rows::<3>(0).into_owned());
    let place = pose.position() + error.fixed_rows::<3>(3);
    let stated = Pose::new(*(pose.rotation() * turn).matrix(), place).unwrap();
    let camera = Camera::new(*eye.camera.model().intrinsics(), stated).unwrap();
    CameraCalibration::new(&eye.name, &camera, Timestamp::EPOCH)
        .with_pose_covariance(&said())
        .with_lasting_errors(LASTING, 0.0)
}

/// The frames with clocks and bearings that err by what is said of them.
fn with_errors(mut frames: Vec<BearingFrame>, random: &mut ChaCha8Rng) -> Vec<BearingFrame> {
    let mut clocks: BTreeMap<String, i64> = BTreeMap::new();
    let mut lasting: BTreeMap<String, (i64, Vector2<f64>)> = BTreeMap::new();
    for frame in &mut frames {
        let mut normal = || -> f64 { StandardNormal.sample(&mut *random) };
        let error = match lasting.get(&frame.camera) {
            None => Vector2::from_fn(|_, _| normal()) * LASTING.sd_rad,
            Some((before_ns, before)) => {
                let apart_s = (frame.capture_time_ns - before_ns) as f64 * 1e-9;
                let kept = (-apart_s / LASTING.time_s).exp();
                let new = LASTING.sd_rad * (1.0 - kept * kept).sqrt();
                before * kept + Vector2::from_fn(|_, _| normal()) * new
            }
        };
        lasting.insert(frame.camera.clone(), (frame.capture_time_ns, error));
        for track in &mut frame.tracks {
            let direction = Unit::new_normalize(Vector3::from(track.bearing.unwrap()));
            let moved = direction.into_inner() + tangent_basis(&direction) * error;
            track.bearing = Some(moved.normalize().into());
        }
        let ahead = clocks
            .entry(frame.camera.clone())
            .or_insert_with(|| (CLOCK_SD_S * normal() * 1e9).round() as i64);
        frame.capture_time_ns += *ahead;
        frame.capture_time_sd_s = CLOCK_SD_S;
    }
    frames
}

/// Position and velocity of a path.
fn state(path: &Path, time_s: f64) -> (Point3<f64>, Vector3<f64>) {
    const STEP_S: f64 = 1e-3;
    let at = |time_s: f64| path(time_s).unwrap();
    (at(time_s), (at(time_s + STEP_S) - at(time_s - STEP_S)) / (2.0 * STEP_S))
}

/// A track's squared errors by its covariance: of position alone, and with the velocity.
fn nees(frame: &TrackFrame, path: &Path) -> Option<[f64; 2]> {
    let time_s = frame.time_ns as f64 * 1e-9;
    let track = frame.tracks.iter().find(|track| track.state() == TrackState::Confirmed)?;
    let (place, velocity) = state(path, time_s);
    let beside = Point3::from(track.position?) - place;
    let mut error = Vector6::zeros();
    error.fixed_rows_mut::<3>(0).copy_from(&beside);
    error.fixed_rows_mut::<3>(3).copy_from(&(Vector3::from(track.velocity?) - velocity));
    let covariance = Matrix6::from_row_slice(&track.covariance);
    let of_place = covariance.fixed_view::<3, 3>(0, 0).into_owned();
    let of_place = beside.dot(&of_place.cholesky()?.solve(&beside));
    Some([of_place, error.dot(&covariance.cholesky()?.solve(&error))])
}

/// The mean NEES, of position and of all, of one flight over a drawn site.
fn of_site(path: Path, seed: u64) -> [f64; 2] {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut scene = Scene::new(vec![path], FLIGHT_S);
    scene.eyes = drawn_site(&mut random);
    let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
    for eye in &scene.eyes {
        fusion.calibrate(&calibration(eye, &mut random)).unwrap();
    }
    let mut frames = with_errors(scene.frames(seed), &mut random);
    frames.sort_by_key(|frame| frame.capture_time_ns);
    let mut outputs: Vec<Output> = frames.iter().flat_map(|frame| fusion.ingest(frame)).collect();
    outputs.extend(fusion.flush());
    let squares: Vec<[f64; 2]> = outputs
        .iter()
        .filter_map(|output| match output {
            Output::Tracks(frame) if frame.time_ns as f64 * 1e-9 > SETTLED_S => {
                nees(frame, &scene.paths[0])
            }
            _ => None,
        })
        .collect();
    assert!(squares.len() > 100, "seed {seed}: {} answers", squares.len());
    [0, 1].map(|k| squares.iter().map(|square| square[k]).sum::<f64>() / squares.len() as f64)
}

/// How many sites are drawn. Their means differ by 2, so the mean of all has a standard error of
/// 0.3.
const SITES: u64 = 40;

/// Places are as well known as is said; velocities are said to be a little less well known than
/// they are, as any target may turn: so it is with exact calibrations and clocks, too (2.9 and 4.0
/// of 6).
fn assert_honest(path: impl Fn() -> Path) {
    let means: Vec<[f64; 2]> = (0..SITES).map(|seed| of_site(path(), seed)).collect();
    let [place, all] = [0, 1].map(|k| means.iter().map(|mean| mean[k]).sum::<f64>() / SITES as f64);
    println!("NEES of position {place:.2} (3), of all {all:.2} (6)");
    assert!((place - 3.0).abs() < 0.8, "position: {place}");
    assert!((3.0..7.0).contains(&all), "position and velocity: {all}");
}

#[test]
fn straight_flight_over_calibrated_sites_is_known_as_well_as_it_says() {
    assert_honest(|| straight([-40.0, 30.0, 45.0], [9.0, -5.0, 0.5]));
}

#[test]
fn turning_flight_over_calibrated_sites_is_known_as_well_as_it_says() {
    assert_honest(|| {
        Box::new(|t| {
            let (sin, cos) = (0.3 * t).sin_cos();
            Some(Point3::new(35.0 * cos, 35.0 * sin, 45.0 + 5.0 * (0.2 * t).sin()))
        })
    });
}
