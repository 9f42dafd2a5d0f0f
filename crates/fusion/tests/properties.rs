//! What the answer must not depend on: where the world's origin lies and how its axes are turned,
//! what the cameras are called, in which units length and time are counted, and in which order
//! frames arrive within the time that is waited for them.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use std::collections::BTreeMap;

use common::{Eye, Scene, found, fusion_of, site, straight};
use crossfix_fusion::{ClockEstimate, Fusion, FusionConfig, Output, TrackStatus};
use crossfix_geometry::{Camera, Pose};
use crossfix_message::BearingFrame;
use nalgebra::{Matrix6, Point3, Rotation3, Unit, Vector3, Vector6};
use proptest::prelude::*;

/// Two targets that fly straight and one that circles, with misses and clutter, for six seconds.
fn scene() -> Scene {
    let circling = |t: f64| Some(Point3::new(15.0 * (0.5 * t).cos(), 15.0 * (0.5 * t).sin(), 30.0));
    let paths = vec![
        straight([-25.0, 5.0, 40.0], [6.0, 1.0, 0.5]),
        straight([20.0, 25.0, 55.0], [-1.0, -7.0, 0.0]),
        Box::new(circling),
    ];
    Scene { detection: 0.9, clutter: 1.0, ..Scene::new(paths, 6.0) }
}

/// All that a fusion centre has said, rejections aside, and itself.
fn run(config: FusionConfig, eyes: &[Eye], frames: &[BearingFrame]) -> (Vec<Output>, Fusion) {
    let mut fusion = fusion_of(config, eyes);
    let mut outputs: Vec<Output> = frames.iter().flat_map(|frame| fusion.ingest(frame)).collect();
    outputs.extend(fusion.flush());
    outputs.retain(|output| !matches!(output, Output::Rejected(_)));
    (outputs, fusion)
}

/// A track as the others see it.
type Seen = (u64, TrackStatus, Vector6<f64>, Matrix6<f64>);

fn tracks(fusion: &Fusion) -> Vec<Seen> {
    let seen = |track: &crossfix_fusion::FusedTrack| {
        (track.id.0, track.status, track.state().mean, track.state().covariance)
    };
    fusion.tracks().map(seen).collect()
}

/// Numbers, states and covariances are the same but for rounding: `tolerance` in m and m/s, and in
/// shares of the larger variance.
fn assert_alike(ours: &[Seen], theirs: &[Seen], tolerance: f64) {
    assert_eq!(ours.len(), theirs.len());
    assert!(ours.len() >= 3, "the targets are found");
    for ((id, status, mean, covariance), other) in ours.iter().zip(theirs) {
        assert_eq!((*id, *status), (other.0, other.1));
        assert!((mean - other.2).amax() < tolerance, "{id}: {}", mean - other.2);
        let difference = (covariance - other.3).amax();
        assert!(difference < tolerance * covariance.amax(), "{id}: {difference:e}");
    }
}

/// The site and its frames with other names.
fn renamed(frames: &[BearingFrame], names: [&str; 3]) -> (Vec<Eye>, Vec<BearingFrame>) {
    let mut eyes = site();
    let new_name: BTreeMap<String, &str> =
        eyes.iter().map(|eye| eye.name.to_string()).zip(names).collect();
    eyes.iter_mut().for_each(|eye| eye.name = new_name[eye.name.as_str()].parse().unwrap());
    let mut renamed = frames.to_vec();
    renamed.iter_mut().for_each(|frame| frame.camera = new_name[&frame.camera].into());
    (eyes, renamed)
}

fn moved(eyes: &[Eye], rotation: &Rotation3<f64>, shift: Vector3<f64>, scale: f64) -> Vec<Eye> {
    let moved = |eye: &Eye| {
        let pose = eye.camera.pose();
        let turned = (rotation * pose.rotation()).into_inner();
        let position = rotation * pose.position() * scale + shift;
        let camera =
            Camera::new(*eye.camera.model().intrinsics(), Pose::new(turned, position).unwrap());
        Eye { camera: camera.unwrap(), ..eye.clone() }
    };
    eyes.iter().map(moved).collect()
}

