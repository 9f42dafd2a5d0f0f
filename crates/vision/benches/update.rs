//! A whole update of a tracker with one target: gate, correlation, fit, filters, reference; and the
//! per-pixel filters of an adaptive reference.
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

/// Frames of a closed path: the target is where it was a round ago.
const ROUND: usize = 60;

fn pictures(width: f32, height: f32) -> Vec<Plane> {
    let mut state = 1_u32;
    (0..ROUND)
        .map(|frame| {
            let angle = frame as f32 / ROUND as f32 * std::f32::consts::TAU;
            let (x, y) = (160.0 + 20.0 * angle.cos(), 120.0 + 20.0 * angle.sin());
            Plane::from_fn(320, 240, |column, row| {
                state ^= state << 13;
                state ^= state >> 17;
                state ^= state << 5;
                let noise = (state >> 24) as f32 / 16.0;
                let (u, v) =
                    ((column as f32 - x) / (0.3 * width), (row as f32 - y) / (0.3 * height));
                let body = (-0.5 * (u * u + v * v)).exp()
                    + 0.5 * (-0.5 * (u * u + 9.0 * (v + 0.6).powi(2))).exp();
                90.0 + noise + 80.0 * body
            })
        })
        .collect()
}

fn update(bencher: Bencher, (width, height): (usize, usize), reference: ReferenceStrategy) {
    let pictures = pictures(width as f32, height as f32);
    let config = TrackerConfig { reference, ..TrackerConfig::default() };
    let Ok(mut tracker) = ImageTracker::new(config) else { return };
    let (w, h) = (width as f64, height as f64);
    tracker.take_up(PixelBox { x: 180.5 - w / 2.0, y: 120.5 - h / 2.0, width: w, height: h });
    let mut frame = 0;
    let mut step = || {
        let time = Timestamp::from_seconds(frame as f64 / 30.0);
        frame += 1;
        tracker.step(black_box(&pictures[(frame - 1) % ROUND]), time).len()
    };
    for _ in 0..2 * ROUND {
        step();
    }
    bencher.bench_local(step);
}

#[divan::bench(args = [(10, 6), (25, 15), (50, 30)])]
fn tracker_update(bencher: Bencher, sides: (usize, usize)) {
    update(bencher, sides, ReferenceStrategy::default());
}

#[divan::bench(args = [(10, 6), (25, 15)])]
fn tracker_update_imm_reference(bencher: Bencher, sides: (usize, usize)) {
    update(bencher, sides, ReferenceStrategy::PixelImm(ImmConfig::default()));
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
