//! Noise of a camera's bearings, relative to what it reports: the white part, which every bearing
//! draws afresh, and the part that lasts from one bearing to the next.
//!
//! In the third difference of four bearings of one target its direction, its rate and its turning
//! cancel, and whatever pose, clock and slow errors shift all four by. What is left of four
//! successive bearings is four draws of white noise. Of four bearings that are a quarter of a
//! second apart there is left, in addition, what a lasting error changes by within that time. So
//! the two together tell the white part of a camera's noise from the lasting part, whatever the
//! track believes.

use crossfix_geometry::SightLine;
use crossfix_message::Timestamp;
use nalgebra::{Unit, Vector2, Vector3};

use crate::spatial::CHI_SQUARE_2_MEDIAN;
use crate::uncertainty::CorrelatedNoise;

/// Number of draws that the estimate remembers: it is then known to 13 %. With half as many a
/// camera must report a third of its variance before that is noticed, and not half of it.
const MEMORY: f64 = 200.0;
/// Standard error of the logarithm of the scale after one draw (simulated: neighbouring draws share
/// three of their four bearings). With half of it chance passes for twice as many standard errors,
/// and cameras are doubted that are as good as they report.
const ERROR_OF_ONE: f64 = 1.9;
/// A camera whose scale is this many standard errors above 1 has more noise than it reports. With
/// half as many one in four is doubted by chance before its first two hundred draws
/// are over.
const NOISIER: f64 = 3.0;
/// A camera's reported variance is divided into parts if its white noise is this many standard
/// errors below it. More than for [`NOISIER`]: white noise as reported, compared thirty times per
/// second, is four below it by chance once in a few minutes, and would be taken for noise that
/// lasts. With half of it that happens all the time; at twice as much a camera half of whose
/// variance lasts is left as it is.
const DIVIDED: f64 = 4.5;
/// The least share of the reported variance that counts as white. Labels that are interpolated, and
/// trackers that smooth, have none at all; with a tenth of this their bearings would be believed
/// more closely than a lens is known from one pixel to the next.
const LEAST_WHITE: f64 = 0.01;
/// Least interval between the bearings of a spaced third difference, s. With half of it an error
/// that lasts for a second must be six times as large to be seen beside white noise; with twice as
/// much the turns of a small drone are taken for errors.
const SPACING_S: f64 = 0.25;
/// Correlation time of the part that lasts, where nobody has declared it, s. From the spaced
/// differences only the rate of change of the error follows, variance over time, and not each for
/// itself: with half of the time the variance found is half as large, and the rate is the same.
pub(crate) const LASTING_S: f64 = 1.0;

/// Squared third differences of a camera's bearings of a target, over their variance by the
/// reported noise (two degrees of freedom each, if that is right).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ThirdDifferences {
    /// Of the last four bearings.
    pub(crate) successive: Option<f64>,
    /// Of four bearings [`SPACING_S`] apart.
    pub(crate) spaced: Option<f64>,
    /// Variance that the newest bearing reports, rad^2 per tangent.
    pub(crate) reported: f64,
}

/// The last bearings that a camera gave of a track.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct RecentBearings {
    successive: LastThree,
    spaced: LastThree,
}

impl RecentBearings {
    /// Takes in a bearing; returns what it and those before it show of the noise. Of successive
    /// bearings no two may be more than `longest_s` apart. `expected` is the direction in which the
    /// track has the target at a time.
    pub(crate) fn see(
        &mut self,
        time: Timestamp,
        line: &SightLine,
        longest_s: f64,
        expected: impl Fn(Timestamp) -> Option<Unit<Vector3<f64>>>,
    ) -> ThirdDifferences {
        ThirdDifferences {
            successive: self.successive.see(time, line, 0.0, longest_s, &expected),
            spaced: self.spaced.see(time, line, SPACING_S, 2.0 * SPACING_S, &expected),
            reported: line.covariance.trace() / 2.0,
        }
    }
}

/// Three bearings of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct LastThree([Option<(Timestamp, Unit<Vector3<f64>>)>; 3]);

