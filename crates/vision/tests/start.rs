//! Boxes as people draw them: too large, too small, beside the target.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{ImageTrack, ImageTracker, PixelBox, TrackerConfig};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// A target, dark or bright, of 11 by 6 pixels.
#[derive(Clone, Copy)]
struct Spot {
    x: f32,
    y: f32,
    contrast: f32,
}

/// An evening sky with noise of two levels, darker to the right, and what is in it.
fn sky(seed: u64, spots: &[Spot], ground: impl Fn(usize, usize) -> Option<f32>) -> Plane {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Plane::from_fn(160, 120, |column, row| {
        let noise: f32 = StandardNormal.sample(&mut rng);
        let sky = ground(column, row).unwrap_or(170.0 - 0.2 * column as f32);
        let body = |spot: &Spot| {
            let (u, v) = ((column as f32 - spot.x) / 3.5, (row as f32 - spot.y) / 2.0);
            spot.contrast * (-0.5 * (u * u + v * v)).exp()
        };
        sky + 2.0 * noise + spots.iter().map(body).sum::<f32>()
    })
}

fn is_sky(_: usize, _: usize) -> Option<f32> {
    None
}

fn taken_up(image: &Plane, place: PixelBox, config: TrackerConfig) -> ImageTrack {
    let mut tracker = ImageTracker::new(config).unwrap();
    tracker.take_up(place);
    tracker.step(image, Timestamp::from_seconds(0.0))[0]
}

/// A box of the target's size, changed by a factor and moved.
fn drawn(spot: Spot, [dx, dy]: [f64; 2], factor: f64) -> PixelBox {
    let centre =
        crossfix_vision::ImagePoint { x: f64::from(spot.x) + dx, y: f64::from(spot.y) + dy };
    PixelBox::about(centre, 11.0 * factor, 6.0 * factor)
}

fn off(track: &ImageTrack, spot: Spot) -> f64 {
    (track.position.x - f64::from(spot.x)).hypot(track.position.y - f64::from(spot.y))
}

const LOOSE: [([f64; 2], f64); 8] = [
    ([8.0, 0.0], 1.0),
    ([-8.0, 0.0], 1.0),
    ([0.0, 8.0], 1.0),
    ([0.0, -8.0], 1.0),
    ([6.0, 5.0], 0.7),
    ([0.0, 0.0], 3.0),
    ([5.0, -7.0], 2.0),
    ([-3.0, 2.0], 4.0),
];

#[test]
fn a_loose_box_is_moved_onto_what_stands_out() {
    for contrast in [-50.0, 70.0] {
        let spot = Spot { x: 80.3, y: 60.6, contrast };
        let image = sky(1, &[spot], is_sky);
        for (beside, factor) in LOOSE {
            let track = taken_up(&image, drawn(spot, beside, factor), TrackerConfig::default());
            assert!(off(&track, spot) < 0.5, "{beside:?} {factor}: {track:?}");
            assert!(
                (7.0..=16.0).contains(&track.width) && (4.0..=10.0).contains(&track.height),
                "{track:?}"
            );
        }
    }
}

#[test]
fn a_box_that_fits_stays_and_so_does_every_box_if_the_configuration_says_so() {
    let spot = Spot { x: 80.3, y: 60.6, contrast: 70.0 };
    let image = sky(2, &[spot], is_sky);
    let fitting = drawn(spot, [0.0; 2], 1.0);
    let track = taken_up(&image, fitting, TrackerConfig::default());
    assert_eq!((track.position, track.width), (fitting.centre(), fitting.width));
    for (beside, factor) in LOOSE {
        let place = drawn(spot, beside, factor);
        let track =
            taken_up(&image, place, TrackerConfig { box_sd_px: 0.0, ..TrackerConfig::default() });
        assert_eq!((track.position, track.width), (place.centre(), place.width));
    }
}

