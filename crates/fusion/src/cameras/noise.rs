//! How noisy a camera's bearings are from one exposure to the next, against what it reports.
//!
//! The third difference of four bearings of one target cancels where the target is, how fast it
//! goes, how it turns, and whatever pose, clock and slow errors shift all four by: what is left is
//! four draws of white noise. So it tells the white part of a camera's noise apart from all else,
//! whatever the track believes.

use crossfix_geometry::SightLine;
use crossfix_message::Timestamp;
use nalgebra::{Unit, Vector2, Vector3};

/// The median of a chi-square of two degrees of freedom.
const MEDIAN: f64 = 1.386_294;
/// How much more of the draws lies below the median by each unit of the logarithm of the scale.
const SLOPE: f64 = 0.346_574;
/// Draws that the estimate remembers: it is then known to 10 %. With half as many a camera must
/// report a third of its variance before it is noticed, and not half of it.
const MEMORY: f64 = 200.0;
/// Standard error of the logarithm of the scale after one draw (simulated: neighbouring ones share
/// three of their four bearings).
const ERROR_OF_ONE: f64 = 1.9;
/// So many standard errors from what it reports a camera is no more taken at its word. With half as
/// many one in four is doubted by chance before its first two hundred draws are over.
const DOUBT: f64 = 3.0;

/// The last bearings that a camera gave of a track.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct LastThree([Option<(Timestamp, Unit<Vector3<f64>>)>; 3]);

impl LastThree {
    /// Takes a bearing in; returns the squared third difference of it and the three before by the
    /// reported noise (two degrees of freedom where that is honest), where none lies further from
    /// the next than `longest_s`. `expected` is the direction in which the track has the target at
    /// a time.
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
        for (i, (then, direction)) in seen.into_iter().enumerate() {
            let others = (0..seen.len()).filter(|k| *k != i);
            let weight = others.map(|k| (ages[i] - ages[k]).recip()).product::<f64>();
            let off = direction.into_inner() - expected(then)?.into_inner();
            difference += line.basis.transpose() * off * weight;
            draws += weight * weight;
        }
        Some(difference.norm_squared() / (draws * line.covariance.trace() / 2.0))
    }
}

/// How often a camera's reported covariances count, by a running median of its third differences:
/// one bearing in ten may be no target's.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct WhiteNoise {
    log_factor: f64,
    draws: f64,
}

impl WhiteNoise {
    /// Takes a squared third difference in.
    pub(crate) fn see(&mut self, squared: f64) {
        self.draws = (self.draws + 1.0).min(MEMORY);
        let above = if squared > MEDIAN * self.log_factor.exp() { 0.5 } else { -0.5 };
        self.log_factor += above / (SLOPE * self.draws.max(10.0));
    }

    /// How many times the reported covariance the noise is; 1 as long as that is not clear, and
    /// where it is less: what a camera reports holds errors that last longer than four pictures,
    /// too.
    pub(crate) fn factor(&self) -> f64 {
        let is_clear = self.log_factor * self.draws.sqrt() > DOUBT * ERROR_OF_ONE;
        if is_clear { self.log_factor.exp() } else { 1.0 }
    }
}
