//! The predicted bearing of a track for one camera.

use crossfix_filter::{Gate, KinematicState};
use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::Point3;

use super::{FusedTrack, log_range_sd};
use crate::motion::MotionSetup;
use crate::prediction::{BearingFit, BearingPrediction};
use crate::uncertainty::{CameraUncertainty, SharedErrors};
use crate::update::{Measured, Updated, VAGUE_LOG_RANGE_SD, bearing_update};

/// Deviations of the logarithm of the range at which a target is looked for in a view. With half of
/// them one in three is hidden from a camera in whose view it is, until that has seen it twice;
/// with twice as much, false bearings at the border of a view are taken for a target that flies
/// beside it.
const RANGE_DEVIATIONS: [f64; 4] = [-2.0, -1.0, 1.0, 2.0];

/// The predicted bearing of a track for one camera.
// Made and used in one exposure: never stored, so the size of the larger variant costs nothing.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub(crate) enum TrackExpectation {
    /// The range is known: one predicted direction with its covariance.
    Near(BearingPrediction),
    /// The range is unknown: the prediction is a stripe along another camera's sight line, and each
    /// bearing is tried by an update.
    Along {
        /// The track's state at the exposure's time.
        state: KinematicState,
        /// Position of the camera that alone follows the target.
        seen_from: Point3<f64>,
        /// The uncertainty of the camera that is exposed now, ...
        camera: CameraUncertainty,
        /// ... and what the track knows of that camera's errors.
        errors: SharedErrors,
    },
}

impl TrackExpectation {
    /// How well a bearing fits; `None` if it lies outside the gate.
    pub(crate) fn fit(&self, line: &SightLine, gate: Gate) -> Option<BearingFit> {
        match self {
            Self::Near(prediction) => prediction.fit(line, gate),
            Self::Along { state, seen_from, camera, errors } => {
                let known = fit_along(state, *seen_from, &Measured { line, camera, errors }, gate);
                let Some((drawn_again, probability)) = errors.renewed() else { return known };
                let measured = Measured { line, camera, errors: &drawn_again };
                let renewed = fit_along(state, *seen_from, &measured, gate);
                BearingFit::likelier(known, renewed, probability)
            }
        }
    }
}

/// How well a bearing fits a target whose range from `seen_from` is uncertain; `None` if it lies
/// outside the gate.
fn fit_along(
    state: &KinematicState,
    seen_from: Point3<f64>,
    measured: &Measured<'_>,
    gate: Gate,
) -> Option<BearingFit> {
    let Updated { nis, log_likelihood, .. } = bearing_update(state, Some(seen_from), measured)?;
    let fit = BearingFit { gate_distance: nis, log_density: log_likelihood };
    gate.holds(nis).then_some(fit)
}

impl FusedTrack {
    /// Where the target may be at a time beside where it is expected: where one camera alone sees
    /// it, anywhere along that one's sight line within two standard deviations of the logarithm of
    /// the range.
    pub(crate) fn places_along(
        &self,
        time: Timestamp,
        motion: &MotionSetup,
    ) -> impl Iterator<Item = Point3<f64>> {
        let along = self.alone().map(|origin| {
            let state = self.predicted(time, motion);
            let (away, sd) = (state.position() - origin, log_range_sd(&state, origin));
            RANGE_DEVIATIONS.map(|deviations| origin + away * (deviations * sd).exp())
        });
        along.into_iter().flatten()
    }

    /// The predicted bearing at a time for a camera at `origin`; `None` if the target would be at
    /// the camera itself.
    pub(crate) fn expectation(
        &self,
        time: Timestamp,
        camera: &CameraName,
        origin: Point3<f64>,
        uncertainty: &CameraUncertainty,
        motion: &MotionSetup,
    ) -> Option<TrackExpectation> {
        let interval = time.seconds_since(self.updated_at);
        let errors = self.errors_of(camera, interval);
        // For the following camera itself the uncertain range moves no bearing: it has one
        // direction.
        let follower = self.alone().filter(|follower| *follower != origin);
        if let Some(seen_from) = follower {
            let state = self.predicted(time, motion);
            if log_range_sd(&state, seen_from) > VAGUE_LOG_RANGE_SD {
                return Some(TrackExpectation::Along {
                    state,
                    seen_from,
                    camera: *uncertainty,
                    errors,
                });
            }
        }
        let models = motion.models(self.ranged);
        BearingPrediction::new(&self.imm, interval, models, origin, uncertainty, &errors)
            .map(TrackExpectation::Near)
    }
}