#[test]
fn a_horizon_is_no_figure() {
    // Trees with bright gaps begin a pixel below a box that lies 4 px too low.
    let spot = Spot { x: 80.3, y: 60.6, contrast: -50.0 };
    let trees = |column: usize, row: usize| {
        (row > 69).then_some(if column % 9 < 3 && row % 7 < 3 { 110.0 } else { 40.0 })
    };
    let image = sky(3, &[spot], trees);
    for factor in [1.0, 1.5] {
        let track = taken_up(&image, drawn(spot, [0.0, 4.0], factor), TrackerConfig::default());
        assert!(off(&track, spot) < 0.7, "{track:?}");
    }
}

#[test]
fn a_mast_through_the_box_leaves_it_where_it_was_drawn() {
    let spot = Spot { x: 80.3, y: 60.6, contrast: 0.0 };
    let mast = |column: usize, _| (83..86).contains(&column).then_some(240.0);
    let place = drawn(spot, [0.0; 2], 1.0);
    let track = taken_up(&sky(4, &[spot], mast), place, TrackerConfig::default());
    assert_eq!((track.position, track.width), (place.centre(), place.width));
}

#[test]
fn between_two_alike_nobody_knows_which_was_meant() {
    let pair = [66.0, 94.0].map(|x| Spot { x, y: 60.0, contrast: 70.0 });
    let place = PixelBox::about(crossfix_vision::ImagePoint { x: 80.0, y: 60.0 }, 40.0, 14.0);
    let track = taken_up(&sky(5, &pair, is_sky), place, TrackerConfig::default());
    assert_eq!((track.position, track.width), (place.centre(), place.width));
}

#[test]
fn nothing_but_noise_moves_no_box() {
    let nothing = Spot { x: 80.0, y: 60.0, contrast: 0.0 };
    for seed in 100..200 {
        let place = drawn(nothing, [0.0; 2], 2.0);
        let track = taken_up(&sky(seed, &[], is_sky), place, TrackerConfig::default());
        assert_eq!((track.position, track.width), (place.centre(), place.width), "seed {seed}");
    }
}

#[test]
fn what_does_not_show_in_the_image_of_its_box_is_taken_up_when_it_does() {
    for seed in 0..20 {
        let spot = |frame: u64| Spot { x: 60.0 + 1.5 * frame as f32, y: 60.0, contrast: -50.0 };
        let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
        tracker.take_up(drawn(spot(0), [3.0, -2.0], 3.0));
        for frame in 0..40 {
            // A video's compression has taken it away for a sixth of a second.
            let shown = if frame < 5 { vec![] } else { vec![spot(frame)] };
            let time = Timestamp::from_seconds(frame as f64 / 30.0);
            let track = tracker.step(&sky(100 * seed + frame, &shown, is_sky), time)[0];
            assert_eq!(track.id.0, 1);
            if frame > 12 {
                assert!(off(&track, spot(frame)) < 2.0, "seed {seed}, image {frame}: {track:?}");
                assert!(track.width < 22.0, "seed {seed}: {}", track.width);
            }
        }
    }
}

/// A box beside a target that no image shows: its reference is made of the target's edge and of
/// noise. Once their mean shows the target, the reference is put on its middle.
#[test]
fn a_box_beside_a_target_that_no_single_image_shows_is_put_right_by_their_mean() {
    const RUNS: u64 = 8;
    let mut put_right = 0;
    for run in 0..RUNS {
        let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
        let mut last = None;
        for frame in 0..120_u64 {
            let t = frame as f32 / 30.0;
            // A peak of five levels in noise of two.
            let spot = Spot { x: 50.0 + 15.0 * t, y: 60.0 + 6.0 * (1.3 * t).sin(), contrast: -5.0 };
            let image = sky(1000 * run + frame, &[spot], is_sky);
            if frame == 0 {
                tracker.take_up(drawn(spot, [0.0, 3.0], 1.0));
            }
            let tracks = tracker.step(&image, Timestamp::from_seconds(f64::from(t)));
            last = Some(off(&tracks[0], spot));
        }
        put_right += u64::from(last.unwrap() < 1.5);
    }
    assert!(put_right >= RUNS - 1, "{put_right} of {RUNS}");
}
