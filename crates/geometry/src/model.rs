use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Matrix3, Matrix3x2, Point3, Unit, Vector2, Vector3};

use crate::{SightLine, tangent_basis};

/// The bearing model: the direction in which a camera at `origin` sees a place, and the derivatives
/// of that by the place, by the camera's pose and by its clock.
///
/// A bearing is compared with its expectation as a residual on the tangent plane at the expected
/// direction, measured less expected. The Jacobians say how that residual changes with errors of
/// the expectation: `residual = by_position * dp + by_pose * de + by_time * dt + noise`, where `dp`
/// is the true place less the expected one (m, world), `de` the true pose less the stated one (a
/// small rotation vector about the world's axes, rad, then the position, m) and `dt` the stated
/// capture time less the true one (s).
///
/// ```
/// use crossfix_geometry::BearingModel;
/// use nalgebra::{Point3, Vector3};
/// let model = BearingModel::new(Point3::origin(), Point3::new(0.0, 100.0, 0.0)).ok_or("at the camera")?;
/// // A metre across, seen from 100 m, is a hundredth of a radian; a metre along the line is nothing.
/// assert!(((model.by_position() * Vector3::x()).norm() - 0.01).abs() < 1e-12);
/// assert!((model.by_position() * Vector3::y()).norm() < 1e-12);
/// # Ok::<(), &str>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BearingModel {
    /// Expected direction, world.
    pub direction: Unit<Vector3<f64>>,
    /// The tangents (columns, world) on which residuals are expressed.
    pub basis: Matrix3x2<f64>,
    /// Distance of the place, m.
    pub range: f64,
}

impl BearingModel {
    /// The model for a camera at `origin` and a place, m, world; `None` if the two coincide.
    pub fn new(origin: Point3<f64>, place: Point3<f64>) -> Option<Self> {
        let (direction, range) = Unit::try_new_and_get(place - origin, 1e-6)?;
        Some(Self { direction, basis: tangent_basis(&direction), range })
    }

    /// The model for a known direction (world) and range (m).
    pub fn along(direction: Unit<Vector3<f64>>, range: f64) -> Self {
        Self { direction, basis: tangent_basis(&direction), range }
    }

    /// Residual of a measured line: measured less expected direction on its
    /// tangents, rad; `None` if the line points to the opposite half space.
    pub fn residual(&self, line: &SightLine) -> Option<Vector2<f64>> {
        // z = E' u_measured: the expected direction itself has no part along its own tangents.
        (self.direction.dot(&line.direction) > 0.0)
            .then(|| self.basis.transpose() * line.direction.into_inner())
    }

    /// A line's own covariance on these tangents, rad^2.
    pub fn covariance_of(&self, line: &SightLine) -> Matrix2<f64> {
        let turn = self.basis.transpose() * line.basis;
        turn * line.covariance * turn.transpose()
    }

    /// Jacobian by the place, `B' / range` with the tangents B, rad/m.
    pub fn by_position(&self) -> Matrix2x3<f64> {
        self.basis.transpose() / self.range
    }

    /// Jacobian by the pose: rad/rad, then rad/m. A camera that is turned by `d` more than stated
    /// measures, in its stated axes, the direction u turned back by `d`, which is u + u x d; one
    /// that stands farther by `c` sees the place moved by `-c`.
    pub fn by_pose(&self) -> Matrix2x6<f64> {
        let tangents = self.basis.transpose();
        let cross: Matrix3<f64> = self.direction.cross_matrix();
        let mut jacobian = Matrix2x6::zeros();
        jacobian.fixed_view_mut::<2, 3>(0, 0).copy_from(&(tangents * cross));
        jacobian.fixed_view_mut::<2, 3>(0, 3).copy_from(&(-tangents / self.range));
        jacobian
    }

    /// Jacobian by the clock, rad/s: a clock that is ahead shows a target of `velocity` (m/s) where
    /// it was earlier than the stated time.
    pub fn by_time(&self, velocity: Vector3<f64>) -> Vector2<f64> {
        -(self.by_position() * velocity)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Rotation3, Vector6};
    use proptest::prelude::*;

    use super::*;

    /// A target's motion.
    struct Motion {
        place: Point3<f64>,
        velocity: Vector3<f64>,
    }

    /// By what a camera's statements are wrong.
    struct Misstated {
        /// Rotation, then position.
        pose: Vector6<f64>,
        ahead_s: f64,
    }

    /// What a camera measures, placed in the world by the pose and the time that it states.
    fn measured(origin: Point3<f64>, target: &Motion, error: &Misstated) -> SightLine {
        let turned = Rotation3::new(error.pose.fixed_rows::<3>(0).into_owned());
        let true_origin = origin + error.pose.fixed_rows::<3>(3);
        let seen_at = target.place - target.velocity * error.ahead_s;
        let direction = Unit::new_normalize(turned.inverse() * (seen_at - true_origin));
        let basis = tangent_basis(&direction);
        SightLine { origin, direction, basis, covariance: Matrix2::identity() }
    }

    proptest! {
        #[test]
        fn the_jacobians_are_the_finite_differences(
            place in prop::array::uniform3(-100.0..100.0f64),
            velocity in prop::array::uniform3(-30.0..30.0f64),
            error in prop::array::uniform6(-1.0..1.0f64),
            moved in prop::array::uniform3(-1.0..1.0f64),
            ahead in -1.0..1.0f64,
        ) {
            let (origin, place) = (Point3::new(1.0, -2.0, 3.0), Point3::from(place));
            prop_assume!((place - origin).norm() > 5.0);
            let step = 1e-6;
            let velocity = Vector3::from(velocity);
            let (moved, error) = (Vector3::from(moved) * step, Vector6::from(error) * step);
            let ahead = ahead * step;
            let model = BearingModel::new(origin, place).unwrap();
            let target = Motion { place: place + moved, velocity };
            let line = measured(origin, &target, &Misstated { pose: error, ahead_s: ahead });
            let residual = model.residual(&line).unwrap();
            let expected = model.by_position() * moved
                + model.by_pose() * error
                + model.by_time(velocity) * ahead;
            prop_assert!((residual - expected).norm() < 1e-4 * step * 10.0, "{residual} {expected}");
        }
    }
}
