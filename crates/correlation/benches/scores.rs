//! One zero-mean normalised cross-correlation of a gate of three template sides, with its sub-pixel
//! peak and covariance; the same over a whole picture; and where the two routes cross.
//!
//! `cargo bench -p crossfix-correlation`

use crossfix_correlation::{
    Correlator, Extent, FitOptions, Fitter, Plane, Reference, Resampler, Route, Similarity, Window,
};
use divan::{Bencher, black_box};

fn main() {
    divan::main();
}

const TEMPLATES: [(usize, usize); 4] = [(10, 6), (25, 15), (50, 30), (100, 60)];

/// Smooth structure of some pixels, and a little noise.
fn texture(x: usize, y: usize) -> f32 {
    let (u, v) = (x as f32, y as f32);
    let smooth = (0.9 * u + 0.3 * v).sin() + (0.7 * v - 0.2 * u).cos() + (0.013 * u * v).sin();
    128.0 + 30.0 * smooth + (((x * 7919 + y * 104_729) ^ (x * y * 31)) % 11) as f32
}

fn search(
    bencher: Bencher,
    gate: (usize, usize),
    (width, height): (usize, usize),
    mut correlator: Correlator,
) {
    let gate = Plane::from_fn(gate.0, gate.1, texture);
    let (left, top) = ((gate.width() - width) / 2, (gate.height() - height) / 2);
    // Between the pixels, so that the fit has its way to go.
    let mut part = Plane::from_fn(width, height, |_, _| 0.0);
    Resampler::default().sample(&gate, left as f64 + 0.3, top as f64 - 0.2, &mut part);
    let reference = Reference::new(part, Window::uniform(width, height));
    let (mut scores, mut fitter) = (Plane::default(), Fitter::default());
    // As many steps as the tracker takes.
    let options = FitOptions { steps: 2, ..FitOptions::default() };
    bencher.bench_local(|| {
        let measure = Similarity::ZeroMeanNormalised;
        correlator.similarity(
            black_box(&gate),
            &reference,
            measure,
            Extent::Linear,
            1.0,
            &mut scores,
        );
        let peak = scores.peak();
        let fit = fitter.fit(&gate, &reference, peak.column as f64, peak.row as f64, options);
        fit.covariance(fit.residual_variance)
    });
}

#[divan::bench(args = TEMPLATES)]
fn gate_of_three_sides(bencher: Bencher, (width, height): (usize, usize)) {
    search(bencher, (3 * width, 3 * height), (width, height), Correlator::default());
}

#[divan::bench]
fn picture_of_720p_25x15(bencher: Bencher) {
    search(bencher, (1280, 720), (25, 15), Correlator::default());
}

#[divan::bench(args = TEMPLATES)]
fn directly(bencher: Bencher, (width, height): (usize, usize)) {
    search(
        bencher,
        (3 * width, 3 * height),
        (width, height),
        Correlator::with_route(Route::Direct),
    );
}

#[divan::bench(args = TEMPLATES)]
fn by_transforms(bencher: Bencher, (width, height): (usize, usize)) {
    search(
        bencher,
        (3 * width, 3 * height),
        (width, height),
        Correlator::with_route(Route::Spectral),
    );
}
