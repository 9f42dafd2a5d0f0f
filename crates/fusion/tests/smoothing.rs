//! States that go out once more, as the bearings since have told.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]
#![allow(dead_code, reason = "each test uses what it needs of the common scene")]

mod common;

use common::{Scene, fusion_of};
use crossfix_fusion::{FusionConfig, Output};
use crossfix_message::{Timestamp, TrackFrame};
use nalgebra::{Matrix6, Point3, Vector3, Vector6};

const LAG_S: f64 = 0.5;
/// Tracks are lost so soon that states of before still wait, s.
const LOST_S: f64 = 1.0;

/// A target that turns now this way and now that, at 12 m/s, until a time, s.
fn weaving(until_s: f64) -> common::Path {
    Box::new(move |t| (t < until_s).then(|| place(t)))
}

fn place(t: f64) -> Point3<f64> {
    Point3::new(-60.0 + 10.0 * t, 8.0 * (0.8 * t).sin(), 45.0)
}

fn velocity(t: f64) -> Vector3<f64> {
    Vector3::new(10.0, 6.4 * (0.8 * t).cos(), 0.0)
}

/// The frames that go out at once, and those that go out later with what the centre had handled by
/// then, s.
fn fused(scene: &Scene, smoothing_s: f64, seed: u64) -> (Vec<TrackFrame>, Vec<(TrackFrame, f64)>) {
    let mut config = FusionConfig::default().smoothed(Some(smoothing_s));
    config.tracking.lost_after_s = LOST_S;
    let mut fusion = fusion_of(config, &scene.eyes);
    let (mut at_once, mut later) = (Vec::new(), Vec::new());
    let mut keep = |outputs: Vec<Output>, now: f64| {
        for output in outputs {
            match output {
                Output::Tracks(frame) => at_once.push(frame),
                Output::Smoothed(frame) => later.push((frame, now)),
                _ => {}
            }
        }
    };
    for frame in scene.frames(seed) {
        let outputs = fusion.ingest(&frame);
        keep(outputs, fusion.now().map_or(0.0, Timestamp::seconds));
    }
    keep(fusion.flush(), f64::INFINITY);
    (at_once, later)
}

fn time_s(frame: &TrackFrame) -> f64 {
    Timestamp::from_nanos(frame.time_ns).seconds()
}

/// Root mean square error of the confirmed tracks' velocities after the first two seconds, m/s.
fn velocity_error<'a>(frames: impl Iterator<Item = &'a TrackFrame>) -> f64 {
    let errors = frames.filter(|frame| time_s(frame) > 2.0).flat_map(|frame| {
        let truth = velocity(time_s(frame));
        frame.tracks.iter().map(move |track| {
            let found: Vector3<f64> = track.velocity.unwrap().into();
            (found - truth).norm_squared()
        })
    });
    let squares: Vec<f64> = errors.collect();
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

#[test]
fn every_state_goes_out_once_more_after_the_lag_and_no_other() {
    // Two targets, of which one leaves while the other flies on, missed now and then.
    let beside: common::Path = Box::new(|t| Some(place(t) + Vector3::new(0.0, 40.0, 5.0)));
    let scene =
        Scene { detection: 0.9, clutter: 0.3, ..Scene::new(vec![weaving(7.0), beside], 12.0) };
    let (at_once, later) = fused(&scene, LAG_S, 1);
    assert!(at_once.iter().any(|frame| frame.tracks.len() == 2));
    let ids = |frame: &TrackFrame| -> Vec<(u64, i32)> {
        frame.tracks.iter().map(|track| (track.id, track.state)).collect()
    };
    assert_eq!(at_once.len(), later.len());
    for (first, (second, said_s)) in at_once.iter().zip(&later) {
        assert_eq!((first.sequence, first.time_ns), (second.sequence, second.time_ns));
        assert_eq!(ids(first), ids(second));
        // Not before its time, and no later than the next exposure.
        let waited_s = said_s - time_s(second);
        assert!(waited_s >= LAG_S - 1e-9, "{waited_s}");
        assert!(waited_s < LAG_S + 0.1 || *said_s == f64::INFINITY, "{waited_s}");
    }
    let (alone, none) = fused(&scene, 0.0, 1);
    assert_eq!(alone, at_once, "what goes out at once is the same");
    assert!(none.is_empty());
}

/// The mean of the squared errors of position and velocity by the covariance that is said of them.
fn mean_nees<'a>(frames: impl Iterator<Item = &'a TrackFrame>) -> f64 {
    let squares = frames.filter(|frame| time_s(frame) > 2.0).flat_map(|frame| {
        let time = time_s(frame);
        frame.tracks.iter().map(move |track| {
            let found: [Vector3<f64>; 2] =
                [track.position.unwrap().into(), track.velocity.unwrap().into()];
            let error = [found[0] - place(time).coords, found[1] - velocity(time)];
            let error = Vector6::from_iterator(error.iter().flatten().copied());
            let covariance = Matrix6::from_column_slice(&track.covariance);
            error.dot(&covariance.cholesky().unwrap().solve(&error))
        })
    });
    let squares: Vec<f64> = squares.collect();
    squares.iter().sum::<f64>() / squares.len() as f64
}

#[test]
fn a_velocity_is_far_better_known_half_a_second_later_and_as_well_as_is_said() {
    let (mut before, mut after, mut nees) = (0.0, 0.0, [0.0; 2]);
    for seed in 0..4 {
        let scene = Scene::new(vec![weaving(f64::INFINITY)], 12.0);
        let (at_once, later) = fused(&scene, LAG_S, seed);
        before += velocity_error(at_once.iter()) / 4.0;
        after += velocity_error(later.iter().map(|(frame, _)| frame)) / 4.0;
        nees[0] += mean_nees(at_once.iter()) / 4.0;
        nees[1] += mean_nees(later.iter().map(|(frame, _)| frame)) / 4.0;
    }
    assert!(after < 0.6 * before, "{after} of {before} m/s");
    // Six is honest; the models are ready for livelier turns than these.
    assert!(nees[1] < 6.0 && nees[1] < 1.5 * nees[0], "{nees:?}");
}

#[test]
fn what_is_known_when_a_track_ends_goes_into_what_waits() {
    // The target is gone at 7 s, its track is lost at 8 s: the last second of it still waits then.
    let scene = Scene::new(vec![weaving(7.0)], 14.0);
    let last = |frame: &&TrackFrame| (6.0..6.8).contains(&time_s(frame));
    let (_, later) = fused(&scene, 2.0, 2);
    let seen = later.iter().map(|(frame, _)| frame).filter(last);
    let smoothed = velocity_error(seen);
    let (at_once, _) = fused(&scene, 0.0, 2);
    let filtered = velocity_error(at_once.iter().filter(last));
    assert!(smoothed < 0.6 * filtered, "{smoothed} of {filtered} m/s");
}
