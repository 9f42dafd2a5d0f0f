use crossfix_geometry::passing_ranges;

use crate::Initiation;
use crate::spatial::{TYPICAL_SPEED, TimedLine};

/// Lines of one target pass each other within this many standard deviations of noise and motion.
/// With half of it some true pairs are left out, and their targets are found a period later; with
/// twice as much, twice as many pairs of lines of two targets are tried.
const SIGMAS: f64 = 3.0;

/// How two lines pass each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Passing {
    /// They come near each other behind a camera, or too far away.
    Nowhere,
    /// Farther apart than the lines of one moving target may be.
    Apart {
        /// The smallest distance, m.
        by_m: f64,
    },
    /// As closely as the lines of one moving target may.
    Close,
}

/// Parameters of the comparison.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Passings {
    max_range_m: f64,
    /// Speed of targets, m/s, standard deviation per axis.
    speed: f64,
}

impl Passings {
    pub(crate) fn new(config: &Initiation) -> Self {
        Self { max_range_m: config.max_range_m, speed: config.velocity_prior_sd_mps }
    }

    /// How two lines pass each other: compared with what one moving target allows.
    pub(crate) fn of(&self, first: &TimedLine, second: &TimedLine) -> Passing {
        let (u, v) = (&first.line.direction, &second.line.direction);
        let base = second.line.origin - first.line.origin;
        let [r1, r2] = passing_ranges(first.line.ray(), second.line.ray());
        let in_range = |r: f64| r > 0.0 && r < self.max_range_m;
        if !(in_range(r1) && in_range(r2)) {
            return Passing::Nowhere;
        }
        // Distance between the points at which the lines pass nearest to each other.
        let by_m = (u.into_inner() * r1 - v.into_inner() * r2 - base).norm();
        // Allowed distance between lines of one target: noise at their ranges, position errors of
        // the cameras, and the target's motion between the two times.
        let noise = first.line.standard_deviation() * r1 + second.line.standard_deviation() * r2;
        let poses = first.origin_sd_m + second.origin_sd_m;
        let unsure = TYPICAL_SPEED * (first.time_sd_s + second.time_sd_s);
        let between = second.time.seconds_since(first.time).abs() + unsure;
        let motion = self.speed * between;
        if by_m <= SIGMAS * (noise + poses + motion) {
            Passing::Close
        } else {
            Passing::Apart { by_m }
        }
    }
}
