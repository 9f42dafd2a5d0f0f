//! The likelihood of every placement of the reference: how much likelier the pixels are with the
//! target there than without it, from the correlation and the statistics of the pixels below it.
//!
//! Contrast is not known but has a prior, and is integrated out; that keeps a bright cloud, which
//! correlates as well, from being as likely as the target.

use crossfix_correlation::{Plane, Statistics};
use pulp::{Arch, Simd, WithSimd};

use crate::lanes;

/// What the likelihood expects of the target at its true place.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Expectation {
    /// Energy of the reference (sum of squares), its mean removed.
    pub(crate) energy: f32,
    /// Number of its pixels.
    pub(crate) pixels: f32,
    /// Variance of the image's noise.
    pub(crate) noise: f32,
    /// The target's contrast, as a multiple of the reference's.
    pub(crate) contrast: f32,
    /// Variance of that contrast.
    pub(crate) contrast_variance: f32,
    /// Inverse of the share of the target's energy by which reference and target may mismatch; that
    /// part counts as noise.
    pub(crate) mismatch: f32,
}

/// Fills `ratios` with the log likelihood ratio of every placement: either the image there is the
/// reference with a contrast `c ~ N(contrast, contrast_variance)`, or it is background alone.
///
/// With `a = <reference, image>` (the zero-mean correlation), `E` the reference's energy, `v` the
/// variance of the noise and `s` that of the contrast,
///
/// `ln L = z^2 / (2 u) - (z - contrast)^2 / (2 (s + u)) - ln(1 + s / u) / 2`, `z = a / E`, `u = v /
/// E`,
///
/// the first term for `z > 0` only. `v^2 = noise^2 + (excess / mismatch)^2`, where the excess is
/// the energy of the image under the reference over that of the noise, but at least the target's
/// own: in structured surroundings a correlation counts for less.
pub(crate) fn log_ratios(statistics: &Statistics, expected: Expectation, ratios: &mut Plane) {
    ratios.reshape(statistics.covariance.width(), statistics.covariance.height());
    Arch::new().dispatch(LogRatios { statistics, expected, ratios });
}

struct LogRatios<'a> {
    statistics: &'a Statistics,
    expected: Expectation,
    ratios: &'a mut Plane,
}

impl WithSimd for LogRatios<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Expectation { energy, pixels, noise, contrast, contrast_variance, mismatch } =
            self.expected;
        // The target's own energy, as expected; and the energy of noise alone under the reference.
        let own = contrast * contrast * energy;
        let (per_energy, per_mismatch, flat) = (1.0 / energy, 1.0 / mismatch, pixels * noise);
        let statistics =
            self.statistics.covariance.samples().iter().zip(self.statistics.variance.samples());
        for (ratio, (covariance, variance)) in self.ratios.samples_mut().iter_mut().zip(statistics)
        {
            // z = a / E is the contrast that fits best, and u = v / E its variance.
            let z = covariance * pixels * per_energy;
            let excess = own.max(variance * pixels - flat) * per_mismatch;
            let u = (noise * noise + excess * excess).sqrt() * per_energy;
            let positive = z.max(0.0);
            let miss = z - contrast;
            let spread = contrast_variance + u;
            // ln N(z; contrast, s + u) - ln N(z; 0, u), where z > 0.
            *ratio = positive * positive / (2.0 * u)
                - miss * miss / (2.0 * spread)
                - 0.5 * lanes::ln(spread / u);
        }
    }
}
