//! How much of the image may be background: where the gate is empty but for one thing, that thing
//! is hardly background, however its looks have changed since the last image.

use std::ops::Range;

use crossfix_correlation::{Plane, Statistics};
use pulp::{Arch, Simd, WithSimd};

use crate::lanes;

/// Probability that in a gate that is empty otherwise, something stands out that is neither the
/// target nor the background: a bird, another drone. With a tenth and with ten times of it the same
/// is followed on real video.
const SOMETHING_ELSE: f32 = 0.01;

/// Energy (sum of the squares about the mean, without that of noise) that the background has under
/// a reference, as the gate shows it beside the target.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BackgroundEnergy {
    /// Its mean; for an empty background, what noise leaves of it.
    mean: f32,
    /// Energy of the noise under the reference.
    noise: f32,
    /// Number of the reference's pixels.
    pixels: f32,
    /// Number of boxes of the reference's size in which the gate may show it.
    boxes: f32,
}

impl BackgroundEnergy {
    /// The energy in a gate outside of the reference's box, whose corner is at `placement` and whose
    /// sides are `sides`; `noise` is the variance of the noise. `None` if that is less than another
    /// such box.
    pub(crate) fn beside(
        gate: &Plane,
        placement: [usize; 2],
        sides: [usize; 2],
        noise: f32,
    ) -> Option<Self> {
        let pixels = (sides[0] * sides[1]) as f32;
        let count = (gate.width() * gate.height()) as f32 - pixels;
        let boxes = count / pixels;
        if boxes < 1.0 {
            return None;
        }
        let [columns, rows] = [0, 1].map(|i| placement[i]..placement[i] + sides[i]);
        let outside = |of: &dyn Fn(&[f32]) -> f32| {
            beside(gate, &columns, &rows).map(|samples| f64::from(of(samples))).sum::<f64>()
        };
        let mean = (outside(&lanes::sum) / f64::from(count)) as f32;
        let squares = outside(&|samples| lanes::squares_about(mean, samples)) as f32;
        let energy = (squares - count * noise).max(0.0);
        // The noise's energy under the reference varies by v sqrt(2 n).
        Some(Self {
            mean: energy / boxes + noise * (2.0 * pixels).sqrt(),
            noise: pixels * noise,
            pixels,
            boxes,
        })
    }

    /// The logarithm of the probability that the background has no less energy than a variance under
    /// the reference shows. The energy of a box is exponential, which is all that a known mean says;
    /// the placement is the best of all.
    ///
    /// `ln P = ln min(1, e + n exp(-E / m))`
    #[inline(always)]
    fn log_probability(&self, variance: f32) -> f32 {
        let energy = variance * self.pixels - self.noise;
        let by_chance = self.boxes * lanes::exp(-energy / self.mean);
        lanes::ln((SOMETHING_ELSE + by_chance).min(1.0))
    }

    /// Takes from the log likelihood ratios of all placements the likelihood of the background's
    /// energy there.
    pub(crate) fn weigh(self, statistics: &Statistics, ratios: &mut Plane) {
        Arch::new().dispatch(Weigh { background: self, statistics, ratios });
    }
}

/// The parts of a gate's rows outside of a box.
fn beside<'a>(
    gate: &'a Plane,
    columns: &'a Range<usize>,
    rows: &'a Range<usize>,
) -> impl Iterator<Item = &'a [f32]> {
    (0..gate.height()).flat_map(move |y| {
        let row = gate.row(y);
        let (left, right) = if rows.contains(&y) {
            (&row[..columns.start], &row[columns.end..])
        } else {
            (row, &row[row.len()..])
        };
        [left, right]
    })
}

struct Weigh<'a> {
    background: BackgroundEnergy,
    statistics: &'a Statistics,
    ratios: &'a mut Plane,
}

impl WithSimd for Weigh<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let variances = self.statistics.variance.samples();
        for (ratio, variance) in self.ratios.samples_mut().iter_mut().zip(variances) {
            *ratio -= self.background.log_probability(*variance);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    use super::*;

    const NOISE: f32 = 4.0;

    /// A gate of noise, and what `more` adds to it.
    fn gate(seed: u64, more: impl Fn(usize, usize) -> f32) -> Plane {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let noise = Normal::new(0.0, NOISE.sqrt()).unwrap();
        let mut gate = Plane::from_fn(41, 31, &more);
        gate.samples_mut().iter_mut().for_each(|sample| *sample += 90.0 + noise.sample(&mut rng));
        gate
    }

    /// Variance of what is in the box.
    fn variance_at(gate: &Plane, [left, top]: [usize; 2], [width, height]: [usize; 2]) -> f32 {
        let samples: Vec<f32> =
            (top..top + height).flat_map(|y| &gate.row(y)[left..left + width]).copied().collect();
        let mean = lanes::sum(&samples) / samples.len() as f32;
        lanes::squares_about(mean, &samples) / samples.len() as f32
    }

    fn log_probability(gate: &Plane) -> f32 {
        let (placement, sides) = ([16, 12], [9, 7]);
        let background = BackgroundEnergy::beside(gate, placement, sides, NOISE).unwrap();
        background.log_probability(variance_at(gate, placement, sides))
    }

    fn target(x: usize, y: usize) -> f32 {
        if (18..23).contains(&x) && (14..17).contains(&y) { 30.0 } else { 0.0 }
    }

    #[test]
    fn the_only_thing_in_a_gate_is_no_background() {
        for seed in 0..20 {
            let alone = log_probability(&gate(seed, target));
            assert!((alone - SOMETHING_ELSE.ln()).abs() < 0.01, "seed {seed}: {alone}");
        }
    }

    #[test]
    fn noise_and_what_stands_out_no_more_than_the_rest_may_be_background() {
        let edge = |x: usize, y: usize| target(x, y) + if 2 * x + y > 70 { 60.0 } else { 0.0 };
        for seed in 0..20 {
            for (name, gate) in [("noise", gate(seed, |_, _| 0.0)), ("an edge", gate(seed, edge))] {
                let alone = log_probability(&gate);
                assert_eq!(alone, 0.0, "{name}, seed {seed}");
            }
        }
    }

    #[test]
    fn a_gate_that_shows_little_but_the_reference_says_nothing() {
        let gate = gate(1, target);
        assert!(BackgroundEnergy::beside(&gate, [2, 2], [30, 25], NOISE).is_none());
        assert!(BackgroundEnergy::beside(&gate, [0, 0], [41, 31], NOISE).is_none());
    }
}
