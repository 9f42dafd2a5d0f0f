//! What the fusion centre does where all clocks step at once, and where it only looks like that.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use std::collections::BTreeSet;

use common::{Path, Scene, found, fusion_of, straight};
use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_message::{BearingFrame, TrackEventKind};

/// When the clocks step, s.
const AT_S: f64 = 6.0;
/// How long the target is looked at, s.
const UNTIL_S: f64 = 12.0;

fn path() -> Path {
    straight([-60.0, 10.0, 45.0], [12.0, 0.0, 0.5])
}

/// The frames of a target that flies straight, with the times that these cameras' clocks give them, which step.
fn stepped(step_s: f64, cameras: &[&str]) -> (Scene, Vec<BearingFrame>) {
    let scene = Scene::new(vec![path()], UNTIL_S);
    let mut frames = scene.frames(3);
    for frame in &mut frames {
        let seconds = frame.capture_time_ns as f64 / 1e9;
        if seconds >= AT_S && cameras.contains(&frame.camera.as_str()) {
            frame.capture_time_ns += (step_s * 1e9) as i64;
        }
    }
    (scene, frames)
}

/// A fusion centre that has taken these frames, and the numbers of all tracks that it was sure of.
fn run(scene: &Scene, frames: &[BearingFrame]) -> (Fusion, BTreeSet<u64>) {
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    let mut outputs: Vec<Output> = frames.iter().flat_map(|frame| fusion.ingest(frame)).collect();
    outputs.extend(fusion.flush());
    let confirmed = |output: &Output| match output {
        Output::Event(event) if event.kind() == TrackEventKind::Confirmed => Some(event.track_id),
        _ => None,
    };
    let numbers = outputs.iter().filter_map(confirmed).collect();
    (fusion, numbers)
}

/// How far the only sure track is from the target where the clocks are ahead by so much, m.
fn error_m(fusion: &Fusion, ahead_s: f64) -> f64 {
    assert_eq!(fusion.tracks().filter(|track| track.is_confirmed()).count(), 1);
    let shown: Path = Box::new(move |t| path()(t - ahead_s));
    let track = found(fusion, &shown).unwrap();
    (track.state().position() - shown(track.updated.seconds()).unwrap()).norm()
}

#[test]
fn a_track_outlives_a_step_of_all_clocks_either_way_by_any_time() {
    for step_s in [-3600.0, -1.0, -0.5, 0.5, 1.0, 37.0] {
        let (scene, frames) = stepped(step_s, &["a", "b", "c"]);
        let (fusion, numbers) = run(&scene, &frames);
        assert_eq!(numbers.len(), 1, "{step_s}");
        assert!(error_m(&fusion, step_s) < 0.3, "{step_s}: {}", error_m(&fusion, step_s));
        let count = |name| fusion.counters().get(name);
        assert_eq!((count("site_time_steps"), count("exposures")), (1, frames.len() as u64), "{step_s}");
    }
}

#[test]
fn a_camera_whose_clock_does_not_step_with_the_others_goes_on_with_them() {
    for step_s in [-1.0, 1.0] {
        let (scene, frames) = stepped(step_s, &["a", "c"]);
        let (fusion, numbers) = run(&scene, &frames);
        assert_eq!(numbers.len(), 1, "{step_s}");
        assert!(error_m(&fusion, step_s) < 0.3, "{step_s}: {}", error_m(&fusion, step_s));
        let newest = fusion.tracks().next().unwrap();
        assert!(newest.residuals.values().all(|r| newest.updated.seconds_since(r.time) < 0.2), "{newest:?}");
    }
}

#[test]
fn one_clock_that_steps_alone_moves_nobody_else() {
    let (scene, frames) = stepped(1.0, &["b"]);
    let (fusion, numbers) = run(&scene, &frames);
    assert_eq!(numbers.len(), 1);
    assert!(error_m(&fusion, 0.0) < 0.3, "{}", error_m(&fusion, 0.0));
    assert_eq!(fusion.counters().get("site_time_steps"), 0);
}

#[test]
fn cameras_that_stand_still_for_a_while_are_no_step() {
    for cameras in [["a", "b", "c"].as_slice(), &["a", "c"], &["b"]] {
        let scene = Scene::new(vec![path()], UNTIL_S);
        let mut frames = scene.frames(3);
        let (slept, awake) = (AT_S..AT_S + 1.0, |frame: &BearingFrame| !cameras.contains(&&*frame.camera));
        frames.retain(|frame| awake(frame) || !slept.contains(&(frame.capture_time_ns as f64 / 1e9)));
        // Numbered without a gap, as by a host that slept.
        for frame in frames.iter_mut().filter(|frame| !awake(frame)) {
            frame.sequence -= if frame.capture_time_ns as f64 / 1e9 > AT_S { 10 } else { 0 };
        }
        let (fusion, numbers) = run(&scene, &frames);
        assert_eq!(numbers.len(), 1);
        assert!(error_m(&fusion, 0.0) < 0.3, "{cameras:?}: {}", error_m(&fusion, 0.0));
        let count = |name| fusion.counters().get(name);
        assert_eq!((count("site_time_steps"), count("exposures")), (0, frames.len() as u64), "{cameras:?}");
    }
}
