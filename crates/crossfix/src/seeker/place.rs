//! Predicted place of a target by a cue, and the distance of a track from it.

use crossfix_geometry::{Bearing, tangent_basis, turn_between, turn_vector};
use crossfix_message::{BearingTrack, Cue, Expected, Timestamp};
use nalgebra::{Matrix2, Rotation3, SymmetricEigen, Unit, Vector2, Vector3};

/// Predicted direction at a time, with covariance, in the camera's frame at rest.
#[derive(Clone, Copy, Debug)]
pub(super) struct PredictedDirection {
    pub(super) direction: Unit<Vector3<f64>>,
    /// Covariance along the tangents of the direction, rad^2.
    pub(super) covariance: Matrix2<f64>,
}

/// Long axis of the error ellipse, and its standard deviation, rad.
pub(super) fn long_axis(place: &PredictedDirection) -> (Vector3<f64>, f64) {
    let axes = SymmetricEigen::new(place.covariance);
    let (index, variance) = axes.eigenvalues.argmax();
    let axis = tangent_basis(&place.direction) * axes.eigenvectors.column(index);
    (axis, variance.max(0.0).sqrt())
}

/// Squared Mahalanobis distance of a track from the predicted place, d^2 = e' (P + R)^-1 e;
/// `turned` rotates the camera's frame to its frame at rest.
pub(super) fn squared_distance(
    expected: &PredictedDirection,
    turned: &Rotation3<f64>,
    track: &BearingTrack,
) -> Option<f64> {
    let own = Unit::try_new(Vector3::from(track.bearing?), 1e-6)?;
    let direction = turned * own;
    let tangents = tangent_basis(&expected.direction).transpose();
    // Error e: the turn from prediction to track, as a vector in the prediction's tangents, rad.
    let turn = turn_between(&expected.direction, &direction)?;
    let offset: Vector2<f64> = tangents * turn_vector(&turn).cross(&expected.direction);
    let [xx, xy, yy] = [track.covariance_xx, track.covariance_xy, track.covariance_yy];
    // The track's tangents, carried back to the prediction and expressed in its tangents: R' = T R
    // T'.
    let carried = turn.inverse() * (turned.matrix() * tangent_basis(&own));
    let to_expected = tangents * carried;
    let own = to_expected * Matrix2::new(xx, xy, xy, yy) * to_expected.transpose();
    let squared = offset.dot(&((expected.covariance + own).try_inverse()? * offset));
    (squared >= 0.0).then_some(squared)
}

/// A cue's prediction at a time, interpolated between the times that it states.
pub(super) fn place_at(cue: &Cue, time: Timestamp) -> Option<PredictedDirection> {
    let seconds = |one: &Expected| Timestamp::from_nanos(one.time_ns).seconds_since(time);
    let after = cue.ahead.iter().position(|one| seconds(one) >= 0.0);
    let after = after.unwrap_or(cue.ahead.len().checked_sub(1)?).max(1);
    let [Some(one), other] = [cue.ahead.get(after - 1), cue.ahead.get(after)] else { return None };
    let (from, to) = (read(one)?, read(other.unwrap_or(one))?);
    let (from_s, to_s) = (seconds(one), other.map_or(0.0, seconds));
    let share = if to_s > from_s { -from_s / (to_s - from_s) } else { 0.0 };
    // Before the cue's first time its first prediction is used; after its last, extrapolated by
    // half a step.
    let share = share.clamp(0.0, 1.5);
    let turn = turn_between(&from.direction, &to.direction)?;
    let part = Rotation3::new(turn_vector(&turn) * share);
    Some(PredictedDirection {
        direction: part * from.direction,
        covariance: from.covariance * (1.0 - share.min(1.0)) + to.covariance * share.min(1.0),
    })
}

fn read(expected: &Expected) -> Option<PredictedDirection> {
    let [xx, xy, yy] = [expected.covariance_xx, expected.covariance_xy, expected.covariance_yy];
    let bearing = Bearing::new(expected.bearing?.into(), Matrix2::new(xx, xy, xy, yy)).ok()?;
    Some(PredictedDirection { direction: bearing.direction(), covariance: *bearing.covariance() })
}
