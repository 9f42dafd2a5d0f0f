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

/// Whether a target is found in the first image in which it shows again, elsewhere, of a camera
/// that has turned all the time over things that look just like it.
fn is_found_at_once_among_others(seed: u64) -> bool {
    let mut scene = Scene::new(seed, 10.0, 2.0, 60.0);
    let at = |frame: u32| match frame {
        0..75 => [70.0 + 1.4 * frame as f32, 90.0 + 0.5 * frame as f32],
        _ => [300.0, 60.0],
    };
    // All are in view when it is lost: one that comes into view meanwhile is taken for it.
    let others: [[f32; 2]; 8] =
        std::array::from_fn(|k| [130.0 + 22.0 * k as f32, if k % 2 == 0 { 40.0 } else { 170.0 }]);
    let mut tracker = tracker_on(at(0));
    let mut last = None;
    for frame in 0..=75 {
        // 20 px in half a second.
        let turned = [1.6 * frame as f32, 0.0];
        let alike = |column: f32, row: f32| {
            let blob = |[x, y]: &[f32; 2]| {
                let (u, v) = ((column + turned[0] - x) / 4.0, (row - y) / 2.4);
                60.0 * (-0.5 * (u * u + v * v).powi(2)).exp()
            };
            others.iter().map(blob).sum::<f32>()
        };
        let target = (!(45..75).contains(&frame)).then(|| at(frame));
        let track = step(&mut tracker, &scene.image_with(target, turned, alike), frame);
        last = Some((track, [at(frame)[0] - turned[0], at(frame)[1]]));
    }
    last.is_some_and(|(track, at)| track.phase == TrackPhase::Tracking && off(&track, at) < 3.0)
}

#[test]
fn what_looks_like_a_lost_target_is_known_where_the_camera_has_turned_to() {
    let found = (0..8).filter(|seed| is_found_at_once_among_others(*seed)).count();
    // All of 16, and of 16 others with turns of 1.3 to 2.4 px an image; 3 where the turn since the
    // scene was seen without the target was left out.
    assert!(found >= 7, "{found} of 8 found in the first image");
}

/// A target leaves the image of a camera that rolls. A cloud of the same looks is where the scene
/// says it must be, though at another place of the image than before.
#[test]
fn a_cloud_is_not_taken_for_a_target_that_has_left_the_image_of_a_camera_that_rolls() {
    for seed in 0..4 {
        let mut scene = Scene::new(seed, 12.0, 2.0, 60.0);
        let mut tracker = tracker_on([60.0, 90.0]);
        let mut taken = 0;
        for frame in 0..130 {
            // By 0.2 rad in a second, as of one that looks up and pans.
            let roll = 0.2 * (frame as f32 / 30.0 * 1.57).sin();
            let at = [60.0 - 1.5 * frame as f32, 90.0];
            let (image, cloud) =
                scene.image_rolled((at[0] > -8.0).then_some(at), roll, [230.0, 60.0]);
            let track = step(&mut tracker, &image, frame);
            let is_taken = track.phase == TrackPhase::Tracking && off(&track, cloud) < 6.0;
            taken += u32::from(frame >= 50 && is_taken);
            let is_followed = track.phase == TrackPhase::Tracking && off(&track, at) < 3.0;
            assert!(is_followed || frame != 25, "seed {seed}: it is lost before it leaves");
        }
        // As long as what a search finds is on probation; of one whose roll is not registered it is
        // taken in all 80 images in half of ten scenes.
        assert!(taken <= 15, "seed {seed}: taken in {taken} images");
    }
}

/// A target leaves the image above. Below, the tops of trees reach into the image and out of it as
/// the camera nods: cut by the border they are as bright and as large as the target.
#[test]
fn a_tree_at_the_border_is_not_taken_for_a_target_that_has_left_the_image() {
    let (mut taken, mut longest) = (0, 0);
    for seed in 0..6 {
        let mut scene = Scene::new(seed, 3.0, 2.0, 60.0);
        let mut tracker = tracker_on([120.0, 40.0]);
        let mut taken_here = 0;
        for frame in 0..200 {
            let down = 8.0 * (frame as f32 / 25.0 * 1.2).sin();
            let at = [120.0, 40.0 - 1.2 * frame as f32];
            let top_of_trees = |x: f32| 177.0 + 8.0 * (x / 6.0).sin() * (x / 23.0 + 1.0).sin();
            let image = scene.image_with(Some(at), [0.0, down], |x, y| {
                60.0 * (y + down - top_of_trees(x)).clamp(0.0, 1.0)
            });
            let track = step(&mut tracker, &image, frame);
            let is_taken = track.phase == TrackPhase::Tracking && track.position.y > 120.0;
            taken_here = if is_taken { taken_here + 1 } else { 0 };
            taken += u32::from(is_taken);
            longest = longest.max(taken_here);
        }
    }
    // As long as what a search finds is on probation. Where what lies beyond the border is compared
    // too, it is up to 118.
    assert!(longest <= 15, "taken for {longest} images, in all for {taken}");
}
