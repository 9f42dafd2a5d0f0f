//! The innovation of a bearing: measured less predicted.

use crossfix_filter::KinematicState;
use crossfix_geometry::{BearingModel, SightLine};
use crossfix_message::Timestamp;
use nalgebra::Vector2;

use super::{FusedTrack, TrackBearing};
use crate::motion::{ManoeuvreDetector, MotionSetup};
use crate::prediction::MahalanobisDistance;
use crate::uncertainty::{CameraUncertainty, SharedErrors};

/// The innovation of a bearing.
pub(super) struct BearingInnovation {
    pub(super) residual: Vector2<f64>,
    pub(super) model: BearingModel,
}

/// A bearing, and the predicted state at its time.
struct Against<'a> {
    before: &'a KinematicState,
    line: &'a SightLine,
    uncertainty: &'a CameraUncertainty,
}

impl Against<'_> {
    /// The distance of an innovation, by what is known of the camera's errors.
    fn distance(
        &self,
        innovation: &BearingInnovation,
        errors: &SharedErrors,
    ) -> Option<MahalanobisDistance> {
        let BearingInnovation { residual, model } = innovation;
        let by = model.by_position();
        let shifts = self.uncertainty.shifts(model, self.before.velocity());
        // S = H P H' + H X J' + J X' H' + J W J' + f R: the camera's errors (effect J, covariance
        // W) are in the bearing and, by the camera's earlier bearings (X), also in the track.
        let cross = by * errors.ties.fixed_rows::<3>(0) * shifts.transpose();
        let spread = by * self.before.position_covariance() * by.transpose()
            + cross
            + cross.transpose()
            + errors.spread(&shifts)
            + model.covariance_of(self.line) * self.uncertainty.factor;
        // z - J E(s).
        let residual = residual - shifts * errors.mean;
        let factor = spread.cholesky()?;
        let squared = residual.dot(&factor.solve(&residual));
        Some(MahalanobisDistance { squared, determinant: factor.determinant() })
    }

    /// Logarithm of the likelihood of errors that have this probability; the constant 2 pi is left
    /// out, which is common to all.
    fn log_likelihood(
        &self,
        innovation: &BearingInnovation,
        errors: &SharedErrors,
        probability: f64,
    ) -> Option<f64> {
        let MahalanobisDistance { squared, determinant } = self.distance(innovation, errors)?;
        Some(probability.ln() - (squared + determinant.ln()) / 2.0)
    }
}

impl FusedTrack {
    /// The innovation of a bearing; `None` if it points away from the target.
    pub(super) fn innovation(
        &self,
        time: Timestamp,
        line: &SightLine,
    ) -> Option<BearingInnovation> {
        let model = BearingModel::new(line.origin, self.position_at(time))?;
        Some(BearingInnovation { residual: model.residual(line)?, model })
    }

    /// The innovation's squared Mahalanobis distance; the reported covariance counts by the factor
    /// that was found for the camera.
    fn nis(
        &self,
        innovation: &BearingInnovation,
        bearing: &TrackBearing<'_>,
        motion: &MotionSetup,
    ) -> Option<f64> {
        let TrackBearing { camera, time, line, uncertainty } = *bearing;
        let interval = time.seconds_since(self.updated_at);
        let before = self.imm.predicted(interval, motion.models(self.ranged));
        let errors = self.errors_of(camera, interval);
        let against = Against { before: &before, line, uncertainty };
        Some(against.distance(innovation, &errors)?.squared)
    }

    /// What is known of a camera's errors if this bearing makes it likelier that the lasting ones
    /// have been drawn again; `None` if it does not.
    pub(super) fn renewed(
        &self,
        innovation: &BearingInnovation,
        bearing: &TrackBearing<'_>,
        errors: &SharedErrors,
        motion: &MotionSetup,
    ) -> Option<SharedErrors> {
        let (drawn_again, probability) = errors.renewed()?;
        let TrackBearing { time, line, uncertainty, .. } = *bearing;
        let interval = time.seconds_since(self.updated_at);
        let before = self.imm.predicted(interval, motion.models(self.ranged));
        let against = Against { before: &before, line, uncertainty };
        let went_on = against.log_likelihood(innovation, errors, 1.0 - probability);
        (against.log_likelihood(innovation, &drawn_again, probability) > went_on)
            .then_some(drawn_again)
    }

    /// Whether the manoeuvre detector fires on a bearing.
    pub(super) fn sees_manoeuvre(
        &mut self,
        innovation: &BearingInnovation,
        bearing: &TrackBearing<'_>,
        motion: &MotionSetup,
    ) -> bool {
        let nis = matches!(self.detector, Some(ManoeuvreDetector::Innovation(_)))
            .then(|| self.nis(innovation, bearing, motion))
            .flatten();
        match &mut self.detector {
            Some(ManoeuvreDetector::Residual(detector)) => {
                // In the axes of the world, so that residuals of different cameras can be averaged.
                let spread = bearing.line.standard_deviation();
                detector.see(innovation.model.basis * innovation.residual / spread)
            }
            Some(ManoeuvreDetector::Innovation(detector)) => {
                nis.is_some_and(|nis| detector.see(nis, 2))
            }
            None => false,
        }
    }
}
