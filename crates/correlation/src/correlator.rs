use std::fmt;

use crate::Plane;
use crate::fft::{Plans, Size};

/// How much each pixel of a reference counts; sums to 1.
#[derive(Clone, Debug, PartialEq)]
pub struct Window(Plane);

impl Window {
    /// Every pixel alike: the plain zero-mean normalised cross-correlation.
    pub fn uniform(width: usize, height: usize) -> Self {
        Self::normalised(Plane::from_fn(width, height, |_, _| 1.0))
    }

    /// A Gaussian about the middle, with a standard deviation of a share of each side: the target in
    /// the middle counts, the background at the border little.
    pub fn gaussian(width: usize, height: usize, share: f64) -> Self {
        let distance =
            |index: usize, side: usize| (index as f64 - (side as f64 - 1.0) / 2.0) / (share * side as f64);
        Self::normalised(Plane::from_fn(width, height, |x, y| {
            (-0.5 * (distance(x, width).powi(2) + distance(y, height).powi(2))).exp() as f32
        }))
    }

    fn normalised(mut plane: Plane) -> Self {
        let sum = plane.mean() * plane.samples().len() as f32;
        plane.samples_mut().iter_mut().for_each(|weight| *weight /= sum);
        Self(plane)
    }
}

/// A reference image, ready to be correlated: its window, and its weighted deviation from its
/// weighted mean.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference {
    image: Plane,
    window: Window,
    kernel: Plane,
    variance: f32,
}

impl Reference {
    /// A reference of an image and a window of the same size.
    ///
    /// # Panics
    /// If the sizes differ.
    pub fn new(image: Plane, window: &Window) -> Self {
        let weights = window.0.samples();
        assert_eq!(weights.len(), image.samples().len(), "window and image differ in size");
        let mean: f32 = weights.iter().zip(image.samples()).map(|(w, s)| w * s).sum();
        let mut kernel = image.clone();
        let mut variance = 0.0;
        for (value, weight) in kernel.samples_mut().iter_mut().zip(weights) {
            let deviation = *value - mean;
            variance += weight * deviation * deviation;
            *value = weight * deviation;
        }
        Self { image, window: window.clone(), kernel, variance }
    }

    /// The image.
    pub fn image(&self) -> &Plane {
        &self.image
    }

    /// The reference after exponential smoothing: `keep` of the old image and the rest of a new one
    /// (003; erratum: the weight of 0.9 to 0.95 is the old image's).
    #[must_use]
    pub fn adapted(&self, new: &Plane, keep: f32) -> Self {
        let mut image = self.image.clone();
        for (old, new) in image.samples_mut().iter_mut().zip(new.samples()) {
            *old = keep * *old + (1.0 - keep) * new;
        }
        Self::new(image, &self.window)
    }
}

/// Correlates references with gates; keeps the FFT plans it has made.
#[derive(Default)]
pub struct Correlator {
    plans: Plans,
}

impl fmt::Debug for Correlator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Correlator").finish_non_exhaustive()
    }
}

impl Correlator {
    /// The zero-mean normalised cross-correlation (001, equation 3.3; erratum: the means are
    /// removed, else it cannot be negative) at every placement of the reference inside the gate, by
    /// FFT (3.6; erratum: the conjugate is the reference's, so that a peak at (x, y) is the
    /// reference placed with its top left sample there).
    ///
    /// Between -1 and 1. `floor` is the noise's standard deviation, added in square to both
    /// variances: a flat gate correlates with nothing. The gate must be at least as large as the
    /// reference; what hangs over is cut off.
    pub fn scores(&mut self, gate: &Plane, reference: &Reference, floor: f32) -> Plane {
        self.mixed_scores(gate, &[(reference, 1.0)], floor)
    }

