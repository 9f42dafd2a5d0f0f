//! The target's trajectory before all cameras are known: by a log, or by two cameras.

use std::ops::Range;

use nalgebra::{Point3, Vector3};

use super::adjustment::{self, NEARLY_SETTLED};
use super::model::{FlightLog, LogErrors};
use super::settle::jerk;
use super::spline::{KNOT_S, TrajectorySpline, Weights};
use super::state::{Flight, FlightState, Priors, RATE_SD};
use crate::survey::Survey;

/// Between samples farther apart than this the target's place counts as unknown, s, ...
const GAP_S: f64 = 1.0;
/// ... if they are also farther apart than this many times the median interval. With half of both
/// one lost sample is a gap in a log of one sample per second.
const GAP_STEPS: f64 = 2.5;

/// A trajectory, with the times at which it is known.
#[derive(Clone, Debug)]
pub(super) struct Course {
    pub(super) way: TrajectorySpline,
    /// Power of its jerk, m^2/s^5.
    pub(super) jerk: f64,
    pub(super) errors: LogErrors,
    times_s: Vec<f64>,
    gap_s: f64,
}

impl Course {
    /// From a log alone. `None`: the adjustment has no solution.
    pub(super) fn of(log: &FlightLog) -> Option<Self> {
        /// Rounds of trajectory and jerk by turns. With half of them a first value that is far off
        /// may still show.
        const ROUNDS: usize = 12;
        /// Power of the jerk that is begun with, m^2/s^5: with half of it the same, as rounds find
        /// it.
        const FIRST_JERK: f64 = 10.0;
        let (from, to) = (log.samples.first()?.time_s, log.samples.last()?.time_s);
        let flight = Flight { cameras: &[], log: Some(log), survey: &Survey::default() };
        let way = TrajectorySpline::over(from, to + KNOT_S);
        let bias = vec![way.drift(); 3];
        let mut state = FlightState { way, cameras: Vec::new(), bias };
        let mut priors = Priors { jerk: FIRST_JERK, rate_sd: RATE_SD, cameras: Vec::new() };
        // The jerk's power and the trajectory by turns: each is estimated with the other as it is.
        for _ in 0..ROUNDS {
            let adjusted = adjustment::adjust(&flight, &priors, state, NEARLY_SETTLED)?;
            priors.jerk = jerk(&adjusted);
            state = adjusted.state;
        }
        let times_s: Vec<f64> = log.samples.iter().map(|sample| sample.time_s).collect();
        Some(Self::along(state.way, priors.jerk, log.errors, times_s))
    }

    /// From a trajectory that is known at these times, in order.
    pub(super) fn along(
        way: TrajectorySpline,
        jerk: f64,
        errors: LogErrors,
        times_s: Vec<f64>,
    ) -> Self {
        let mut steps: Vec<f64> = times_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
        steps.sort_unstable_by(f64::total_cmp);
        let usual = steps.get(steps.len() / 2).copied().unwrap_or(0.0);
        Self { way, jerk, errors, times_s, gap_s: GAP_S.max(GAP_STEPS * usual) }
    }

    /// The spline's weights at a time; `None` where the trajectory is not known.
    pub(super) fn weights(&self, time_s: f64) -> Option<Weights> {
        let next = self.times_s.partition_point(|known| *known < time_s);
        let (before, after) = (self.times_s.get(next.wrapping_sub(1)), self.times_s.get(next));
        // Between two known times the gap decides; beyond the ends one knot's spacing is allowed.
        let is_known = match (before, after) {
            (Some(before), Some(after)) => after - before <= self.gap_s,
            (_, Some(after)) => *after - time_s < KNOT_S,
            (Some(before), _) => time_s - before < KNOT_S,
            (None, None) => false,
        };
        is_known.then(|| self.way.weights(time_s))?
    }

    /// The target's place at a time; `None` where the trajectory is not known.
    pub(super) fn place_at(&self, time_s: f64) -> Option<Point3<f64>> {
        self.weights(time_s).map(|weights| self.way.place(&weights))
    }

    /// A course that is known at no time.
    pub(super) fn nowhere() -> Self {
        let errors = LogErrors { sd_m: 1.0, drift_sd_m: 0.0, drift_time_s: 1.0 };
        Self::along(TrajectorySpline::over(0.0, 1.0), 1.0, errors, Vec::new())
    }

    /// Makes a spline follow the course. A smooth trajectory through an unknown stretch swings far
    /// out, and labels there would be left beside it.
    pub(super) fn lead(&self, way: &mut TrajectorySpline) {
        way.lead(|time_s| self.place_throughout(time_s));
    }

    /// The place at any time: as it is where it is known, straight from one known place to the
    /// next, and constant before the begin and after the end.
    fn place_throughout(&self, time_s: f64) -> Option<Vector3<f64>> {
        let known = |time_s: f64| Some(self.way.place_at(time_s)?.coords);
        if self.weights(time_s).is_some() {
            return known(time_s);
        }
        let next = self.times_s.partition_point(|known| *known < time_s);
        let before = next.checked_sub(1).map(|before| self.times_s[before]);
        match (before, self.times_s.get(next).copied()) {
            (Some(before), Some(after)) => {
                let share = (time_s - before) / (after - before);
                Some(known(before)?.lerp(&known(after)?, share))
            }
            (end, None) | (None, end) => known(end?),
        }
    }

    /// Range of its times, s.
    pub(super) fn range(&self) -> Range<f64> {
        self.way.range()
    }

    /// Its mirror image in a level plane.
    pub(super) fn mirrored(&self) -> Self {
        let mut mirrored = self.clone();
        mirrored.way.coefficients.iter_mut().for_each(|place| place.z = -place.z);
        mirrored
    }

    /// The median distance of the target from a place, m.
    pub(super) fn middle_distance(&self, place: Point3<f64>) -> f64 {
        let known = self.times_s.iter().filter_map(|time_s| self.way.place_at(*time_s));
        let mut distances: Vec<f64> = known.map(|known| (known - place).norm()).collect();
        distances.sort_unstable_by(f64::total_cmp);
        distances.get(distances.len() / 2).map_or(1.0, |distance| distance.max(1.0))
    }
}
