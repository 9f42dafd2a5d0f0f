//! One zero-mean normalised cross-correlation of a gate of three template sides.
//!
//! `cargo bench -p crossfix-correlation`

use crossfix_correlation::{Correlator, Plane, Reference, Window};
use divan::{Bencher, black_box};

fn main() {
    divan::main();
}

#[divan::bench(args = [(10, 6), (25, 15), (50, 30), (100, 60)])]
fn gate_of_three_sides(bencher: Bencher, (width, height): (usize, usize)) {
    let texture = |x: usize, y: usize| ((x * 7919 + y * 104_729) % 251) as f32;
    let gate = Plane::from_fn(3 * width, 3 * height, texture);
    let crop = gate.crop(width as isize, height as isize, width, height);
    let reference = Reference::new(crop, &Window::uniform(width, height));
    let mut correlator = Correlator::default();
    bencher.bench_local(|| {
        let scores = correlator.scores(black_box(&gate), &reference, 1.0);
        scores.peak().refined(&scores)
    });
}
