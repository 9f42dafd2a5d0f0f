//! The Cramer-Rao bound of a straight flight.

use crossfix_fusion::spatial::TimedLine;
use crossfix_message::Timestamp;
use nalgebra::{Matrix2x6, Matrix3, Matrix6};

use super::site::Target;

/// The least covariance of position and velocity at a time that any unbiased estimator can have from
/// sight lines of a target: the inverse of their Fisher information at the truth. `None` if they do
/// not determine the six.
pub(super) fn bound(lines: &[TimedLine], target: &Target, reference: Timestamp) -> Option<Matrix6<f64>> {
    let mut information = Matrix6::zeros();
    for TimedLine { line, time } in lines {
        let offset = target.at(time.seconds()) - line.origin;
        let range = offset.norm();
        let direction = offset / range;
        let across = (Matrix3::identity() - direction * direction.transpose()) / range;
        let position = line.basis.transpose() * across;
        let mut derivative = Matrix2x6::zeros();
        derivative.fixed_view_mut::<2, 3>(0, 0).copy_from(&position);
        let dt = time.seconds_since(reference);
        derivative.fixed_view_mut::<2, 3>(0, 3).copy_from(&(position * dt));
        information += derivative.transpose() * line.covariance.try_inverse()? * derivative;
    }
    information.try_inverse()
}
