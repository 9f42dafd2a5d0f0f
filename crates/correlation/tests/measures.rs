//! Every similarity measure against its definition, on both routes.

use crossfix_correlation::{
    Correlator, Extent, Plane, Reference, Route, Similarity, SpectralWeight, Window,
};
use proptest::prelude::*;

fn noise(width: usize, height: usize, seed: u32) -> Plane {
    let mut state = seed.wrapping_mul(2_654_435_761).max(1);
    Plane::from_fn(width, height, |_, _| {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        (state >> 8) as f32 / 65536.0
    })
}

const ALL: [Similarity; 8] = [
    Similarity::CrossCorrelation,
    Similarity::Normalised,
    Similarity::ZeroMeanNormalised,
    Similarity::Phase,
    Similarity::CrossSpectrum(SpectralWeight { whitening: 0.5, band: 0.3 }),
    Similarity::AbsoluteDifferences,
    Similarity::SquaredDifferences,
    Similarity::MaximumDifference,
];

fn scores(
    route: Route,
    gate: &Plane,
    reference: &Reference,
    measure: Similarity,
    extent: Extent,
) -> Plane {
    let mut scores = Plane::default();
    Correlator::with_route(route).similarity(gate, reference, measure, extent, 1.0, &mut scores);
    scores
}

/// The definitions of Lytvynets 2020, sample by sample, of the measures that have one in samples.
fn defined(gate: &Plane, reference: &Reference, measure: Similarity, extent: Extent) -> Plane {
    let (w, h) = (reference.image().width(), reference.image().height());
    let (width, height) = match extent {
        Extent::Linear => (gate.width() + 1 - w, gate.height() + 1 - h),
        Extent::Circular => (gate.width(), gate.height()),
    };
    Plane::from_fn(width, height, |x, y| {
        let part = |i: usize, j: usize| gate.row((y + j) % gate.height())[(x + i) % gate.width()];
        let places = || (0..h).flat_map(move |j| (0..w).map(move |i| (i, j)));
        let sum = |term: &dyn Fn(f32, f32, f32) -> f32| -> f32 {
            places()
                .map(|(i, j)| {
                    term(part(i, j), reference.image().row(j)[i], reference.window().weight(i, j))
                })
                .sum()
        };
        match measure {
            Similarity::CrossCorrelation => sum(&|a, b, _| a * b),
            Similarity::Normalised => {
                sum(&|a, b, _| a * b) / (sum(&|a, _, _| a * a) * sum(&|_, b, _| b * b)).sqrt()
            }
            Similarity::ZeroMeanNormalised => {
                let (a0, b0) = (sum(&|a, _, w| w * a), sum(&|_, b, w| w * b));
                let cross = sum(&|a, b, w| w * (a - a0) * (b - b0));
                let (va, vb) =
                    (sum(&|a, _, w| w * (a - a0).powi(2)), sum(&|_, b, w| w * (b - b0).powi(2)));
                cross / ((va + 1.0) * (vb + 1.0)).sqrt()
            }
            Similarity::AbsoluteDifferences => -sum(&|a, b, _| (a - b).abs()),
            Similarity::SquaredDifferences => -sum(&|a, b, _| (a - b).powi(2)).sqrt(),
            Similarity::MaximumDifference => -places()
                .map(|(i, j)| (part(i, j) - reference.image().row(j)[i]).abs())
                .fold(0.0, f32::max),
            Similarity::Phase | Similarity::CrossSpectrum(_) => 0.0,
        }
    })
}

