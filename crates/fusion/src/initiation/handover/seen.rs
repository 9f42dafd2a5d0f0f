//! A direction that one camera alone follows.

use std::collections::BTreeSet;

use crossfix_filter::KinematicState;
use crossfix_geometry::{BearingModel, Ray, SightLine, passing_ranges};
use crossfix_message::{CameraName, Cued, Solver, Timestamp};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use super::super::one_target::OneTargetTest;
use super::super::sight::DirectionFilter;
use super::Rules;
use super::reading::{Reading, ReadingContext};
use crate::comparison::Comparison;
use crate::cueing::CueTarget;
use crate::evidence::ONE_IN_A_HUNDRED;
use crate::motion::MotionSetup;
use crate::spatial::{Fix, Observability, TimedLine, VelocityKnowledge};
use crate::track::FusedTrack;
use crate::uncertainty::CameraUncertainty;
use crate::{Exposure, Tracking};

/// Standard deviation of a direction's turning rate, rad/s: 45 m/s at 150 m. With half of it, what
/// flies past a camera is lost again and again; with twice as much, other objects are taken
/// for it.
const TURNING_SD: f64 = 0.3;
/// White acceleration of a direction, rad^2/s^3: 7 m^2/s^3 at 150 m, which is lively. With half of
/// it, what turns hard is lost; with twice as much, two directions are too soon alike.
const TURNING_DENSITY: f64 = 3e-4;
/// Standard deviation of the logarithm of an unknown range: the density at its middle is as if all
/// ranges over a factor of 150 were equally likely. With half of it (a factor of 12) lines that
/// cross by chance gain 0.7 in log-likelihood.
const UNKNOWN_LOG_RANGE_SD: f64 = 2.0;

/// A direction that one camera alone follows, at the time of its last line.
#[derive(Clone, Debug)]
pub(super) struct SeenDirection {
    /// Its number: tells directions apart that begin with the same exposure.
    pub(super) number: u64,
    /// The number of the camera's own image track.
    pub(super) image_track: u64,
    pub(super) sight: DirectionFilter,
    /// Time of its first line.
    pub(super) first: Timestamp,
    /// Its last line, with the uncertainty of the camera's pose included in the line's covariance,
    /// the pose's part of that (variance, rad^2), ...
    pub(super) line: TimedLine,
    pub(super) pose_variance: f64,
    /// ... and the camera's uncertainty.
    pub(super) uncertainty: CameraUncertainty,
    /// Log-likelihood ratio of a target, at whatever position, against clutter.
    pub(super) score: f64,
    /// Number of its lines so far, ...
    pub(super) lines: f64,
    /// ... of the exposures between them without a line, ...
    pub(super) gaps: f64,
    /// ... and of those since the last line.
    pub(super) missed: f64,
    /// The ways in which other cameras may have seen the target since, ...
    pub(super) readings: Vec<Reading>,
    /// ... and the numbers of the directions tried: one that is refuted is not tried again.
    pub(super) tried: BTreeSet<u64>,
}

impl SeenDirection {
    pub(super) fn first(number: u64, line: TimedLine, exposure: &Exposure, index: usize) -> Self {
        let time = exposure.time;
        Self {
            number,
            image_track: exposure.sightings[index].image_track,
            sight: DirectionFilter::first(&exposure.sightings[index].line, time, TURNING_SD),
            first: time,
            pose_variance: pose_variance(&line, exposure, index),
            line,
            uncertainty: exposure.uncertainty,
            score: 0.0,
            lines: 1.0,
            gaps: 0.0,
            missed: 0.0,
            readings: Vec::new(),
            tried: BTreeSet::new(),
        }
    }

    /// Whether the camera no longer sees it: it has missed it more often than happens by chance, or
    /// is silent itself.
    pub(super) fn is_lost(&self, now: Timestamp, tracking: &Tracking) -> bool {
        // The camera's own share of detections so far; n misses have the probability (1 - share)^n.
        let share = (self.lines / (self.lines + self.gaps)).min(tracking.detection_probability);
        let is_silent = now.seconds_since(self.sight.time) > tracking.coasting_after_s;
        is_silent || self.missed * (1.0 - share).ln() <= ONE_IN_A_HUNDRED
    }

    /// Whether it is confirmed to be something, and not the camera's false alarms.
    pub(super) fn is_sure(&self, tracking: &Tracking) -> bool {
        self.score >= tracking.confirm_score
    }

    /// Whether it is still of use: not if it has been silent for as long as a track would be kept,
    /// nor if it was lost before it was sure.
    pub(super) fn is_worth_keeping(&self, now: Timestamp, rules: &Rules) -> bool {
        let silent_s = now.seconds_since(self.sight.time);
        if self.is_sure(&rules.tracking) {
            silent_s <= rules.tracking.lost_after_s || !self.readings.is_empty()
        } else {
            silent_s <= rules.pair_s || !self.is_lost(now, &rules.tracking)
        }
    }