/// The defaults in units of length and time that are `s` and `u` times smaller.
fn scaled_config(s: f64, u: f64) -> FusionConfig {
    let mut config = FusionConfig::default();
    config.event_time.lateness_s *= u;
    config.event_time.max_ahead_s *= u;
    let initiation = &mut config.initiation;
    initiation.birth_density_per_m3 /= s.powi(3);
    initiation.period_s *= u;
    initiation.pair_s *= u;
    initiation.velocity_prior_sd_mps *= s / u;
    initiation.max_range_m *= s;
    let tracking = &mut config.tracking;
    for model in &mut tracking.models {
        model.acceleration_density *= s.powi(2) / u.powi(3);
    }
    tracking.switching_rate_per_s /= u;
    tracking.calming_rate_per_s /= u;
    tracking.restlessness_prior_s *= u;
    tracking.coasting_after_s *= u;
    tracking.lost_after_s *= u;
    tracking.max_position_sd_m *= s;
    config
}

/// Each camera's frames in their order, but late by up to `delays` of seconds; the first come in
/// time.
fn delayed(frames: &[BearingFrame], delays: &[f64]) -> Vec<BearingFrame> {
    let mut last: BTreeMap<&str, f64> = BTreeMap::new();
    let mut arrivals: Vec<(f64, &BearingFrame)> = Vec::new();
    for (i, frame) in frames.iter().enumerate() {
        let seconds = frame.capture_time_ns as f64 / 1e9;
        let delay = if i < 3 { 0.0 } else { delays[i % delays.len()] };
        let before = last.entry(frame.camera.as_str()).or_insert(0.0);
        *before = before.max(seconds + delay);
        arrivals.push((*before, frame));
    }
    arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
    arrivals.into_iter().map(|(_, frame)| frame.clone()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 16, failure_persistence: None, ..ProptestConfig::default() })]

    /// Coordinates of up to 1500 m are exact to 2e-13 m, and a state that is solved from
    /// differences of them magnifies that by some thousands, as its variances differ by so much.
    #[test]
    fn turning_and_shifting_the_world_turns_and_shifts_the_answer(
        axis in prop::array::uniform3(-1.0..1.0),
        angle in -3.1..3.1,
        shift in prop::array::uniform3(-1000.0..1000.0),
        seed in 0..1000u64,
    ) {
        let rotation = Unit::try_new(Vector3::from(axis), 1e-3)
            .map_or_else(Rotation3::identity, |axis| Rotation3::from_axis_angle(&axis, angle));
        let shift = Vector3::from(shift);
        let frames = scene().frames(seed);
        let (_, here) = run(FusionConfig::default(), &site(), &frames);
        let (_, there) = run(FusionConfig::default(), &moved(&site(), &rotation, shift, 1.0), &frames);
        let mut turn = Matrix6::zeros();
        for block in [0, 3] {
            turn.fixed_view_mut::<3, 3>(block, block).copy_from(rotation.matrix());
        }
        let mut expected = tracks(&here);
        for (_, _, mean, covariance) in &mut expected {
            *mean = turn * *mean;
            *covariance = turn * *covariance * turn.transpose();
            let mut position = mean.fixed_rows_mut::<3>(0);
            position += shift;
        }
        assert_alike(&tracks(&there), &expected, 1e-9);
    }

    #[test]
    fn what_the_cameras_are_called_does_not_matter(
        names in Just(["a", "m", "z"]).prop_shuffle(),
        seed in 0..1000u64,
    ) {
        let frames = scene().frames(seed);
        let (_, plain) = run(FusionConfig::default(), &site(), &frames);
        let (eyes, renamed) = renamed(&frames, names);
        let (_, other) = run(FusionConfig::default(), &eyes, &renamed);
        prop_assert_eq!(tracks(&other), tracks(&plain));
    }

    /// The state of the clocks is against the camera that was heard first, whatever it is called;
    /// but sums over all cameras go by their names. A window's information (in m^2 and s^2) has a
    /// condition of some 1e9: rounding of 1e-16 is up to 1e-7 of a standard deviation.
    #[test]
    fn nor_does_it_where_clocks_are_unsure(
        names in Just(["a", "m", "z"]).prop_shuffle(),
        offsets in prop::array::uniform3(-0.1..0.1f64),
        seed in 0..1000u64,
    ) {
        let mut frames = scene().frames(seed);
        for frame in &mut frames {
            let index = site().iter().position(|eye| eye.name.as_str() == frame.camera).unwrap();
            frame.capture_time_ns += (offsets[index] * 1e9) as i64;
            frame.capture_time_sd_s = 0.05;
        }
        let (_, plain) = run(FusionConfig::default(), &site(), &frames);
        let (eyes, renamed) = renamed(&frames, names);
        let (_, other) = run(FusionConfig::default(), &eyes, &renamed);
        assert_alike(&tracks(&other), &tracks(&plain), 1e-6);
        let clocks = |fusion: &Fusion, eyes: &[Eye]| -> Vec<ClockEstimate> {
            let of = |eye: &Eye| fusion.cameras().find(|report| report.camera == eye.name)?.clock;
            eyes.iter().filter_map(of).collect()
        };
        let (ours, theirs) = (clocks(&other, &eyes), clocks(&plain, &site()));
        prop_assert_eq!((ours.len(), theirs.len()), (3, 3));
        for (our, their) in ours.iter().zip(&theirs) {
            prop_assert!(their.relative_sd_s < 0.02, "they are learnt: {:?}", their);
            prop_assert!((our.offset_s - their.offset_s).abs() < 1e-6 * their.relative_sd_s, "{our:?} {their:?}");
            prop_assert!((our.relative_sd_s / their.relative_sd_s - 1.0).abs() < 1e-6, "{our:?} {their:?}");
        }
    }

    /// An update's iteration ends by shares of the bearing's noise, which have no units; what is in
    /// metres and seconds beside it (what keeps matrices regular) is far below what bearings tell.
    #[test]
    fn length_and_time_have_no_units_of_their_own(
        s in prop::sample::select(vec![0.25, 0.5, 2.0, 3.0]),
        u in prop::sample::select(vec![0.5, 1.0, 2.0, 3.0]),
        seed in 0..1000u64,
    ) {
        let frames = scene().frames(seed);
        let (_, plain) = run(FusionConfig::default(), &site(), &frames);
        let mut slow = frames;
        // Times are whole milliseconds: half of one is exact.
        slow.iter_mut().for_each(|f| f.capture_time_ns = (f.capture_time_ns as f64 * u) as i64);
        let eyes = moved(&site(), &Rotation3::identity(), Vector3::zeros(), s);
        let (_, scaled) = run(scaled_config(s, u), &eyes, &slow);
        let units = Vector6::new(s, s, s, s / u, s / u, s / u).map(|unit: f64| 1.0 / unit);
        let mut back = tracks(&scaled);
        for (_, _, mean, covariance) in &mut back {
            *mean = mean.component_mul(&units);
            *covariance = Matrix6::from_diagonal(&units) * *covariance * Matrix6::from_diagonal(&units);
        }
        assert_alike(&back, &tracks(&plain), 1e-6);
    }

    #[test]
    fn the_order_of_arrival_within_the_lateness_changes_not_one_bit(
        delays in prop::collection::vec(0.0..0.35f64, 40),
        seed in 0..1000u64,
    ) {
        let frames = scene().frames(seed);
        let (outputs, plain) = run(FusionConfig::default(), &site(), &frames);
        let late = delayed(&frames, &delays);
        let (late_outputs, other) = run(FusionConfig::default(), &site(), &late);
        prop_assert_ne!(late, frames);
        prop_assert_eq!(late_outputs, outputs);
        prop_assert!(other.tracks().eq(plain.tracks()));
        prop_assert_eq!(other.counters(), plain.counters());
    }
}

#[test]
fn the_scene_of_these_properties_is_an_ordinary_one() {
    let scene = scene();
    let (_, fusion) = run(FusionConfig::default(), &scene.eyes, &scene.frames(1));
    assert!(scene.paths.iter().all(|path| found(&fusion, path).is_some()));
}
