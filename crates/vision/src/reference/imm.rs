//! Filter of each pixel's brightness: interacting multiple models, of three models (Solonar 2023,
//! section 3, table 1; docs/papers.md).

use pulp::{Arch, Simd, WithSimd};
use serde::{Deserialize, Serialize};

use crate::lanes::{LANES, Lanes};

/// Number of models: order 0, order 1, Singer's.
const MODELS: usize = 3;
/// Numbers in a model's state: brightness, rate, and their covariance 11, 12, 22.
const PARTS: usize = 5;
/// Least probability of a model: one at zero could not come back. With half of it the same: each
/// frame brings a model more from the others.
const LEAST_PROBABILITY: f32 = 1e-6;

/// The three models of Solonar 2023, table 1. Brightness in levels of 8 bits, times in frames of a
/// thirtieth of a second.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImmConfig {
    /// Intensity `K_M` of the order-0 model, levels per frame. Default 0.05.
    pub constant_sd: f32,
    /// Rate noise `sigma_M` of the order-1 model, levels per frame squared. Default 0.4.
    pub drift_sd: f32,
    /// Rate noise of Singer's model, levels per frame to the power of 1.5. Default 120: the jumps.
    pub jump_sd: f32,
    /// Singer's manoeuvre constant `k_m`, 1 per frame. Default 1.
    pub jump_rate: f32,
    /// Probability that a model stays from frame to frame. Default 0.99.
    pub stay: f32,
}

impl Default for ImmConfig {
    fn default() -> Self {
        Self { constant_sd: 0.05, drift_sd: 0.4, jump_sd: 120.0, jump_rate: 1.0, stay: 0.99 }
    }
}

/// A model's transition `B = [[1, rate], [0, keep]]` and noise `M = [[m11, m12], [m12, m22]]`.
#[derive(Clone, Copy, Debug)]
struct PixelModel {
    rate: f32,
    keep: f32,
    noise: [f32; 3],
}

impl ImmConfig {
    fn models(&self, interval: f32) -> [PixelModel; MODELS] {
        let constant =
            // The order-0 state has one component; a rate that is always 0 makes it as long as the
            // others (erratum).
            PixelModel { rate: 0.0, keep: 0.0, noise: [self.constant_sd.powi(2), 0.0, 0.0] };
        // M = S S' sigma_M^2 with S = [T^2 / 2, T]' (erratum: the square is missing).
        let (half, drift) = (interval * interval / 2.0, self.drift_sd.powi(2));
        let drifting = PixelModel {
            rate: interval,
            keep: 1.0,
            noise: [half * half * drift, half * interval * drift, interval * interval * drift],
        };
        // Singer's (erratum: V21 is 0, and M22 has e^2 and 2 k). In double precision: the terms of
        // M11 nearly cancel.
        let (k, t) = (f64::from(self.jump_rate), f64::from(interval));
        let e = (-k * t).exp();
        let jump = f64::from(self.jump_sd).powi(2);
        let noise = [
            (-3.0 + 4.0 * e - e * e + 2.0 * k * t) / (2.0 * k.powi(3)),
            (1.0 + e * e - 2.0 * e) / (2.0 * k * k),
            (1.0 - e * e) / (2.0 * k),
        ];
        let jumping = PixelModel {
            rate: ((1.0 - e) / k) as f32,
            keep: e as f32,
            noise: noise.map(|m| (m * jump) as f32),
        };
        [constant, drifting, jumping]
    }
}

/// One model's state of eight pixels, in `PARTS` numbers.
type EightStates = [Lanes; PARTS];

/// The filters of eight pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct EightPixels {
    states: [EightStates; MODELS],
    probabilities: [Lanes; MODELS],
}

/// The filters of one colour channel of a reference: 18 numbers per pixel. A colour reference has
/// one of these per channel.
///
/// ```
/// use crossfix_vision::{ImmConfig, PixelImm};
/// let mut filter = PixelImm::new(ImmConfig::default(), &[100.0], 25.0);
/// for _ in 0..50 {
///     filter.step(&[120.0], 1.0, 25.0, &mut [0.0]);
/// }
/// let mut brightness = [0.0];
/// filter.step(&[120.0], 1.0, 25.0, &mut brightness);
/// assert!((brightness[0] - 120.0).abs() < 1.0);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct PixelImm {
    config: ImmConfig,
    blocks: Vec<EightPixels>,
}

impl PixelImm {
    /// Filters that start at given brightnesses, measured with noise of a given variance.
    pub fn new(config: ImmConfig, brightness: &[f32], variance: f32) -> Self {
        let blocks = brightness.chunks(LANES).map(|pixels| EightPixels::start(pixels, variance));
        Self { config, blocks: blocks.collect() }
    }

