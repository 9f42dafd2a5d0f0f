//! The life of 2D tracks: found, followed, hidden, lost, taken back.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{DetectorConfig, ImageTracker, PixelBox, TrackPhase, TrackerConfig};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

fn spots(places: &[(f32, f32)]) -> Plane {
    Plane::from_fn(160, 120, |column, row| {
        let spot = |&(x, y): &(f32, f32)| {
            let (dx, dy) = (column as f32 - x, row as f32 - y);
            120.0 * (-(dx * dx + dy * dy) / 8.0).exp()
        };
        50.0 + places.iter().map(spot).sum::<f32>()
    })
}

fn at(frame: u32) -> Timestamp {
    Timestamp::from_seconds(f64::from(frame) / 30.0)
}

#[test]
fn two_targets_are_found_followed_and_kept_apart() {
    let config =
        TrackerConfig { detector: Some(DetectorConfig::default()), ..TrackerConfig::default() };
    let mut tracker = ImageTracker::new(config).unwrap();
    let mut last = Vec::new();
    for frame in 0..60 {
        let t = frame as f32;
        let image = if frame < 12 {
            spots(&[])
        } else {
            spots(&[(20.0 + t, 30.0), (140.0 - 1.5 * t, 90.0)])
        };
        last = tracker.step(&image, at(frame)).to_vec();
    }
    assert_eq!(last.len(), 2, "{last:?}");
    let mut x: Vec<f64> = last.iter().map(|track| track.measured.unwrap().place.x).collect();
    x.sort_by(f64::total_cmp);
    assert!((x[0] - 51.5).abs() < 1.0 && (x[1] - 79.0).abs() < 1.0, "{x:?}");
}

#[test]
fn an_occluded_target_coasts_and_is_taken_back() {
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    tracker.take_up(PixelBox { x: 16.0, y: 56.0, width: 9.0, height: 9.0 });
    let mut phases = Vec::new();
    for frame in 0..60 {
        let x = 20.0 + 2.0 * frame as f32;
        let hidden = (25..33).contains(&frame);
        let tracks =
            tracker.step(&if hidden { spots(&[]) } else { spots(&[(x, 60.0)]) }, at(frame));
        phases.push(tracks[0].phase);
        if frame == 59 {
            assert!((tracks[0].position.x - f64::from(x)).abs() < 1.0, "{tracks:?}");
        }
    }
    assert_eq!(phases[0], TrackPhase::Tentative);
    assert_eq!(phases[26], TrackPhase::Coasting);
    assert_eq!(phases[31], TrackPhase::Searching);
    assert_eq!(phases[45], TrackPhase::Tracking);
}

/// A textured sky with a spot: what a target can be told from.
fn over_sky(x: f32, y: f32, hidden: impl Fn(usize) -> bool) -> Plane {
    Plane::from_fn(160, 120, |column, row| {
        let sky = 50.0 + 3.0 * ((column as f32 / 9.0).sin() + (row as f32 / 7.0).cos());
        let (dx, dy) = (column as f32 - x, row as f32 - y);
        let noise = ((column * 7919 + row * 104_729 + (x * 31.0) as usize * 613) % 17) as f32 / 8.0;
        let spot = if hidden(column) { 0.0 } else { 120.0 * (-(dx * dx + dy * dy) / 8.0).exp() };
        sky + noise + spot
    })
}

#[test]
fn a_target_that_leaves_the_image_is_taken_back_where_it_enters_again() {
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    tracker.take_up(PixelBox { x: 126.0, y: 56.0, width: 9.0, height: 9.0 });
    let mut last = None;
    // To the right out of the image, ten frames away, and in again.
    for frame in 0..60 {
        let t = f32::from(u8::try_from(frame).unwrap());
        let x = 130.0 + 50.0 * (t / 60.0 * std::f32::consts::PI).sin();
        let image = over_sky(x, 60.0, |_| false);
        let track = tracker.step(&image, at(frame))[0];
        if (28..32).contains(&frame) {
            assert_ne!(track.phase, TrackPhase::Tracking, "frame {frame}");
        }
        last = Some((track, f64::from(x)));
    }
    let (track, x) = last.unwrap();
    assert_eq!(track.phase, TrackPhase::Tracking);
    assert!(
        (track.position.x - x).abs() < 0.5 && (track.position.y - 60.0).abs() < 0.5,
        "{track:?}"
    );
}

#[test]
fn a_target_half_hidden_is_still_followed() {
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    tracker.take_up(PixelBox { x: 16.0, y: 56.0, width: 9.0, height: 9.0 });
    for frame in 0..60 {
        let x = 20.0 + 1.5 * frame as f32;
        // A mast of three columns stands in the way.
        let image = over_sky(x, 60.0, |column| (60..63).contains(&column));
        let track = tracker.step(&image, at(frame))[0];
        assert!((track.position.x - f64::from(x)).abs() < 2.0, "frame {frame}: {track:?}");
    }
}

/// A sky that the camera drifts over, with a cloud that looks like the target and is two thirds as
/// bright.
fn drifting(frame: u32, target: Option<(f32, f32)>, noise: &mut impl FnMut() -> f32) -> Plane {
    let drift = 0.3 * frame as f32;
    let spot = |x: f32, y: f32, column: f32, row: f32| {
        (-((column - x).powi(2) + (row - y).powi(2)) / 8.0).exp()
    };
    Plane::from_fn(320, 240, |column, row| {
        let (column, row) = (column as f32, row as f32);
        let sky = 12.0 * (((column + drift) / 31.0).sin() + (row / 23.0).cos());
        let cloud = 40.0 * spot(148.0 - drift, 118.0, column, row);
        let target = target.map_or(0.0, |(x, y)| 60.0 * spot(x, y, column, row));
        80.0 + sky + cloud + target + noise()
    })
}

