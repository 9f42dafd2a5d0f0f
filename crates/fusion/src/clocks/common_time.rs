//! Common time of a site's clocks, some of which are worse than reported.
//!
//! Each clock is as good as its deviation says, or one of a few (liars) that are off by a second.
//! The likelihood of the common offset then has several maxima, each of which believes some clocks
//! and not the others. They are found by expectation maximisation started at every clock, and are
//! weighted by how likely they are: where two clocks contradict each other either may be right, and
//! the variance is as large as they are apart.

use std::f64::consts::PI;

/// Share of clocks that are not as good as reported: a source of time lost, a latency unknown. It
/// hardly matters: with half of it one clock of three counts until it is off by 5.6 of its
/// deviations, and not by 5.5.
const LIARS: f64 = 0.01;
/// Standard deviation of their offsets, s. With half of it the same.
pub(super) const LIARS_SD_S: f64 = 1.0;
/// Iterations towards a maximum: they settle in three or four, so that half of it would do.
const STEPS: usize = 10;
/// Maxima closer to each other than this many standard deviations count as one. With half of it the
/// same: climbs to one maximum end much closer to each other.
const APART: f64 = 0.5;

/// A clock's offset from an arbitrary one of the clocks, s, and its reported variance, s^2.
#[derive(Clone, Copy, Debug)]
pub(super) struct StatedClock {
    pub(super) offset: f64,
    pub(super) variance: f64,
}

impl StatedClock {
    fn liars_variance(self) -> f64 {
        LIARS_SD_S.powi(2).max(self.variance)
    }

    /// Log density of the clock's being off by `off` from the common time, s: two normals mixed.
    fn log_likelihood(self, off: f64) -> f64 {
        let normal =
            |variance: f64| (-off.powi(2) / variance / 2.0).exp() / (2.0 * PI * variance).sqrt();
        ((1.0 - LIARS) * normal(self.variance) + LIARS * normal(self.liars_variance())).ln()
    }

    /// Variance that is believed of the clock where it is off by `off` from the common time, s^2.
    pub(super) fn believed(self, off: f64) -> f64 {
        if self.variance <= 0.0 {
            return 0.0;
        }
        let liars = self.liars_variance();
        // Posterior odds of a liar, L / (1 - L) N(off; V) / N(off; R), of liar's and reported
        // variance.
        let odds = LIARS / (1.0 - LIARS) * (self.variance / liars).sqrt();
        // P(as reported | off) = 1 / (1 + odds).
        let honest =
            (1.0 + odds * (off.powi(2) * (1.0 / self.variance - 1.0 / liars) / 2.0).exp()).recip();
        // The reciprocal of the expected precision.
        (honest / self.variance + (1.0 - honest) / liars).recip()
    }
}

/// The common time of all clocks.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Common {
    /// Each clock's share in it.
    pub(super) shares: Vec<f64>,
    /// Variance of the common offset, s^2.
    pub(super) variance: f64,
}

/// A maximum of the likelihood: the common offset, its variance, the clocks' shares in it, and its
/// log-likelihood.
struct Maximum {
    offset: f64,
    variance: f64,
    shares: Vec<f64>,
    log_likelihood: f64,
}

impl Maximum {
    fn is_apart_from(&self, other: &Self) -> bool {
        (self.offset - other.offset).abs() > APART * self.variance.min(other.variance).sqrt()
    }
}

/// Common time of the clocks, with each one's share. Clocks that are right by definition have all
/// of it.
pub(super) fn common_time(clocks: &[StatedClock]) -> Common {
    let right = clocks.iter().filter(|clock| clock.variance <= 0.0).count();
    if right > 0 {
        let share =
            |clock: &StatedClock| if clock.variance <= 0.0 { 1.0 / right as f64 } else { 0.0 };
        return Common { shares: clocks.iter().map(share).collect(), variance: 0.0 };
    }
    // Ordered by offset and not by the cameras' names: rounding decides nothing.
    let mut order: Vec<usize> = (0..clocks.len()).collect();
    order.sort_by(|&i, &k| clocks[i].offset.total_cmp(&clocks[k].offset));
    let mut maxima: Vec<Maximum> = Vec::new();
    for &start in &order {
        let found = climb(clocks, &order, clocks[start].offset);
        if maxima.iter().all(|known| known.is_apart_from(&found)) {
            maxima.push(found);
        }
    }
    mixed(clocks.len(), &maxima)
}

/// Climbs from a common offset to the maximum above it.
fn climb(clocks: &[StatedClock], order: &[usize], start: f64) -> Maximum {
    let mut offset = start;
    let (mut shares, mut variance) = (Vec::new(), 0.0);
    for _ in 0..STEPS {
        // E step: the precision believed of each clock. M step: the mean weighted by it.
        shares = clocks.iter().map(|clock| clock.believed(clock.offset - offset).recip()).collect();
        // 1 / sigma^2 = sum of precisions; each share is its precision times sigma^2.
        variance = order.iter().map(|&i| shares[i]).sum::<f64>().recip();
        shares.iter_mut().for_each(|share| *share *= variance);
        offset = order.iter().map(|&i| shares[i] * clocks[i].offset).sum();
    }
    let log_likelihood =
        order.iter().map(|&i| clocks[i].log_likelihood(clocks[i].offset - offset)).sum();
    Maximum { offset, variance, shares, log_likelihood }
}

