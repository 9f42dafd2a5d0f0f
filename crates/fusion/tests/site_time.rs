//! What the fusion centre does where all clocks step at once, and where it only looks like that.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use std::collections::BTreeSet;

use common::{Path, Scene, found, fusion_of, straight};
use crossfix_fusion::{Fusion, FusionConfig, Output};
use crossfix_message::{BearingFrame, TrackEventKind};

/// When the clocks step, s.
const AT_S: f64 = 15.0;
/// How long the target is looked at, s.
const UNTIL_S: f64 = 21.0;

fn path() -> Path {
    straight([-60.0, 10.0, 45.0], [5.0, 0.0, 0.2])
}

/// The frames of a target that flies straight, with the times that the cameras' clocks give them,
/// of which these step.
fn stepped(step_s: f64, sd_s: f64, cameras: &[&str]) -> (Scene, Vec<BearingFrame>) {
    let scene = Scene::new(vec![path()], UNTIL_S);
    let mut frames = scene.frames(3);
    for frame in &mut frames {
        let seconds = frame.capture_time_ns as f64 / 1e9;
        frame.capture_time_sd_s = sd_s;
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
    (track.state().position() - shown(track.updated_at.seconds()).unwrap()).norm()
}

#[test]
fn a_track_outlives_a_step_of_all_clocks_either_way() {
    let steps = [-3600.0, -1.0, -0.5, 0.5, 1.0];
    // Clocks that are right, and clocks of which something has been learnt.
    for (step_s, sd_s) in steps.into_iter().flat_map(|step_s| [(step_s, 0.0), (step_s, 0.02)]) {
        let (scene, frames) = stepped(step_s, sd_s, &["a", "b", "c"]);
        let (fusion, numbers) = run(&scene, &frames);
        assert_eq!(numbers.len(), 1, "{step_s}");
        assert!(error_m(&fusion, step_s) < 0.3, "{step_s}: {}", error_m(&fusion, step_s));
        let count = |name| fusion.counters().get(name);
        assert_eq!(
            (count("site_time_steps"), count("exposures")),
            (1, frames.len() as u64),
            "{step_s}"
        );
    }
}

/// How far a camera's clock is said to be ahead, s.
fn ahead_s(fusion: &Fusion, camera: &str) -> f64 {
    let report = fusion.cameras().find(|report| report.camera.as_str() == camera).unwrap();
    report.clock.unwrap().offset_s
}

#[test]
fn one_clock_that_steps_alone_costs_its_camera_half_a_second_and_moves_nobody_else() {
    let steps = [-3600.0, -5.0, -1.0, -0.6, 0.6, 1.0, 5.0, 3600.0];
    for (step_s, sd_s) in steps.into_iter().flat_map(|step_s| [(step_s, 0.0), (step_s, 0.02)]) {
        for camera in ["a", "b", "c"] {
            let (scene, frames) = stepped(step_s, sd_s, &[camera]);
            let (fusion, numbers) = run(&scene, &frames);
            assert_eq!(numbers.len(), 1, "{camera} by {step_s}");
            assert!(error_m(&fusion, 0.0) < 0.3, "{}", error_m(&fusion, 0.0));
            let count = |name| fusion.counters().get(name);
            assert_eq!(
                (count("site_time_steps"), count("clock_steps")),
                (0, 1),
                "{camera} by {step_s}, {sd_s}"
            );
            assert!((ahead_s(&fusion, camera) - step_s).abs() < 0.02, "{camera} by {step_s}");
            // All that it saw since is used.
            let lost = frames.len() as u64 - count("exposures");
            assert!(lost <= 5, "{camera} by {step_s}: {lost} frames lost");
        }
    }
}

#[test]
fn a_clock_that_steps_and_is_set_back_is_followed_both_ways() {
    let (scene, mut frames) = stepped(-1.0, 0.0, &["b"]);
    for frame in frames.iter_mut().filter(|frame| frame.camera == "b") {
        // It has been a second behind since 15 s, and is right again from 18 s on.
        let seconds = frame.capture_time_ns as f64 / 1e9;
        frame.capture_time_ns += if seconds + 1.0 >= AT_S + 3.0 { 1_000_000_000 } else { 0 };
    }
    let (fusion, numbers) = run(&scene, &frames);
    assert_eq!((numbers.len(), fusion.counters().get("clock_steps")), (1, 2));
    assert!(ahead_s(&fusion, "b").abs() < 0.02, "{}", ahead_s(&fusion, "b"));
    assert!(error_m(&fusion, 0.0) < 0.3, "{}", error_m(&fusion, 0.0));
}

#[test]
fn clocks_that_are_set_right_one_after_the_other_take_the_sites_time_along() {
    // By NTP, seconds apart: first `a`, then `b`, then `c`.
    let scene = Scene::new(vec![path()], UNTIL_S + 6.0);
    let mut frames = scene.frames(3);
    for frame in &mut frames {
        let seconds = frame.capture_time_ns as f64 / 1e9;
        let at_s = AT_S + f64::from(frame.camera.as_bytes()[0] - b'a') * 3.0;
        frame.capture_time_ns -= if seconds >= at_s { 1_000_000_000 } else { 0 };
    }
    let (fusion, numbers) = run(&scene, &frames);
    assert_eq!(numbers.len(), 1);
    assert!(error_m(&fusion, -1.0) < 0.3, "{}", error_m(&fusion, -1.0));
    for camera in ["a", "b", "c"] {
        assert!(ahead_s(&fusion, camera).abs() < 0.02, "{camera}");
    }
}

#[test]
fn a_frame_with_a_wrong_time_is_no_step() {
    for off_s in [-1.0, 1.0, 3600.0] {
        let (scene, mut frames) = stepped(0.0, 0.0, &[]);
        let wrong = frames
            .iter()
            .position(|frame| frame.camera == "b" && frame.capture_time_ns as f64 / 1e9 > AT_S);
        frames[wrong.unwrap()].capture_time_ns += (off_s * 1e9) as i64;
        let (fusion, numbers) = run(&scene, &frames);
        let count = |name| fusion.counters().get(name);
        assert_eq!((numbers.len(), count("clock_steps"), count("site_time_steps")), (1, 0, 0));
        assert!(frames.len() as u64 - count("exposures") <= 5, "{off_s}");
    }
}

#[test]
fn cameras_that_stand_still_for_a_while_are_no_step() {
    let hovering = || straight([5.0, 10.0, 45.0], [0.0; 3]);
    let all = ["a", "b", "c"].as_slice();
    for (cameras, path) in
        [(all, path()), (all, hovering()), (&["a", "c"], path()), (&["a", "c"], hovering())]
    {
        let shown = path(0.0).unwrap() + (path(1.0).unwrap() - path(0.0).unwrap()) * UNTIL_S;
        let scene = Scene::new(vec![path], UNTIL_S);
        let mut frames = scene.frames(3);
        let (slept, awake) =
            (AT_S..AT_S + 1.0, |frame: &BearingFrame| !cameras.contains(&&*frame.camera));
        frames
            .retain(|frame| awake(frame) || !slept.contains(&(frame.capture_time_ns as f64 / 1e9)));
        // Numbered without a gap, as by a host that slept.
        for frame in frames.iter_mut().filter(|frame| !awake(frame)) {
            frame.sequence -= if frame.capture_time_ns as f64 / 1e9 > AT_S { 10 } else { 0 };
        }
        let (fusion, numbers) = run(&scene, &frames);
        assert_eq!(numbers.len(), 1);
        let end = fusion.tracks().next().unwrap().state().position();
        assert!((end - shown).norm() < 1.0, "{cameras:?}: {end} {shown}");
        let count = |name| fusion.counters().get(name);
        assert_eq!(
            (count("site_time_steps"), count("exposures")),
            (0, frames.len() as u64),
            "{cameras:?}"
        );
    }
}
