//! A whole update of a tracker with one target and with thirty (gate, correlation, fit, filters,
//! reference), and the per-pixel filters of an adaptive reference.
//!
//! `cargo bench -p crossfix-vision`

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{
    ImageTracker, ImmConfig, PixelBox, PixelImm, ReferenceStrategy, TrackerConfig,
};
use divan::counter::ItemsCount;
use divan::{Bencher, black_box};

fn main() {
    divan::main();
}

/// Frames of a closed path: the targets are where they were a round ago.
const ROUND: usize = 60;

/// A picture of squares in columns and rows; in each of the first squares a target goes round.
struct Scene {
    squares: [usize; 2],
    targets: usize,
    /// Sides of a target, px.
    sides: [f32; 2],
}

/// Side of a square, px: no target is in another's gate.
const SQUARE: usize = 160;
/// Radius of a target's path, px.
const RADIUS: f32 = 20.0;

impl Scene {
    /// Where the targets are in a frame.
    fn places(&self, frame: usize) -> Vec<[f32; 2]> {
        (0..self.targets).map(|target| self.place(target, frame)).collect()
    }

    fn place(&self, target: usize, frame: usize) -> [f32; 2] {
        let turn = frame as f32 / ROUND as f32 * std::f32::consts::TAU;
        // Each at another point of its path: if all went the same way, the camera would have
        // turned.
        let angle = turn + target as f32;
        let columns = self.squares[0];
        let [x, y] =
            [target % columns, target / columns].map(|at| (at as f32 + 0.5) * SQUARE as f32);
        [x + RADIUS * angle.cos(), y + RADIUS * angle.sin()]
    }

    fn pictures(&self) -> Vec<Plane> {
        let mut state = 1_u32;
        let [width, height] = self.sides;
        let [columns, rows] = self.squares.map(|count| count * SQUARE);
        (0..ROUND)
            .map(|frame| {
                let places = self.places(frame);
                Plane::from_fn(columns, rows, |column, row| {
                    state ^= state << 13;
                    state ^= state >> 17;
                    state ^= state << 5;
                    let noise = (state >> 24) as f32 / 16.0;
                    let square = row / SQUARE * self.squares[0] + column / SQUARE;
                    let Some([x, y]) = places.get(square) else { return 90.0 + noise };
                    let (u, v) =
                        ((column as f32 - x) / (0.3 * width), (row as f32 - y) / (0.3 * height));
                    let body = (-0.5 * (u * u + v * v)).exp()
                        + 0.5 * (-0.5 * (u * u + 9.0 * (v + 0.6).powi(2))).exp();
                    90.0 + noise + 80.0 * body
                })
            })
            .collect()
    }
}

fn update(bencher: Bencher, scene: &Scene, reference: ReferenceStrategy) {
    let pictures = scene.pictures();
    let config = TrackerConfig { reference, ..TrackerConfig::default() };
    let Ok(mut tracker) = ImageTracker::new(config) else { return };
    let [width, height] = scene.sides.map(f64::from);
    for [x, y] in scene.places(0) {
        let (x, y) = (f64::from(x) + 0.5 - width / 2.0, f64::from(y) + 0.5 - height / 2.0);
        tracker.take_up(PixelBox { x, y, width, height });
    }
    let mut frame = 0;
    // Each picture is written again before it is used, as by a camera's driver or a decoder.
    let mut next = || {
        frame += 1;
        (pictures[(frame - 1) % ROUND].clone(), Timestamp::from_seconds(frame as f64 / 30.0))
    };
    for _ in 0..2 * ROUND {
        let (picture, time) = next();
        tracker.step(&picture, time);
    }
    bencher
        .counter(ItemsCount::new(scene.places(0).len()))
        .with_inputs(next)
        .bench_local_refs(|(picture, time)| tracker.step(black_box(picture), *time).len());
}

/// One target in an image of 320x320: a third of the images are registered with the scene, and one
/// in eighteen becomes one of its pictures.
#[divan::bench(args = [(10, 6), (25, 15), (50, 30)])]
fn tracker_update(bencher: Bencher, (width, height): (u8, u8)) {
    let scene = Scene { squares: [2, 2], targets: 1, sides: [width.into(), height.into()] };
    update(bencher, &scene, ReferenceStrategy::default());
}

/// Thirty targets in an image of 960x800: the items a second are the updates of one of them, with
/// its share of the registration.
#[divan::bench(args = [(10, 6), (25, 15), (50, 30)])]
fn tracker_update_of_thirty(bencher: Bencher, (width, height): (u8, u8)) {
    let scene = Scene { squares: [6, 5], targets: 30, sides: [width.into(), height.into()] };
    update(bencher, &scene, ReferenceStrategy::default());
}

#[divan::bench(args = [(10, 6), (25, 15)])]
fn tracker_update_imm_reference(bencher: Bencher, (width, height): (u8, u8)) {
    let scene = Scene { squares: [2, 2], targets: 1, sides: [width.into(), height.into()] };
    update(bencher, &scene, ReferenceStrategy::PixelImm(ImmConfig::default()));
}

#[divan::bench]
fn pixel_imm_of_1000_pixels(bencher: Bencher) {
    let measured: Vec<f32> = (0..1000).map(|i| (i * 37 % 251) as f32).collect();
    let mut filter = PixelImm::new(ImmConfig::default(), &measured, 25.0);
    let mut filtered = vec![0.0; 1000];
    bencher.counter(ItemsCount::new(1000_usize)).bench_local(|| {
        filter.step(black_box(&measured), 1.0, 25.0, &mut filtered);
    });
}
