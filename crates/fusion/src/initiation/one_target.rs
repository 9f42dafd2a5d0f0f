//! Test whether lines of several cameras belong to one target, or each camera sees a target of its
//! own.

use crossfix_geometry::SightLine;
use crossfix_message::CameraName;
use nalgebra::Point3;

use super::NamedLine;
use super::sight::DirectionFilter;
use crate::evidence::ONE_IN_A_HUNDRED;
use crate::prediction::BearingPrediction;
use crate::spatial::{LineId, TYPICAL_SPEED, TimedLine};
use crate::track::TrackBearing;
use crate::visibility::independent_share;

/// If the clock's uncertainty shifts a camera's bearings by a variance of more than this many times
/// their own, the test says nothing. With half of it clocks that are 0.7 times as uncertain let
/// lines that cross by chance pass untested.
const INCONCLUSIVE: f64 = 10.0;

/// How a target may move.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mobility {
    /// Density of its acceleration, m^2/s^3.
    pub(super) density: f64,
    /// Standard deviation of its speed, m/s.
    pub(super) speed: f64,
}

/// Log-likelihood ratio of all lines being one target's against every camera seeing a target of its
/// own that no other camera sees, or clutter.
///
/// Against clutter, any line that continues smoothly is a target's. But if there are many targets
/// that one camera each sees, their lines cross, and only how well the lines agree with one
/// position and velocity decides: one target has six numbers, two independent lines have four each.
#[derive(Clone, Debug)]
pub(super) struct OneTargetTest {
    /// Each camera's lines, followed as if that camera alone saw the target.
    sights: Vec<(CameraName, DirectionFilter)>,
    /// Cameras that should see the target and never have, with the log-likelihood of their misses.
    silent: Vec<(CameraName, f64)>,
    log_ratio: f64,
    /// Whether clocks are so uncertain that the test says nothing.
    inconclusive: bool,
}

impl OneTargetTest {
    /// The test for the lines of a seed, with its log-likelihood ratio; at `place` the target may
    /// have a speed of `speed` (m/s, standard deviation).
    pub(super) fn begin(
        lines: &[NamedLine],
        place: Point3<f64>,
        speed: f64,
        log_ratio: f64,
    ) -> Self {
        let sights = lines.iter().map(|(LineId { camera, .. }, TimedLine { line, time, .. })| {
            // A speed of v across the line turns it at v / r.
            let range = (place - line.origin).norm();
            (camera.clone(), DirectionFilter::first(line, *time, speed / range))
        });
        Self { sights: sights.collect(), silent: Vec::new(), log_ratio, inconclusive: false }
    }

    /// The test for what one camera alone has followed so far.
    pub(super) fn of_one(camera: &CameraName, sight: DirectionFilter) -> Self {
        Self {
            sights: vec![(camera.clone(), sight)],
            silent: Vec::new(),
            log_ratio: 0.0,
            inconclusive: false,
        }
    }

    /// Estimates a camera's shift from the first line, one of those that the target's position was
    /// made from.
    pub(super) fn begin_shift(
        &mut self,
        camera: &CameraName,
        line: &SightLine,
        prediction: &BearingPrediction,
    ) {
        if let Some((_, sight)) = self.sights.iter_mut().find(|(name, _)| name == camera) {
            sight.begin_shift(line, prediction);
        }
    }

    /// Whether a line of this camera has been used.
    pub(super) fn knows(&self, camera: &CameraName) -> bool {
        self.sights.iter().any(|(name, _)| name == camera)
    }

    /// Adds a camera's first line, with its log-likelihood ratio; the target may move across it at
    /// `rate_sd` (rad/s, standard deviation).
    pub(super) fn see_first(
        &mut self,
        TrackBearing { camera, time, line, .. }: &TrackBearing<'_>,
        rate_sd: f64,
        first_ratio: f64,
    ) {
        self.log_ratio += first_ratio;
        self.sights.push(((*camera).clone(), DirectionFilter::first(line, *time, rate_sd)));
    }

    /// Adds a line that continues the target as predicted. `ratio` is its log-likelihood ratio
    /// against clutter (where a target is handed over, against another thing in the view). It is
    /// all that a camera's first line says, and no later one says more: what continues no object
    /// that the camera alone sees may still be clutter.
    pub(super) fn see(
        &mut self,
        bearing: &TrackBearing<'_>,
        prediction: &BearingPrediction,
        Mobility { density, speed }: Mobility,
        ratio: f64,
    ) {
        let TrackBearing { camera, time, line, uncertainty } = *bearing;
        let range = prediction.range();
        let Some((_, sight)) = self.sights.iter_mut().find(|(name, _)| name == camera) else {
            return self.see_first(bearing, speed / range, ratio);
        };
        sight.predict(time, density / range.powi(2));
        self.log_ratio += sight.log_ratio(line, prediction).unwrap_or(0.0).min(ratio);
        // The shift by an uncertain clock is not known before the velocity is: use a typical speed.
        // Var = (v sd(t) / r)^2 per tangent.
        let clock = (speed * TYPICAL_SPEED * uncertainty.time_sd_s / range).powi(2);
        self.inconclusive |= clock > INCONCLUSIVE * line.covariance.trace() / 2.0;
        sight.update(line);
    }

    /// Notes that a camera that should have seen the target has not, `interval_s` seconds after its
    /// exposure before.
    pub(super) fn miss(&mut self, camera: &CameraName, log_miss: f64, interval_s: f64) {
        if self.sights.iter().any(|(name, _)| name == camera) {
            return;
        }
        // Exposures close together count as one look, and all of them no more than that the camera
        // never detects this target.
        let more = log_miss * independent_share(interval_s);
        match self.silent.iter_mut().find(|(name, _)| name == camera) {
            Some((_, log)) => *log = (*log + more).max(ONE_IN_A_HUNDRED),
            None => self.silent.push((camera.clone(), more.max(ONE_IN_A_HUNDRED))),
        }
    }

    /// The log-likelihood ratio; `None` if the clocks are too uncertain for it.
    pub(super) fn log_ratio(&self) -> Option<f64> {
        if self.inconclusive {
            return None;
        }
        let never = |camera: &CameraName| self.sights.iter().all(|(name, _)| name != camera);
        let silent = self.silent.iter().filter(|(camera, _)| never(camera));
        Some(self.log_ratio + silent.map(|(_, log)| log).sum::<f64>())
    }
}
