//! Targets that are lost, and what may be taken for them.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod clouds;

use clouds::{Scene, off, step, tracker_on};
use crossfix_vision::TrackPhase;

/// Something of other looks than the target: a dark bar, upright.
fn bar([x, y]: [f32; 2], contrast: f32) -> impl Fn(f32, f32) -> f32 {
    move |column, row| {
        if (column - x).abs() <= 1.5 && (row - y).abs() <= 5.0 { contrast } else { 0.0 }
    }
}

#[test]
fn what_looks_as_it_did_at_first_is_found_again() {
    for seed in 0..3 {
        let mut scene = Scene::new(seed, 4.0, 2.0, 60.0);
        let mut tracker = tracker_on([60.0, 60.0]);
        let mut found = None;
        for frame in 0..200 {
            // For four seconds it turns from a bright blob to a dark bar; then it is hidden, and
            // hovers elsewhere as it was.
            let share = |from: f32| ((frame as f32 - from) / 40.0).clamp(0.0, 1.0);
            let (at, is_hidden) =
                ([60.0 + 0.3 * frame.min(120) as f32, 60.0], (120..140).contains(&frame));
            let image = if is_hidden {
                scene.image(None, [0.0; 2])
            } else if frame < 120 {
                scene.contrast = 60.0 * (1.0 - share(60.0));
                scene.image_with(Some(at), [0.0; 2], bar(at, -60.0 * share(20.0)))
            } else {
                scene.contrast = 60.0;
                scene.image(Some([170.0, 110.0]), [0.0; 2])
            };
            let track = step(&mut tracker, &image, frame);
            if frame == 119 {
                assert!(off(&track, at) < 3.0, "seed {seed}: it is lost before it is hidden");
            }
            let is_there = frame >= 140
                && track.phase == TrackPhase::Tracking
                && off(&track, [170.0, 110.0]) < 3.0;
            found = found.or(is_there.then_some(frame));
        }
        assert!(found.is_some_and(|found| found < 165), "seed {seed}: found in image {found:?}");
    }
}

#[test]
fn the_one_thing_that_moves_is_shown_for_a_lost_target_until_that_is_found() {
    for seed in 0..3 {
        let mut scene = Scene::new(seed, 4.0, 2.0, 60.0);
        let mut tracker = tracker_on([60.0, 60.0]);
        let mut shown = 0;
        for frame in 0..200 {
            let at = [60.0 + 0.8 * frame as f32, 60.0 + 0.4 * frame as f32];
            let image = match frame {
                0..50 => scene.image(Some(at), [0.0; 2]),
                50..75 => scene.image(None, [0.0; 2]),
                // It comes out of a cloud as something that nobody has seen before, and turns back.
                75..150 => scene.image_with(None, [0.0; 2], bar(at, -50.0)),
                _ => scene.image(Some(at), [0.0; 2]),
            };
            let track = step(&mut tracker, &image, frame);
            if (125..150).contains(&frame)
                && track.phase == TrackPhase::Tracking
                && off(&track, at) < 4.0
            {
                assert!(track.certainty <= 0.5, "seed {seed}, image {frame}: {}", track.certainty);
                shown += 1;
            }
            if frame == 199 {
                assert!(off(&track, at) < 3.0 && track.certainty > 0.9, "seed {seed}: {track:?}");
            }
        }
        assert!(shown >= 23, "seed {seed}: shown in {shown} of 25 images");
    }
}

#[test]
fn what_is_written_into_the_video_is_not_taken_for_a_lost_target() {
    for seed in 0..3 {
        let mut scene = Scene::new(seed, 12.0, 2.0, 60.0);
        let at = |frame: u32| [100.0 + 0.5 * frame as f32, 90.0 + 0.3 * frame as f32];
        let mut tracker = tracker_on(at(0));
        let (written, mut taken) = ([200.0, 150.0], 0);
        for frame in 0..160 {
            // The camera turns; the mark keeps to its place in the image, and looks like the
            // target.
            let turned = [0.8 * frame as f32, 0.4 * frame as f32];
            let mark = |x: f32, y: f32| {
                let (u, v) = ((x - written[0]) / 4.0, (y - written[1]) / 2.4);
                60.0 * (-0.5 * (u * u + v * v).powi(2)).exp()
            };
            let target = (frame < 60).then(|| at(frame));
            let track = step(&mut tracker, &scene.image_with(target, turned, mark), frame);
            let is_taken = track.phase == TrackPhase::Tracking && off(&track, written) < 4.0;
            taken += u32::from(frame >= 60 && is_taken);
        }
        // As long as what a search finds is on probation.
        assert!(taken <= 15, "seed {seed}: taken in {taken} images");
    }
}

#[test]
fn what_was_shown_for_a_lost_target_is_forgotten_where_that_comes_back() {
    for seed in 0..3 {
        let mut scene = Scene::new(seed, 4.0, 2.0, 60.0);
        let mut tracker = tracker_on([60.0, 60.0]);
        let mut found = None;
        for frame in 0..200 {
            let at = [60.0 + 0.8 * frame as f32, 60.0 + 0.4 * frame as f32];
            let other = [200.0 - 0.7 * frame as f32, 150.0];
            // Both are there in the end; `step` wants one track in every image.
            let image = match frame {
                0..50 => scene.image(Some(at), [0.0; 2]),
                50..130 => scene.image_with(None, [0.0; 2], bar(other, -50.0)),
                _ => scene.image_with(Some(at), [0.0; 2], bar(other, -50.0)),
            };
            let track = step(&mut tracker, &image, frame);
            let is_there = frame >= 130 && off(&track, at) < 3.0 && track.certainty > 0.9;
            found = found.or(is_there.then_some(frame));
        }
        assert!(found.is_some_and(|found| found < 160), "seed {seed}: found in image {found:?}");
    }
}

#[test]
fn what_stands_out_of_no_single_image_is_found_again_by_several() {
    let found = (0..10).filter(|&seed| {
        let mut scene = Scene::new(seed, 4.0, 45.0, 36.0);
        let mut tracker = tracker_on([60.0, 60.0]);
        let mut seen = 0;
        for frame in 0..160 {
            // It is followed for two seconds and a half, hidden for two, and comes out elsewhere.
            // Of the ten thousand places of an image some look more like it than it does itself.
            let at = match frame {
                0..60 => [60.0 + 0.5 * frame as f32, 60.0],
                _ => [150.0 + 0.8 * (frame as f32 - 105.0), 120.0],
            };
            let is_there = !(60..105).contains(&frame);
            let track = step(&mut tracker, &scene.image(is_there.then_some(at), [0.0; 2]), frame);
            // What stands in for a lost target has a certainty of a half at most.
            let is_on_it = track.certainty > 0.5 && off(&track, at) < 3.0;
            seen += usize::from(frame >= 150 && is_on_it);
        }
        seen >= 8
    });
    let found = found.count();
    // By single images two are.
    assert!(found >= 7, "{found} of 10 found");
}
