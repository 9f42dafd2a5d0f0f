//! How far the residuals of a camera repeat one another, by batch means.
//!
//! What a lens, a pose or a tracker leaves of a direction lasts for as long as the target is in the
//! same part of the image: fifty bearings of a second then say what one does. Residuals z of unit
//! variance that are independent have sums over batches with `E |sum z|^2 = E sum |z|^2`; those that
//! repeat one another have larger ones, by the factor by which the variance of their mean is larger.

use std::collections::BTreeMap;

use nalgebra::Vector2;

/// Length of a batch, s: a quarter of a window of the estimate. Errors that last longer are seen in
/// part: with half of it clocks of real flights were off by 1.5 of their stated deviations in the
/// median, with this by 1.2, and with twice as much by 1.1.
const BATCH_S: f64 = 2.0;
/// Standard errors above 1 that are chance: there the factor stays 1. With half as many, a factor in
/// twenty of independent residuals would be above 1.
const CHANCE: f64 = 4.0;

/// Sums of a camera's residuals over batches, and of their squares.
#[derive(Clone, Debug, Default)]
pub(super) struct BatchMeans {
    sums: BTreeMap<i64, Vector2<f64>>,
    squares: f64,
}

impl BatchMeans {
    /// Takes in the residual of a bearing at a time (s), in units of its noise.
    pub(super) fn add(&mut self, time_s: f64, residual: Vector2<f64>) {
        *self.sums.entry((time_s / BATCH_S).floor() as i64).or_default() += residual;
        self.squares += residual.norm_squared();
    }

    /// Factor on the variance of what the bearings say together, at least 1.
    pub(super) fn inflation(&self) -> f64 {
        let found = self.sums.values().map(Vector2::norm_squared).sum::<f64>() / self.squares;
        // The mean of as many squares of two degrees of freedom has this relative standard error.
        let error = (self.sums.len() as f64).sqrt().recip();
        if found > 1.0 + CHANCE * error { found } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;

    /// Inflation of forty seconds at 30 Hz of noise, a share of whose variance lasts for a batch.
    fn inflation(seed: u64, lasting: f64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal =
            |sd: f64| Vector2::from_fn(|_, _| sd * rng.sample::<f64, _>(StandardNormal));
        let mut means = BatchMeans::default();
        let mut held = Vector2::zeros();
        for k in 0..1200 {
            if k % 60 == 0 {
                held = normal(lasting.sqrt());
            }
            means.add(f64::from(k) / 30.0, held + normal((1.0 - lasting).sqrt()));
        }
        means.inflation()
    }

    #[test]
    fn independent_residuals_are_taken_as_such() {
        let inflated = (0..200).filter(|seed| inflation(*seed, 0.0) > 1.0).count();
        assert!(inflated <= 2, "{inflated} of 200");
        assert_eq!(BatchMeans::default().inflation(), 1.0);
    }

    #[test]
    fn residuals_that_last_count_as_often_as_they_repeat() {
        // Variance of a batch's sum over the sum of its variances: 1 + (n - 1) c for a share c.
        for lasting in [0.5, 0.9, 1.0] {
            let expected = 1.0 + 59.0 * lasting;
            let mean = (0..200).map(|seed| inflation(seed, lasting)).sum::<f64>() / 200.0;
            assert!((mean / expected - 1.0).abs() < 0.05, "{mean} for {expected}");
        }
    }
}
