//! Whether lines of several cameras are one target's, or each camera sees another.

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};

use super::sight::Sight;
use crate::prediction::BearingPrediction;
use crate::spatial::TYPICAL_SPEED;
use crate::visibility::independent_share;

/// Logarithm of the probability that a camera is blind for a target that it should see.
const LOG_NEVER_DETECTED: f64 = -4.6;
/// A camera whose clock shifts its bearings by so many times their own variance agrees with
/// nothing.
const INCONCLUSIVE: f64 = 10.0;

/// How much likelier it is that lines are one target's than that every camera sees a target of its
/// own, which no other camera sees.
///
/// Against clutter any line that goes on smoothly is a target's. But where there are many targets
/// that one camera each sees, their lines cross, and only how well these agree with one place and
/// velocity tells: one target has six numbers, two lines have four each.
#[derive(Clone, Debug)]
pub(super) struct OneTargetTest {
    sights: Vec<(CameraName, Sight)>,
    /// Cameras that should see the target and never have, with the logarithm of that probability.
    silent: Vec<(CameraName, f64)>,
    log_ratio: f64,
    /// Whether clocks are so uncertain that it says nothing.
    inconclusive: bool,
}

impl OneTargetTest {
    /// Of the lines of a beginning, with its log-likelihood ratio; the target may be as fast as
    /// `speed` (m/s, standard deviation) at a place.
    pub(super) fn begin<'a>(
        lines: impl Iterator<Item = (&'a CameraName, &'a SightLine, Timestamp)>,
        (place, speed): (nalgebra::Point3<f64>, f64),
        log_ratio: f64,
    ) -> Self {
        let sight = |(camera, line, time): (&CameraName, &SightLine, Timestamp)| {
            let range = (place - line.origin).norm();
            (camera.clone(), Sight::first(line, time, speed / range))
        };
        Self {
            sights: lines.map(sight).collect(),
            silent: Vec::new(),
            log_ratio,
            inconclusive: false,
        }
    }

    /// Of what one camera has followed so far.
    pub(super) fn of_one(camera: &CameraName, sight: Sight) -> Self {
        Self {
            sights: vec![(camera.clone(), sight)],
            silent: Vec::new(),
            log_ratio: 0.0,
            inconclusive: false,
        }
    }

    /// Learns what a camera shifts its first line by, of which the target's place has been made.
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

    /// Whether a camera has given it a line.
    pub(super) fn knows(&self, camera: &CameraName) -> bool {
        self.sights.iter().any(|(name, _)| name == camera)
    }

    /// A camera's first line, with its log-likelihood ratio; the target may move across it at
    /// `rate_sd` (rad/s).
    pub(super) fn see_first(
        &mut self,
        camera: &CameraName,
        (line, time): (&SightLine, Timestamp),
        rate_sd: f64,
        first_ratio: f64,
    ) {
        self.log_ratio += first_ratio;
        self.sights.push((camera.clone(), Sight::first(line, time, rate_sd)));
    }

    /// A line that goes on with the target as predicted. `first_ratio` is its log-likelihood ratio
    /// where it is its camera's first.
    pub(super) fn see(
        &mut self,
        camera: &CameraName,
        (line, time, time_sd_s): (&SightLine, Timestamp, f64),
        prediction: &BearingPrediction,
        (density, speed): (f64, f64),
        first_ratio: f64,
    ) {
        let range = prediction.range();
        let Some((_, sight)) = self.sights.iter_mut().find(|(name, _)| name == camera) else {
            return self.see_first(camera, (line, time), speed / range, first_ratio);
        };
        sight.predict(time, density / range.powi(2));
        self.log_ratio += sight.log_ratio(line, prediction).unwrap_or(0.0);
        // What an unsure clock shifts a bearing by is not known before the velocity is.
        let clock = (speed * TYPICAL_SPEED * time_sd_s / range).powi(2);
        self.inconclusive |= clock > INCONCLUSIVE * line.covariance.trace() / 2.0;
        sight.update(line);
    }

    /// A camera that should have seen the target has not, `interval_s` after its exposure before.
    pub(super) fn miss(&mut self, camera: &CameraName, log_miss: f64, interval_s: f64) {
        if self.sights.iter().any(|(name, _)| name == camera) {
            return;
        }
        let more = log_miss * independent_share(interval_s);
        match self.silent.iter_mut().find(|(name, _)| name == camera) {
            Some((_, log)) => *log = (*log + more).max(LOG_NEVER_DETECTED),
            None => self.silent.push((camera.clone(), more.max(LOG_NEVER_DETECTED))),
        }
    }

    /// The log-likelihood ratio; `None` if clocks are too uncertain for it.
    pub(super) fn log_ratio(&self) -> Option<f64> {
        if self.inconclusive {
            return None;
        }
        let never = |camera: &CameraName| self.sights.iter().all(|(name, _)| name != camera);
        let silent = self.silent.iter().filter(|(camera, _)| never(camera));
        Some(self.log_ratio + silent.map(|(_, log)| log).sum::<f64>())
    }
}
