//! What a camera should see of a track.

use crossfix_filter::{Gate, KinematicState};
use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::Point3;

use super::{Track, log_range_sd};
use crate::motion::Motion;
use crate::prediction::{BearingPrediction, Fit};
use crate::uncertainty::{CameraUncertainty, SharedErrors};
use crate::update::{Measured, Updated, VAGUE_LOG_RANGE_SD, updated};

/// What a camera should see of a track.
// Made and used in one exposure: never stored, so the size of the larger variant costs nothing.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub(crate) enum Expectation {
    /// The range is known: one direction with its covariance.
    Near(BearingPrediction),
    /// It is not: a stripe along another camera's sight line. Each bearing is tried by an update.
    Along {
        /// The track's state at the exposure's time.
        state: KinematicState,
        /// Where the camera stands that follows the target.
        seen_from: Point3<f64>,
        /// The camera that looks now, ...
        camera: CameraUncertainty,
        /// ... and what the track knows of its errors.
        errors: SharedErrors,
    },
}

impl Expectation {
    /// How a bearing fits; `None` if it lies outside the gate.
    pub(crate) fn fit(&self, line: &SightLine, gate: Gate) -> Option<Fit> {
        match self {
            Self::Near(prediction) => prediction.fit(line, gate),
            Self::Along { state, seen_from, camera, errors } => {
                let fit = |errors: &SharedErrors| {
                    let Updated { nis, log_likelihood, .. } =
                        updated(state, Some(*seen_from), &Measured { line, camera, errors })?;
                    let fit = Fit { gate_distance: nis, log_density: log_likelihood };
                    gate.holds(nis).then_some(fit)
                };
                let Some((anew, probability)) = errors.renewed() else { return fit(errors) };
                Fit::likelier(fit(errors), fit(&anew), probability)
            }
        }
    }
}

impl Track {
    /// What a camera at `origin` should see at a time.
    pub(crate) fn expectation(
        &self,
        time: Timestamp,
        (camera, origin): (&CameraName, Point3<f64>),
        uncertainty: &CameraUncertainty,
        motion: &Motion,
    ) -> Option<Expectation> {
        let interval = time.seconds_since(self.updated);
        let errors = self.errors_of(camera, interval);
        let follower = self.follower.filter(|follower| !self.held && *follower != origin);
        if let Some(seen_from) = follower {
            let state = self.predicted(time, motion);
            if log_range_sd(&state, seen_from) > VAGUE_LOG_RANGE_SD {
                return Some(Expectation::Along { state, seen_from, camera: *uncertainty, errors });
            }
        }
        let models = motion.models(self.ranged);
        BearingPrediction::new(&self.imm, interval, models, origin, uncertainty, &errors)
            .map(Expectation::Near)
    }
}
