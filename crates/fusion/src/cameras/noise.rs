//! White noise of a camera's bearings from one exposure to the next, relative to what it reports.
//!
//! In the third difference of four bearings of one target its direction, its rate and its turning
//! cancel, and whatever pose, clock and slow errors shift all four by: what is left is four draws
//! of white noise. So it separates the white part of a camera's noise from all else, whatever the
//! track believes.

use crossfix_geometry::SightLine;
use crossfix_message::Timestamp;
use nalgebra::{Unit, Vector2, Vector3};

/// Median of a chi-square of two degrees of freedom.
const MEDIAN: f64 = 1.386_294;
/// Increase of the share of draws below the median per unit of the logarithm of the scale.
const SLOPE: f64 = 0.346_574;
/// Number of draws that the estimate remembers: it is then known to 10 %. With half as many a
/// camera must report a third of its variance before that is noticed, and not half of it.
const MEMORY: f64 = 200.0;
/// Standard error of the logarithm of the scale after one draw (simulated: neighbouring draws share
/// three of their four bearings).
const ERROR_OF_ONE: f64 = 1.9;
/// A camera whose scale is this many standard errors above what it reports is no longer taken at
/// its word. With half as many one in four is doubted by chance before its first two hundred draws
/// are over.
const DOUBT: f64 = 3.0;

/// The last three bearings that a camera gave of a track.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct LastThree([Option<(Timestamp, Unit<Vector3<f64>>)>; 3]);

impl LastThree {
    /// Takes in a bearing; returns the squared third difference of it and the three before, over
    /// its variance by the reported noise (two degrees of freedom where that is right), provided
    /// that no two successive ones are more than `longest_s` apart. `expected` is the direction in
    /// which the track has the target at a time.
    pub(crate) fn see(
        &mut self,
        time: Timestamp,
        line: &SightLine,
        longest_s: f64,
        expected: impl Fn(Timestamp) -> Option<Unit<Vector3<f64>>>,
    ) -> Option<f64> {
        let [first, second, third] = self.0;
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

/// Factor on a camera's reported covariances, from a running median of its squared third
/// differences: one bearing in ten may be of no target.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct WhiteNoise {
    log_factor: f64,
    draws: f64,
}

impl WhiteNoise {
    /// Takes a squared third difference in.
    pub(crate) fn see(&mut self, squared: f64) {
        self.draws = (self.draws + 1.0).min(MEMORY);
        // A step towards the median, up or down: half a draw over the slope and the number of
        // draws.
        let above = if squared > MEDIAN * self.log_factor.exp() { 0.5 } else { -0.5 };
        self.log_factor += above / (SLOPE * self.draws.max(10.0));
    }

    /// Ratio of the noise's covariance to the reported one; 1 as long as that is not clear, and
    /// where it is less: a reported covariance also covers errors that last longer than four
    /// pictures.
    pub(crate) fn factor(&self) -> f64 {
        // ln f > DOUBT standard errors, each ERROR_OF_ONE / sqrt(n).
        let is_clear = self.log_factor * self.draws.sqrt() > DOUBT * ERROR_OF_ONE;
        if is_clear { self.log_factor.exp() } else { 1.0 }
    }
}