    /// Takes the measured brightnesses in, `interval` frames after the last ones, and writes the
    /// filtered ones: steps 1 to 7 of Solonar 2023, section 3. Where the slices are longer than the
    /// filters, the rest is left alone.
    pub fn step(&mut self, measured: &[f32], interval: f32, variance: f32, filtered: &mut [f32]) {
        let (models, stay) = (self.config.models(interval), self.config.stay);
        Arch::new().dispatch(FilterStep {
            blocks: &mut self.blocks,
            models,
            stay,
            measured,
            variance,
            filtered,
        });
    }
}

struct FilterStep<'a> {
    blocks: &'a mut [EightPixels],
    models: [PixelModel; MODELS],
    stay: f32,
    measured: &'a [f32],
    variance: f32,
    filtered: &'a mut [f32],
}

impl WithSimd for FilterStep<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let pixels = self.measured.chunks(LANES).zip(self.filtered.chunks_mut(LANES));
        for (block, (measured, filtered)) in self.blocks.iter_mut().zip(pixels) {
            let mut lane = [0.0; LANES];
            lane[..measured.len()].copy_from_slice(measured);
            let Lanes(out) =
                block.step(&self.models, self.stay, Lanes(lane), Lanes::splat(self.variance));
            filtered.copy_from_slice(&out[..filtered.len()]);
        }
    }
}

impl EightPixels {
    /// Filters that start at the brightness of up to eight pixels, all models equally likely.
    fn start(pixels: &[f32], variance: f32) -> Self {
        let mut first = [0.0; LANES];
        first[..pixels.len()].copy_from_slice(pixels);
        let [variance, rate_variance] = [variance, 1.0].map(Lanes::splat);
        let state = [Lanes(first), Lanes::splat(0.0), variance, Lanes::splat(0.0), rate_variance];
        Self { states: [state; MODELS], probabilities: [Lanes::splat(1.0 / MODELS as f32); MODELS] }
    }

    /// One step of eight pixels; returns their filtered brightness.
    #[inline(always)]
    fn step(
        &mut self,
        models: &[PixelModel; MODELS],
        stay: f32,
        measured: Lanes,
        variance: Lanes,
    ) -> Lanes {
        let before = *self;
        let zero = Lanes::splat(0.0);
        let mut likelihoods = [zero; MODELS];
        let mut exponents = [zero; MODELS];
        for l in 0..MODELS {
            let (prior, mixed) = before.mixed(l, stay);
            let predicted = models[l].time_update(mixed);
            let inverse = Lanes::splat(1.0) / (predicted[2] + variance);
            let innovation = measured - predicted[0];
            self.states[l] = measurement_update(predicted, innovation, inverse, variance);
            // (14)-(15): the likelihood N(innovation; 0, P11 + R) up to a common factor, its
            // exponent kept apart.
            exponents[l] = innovation * innovation * inverse * -0.5;
            likelihoods[l] = prior * inverse.sqrt();
        }
        self.weigh(likelihoods, exponents);
        // (16): the estimate that does not depend on a hypothesis.
        let mut filtered = zero;
        for (probability, state) in self.probabilities.iter().zip(&self.states) {
            filtered = filtered + *probability * state[0];
        }
        filtered
    }

    /// The states mixed for a model `l`, and its probability before the measurement: equations
    /// (10) and (11).
    #[inline(always)]
    fn mixed(&self, l: usize, stay: f32) -> (Lanes, EightStates) {
        let leave = (1.0 - stay) / (MODELS - 1) as f32;
        let (zero, states) = (Lanes::splat(0.0), &self.states);
        // (10): the probability of each model before, given that l holds now.
        let mut weights = self.probabilities;
        let mut prior = zero;
        for (m, weight) in weights.iter_mut().enumerate() {
            *weight = *weight * if m == l { stay } else { leave };
            prior = prior + *weight;
        }
        let share = Lanes::splat(1.0) / prior;
        // (11): mixed state and covariance.
        let [mut brightness, mut rate] = [zero; 2];
        for m in 0..MODELS {
            weights[m] = weights[m] * share;
            brightness = brightness + weights[m] * states[m][0];
            rate = rate + weights[m] * states[m][1];
        }
        // P = sum w_m (P_m + d d'), d = x_m - x: the spread of the means is part of it.
        let [mut p11, mut p12, mut p22] = [zero; 3];
        for m in 0..MODELS {
            let (d0, d1) = (states[m][0] - brightness, states[m][1] - rate);
            p11 = p11 + weights[m] * (states[m][2] + d0 * d0);
            p12 = p12 + weights[m] * (states[m][3] + d0 * d1);
            p22 = p22 + weights[m] * (states[m][4] + d1 * d1);
        }
        (prior, [brightness, rate, p11, p12, p22])
    }