proptest! {
    #[test]
    fn both_routes_give_what_the_definitions_give(
        w in 1usize..9, h in 1usize..9, dx in 0usize..20, dy in 0usize..20, seed in 1u32..1000,
        share in prop::option::of(0.2..1.0f64), circular: bool,
    ) {
        let gate = noise(w + dx, h + dy, seed);
        let window = share.map_or(Window::uniform(w, h), |share| Window::gaussian(w, h, share));
        let reference = Reference::new(noise(w, h, seed + 1), window);
        let extent = if circular { Extent::Circular } else { Extent::Linear };
        for measure in ALL {
            let direct = scores(Route::Direct, &gate, &reference, measure, extent);
            let spectral = scores(Route::Spectral, &gate, &reference, measure, extent);
            let expected = defined(&gate, &reference, measure, extent);
            prop_assert_eq!((direct.width(), direct.height()), (expected.width(), expected.height()));
            let scale = 1.0 + expected.samples().iter().fold(0.0f32, |m, v| m.max(v.abs()));
            for ((a, b), c) in direct.samples().iter().zip(spectral.samples()).zip(expected.samples()) {
                prop_assert!((a - b).abs() < 2e-3 * scale, "{measure:?} routes: {a} {b}");
                if !matches!(measure, Similarity::Phase | Similarity::CrossSpectrum(_)) {
                    prop_assert!((a - c).abs() < 2e-3 * scale, "{measure:?}: {a} {c}");
                }
            }
        }
    }
}

#[test]
fn every_measure_finds_a_known_shift_on_each_axis() {
    let gate = noise(40, 30, 9);
    for (x, y) in [(3, 0), (0, 5), (11, 7), (25, 19)] {
        let reference = Reference::new(gate.crop(x, y, 12, 9), Window::uniform(12, 9));
        for measure in ALL.into_iter().filter(|m| *m != Similarity::CrossCorrelation) {
            for extent in [Extent::Linear, Extent::Circular] {
                let peak = scores(Route::Direct, &gate, &reference, measure, extent).peak();
                assert_eq!(
                    (peak.column, peak.row),
                    (x as usize, y as usize),
                    "{measure:?} {extent:?}"
                );
            }
        }
    }
}

#[test]
fn brightness_and_contrast_change_nothing() {
    let gate = noise(30, 24, 5);
    let reference = Reference::new(gate.crop(9, 7, 8, 6), Window::uniform(8, 6));
    for (gain, offset) in [(0.5, 20.0), (2.0, -50.0)] {
        let mut other = gate.clone();
        other.samples_mut().iter_mut().for_each(|s| *s = *s * gain + offset);
        let measure = Similarity::ZeroMeanNormalised;
        let peak = scores(Route::Direct, &other, &reference, measure, Extent::Linear).peak();
        assert_eq!((peak.column, peak.row), (9, 7));
        assert!((peak.score - 1.0).abs() < 1e-2);
    }
}

#[test]
fn pieces_of_a_large_gate_fit_together() {
    let gate = noise(700, 300, 3);
    let reference = Reference::new(noise(25, 15, 4), Window::uniform(25, 15));
    let measure = Similarity::ZeroMeanNormalised;
    let whole = scores(Route::Direct, &gate, &reference, measure, Extent::Linear);
    let pieces = scores(Route::Spectral, &gate, &reference, measure, Extent::Linear);
    for (a, b) in whole.samples().iter().zip(pieces.samples()) {
        assert!((a - b).abs() < 1e-3, "{a} {b}");
    }
}

#[test]
fn a_flat_gate_correlates_with_nothing_and_is_finite() {
    let reference = Reference::new(noise(5, 5, 3), Window::uniform(5, 5));
    let flat = Plane::from_fn(15, 15, |_, _| 200.0);
    for measure in ALL {
        let scores = scores(Route::Spectral, &flat, &reference, measure, Extent::Linear);
        assert!(scores.samples().iter().all(|s| s.is_finite()), "{measure:?}");
        if measure == Similarity::ZeroMeanNormalised {
            assert!(scores.samples().iter().all(|s| s.abs() < 1e-2));
        }
    }
}

#[test]
fn a_gate_smaller_than_the_reference_is_answered() {
    let reference = Reference::new(noise(9, 9, 3), Window::uniform(9, 9));
    for measure in ALL {
        let scores = scores(Route::Direct, &noise(4, 12, 1), &reference, measure, Extent::Linear);
        assert_eq!((scores.width(), scores.height()), (1, 4));
    }
}