/// Mean and variance over all maxima, each weighted by the volume under it.
fn mixed(clocks: usize, maxima: &[Maximum]) -> Common {
    // Logarithm of the volume under a normal peak, up to a constant: ln L + ln sigma.
    let volume = |maximum: &Maximum| maximum.log_likelihood + maximum.variance.ln() / 2.0;
    let largest = maxima.iter().map(volume).fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> =
        maxima.iter().map(|maximum| (volume(maximum) - largest).exp()).collect();
    let total: f64 = weights.iter().sum();
    let weighed = || maxima.iter().zip(weights.iter().map(|weight| weight / total));
    let mean: f64 = weighed().map(|(maximum, weight)| maximum.offset * weight).sum();
    let mut shares = vec![0.0; clocks];
    let mut variance = 0.0;
    for (maximum, weight) in weighed() {
        // Variance of a mixture: within each maximum, plus between them.
        variance += (maximum.variance + (maximum.offset - mean).powi(2)) * weight;
        shares.iter_mut().zip(&maximum.shares).for_each(|(sum, share)| *sum += share * weight);
    }
    Common { shares, variance }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;

    /// Common offset of clocks of these offsets and deviations, and its standard deviation, s.
    fn common(clocks: &[(f64, f64)]) -> (f64, f64) {
        let clocks: Vec<StatedClock> = clocks
            .iter()
            .map(|(offset, sd)| StatedClock { offset: *offset, variance: sd.powi(2) })
            .collect();
        let Common { shares, variance } = common_time(&clocks);
        (
            shares.iter().zip(&clocks).map(|(share, clock)| share * clock.offset).sum(),
            variance.sqrt(),
        )
    }

    #[test]
    fn clocks_that_are_as_good_as_they_say_count_by_their_variances() {
        let (offset, sd) = common(&[(1e-3, 1e-3), (-2e-3, 2e-3), (0.0, 1e-3)]);
        let information = 1e6 + 0.25e6 + 1e6;
        assert!((offset - (1e3 - 500.0) / information).abs() < 1e-6, "{offset}");
        assert!((sd - 1.0 / f64::sqrt(information)).abs() < 1e-6, "{sd}");
        assert_eq!(common(&[(0.4, 0.0), (0.0, 1e-3)]), (0.4, 0.0), "right by definition");
    }

    #[test]
    fn honest_clocks_of_all_deviations_are_believed() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for sds in
            [&[0.002, 0.02][..], &[0.002, 0.05, 0.05], &[0.002, 0.002, 0.05, 0.05], &[0.1; 4]]
        {
            let best = sds.iter().map(|sd: &f64| sd.powi(-2)).sum::<f64>().recip();
            let (mut squares, mut scaled) = (0.0, 0.0);
            for _ in 0..2000 {
                let drawn = sds.iter().map(|sd| (rng.sample::<f64, _>(StandardNormal) * sd, *sd));
                let (offset, sd) = common(&drawn.collect::<Vec<_>>());
                squares += offset.powi(2) / 2000.0;
                scaled += (offset / sd).powi(2) / 2000.0;
            }
            assert!(squares < 1.2 * best, "{sds:?}: {} {}", squares.sqrt(), best.sqrt());
            // The standard error of a mean square of 2000 draws is 0.03; that any clock may be a
            // liar makes the common time less sure.
            assert!((0.7..1.1).contains(&scaled), "{sds:?}: {scaled}");
        }
    }

    #[test]
    fn one_liar_of_three_does_not_move_the_common_time() {
        for off in [0.02, 0.05, 1.0, -30.0] {
            let (offset, sd) = common(&[(off, 2e-3), (0.0, 2e-3), (0.3e-3, 2e-3)]);
            assert!((offset - 0.15e-3).abs() < 0.1e-3, "{off}: {offset}");
            // The chance of one in a hundred thousand that the other two are wrong, and alike,
            // contributes a millisecond or two.
            assert!((1.4e-3..5e-3).contains(&sd), "{off}: {sd}");
        }
    }

    #[test]
    fn of_two_that_contradict_each_other_either_may_be_right() {
        for apart in [0.024, 0.05, 0.2] {
            let (offset, sd) = common(&[(0.0, 2e-3), (apart, 2e-3)]);
            assert!((offset - apart / 2.0).abs() < 1e-9, "{offset}");
            assert!((0.9..1.2).contains(&(sd / (apart / 2.0))), "{apart}: {sd}");
        }
    }
}
