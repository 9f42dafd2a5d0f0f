//! Many targets at once over a clear sky: all are found, and each keeps its number where two cross.

#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "a table is printed; a test that cannot set itself up has failed"
)]

use std::collections::{BTreeMap, BTreeSet};

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{
    DetectorConfig, ImagePoint, ImageTracker, PixelBox, TrackPhase, TrackerConfig,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

const RATE_HZ: f64 = 30.0;
const FRAMES: u32 = 450;
/// Standard deviation of the sensor's noise, levels.
const NOISE: f64 = 4.0;
/// A track within this many pixels of a target is that target's: a quarter of the least distance
/// that the test asks of targets whose tracks it compares.
const NEAR_PX: f64 = 4.0;

/// A dark spot that flies straight on and turns back at the image's border.
struct Flyer {
    place: [f64; 2],
    /// px per image.
    velocity: [f64; 2],
    radius: f64,
    darker: f64,
}

impl Flyer {
    fn new(rng: &mut ChaCha8Rng, sides: [usize; 2]) -> Self {
        let place = sides.map(|side| rng.random_range(20.0..side as f64 - 20.0));
        let (speed, way) =
            (rng.random_range(15.0..60.0), rng.random_range(0.0..std::f64::consts::TAU));
        let velocity = [way.cos(), way.sin()].map(|along| along * speed / RATE_HZ);
        let (radius, darker) = (rng.random_range(2.0..3.5), rng.random_range(50.0..90.0));
        Self { place, velocity, radius, darker }
    }

    fn fly(&mut self, sides: [usize; 2]) {
        for (axis, side) in sides.into_iter().enumerate() {
            let [first, last] = [10.0, side as f64 - 10.0];
            let (place, velocity) = (&mut self.place[axis], &mut self.velocity[axis]);
            if (*place < first && *velocity < 0.0) || (*place > last && *velocity > 0.0) {
                *velocity = -*velocity;
            }
            *place += *velocity;
        }
    }

    fn draw(&self, image: &mut Plane) {
        let reach = (3.0 * self.radius).ceil() as usize;
        let [column, row] = self.place.map(|at| at.round() as usize);
        for y in row.saturating_sub(reach)..(row + reach).min(image.height()) {
            for x in column.saturating_sub(reach)..(column + reach).min(image.width()) {
                let off = (x as f64 - self.place[0]).hypot(y as f64 - self.place[1]) / self.radius;
                image.row_mut(y)[x] -= (self.darker * (-0.5 * off.powi(4)).exp()) as f32;
            }
        }
    }

    fn distance(&self, [x, y]: [f64; 2]) -> f64 {
        (self.place[0] - x).hypot(self.place[1] - y)
    }
}

/// What became of a swarm: the share of its places at which a target had a track, the number of
/// times that two targets came together, and how often a target had another number than before.
#[derive(Debug)]
struct Outcome {
    covered: f64,
    crossings: usize,
    renumbered: usize,
}

fn fly(targets: usize, sides: [usize; 2], seed: u64) -> Outcome {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let noise = Normal::new(0.0, NOISE).unwrap();
    let mut flyers: Vec<Flyer> = (0..targets).map(|_| Flyer::new(&mut rng, sides)).collect();
    let detector = Some(DetectorConfig { max_targets: targets, ..DetectorConfig::default() });
    let mut tracker =
        ImageTracker::new(TrackerConfig { detector, ..TrackerConfig::default() }).unwrap();
    let (mut covered, mut renumbered) = (0, 0);
    let mut numbers: BTreeMap<usize, u64> = BTreeMap::new();
    let (mut together, mut crossings) = (BTreeSet::new(), 0);
    for frame in 0..FRAMES {
        let mut image =
            Plane::from_fn(sides[0], sides[1], |_, _| (150.0 + noise.sample(&mut rng)) as f32);
        flyers.iter_mut().for_each(|flyer| flyer.fly(sides));
        flyers.iter().for_each(|flyer| flyer.draw(&mut image));
        let tracks = tracker.step(&image, Timestamp::from_seconds(f64::from(frame) / RATE_HZ));
        for (index, flyer) in flyers.iter().enumerate() {
            let seen = tracks.iter().find(|track| {
                track.phase == TrackPhase::Tracking
                    && flyer.distance([track.position.x, track.position.y]) < NEAR_PX
            });
            covered += usize::from(seen.is_some());
            let mut is_alone = true;
            for (other, beside) in flyers.iter().enumerate().filter(|(other, _)| *other != index) {
                let apart = flyer.distance(beside.place);
                is_alone &= apart > 4.0 * NEAR_PX;
                let pair = (index.min(other), index.max(other));
                if apart < 2.0 * NEAR_PX {
                    crossings += usize::from(together.insert(pair));
                } else if apart > 4.0 * NEAR_PX {
                    together.remove(&pair);
                }
            }
            if let Some(track) = seen.filter(|_| is_alone) {
                let before = numbers.insert(index, track.id.0);
                renumbered += usize::from(before.is_some_and(|before| before != track.id.0));
            }
        }
    }
    let places = f64::from(FRAMES) * targets as f64;
    Outcome { covered: covered as f64 / places, crossings, renumbered }
}

#[test]
fn a_swarm_over_a_clear_sky_is_found_and_keeps_its_numbers() {
    for seed in 1..=4 {
        let outcome = fly(12, [320, 256], seed);
        assert!(outcome.covered > 0.9, "seed {seed}: {outcome:?}");
        assert!(outcome.crossings >= 5, "seed {seed}: {outcome:?}");
        // Two targets take part in each crossing.
        assert!(outcome.renumbered * 3 <= outcome.crossings, "seed {seed}: {outcome:?}");
    }
}

/// A person may give one target two boxes: the whole, and a part of it.
#[test]
fn two_boxes_on_one_target_are_both_followed() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let noise = Normal::new(0.0, NOISE).unwrap();
    let sides = [320, 256];
    let mut flyer = Flyer::new(&mut rng, sides);
    flyer.radius = 5.0;
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    for (width, height) in [(12.0, 12.0), (12.0, 12.0), (8.0, 8.0)] {
        let [x, y] = flyer.place;
        tracker.take_up(PixelBox::about(ImagePoint { x, y }, width, height));
    }
    for frame in 0..FRAMES {
        let mut image =
            Plane::from_fn(sides[0], sides[1], |_, _| (150.0 + noise.sample(&mut rng)) as f32);
        flyer.draw(&mut image);
        let tracks = tracker.step(&image, Timestamp::from_seconds(f64::from(frame) / RATE_HZ));
        assert_eq!(tracks.len(), 3, "frame {frame}");
        for track in tracks {
            let off = flyer.distance([track.position.x, track.position.y]);
            assert!(off < NEAR_PX && track.phase != TrackPhase::Searching, "{frame}: {track:?}");
        }
        flyer.fly(sides);
    }
}

/// Prints the table of docs/results.md.
#[test]
#[ignore = "half a minute in a release build: it prints a table"]
fn how_swarms_fare() {
    println!("targets  seed  covered  crossings  renumbered");
    for targets in [10, 25, 50] {
        for seed in 1..=4 {
            let Outcome { covered, crossings, renumbered } = fly(targets, [640, 512], seed);
            println!("{targets:>7}{seed:>6}{covered:>9.3}{crossings:>11}{renumbered:>12}");
        }
    }
}
