//! Where the image does not say what is the target: noise, clouds that look like it, a camera that
//! is jerked.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

mod clouds;

use clouds::{Scene, off, step, tracker_on};
use crossfix_message::Timestamp;
use crossfix_vision::{ImagePoint, ImageTracker, PixelBox, TrackPhase, TrackerConfig, TrackerPart};
use rand::RngExt;

#[test]
fn a_faint_target_of_unknown_speed_is_held_from_its_first_image_on() {
    let held = (0..40).filter(|&seed| {
        let mut scene = Scene::new(seed, 10.0, 30.0, 40.0);
        let angle = scene.rng.random_range(0.0..std::f32::consts::TAU);
        let at = |frame: u32| {
            let gone = 3.5 * frame as f32;
            [120.0 + gone * angle.cos(), 90.0 + gone * angle.sin()]
        };
        let mut tracker = tracker_on(at(0));
        (0..20)
            .map(|frame| step(&mut tracker, &scene.image(Some(at(frame)), [0.0; 2]), frame))
            .last()
            .is_some_and(|track| track.phase == TrackPhase::Tracking && off(&track, at(19)) < 3.0)
    });
    let held = held.count();
    assert!(held >= 30, "{held} of 40 held");
}

#[test]
fn a_camera_that_is_jerked_does_not_lose_its_target() {
    for seed in 0..10 {
        let mut scene = Scene::new(seed, 12.0, 3.0, 60.0);
        let mut tracker = tracker_on([120.0, 90.0]);
        let (mut turned, mut seen) = ([0.0_f32; 2], 0);
        for frame in 0..100 {
            if frame > 20 && frame % 12 == 0 {
                turned = [0, 1].map(|i| turned[i] + scene.rng.random_range(-16.0..16.0_f32));
                turned = turned.map(|turned| turned.clamp(-60.0, 60.0));
            }
            let at = [120.0 + 0.8 * frame as f32, 90.0];
            let track = step(&mut tracker, &scene.image(Some(at), turned), frame);
            seen += u32::from(off(&track, [at[0] - turned[0], at[1] - turned[1]]) < 3.0);
        }
        // A target that moves on its own in the image of the jerk is where nobody expects it.
        assert!(seen >= 98, "seed {seed}: seen in {seen} of 100 images");
    }
}

#[test]
fn what_is_gone_for_good_is_not_seen_in_the_clouds() {
    for seed in 0..5 {
        let mut scene = Scene::new(seed, 10.0, 12.0, 36.0);
        let at = |frame: u32| [60.0 + 1.5 * frame as f32, 90.0];
        let mut tracker = tracker_on(at(0));
        let (mut longest, mut running) = (0, 0);
        for frame in 0..200 {
            let track = step(
                &mut tracker,
                &scene.image((frame < 60).then(|| at(frame)), [0.1 * frame as f32, 0.0]),
                frame,
            );
            running =
                if frame >= 60 && track.phase != TrackPhase::Searching { running + 1 } else { 0 };
            longest = longest.max(running);
        }
        assert!(longest <= 25, "seed {seed}: {longest} images on something else");
    }
}

/// A dark bar of 15 by 4 pixels, at an angle.
fn bar([x, y]: [f32; 2], angle: f32) -> impl Fn(f32, f32) -> f32 {
    move |column, row| {
        let (right, down) = (column - x, row - y);
        let along = right * angle.cos() + down * angle.sin();
        let across = down * angle.cos() - right * angle.sin();
        let is_in = along.abs() < 7.5 && across.abs() < 2.0;
        if is_in { -40.0 } else { 0.0 }
    }
}

/// In how many of 80 images, ten a second, a target is followed that is alone in the sky, and whose
/// roll is another in each image, up to `most_rad` to either side.
fn followed_while_it_rolls(seed: u64, most_rad: f32, config: TrackerConfig) -> usize {
    let mut scene = Scene::new(seed, 1.0, 1.5, 0.0);
    let mut tracker = ImageTracker::new(config).unwrap();
    tracker.take_up(PixelBox::about(ImagePoint { x: 60.0, y: 60.0 }, 17.0, 6.0));
    let (mut angle, mut followed) = (0.0, 0);
    for image in 0..80_u8 {
        let phase = 0.06 * f32::from(image);
        let at = [60.0 + 60.0 * (1.0 - phase.cos()), 60.0 + 40.0 * phase.sin()];
        let picture = scene.image_with(None, [0.0; 2], bar(at, angle));
        let time = Timestamp::from_seconds(f64::from(image) / 10.0);
        let track = tracker.step(&picture, time)[0];
        followed += usize::from(track.phase == TrackPhase::Tracking && off(&track, at) < 4.0);
        angle = scene.rng.random_range(-most_rad..most_rad);
    }
    followed
}

#[test]
fn a_target_that_rolls_alone_in_the_sky_is_held_at_ten_images_a_second() {
    let all = |most_rad: f32, part: Option<TrackerPart>| -> Vec<usize> {
        let config = TrackerConfig::default();
        let config = part.map_or(config.clone(), |part| config.without(part));
        (0..8).map(|seed| followed_while_it_rolls(seed, most_rad, config.clone())).collect()
    };
    let less = all(0.7, None);
    assert!(less.iter().all(|followed| *followed >= 72), "{less:?}");
    let (with, without) = (all(0.9, None), all(0.9, Some(TrackerPart::BackgroundEnergy)));
    let sums = [&with, &without].map(|followed| followed.iter().sum::<usize>());
    // When it was written 587 of 640 were followed, and 556 without; none of the eight did worse.
    assert!(with.iter().all(|followed| *followed >= 64), "{with:?}");
    assert!(sums[0] > sums[1] + 10, "{with:?}, without the background's energy {without:?}");
}