impl LastThree {
    /// Takes in a bearing if it is at least `least_s` later than the one before; returns the
    /// squared third difference of it and the three before, over its variance by the reported
    /// noise, provided that no two successive ones are more than `longest_s` apart.
    fn see(
        &mut self,
        time: Timestamp,
        line: &SightLine,
        least_s: f64,
        longest_s: f64,
        expected: impl Fn(Timestamp) -> Option<Unit<Vector3<f64>>>,
    ) -> Option<f64> {
        let [first, second, third] = self.0;
        if third.is_some_and(|(before, _)| (0.0..least_s).contains(&time.seconds_since(before))) {
            return None;
        }
        self.0 = [second, third, Some((time, line.direction))];
        let seen = [first?, second?, third?, (time, line.direction)];
        let ages = seen.map(|(then, _)| time.seconds_since(then));
        if !ages
            .windows(2)
            .all(|pair| (0.0..=longest_s).contains(&(pair[0] - pair[1])) && pair[0] > pair[1])
        {
            return None;
        }
        let (mut difference, mut draws) = (Vector2::zeros(), 0.0);
        // Third divided difference: sum of z_i / product over k of (t_i - t_k), 0 for any parabola.
        for (i, (then, direction)) in seen.into_iter().enumerate() {
            let others = (0..seen.len()).filter(|k| *k != i);
            let weight = others.map(|k| (ages[i] - ages[k]).recip()).product::<f64>();
            let off = direction.into_inner() - expected(then)?.into_inner();
            difference += line.basis.transpose() * off * weight;
            draws += weight * weight;
        }
        // Its variance per tangent is the sum of the squared weights times the reported variance.
        Some(difference.norm_squared() / (draws * line.covariance.trace() / 2.0))
    }
}

/// Ratio of a noise to the reported one, from a running median of squared third differences: one
/// bearing in ten may be of no target.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct RunningScale {
    log_factor: f64,
    draws: f64,
    /// Whether it has been found to be below 1, and is not yet as good as 1 again.
    is_less: bool,
}

impl RunningScale {
    /// Takes a squared third difference in.
    fn see(&mut self, squared: f64) {
        self.draws = (self.draws + 1.0).min(MEMORY);
        // A step towards the median, up or down: half a draw over the number of draws and over the
        // slope, by which the share of draws below the median m grows with the scale's logarithm:
        // that is m / 4, the distribution's density there.
        let above = if squared > CHI_SQUARE_2_MEDIAN * self.log_factor.exp() { 0.5 } else { -0.5 };
        let slope = CHI_SQUARE_2_MEDIAN / 4.0;
        let next = self.log_factor + above / (slope * self.draws.max(10.0));
        // Of labels that are interpolated all draws are next to nothing: what is below the least
        // that counts is not remembered.
        self.log_factor = next.max(LEAST_WHITE.ln());
        let least = if self.is_less { NOISIER } else { DIVIDED };
        self.is_less = self.standard_errors() < -least;
    }

    /// The logarithm of the ratio in its standard errors, each [`ERROR_OF_ONE`] / sqrt(n).
    fn standard_errors(&self) -> f64 {
        self.log_factor * self.draws.sqrt() / ERROR_OF_ONE
    }

    /// The ratio; 1 as long as it is not clear that it differs.
    fn factor(&self) -> f64 {
        let is_clear = self.is_less || self.standard_errors() > NOISIER;
        if is_clear { self.log_factor.exp() } else { 1.0 }
    }

    /// The largest ratio that the draws allow: [`NOISIER`] standard errors above the estimate.
    fn most(&self) -> f64 {
        (self.log_factor + NOISIER * ERROR_OF_ONE / self.draws.sqrt()).exp()
    }
}

/// The noise of a camera's bearings, as their third differences show it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct BearingNoise {
    successive: RunningScale,
    spaced: RunningScale,
    /// Mean of the logarithms of the variances that the bearings report (rad^2 per tangent), and
    /// their number: a bearing that says next to nothing must not pass for the camera's usual one.
    log_reported: f64,
    bearings: f64,
}

impl BearingNoise {
    /// Takes the third differences that a bearing has completed in.
    pub(crate) fn see(&mut self, differences: &ThirdDifferences) {
        differences.successive.into_iter().for_each(|squared| self.successive.see(squared));
        differences.spaced.into_iter().for_each(|squared| self.spaced.see(squared));
        self.bearings = (self.bearings + 1.0).min(MEMORY);
        self.log_reported += (differences.reported.ln() - self.log_reported) / self.bearings;
    }

    /// Ratio of the white noise's covariance to the reported one; 1 as long as that is not clear.
    pub(crate) fn white(&self) -> f64 {
        self.successive.factor()
    }

    /// The part of the noise that lasts: what the reported variance holds beside the white part, as
    /// far as it changes as quickly as the spaced third differences allow. What lasts longer than
    /// that shifts all bearings of the camera, as its pose does, and is in the pose's covariance.
    pub(crate) fn lasting(&self) -> CorrelatedNoise {
        let white = self.white();
        // The third difference of a process of variance c^2 with the correlations p, p^2, p^3
        // between four values has the variance c^2 (20 - 30 p + 12 p^2 - 2 p^3); of white noise w
        // it has 20 w.
        let kept = (-SPACING_S / LASTING_S).exp();
        let share = 1.0 - 1.5 * kept + 0.6 * kept.powi(2) - 0.1 * kept.powi(3);
        let changing = (self.spaced.most() - white).max(0.0) / share;
        let variance = (1.0 - white).max(0.0).min(changing) * self.log_reported.exp();
        CorrelatedNoise { sd_rad: variance.sqrt(), time_s: LASTING_S }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Point3, Vector2, Vector3};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const REPORTED_SD_RAD: f64 = 5e-4;