    /// Sets the models' probabilities from their likelihoods, the exponents of which are apart.
    #[inline(always)]
    fn weigh(&mut self, mut likelihoods: [Lanes; MODELS], exponents: [Lanes; MODELS]) {
        // The largest exponent is taken out of all, so that not all of them underflow.
        let largest = exponents[0].max(exponents[1]).max(exponents[2]);
        let least = Lanes::splat(f32::MIN_POSITIVE);
        let mut total = Lanes::splat(0.0);
        for (likelihood, exponent) in likelihoods.iter_mut().zip(exponents) {
            *likelihood = (*likelihood * (exponent - largest).exp()).max(least);
            total = total + *likelihood;
        }
        let share = Lanes::splat(1.0) / total;
        for (probability, likelihood) in self.probabilities.iter_mut().zip(likelihoods) {
            *probability = (likelihood * share).max(Lanes::splat(LEAST_PROBABILITY));
        }
    }
}

impl PixelModel {
    /// Equation (12): extrapolation, x = B x and P = B P B' + M.
    #[inline(always)]
    fn time_update(&self, [brightness, rate, p11, p12, p22]: EightStates) -> EightStates {
        let Self { rate: step, keep, noise } = *self;
        let cross = p12 + p22 * step;
        [
            brightness + rate * step,
            rate * keep,
            p11 + (p12 + cross) * step + Lanes::splat(noise[0]),
            cross * keep + Lanes::splat(noise[1]),
            p22 * (keep * keep) + Lanes::splat(noise[2]),
        ]
    }
}

/// Equation (13), with the innovation and the inverse of its variance (erratum: `f` is the
/// measurement and `R_f` its variance).
#[inline(always)]
fn measurement_update(
    [brightness, slope, p11, p12, p22]: EightStates,
    innovation: Lanes,
    inverse: Lanes,
    variance: Lanes,
) -> EightStates {
    let (k1, k2) = (p11 * inverse, p12 * inverse);
    [
        brightness + k1 * innovation,
        slope + k2 * innovation,
        k1 * variance,
        k2 * variance,
        p22 - k2 * p12,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pixel_is_filtered_alone() {
        let start = [10.0, 50.0, 90.0, 130.0, 170.0, 200.0, 220.0, 240.0, 250.0, 30.0];
        let mut together = PixelImm::new(ImmConfig::default(), &start, 25.0);
        let mut out = [0.0; 10];
        for frame in 0..20 {
            let measured = start.map(|s| if frame > 9 { 255.0 - s } else { s + frame as f32 });
            together.step(&measured, 1.0, 25.0, &mut out);
        }
        for (i, first) in start.iter().enumerate() {
            let mut alone = PixelImm::new(ImmConfig::default(), &[*first], 25.0);
            let mut one = [0.0];
            for frame in 0..20 {
                let measured = if frame > 9 { 255.0 - first } else { first + frame as f32 };
                alone.step(&[measured], 1.0, 25.0, &mut one);
            }
            assert_eq!(one[0], out[i]);
        }
    }

    #[test]
    fn a_jump_is_followed_within_two_frames_and_noise_is_not() {
        let mut filter = PixelImm::new(ImmConfig::default(), &[100.0], 25.0);
        let mut out = [0.0];
        let mut spread = 0.0_f32;
        for frame in 0..200 {
            let noise = if frame % 2 == 0 { 5.0 } else { -5.0 };
            filter.step(&[100.0 + noise], 1.0, 25.0, &mut out);
            if frame > 100 {
                spread = spread.max((out[0] - 100.0).abs());
            }
        }
        assert!(spread < 1.5, "{spread}");
        for _ in 0..2 {
            filter.step(&[180.0], 1.0, 25.0, &mut out);
        }
        assert!((out[0] - 180.0).abs() < 3.0, "{}", out[0]);
    }

    #[test]
    fn singers_model_is_stable() {
        let [_, _, singer] = ImmConfig::default().models(1.0);
        // Upper triangular: the eigenvalues are 1 and e.
        assert!(singer.keep < 1.0 && singer.rate > 0.0);
        assert!(
            singer.noise[0] > 0.0
                && singer.noise[0] * singer.noise[2] >= singer.noise[1].powi(2) * 0.99
        );
    }
}