    /// The weighted sum of the scores of several references of one size and window.
    ///
    /// # Panics
    /// If there is no reference.
    pub fn mixed_scores(&mut self, gate: &Plane, references: &[(&Reference, f32)], floor: f32) -> Plane {
        let window = &references[0].0.window.0;
        let plan = self.plans.of(Size::holding(gate));
        let width = (gate.width() + 1).saturating_sub(window.width()).max(1);
        let height = (gate.height() + 1).saturating_sub(window.height()).max(1);
        let window = window.crop(0, 0, window.width().min(gate.width()), window.height().min(gate.height()));

        // Without its mean the gate loses fewer digits in the squares.
        let mean = gate.mean();
        let mut centred = gate.clone();
        centred.samples_mut().iter_mut().for_each(|s| *s -= mean);
        let mut squared = centred.clone();
        squared.samples_mut().iter_mut().for_each(|s| *s *= *s);

        let gate_spectrum = plan.forward(&centred);
        let window_spectrum = plan.forward(&window);
        let local_mean = plan.inverse(gate_spectrum.times_conjugate(&window_spectrum), width, height);
        let local_square =
            plan.inverse(plan.forward(&squared).times_conjugate(&window_spectrum), width, height);
        let mut total = Plane::from_fn(width, height, |_, _| 0.0);
        for (reference, share) in references {
            let kernel = reference.kernel.crop(0, 0, window.width(), window.height());
            let product = gate_spectrum.times_conjugate(&plan.forward(&kernel));
            let correlation = plan.inverse(product, width, height);
            let reference_deviation = (reference.variance + floor * floor).sqrt();
            for (i, sum) in total.samples_mut().iter_mut().enumerate() {
                let variance = (local_square.samples()[i] - local_mean.samples()[i].powi(2)).max(0.0);
                let deviation = (variance + floor * floor).sqrt();
                *sum += share * correlation.samples()[i] / (reference_deviation * deviation);
            }
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The definition, sample by sample.
    fn direct(gate: &Plane, reference: &Reference, floor: f32) -> Plane {
        let (w, h) = (reference.image.width(), reference.image.height());
        Plane::from_fn(gate.width() - w + 1, gate.height() - h + 1, |x, y| {
            let part = gate.crop(x as isize, y as isize, w, h);
            let weights = reference.window.0.samples();
            let mean: f32 = weights.iter().zip(part.samples()).map(|(w, s)| w * s).sum();
            let variance: f32 = weights.iter().zip(part.samples()).map(|(w, s)| w * (s - mean).powi(2)).sum();
            let cross: f32 = reference.kernel.samples().iter().zip(part.samples()).map(|(k, s)| k * s).sum();
            cross / ((reference.variance + floor * floor) * (variance + floor * floor)).sqrt()
        })
    }

    fn noise(width: usize, height: usize, seed: u32) -> Plane {
        let mut state = seed.wrapping_mul(2_654_435_761).max(1);
        Plane::from_fn(width, height, |_, _| {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            (state >> 8) as f32 / 65536.0
        })
    }

    proptest! {
        #[test]
        fn the_fft_gives_what_the_definition_gives(
            w in 1usize..9, h in 1usize..9, dx in 0usize..20, dy in 0usize..20, seed in 1u32..1000, share in 0.2..1.0f64,
        ) {
            let gate = noise(w + dx, h + dy, seed);
            let reference = Reference::new(noise(w, h, seed + 1), &Window::gaussian(w, h, share));
            let fast = Correlator::default().scores(&gate, &reference, 1.0);
            let slow = direct(&gate, &reference, 1.0);
            for (a, b) in fast.samples().iter().zip(slow.samples()) {
                prop_assert!((a - b).abs() < 2e-3, "{a} {b}");
                prop_assert!(a.abs() <= 1.0 + 2e-3);
            }
        }

        #[test]
        fn brightness_and_contrast_change_nothing(gain in 0.5f32..2.0, offset in -50.0f32..50.0) {
            let gate = noise(30, 24, 5);
            let reference = Reference::new(gate.crop(9, 7, 8, 6), &Window::uniform(8, 6));
            let mut other = gate;
            other.samples_mut().iter_mut().for_each(|s| *s = *s * gain + offset);
            let scores = Correlator::default().scores(&other, &reference, 0.01);
            let peak = scores.peak();
            prop_assert_eq!((peak.column, peak.row), (9, 7));
            prop_assert!((peak.score - 1.0).abs() < 1e-2);
        }
    }

    #[test]
    fn a_flat_gate_correlates_with_nothing_and_is_finite() {
        let reference = Reference::new(noise(5, 5, 3), &Window::uniform(5, 5));
        let flat = Plane::from_fn(15, 15, |_, _| 200.0);
        let scores = Correlator::default().scores(&flat, &reference, 1.0);
        assert!(scores.samples().iter().all(|s| s.abs() < 1e-2));
    }

    #[test]
    fn a_gate_smaller_than_the_reference_is_answered() {
        let reference = Reference::new(noise(9, 9, 3), &Window::uniform(9, 9));
        let scores = Correlator::default().scores(&noise(4, 12, 1), &reference, 1.0);
        assert_eq!((scores.width(), scores.height()), (1, 4));
    }
}
