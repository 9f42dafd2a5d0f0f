//! What the fusion centre says where it finds nothing.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod common;

use common::{Eye, Scene, calibration, found, fusion_of, site, straight};
use crossfix_fusion::{Fusion, FusionConfig, UnmetLines};
use crossfix_message::BearingFrame;
use nalgebra::{Rotation3, Vector3};

/// Feeds frames, each changed by `spoil`, and returns when it was said why nothing is found, s
/// after the first.
fn said(scene: &Scene, spoil: impl Fn(&mut BearingFrame)) -> (Fusion, Option<f64>) {
    let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
    let mut when = None;
    for mut frame in scene.frames(3) {
        let time_s = frame.capture_time_ns as f64 / 1e9;
        spoil(&mut frame);
        fusion.ingest(&frame);
        if when.is_none() && fusion.why_nothing().is_some() {
            when = Some(time_s);
        }
    }
    fusion.flush();
    (fusion, when)
}

/// Two cameras and a target that stays in sight of both.
fn two_cameras() -> Scene {
    let mut eyes = site();
    eyes.truncate(2);
    Scene { eyes, ..Scene::new(vec![straight([-40.0, -40.0, 45.0], [5.0, 6.0, 0.0])], 12.0) }
}

#[test]
fn lines_that_miss_each_other_are_said_within_ten_seconds_and_by_how_much() {
    let scene = two_cameras();
    // 0.1 rad of a camera that is knocked, at some 150 m: 15 m.
    let (fusion, when) = said(&scene, |frame| {
        for track in frame.tracks.iter_mut().filter(|_| frame.camera == "b") {
            let turned =
                Rotation3::from_euler_angles(0.1, 0.0, 0.0) * Vector3::from(track.bearing.unwrap());
            track.bearing = Some(turned.into());
        }
    });
    assert!(when.is_some_and(|when| when < 10.0), "{when:?}");
    let why = fusion.why_nothing().unwrap();
    assert_eq!(why.cameras.each_ref().map(|camera| camera.as_str()), ["a", "b"]);
    assert!(
        matches!(why.lines, UnmetLines::Apart { by_m } if (10.0..20.0).contains(&by_m)),
        "{why:?}"
    );
    let text = why.to_string();
    assert!(
        text.starts_with(
            "cameras `a` and `b` see something at the same time, but their lines miss"
        ),
        "{text}"
    );
    assert!(fusion.counters().get("unfound_lines_miss_each_other") > 10);
}

#[test]
fn nothing_is_said_any_more_when_the_target_or_a_camera_is_gone() {
    let scene = Scene { time_s: 0.0..25.0, ..two_cameras() };
    let knocked = |frame: &mut BearingFrame| {
        for track in frame.tracks.iter_mut().filter(|_| frame.camera == "b") {
            let turned =
                Rotation3::from_euler_angles(0.1, 0.0, 0.0) * Vector3::from(track.bearing.unwrap());
            track.bearing = Some(turned.into());
        }
    };
    let (fusion, when) = said(&scene, |frame| {
        knocked(frame);
        if frame.capture_time_ns > 12_000_000_000 {
            frame.tracks.clear();
        }
    });
    assert!(when.is_some() && fusion.why_nothing().is_none(), "{:?}", fusion.why_nothing());
    let (fusion, when) = said(&scene, |frame| {
        knocked(frame);
        if frame.capture_time_ns > 12_000_000_000 && frame.camera == "b" {
            frame.camera = "nobody".to_owned();
        }
    });
    assert!(when.is_some() && fusion.why_nothing().is_none(), "{:?}", fusion.why_nothing());
}

#[test]
fn where_a_target_is_found_nothing_is_said() {
    let scene = two_cameras();
    let (fusion, when) = said(&scene, |_| {});
    assert_eq!(when, None);
    assert!(found(&fusion, &scene.paths[0]).is_some());
}

#[test]
fn clutter_is_not_something() {
    let scene = Scene { paths: Vec::new(), clutter: 5.0, ..two_cameras() };
    // What an agent follows has a number; what it takes up and drops in one picture never has the
    // same again.
    let (_, when) = said(&scene, |frame| {
        for (i, track) in frame.tracks.iter_mut().enumerate() {
            track.track_id = frame.sequence * 1000 + i as u64;
        }
    });
    assert_eq!(when, None);
}

#[test]
fn a_wrong_pose_is_said_where_bearings_are_numbered_anew_in_each_image() {
    let scene = two_cameras();
    let (fusion, _) = said(&scene, |frame| {
        let turn = if frame.camera == "b" { 0.4 } else { 0.0 };
        for track in &mut frame.tracks {
            track.track_id = frame.sequence * 1000;
            let turned = Rotation3::from_euler_angles(turn, 0.0, 0.0)
                * Vector3::from(track.bearing.unwrap());
            track.bearing = Some(turned.into());
        }
    });
    let why = fusion.why_nothing().unwrap();
    assert!(matches!(why.lines, UnmetLines::Apart { .. }), "{why:?}");
}

#[test]
fn cameras_whose_poses_are_copies_are_said() {
    let scene = two_cameras();
    // Both see the target from where they are, but the fusion centre is told one place for both.
    let [first, second] = [&scene.eyes[0], &scene.eyes[1]].map(Eye::clone);
    let told = [first.clone(), Eye { name: second.name, ..first }];
    let mut fusion = fusion_of(FusionConfig::default(), &told);
    for frame in scene.frames(3) {
        fusion.ingest(&frame);
    }
    let why = fusion.why_nothing().unwrap();
    assert_eq!(why.lines, UnmetLines::Together);
    assert!(why.to_string().ends_with("check whether a pose was copied"), "{why}");
}

#[test]
fn cameras_whose_places_are_hardly_known_are_not_taken_for_copies() {
    // A phone's position: 5 m. 260 m apart the places are still two, and the turned camera is said.
    let scene = two_cameras();
    let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
    for eye in &scene.eyes {
        fusion.calibrate(&calibration(eye).with_pose_sd(0.001, 5.0)).unwrap();
    }
    for mut frame in scene.frames(3) {
        for track in frame.tracks.iter_mut().filter(|_| frame.camera == "b") {
            let turned =
                Rotation3::from_euler_angles(0.4, 0.0, 0.0) * Vector3::from(track.bearing.unwrap());
            track.bearing = Some(turned.into());
        }
        fusion.ingest(&frame);
    }
    let why = fusion.why_nothing().unwrap();
    assert!(matches!(why.lines, UnmetLines::Apart { by_m } if by_m > 30.0), "{why:?}");
}