/// Noise of three levels.
fn noise(seed: u64) -> impl FnMut() -> f32 {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    move || {
        let normal: f32 = StandardNormal.sample(&mut rng);
        3.0 * normal
    }
}

#[test]
fn a_cloud_that_looks_like_the_target_is_not_followed_in_its_place() {
    for seed in 0..6 {
        let mut noise = noise(seed);
        let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
        tracker.take_up(PixelBox { x: 36.0, y: 116.0, width: 9.0, height: 9.0 });
        let (mut longest, mut running) = (0, 0);
        for frame in 0..150 {
            let place = (40.0 + 1.5 * frame as f32, 120.0);
            // Hidden for half a second where the cloud is, and for good nowhere.
            let hidden = (66..81).contains(&frame);
            let image = drifting(frame, (!hidden).then_some(place), &mut noise);
            let track = tracker.step(&image, at(frame))[0];
            let off = (track.position.x - f64::from(place.0))
                .hypot(track.position.y - f64::from(place.1));
            running =
                if track.phase != TrackPhase::Searching && off > 10.0 { running + 1 } else { 0 };
            longest = longest.max(running);
            if frame > 120 {
                assert!(off < 1.0, "seed {seed}, frame {frame}: {off} px off");
            }
        }
        assert!(longest <= 10, "seed {seed}: {longest} frames on something else");
    }
}

#[test]
fn a_target_that_hovers_is_found_again_where_it_was() {
    for seed in 0..4 {
        let mut noise = noise(seed);
        let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
        tracker.take_up(PixelBox { x: 216.0, y: 76.0, width: 9.0, height: 9.0 });
        for frame in 0..240 {
            // Hidden for half a second now and then, and for longer than any picture of the scene
            // is kept.
            let hidden = (60..75).contains(&frame) || (100..220).contains(&frame);
            let image = drifting(frame, (!hidden).then_some((220.0, 80.0)), &mut noise);
            let track = tracker.step(&image, at(frame))[0];
            if (90..100).contains(&frame) || frame >= 235 {
                let off = (track.position.x - 220.0).hypot(track.position.y - 80.0);
                let is_seen = track.phase == TrackPhase::Tracking && off < 1.0;
                assert!(is_seen, "seed {seed}, frame {frame}: {:?}, {off} px off", track.phase);
            }
        }
    }
}

#[test]
fn images_of_another_size_or_out_of_order_are_refused() {
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    tracker.take_up(PixelBox { x: 16.0, y: 56.0, width: 9.0, height: 9.0 });
    assert_eq!(tracker.step(&spots(&[]), at(5)).len(), 1);
    assert_eq!(tracker.step(&spots(&[]), at(5)).len(), 0);
    assert_eq!(tracker.step(&Plane::from_fn(10, 10, |_, _| 0.0), at(6)).len(), 0);
    assert_eq!(tracker.refused(), 2);
}

#[test]
fn a_camera_that_changes_its_size_or_has_had_one_wrong_time_is_followed_again() {
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    tracker.step(&Plane::from_fn(10, 10, |_, _| 0.0), at(1_000_000));
    for frame in 0..3 {
        assert!(tracker.step(&spots(&[]), at(frame)).is_empty());
    }
    tracker.take_up(PixelBox { x: 16.0, y: 56.0, width: 9.0, height: 9.0 });
    assert_eq!(tracker.step(&spots(&[]), at(3)).len(), 1);
    assert_eq!(tracker.refused(), 3);
}

#[test]
fn a_found_target_that_one_wrong_time_has_cut_off_is_given_up_in_time() {
    let config =
        TrackerConfig { detector: Some(DetectorConfig::default()), ..TrackerConfig::default() };
    let mut tracker = ImageTracker::new(config).unwrap();
    for frame in 0..40 {
        let t = frame as f32;
        let image = if frame < 12 { spots(&[]) } else { spots(&[(20.0 + t, 30.0)]) };
        let tracks = tracker.step(&image, at(frame)).len();
        assert!(frame < 25 || tracks == 1, "{frame}: {tracks}");
    }
    // A time of the next day, and then nothing more to see.
    tracker.step(&spots(&[(60.0, 30.0)]), at(2_592_000));
    let mut tracks = 1;
    for frame in 41..75 {
        tracks = tracker.step(&spots(&[]), at(frame)).len();
    }
    assert_eq!(tracks, 0);
}

proptest! {
    #[test]
    fn any_box_on_any_image_is_survived(
        x in -200.0..400.0, y in -200.0..400.0, width in 0.0..300.0, height in 0.0..300.0,
        sides in (1_usize..160, 1_usize..120),
        detects in any::<bool>(),
        level in prop_oneof![Just(0.0f32), Just(255.0), Just(1e30), Just(f32::NAN), Just(f32::INFINITY)],
    ) {
        let detector = detects.then(DetectorConfig::default);
        let mut tracker = ImageTracker::new(TrackerConfig { detector, ..TrackerConfig::default() }).unwrap();
        tracker.take_up(PixelBox { x, y, width, height });
        for frame in 0..14 {
            // Stripes that move, so that something comes.
            let moved = frame as usize * usize::from(frame > 8);
            let image = Plane::from_fn(sides.0, sides.1, |column, row| {
                if (column + moved) % 17 < 3 && row % 13 < 4 { level } else { 10.0 }
            });
            for track in tracker.step(&image, at(frame)) {
                prop_assert!(track.position.x.is_finite() && track.position.y.is_finite());
            }
        }
    }
}