    /// What is found of a camera's noise in two minutes at 30 Hz, where its bearings have this
    /// white and this lasting variance in units of the reported one; the lasting error has this
    /// correlation time, and the target turns by 0.1 rad/s.
    fn found(seed: u64, [white, lasting]: [f64; 2], time_s: f64) -> BearingNoise {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || Vector2::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut rng) });
        let kept = (-1.0 / 30.0 / time_s).exp();
        let (mut error, mut recent, mut noise) =
            (normal(), RecentBearings::default(), BearingNoise::default());
        let ahead = |time: Timestamp| {
            let angle = 0.1 * time.seconds();
            Some(Unit::new_normalize(Vector3::new(angle.cos(), angle.sin(), 0.1)))
        };
        for k in 0..3600 {
            let time = Timestamp::EPOCH.plus_seconds(f64::from(k) / 30.0);
            error = error * kept + normal() * (1.0 - kept * kept).sqrt();
            let off = (error * lasting.sqrt() + normal() * white.sqrt()) * REPORTED_SD_RAD;
            let exact = ahead(time).unwrap();
            let basis = crossfix_geometry::tangent_basis(&exact);
            let direction = Unit::new_normalize(exact.into_inner() + basis * off);
            let covariance = Matrix2::identity() * REPORTED_SD_RAD.powi(2);
            let line = SightLine {
                origin: Point3::origin(),
                direction,
                basis: crossfix_geometry::tangent_basis(&direction),
                covariance,
            };
            noise.see(&recent.see(time, &line, 0.15, ahead));
        }
        noise
    }

    /// Variance of the lasting noise found, in units of the reported one.
    fn lasting_share(noise: &BearingNoise) -> f64 {
        noise.lasting().variance() / REPORTED_SD_RAD.powi(2)
    }

    #[test]
    fn white_noise_as_reported_is_left_as_it_is() {
        let honest = (0..40).filter(|&seed| {
            let noise = found(seed, [1.0, 0.0], 1.0);
            noise.white() == 1.0 && lasting_share(&noise) == 0.0
        });
        // At the end of a run a scale is three standard errors off in one of 370.
        assert!(honest.count() >= 39);
    }

    #[test]
    fn a_reported_variance_is_divided_into_what_is_white_and_what_lasts() {
        for seed in 0..10 {
            let noise = found(seed, [0.1, 0.9], 1.0);
            // The lasting part changes a little from one bearing to the next, too. 200 draws are
            // known to 13 %.
            assert!((0.08..0.19).contains(&noise.white()), "{}", noise.white());
            // All that is left is taken for lasting: the spaced differences allow it.
            let left = 1.0 - noise.white();
            assert!((lasting_share(&noise) - left).abs() < 1e-9, "{}", lasting_share(&noise));
        }
    }

    #[test]
    fn of_a_variance_that_is_overstated_only_what_changes_is_taken_for_lasting() {
        for seed in 0..10 {
            let share = lasting_share(&found(seed, [0.02, 0.1], 1.0));
            // 0.1, and three standard errors of 13 % of what the spaced differences show.
            assert!((0.1..0.3).contains(&share), "{share}");
            // A bias that lasts longer than one looks is the pose's: what is left is what the white
            // part hides, 0.02 (e^(3 x 0.13) - 1) / 0.149, the white part itself known to 13 %.
            let bias = lasting_share(&found(seed, [0.02, 0.9], 600.0));
            assert!(bias < 0.17, "{bias}");
        }
    }

    #[test]
    fn labels_that_were_interpolated_for_long_are_forgotten_when_they_no_longer_are() {
        let mut scale = RunningScale::default();
        (0..18_000).for_each(|_| scale.see(0.0));
        assert!((scale.factor() - LEAST_WHITE).abs() < 1e-12, "{scale:?}");
        // A minute of draws of the reported size, quantiles of chi-square: at first each raises the
        // scale, by 1/(2 x 0.347 x 200), and 4.6 are to be made up for.
        let quantile = |k: i32| -2.0 * ((f64::from(k * 37 % 100) + 0.5) / 100.0).ln();
        (0..1800).for_each(|k| scale.see(quantile(k)));
        assert_eq!(scale.factor(), 1.0, "{scale:?}");
    }
}
