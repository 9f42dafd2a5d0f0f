//! One step of a target's two Kalman filters: both axes predict and take a measurement in
//! (Herasymenko 2021, eqs. 8-12; the thesis' chapter 7 allows 14.8 of the unit it prints, ns). With
//! one target per step waits for the one before it; with many, as in a picture, they overlap.
//!
//! `cargo bench -p crossfix-filter`

use crossfix_filter::{AxisFilter, AxisMeasurement};
use divan::counter::ItemsCount;
use divan::{Bencher, black_box};

fn main() {
    divan::main();
}

#[divan::bench(args = [1, 16])]
fn both_axes_one_step(bencher: Bencher, targets: usize) {
    let at = |position| AxisMeasurement { position, variance: 1.0 };
    let filter = AxisFilter::start(at(0.0), at(1.0), 1.0, 1.0);
    let mut axes = vec![[filter.clone(), filter]; targets];
    let measured: Vec<[f64; 2]> = (0..targets).map(|i| [i as f64, 1.0]).collect();
    bencher.counter(ItemsCount::new(targets)).bench_local(|| {
        let interval = black_box(1.0);
        for (axes, measured) in axes.iter_mut().zip(black_box(&measured)) {
            for (axis, position) in axes.iter_mut().zip(measured) {
                axis.time_update(interval);
                axis.measurement_update(at(*position));
            }
        }
    });
}