    /// Its prediction for cueing, as `camera` follows it, if its unknown range is about `range`
    /// (m).
    pub(super) fn cue_target(
        &self,
        camera: &CameraName,
        now: Timestamp,
        range: f64,
        speed: f64,
    ) -> Option<CueTarget> {
        let state = self.state_at(range, speed)?;
        let of = Cued { track_id: 0, camera: camera.to_string(), image_track_id: self.image_track };
        let seen_from = Some(self.line.line.origin);
        Some(CueTarget::new(of, now, seen_from, |time| {
            let ahead_s = time.seconds_since(self.sight.time);
            state.predicted(ahead_s, TURNING_DENSITY * range.powi(2))
        }))
    }

    /// The direction predicted to a time.
    pub(super) fn at(&self, time: Timestamp) -> DirectionFilter {
        let mut sight = self.sight.clone();
        sight.predict(time, TURNING_DENSITY);
        sight
    }

    /// The reading that what `camera` has followed alone is now seen in the exposure's line of this
    /// index. `None` if the two do not meet, or the numbers fail.
    pub(super) fn read_in(
        &self,
        camera: &CameraName,
        index: usize,
        context: &ReadingContext<'_>,
        rules: &Rules,
    ) -> Option<Reading> {
        let Comparison { exposure, motion, .. } = context.comparison;
        let line = &exposure.sightings[index].line;
        let track = self.placed(camera, line, exposure.time, rules, motion)?;
        let one_target = OneTargetTest::of_one(camera, self.sight.clone());
        Reading::begin((camera.clone(), self.number), track, one_target, index, context, rules)
    }

    /// A track of it, as `camera` has followed it, at the position where its direction at a time
    /// crosses another camera's line. `None` if the lines do not cross within range in front of
    /// both cameras.
    fn placed(
        &self,
        camera: &CameraName,
        line: &SightLine,
        time: Timestamp,
        rules: &Rules,
        motion: &MotionSetup,
    ) -> Option<FusedTrack> {
        let Self { sight, line: last, uncertainty, .. } = self;
        let max_range_m = rules.comparison.max_range_m;
        let by_now = Ray { origin: last.line.origin, direction: self.at(time).direction };
        let [range, there] = passing_ranges(by_now, line.ray());
        if ![range, there].iter().all(|range| (f64::MIN_POSITIVE..=max_range_m).contains(range)) {
            return None;
        }
        let state = self.state_at(range, rules.speed)?;
        let observability = Observability::unexamined(6);
        let (velocity, solver) = (VelocityKnowledge::Solved, Solver::Map);
        let fix = Fix { time: sight.time, state, velocity, solver, observability };
        Some(FusedTrack::start_alone(&fix, camera, last, *uncertainty, motion))
    }

    /// Its position and velocity at its last line, if its unknown range is about `range` (m). The
    /// target's speed along the direction has a standard deviation of `speed` (m/s).
    pub(super) fn state_at(&self, range: f64, speed: f64) -> Option<KinematicState> {
        let Self { sight, line: last, .. } = self;
        let along = sight.direction.into_inner();
        // v = r (I - u u') w: the turning rate across the direction, times the range.
        let velocity = (sight.rate - along * along.dot(&sight.rate)) * range;
        let model = BearingModel::new(last.line.origin, last.line.origin + along * range)?;
        let [across, along_squared] =
            [model.basis * model.basis.transpose(), along * along.transpose()];
        // A relative error of the range moves the position along the direction by that share, and
        // scales the velocity by it: d(p, v) = (u r, v) d(ln r).
        let scale = stacked(along * range, velocity) * UNKNOWN_LOG_RANGE_SD;
        let direction_variance = sight.variance + self.pose_variance;
        let (tie, turning) = (sight.tie, sight.rate_variance);
        let mut covariance = scale * scale.transpose();
        // Across the direction: the filter's covariance of direction and rate times r^2.
        let tied = across * (tie * range.powi(2));
        add_block(&mut covariance, [0, 0], across * (direction_variance * range.powi(2)));
        add_block(&mut covariance, [0, 3], tied);
        add_block(&mut covariance, [3, 0], tied);
        let turning = across * (turning * range.powi(2)) + along_squared * speed.powi(2);
        add_block(&mut covariance, [3, 3], turning);
        let mean = stacked(last.line.origin.coords + along * range, velocity);
        Some(KinematicState { mean, covariance })
    }
}

/// Variance that the pose's uncertainty adds to a line along each tangent, rad^2.
pub(super) fn pose_variance(with_pose: &TimedLine, exposure: &Exposure, index: usize) -> f64 {
    let own = exposure.sightings[index].line.covariance * exposure.uncertainty.factor;
    (with_pose.line.covariance - own).trace().max(0.0) / 2.0
}

/// Adds a block to a covariance, from this row and column on.
fn add_block(to: &mut Matrix6<f64>, [row, column]: [usize; 2], block: Matrix3<f64>) {
    let mut view = to.fixed_view_mut::<3, 3>(row, column);
    view += block;
}

fn stacked(place: Vector3<f64>, velocity: Vector3<f64>) -> Vector6<f64> {
    let mut both = Vector6::zeros();
    both.fixed_rows_mut::<3>(0).copy_from(&place);
    both.fixed_rows_mut::<3>(3).copy_from(&velocity);
    both
}
