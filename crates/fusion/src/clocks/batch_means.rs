//! How far the residuals of a camera repeat one another, by batch means.
//!
//! What a lens, a pose or a tracker leaves of a direction lasts for as long as the target is in the
//! same part of the image: fifty bearings of a second then say what one does. Residuals z that are
//! independent have sums over batches with `E |sum z|^2 = E sum |z|^2`; those that repeat one
//! another have larger ones, by the factor by which the variance of their mean is larger. Where
//! errors are known to last, the variance that is reckoned with is larger already, by an allowance;
//! what remains is the ratio of the two.

use std::collections::BTreeMap;

use nalgebra::Vector2;

use super::WINDOW_S;

/// Length of a batch, s: a quarter of a window of the estimate. Errors that last longer are seen in
/// part: with half of it, errors that last for a second leave clocks off by a half more of their
/// stated deviations.
const BATCH_S: f64 = WINDOW_S / 4.0;
/// Standard errors above 1 that are chance: there the factor stays 1, in a window of four batches
/// up to 3. With half as many, a factor in twenty of independent residuals would be above 1.
const CHANCE: f64 = 4.0;

/// Sums of a camera's residuals over batches, of their squares, and of their allowances.
#[derive(Clone, Debug, Default)]
pub(super) struct BatchMeans {
    sums: BTreeMap<i64, Vector2<f64>>,
    squares: f64,
    allowances: f64,
    count: f64,
}

impl BatchMeans {
    /// Takes in the residual of a bearing at a time (s), in units of the noise that is reckoned
    /// with, whose variance is `allowance` times that of the bearing alone.
    pub(super) fn add(&mut self, time_s: f64, residual: Vector2<f64>, allowance: f64) {
        *self.sums.entry((time_s / BATCH_S).floor() as i64).or_default() += residual;
        self.squares += residual.norm_squared();
        self.allowances += allowance;
        self.count += 1.0;
    }

    /// Factor on the variance of what the bearings say together, at least 1.
    pub(super) fn inflation(&self) -> f64 {
        let sums = self.sums.values().map(Vector2::norm_squared).sum::<f64>();
        let ratio = sums / self.squares / (self.allowances / self.count);
        // The mean of as many squares of two degrees of freedom has this relative standard error.
        let error = (self.sums.len() as f64).sqrt().recip();
        if ratio > 1.0 + CHANCE * error { ratio } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;

    /// Inflation of some seconds at 30 Hz of noise, a share of whose variance lasts for a batch.
    fn inflation(seed: u64, seconds: u32, lasting: f64, allowance: f64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = |share: f64| {
            let sd = share.sqrt();
            Vector2::from_fn(|_, _| sd * rng.sample::<f64, _>(StandardNormal))
        };
        let mut means = BatchMeans::default();
        let mut last = Vector2::zeros();
        for k in 0..30 * seconds {
            if k % 60 == 0 {
                last = normal(lasting);
            }
            means.add(f64::from(k) / 30.0, last + normal(1.0 - lasting), allowance);
        }
        means.inflation()
    }

    #[test]
    fn independent_residuals_are_taken_as_such() {
        for seconds in [1, 8, 40] {
            let inflated = (0..200).filter(|seed| inflation(*seed, seconds, 0.0, 1.0) > 1.0);
            let inflated = inflated.count();
            assert!(inflated <= 3, "{inflated} of 200 in {seconds} s");
        }
        assert_eq!(BatchMeans::default().inflation(), 1.0);
    }

    #[test]
    fn residuals_that_last_count_as_often_as_they_repeat() {
        // Variance of a batch's sum over the sum of its variances: 1 + (n - 1) c for a share c.
        for lasting in [0.5, 0.9, 1.0] {
            let expected = 1.0 + 59.0 * lasting;
            let mean = (0..200).map(|seed| inflation(seed, 40, lasting, 1.0)).sum::<f64>() / 200.0;
            // The mean of a ratio over 20 batches is a fortieth too small, ...
            assert!((mean / expected - 1.0).abs() < 0.05, "{mean} for {expected}");
            // ... and over the four of a window a seventh.
            let mean = (0..400).map(|seed| inflation(seed, 8, lasting, 1.0)).sum::<f64>() / 400.0;
            assert!((0.75..=1.0).contains(&(mean / expected)), "{mean} for {expected}");
        }
    }

    #[test]
    fn errors_that_are_known_to_last_are_not_counted_twice() {
        // Counted as white noise that averages out as slowly: 60 times the variance.
        let inflated = (0..200).filter(|seed| inflation(*seed, 8, 1.0, 60.0) > 1.0).count();
        assert!(inflated <= 3, "{inflated} of 200");
    }
}
