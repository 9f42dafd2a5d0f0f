use nalgebra::{Matrix3, Point3, Quaternion, Rotation3, Unit, UnitQuaternion, Vector3};

use crate::GeometryError;

/// Largest deviation of an element of R'R from the identity: what a matrix printed with six digits
/// keeps. With half of it these still pass; with a tenth, 1e-6, not all do.
const ORTHONORMAL_TOLERANCE: f64 = 1e-5;

/// Where a camera is and how it is turned: `world_from_camera`.
///
/// The rotation's columns are the camera's axes (x right, y down, z forward) in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    rotation: Rotation3<f64>,
    position: Point3<f64>,
}

/// A rotation as its axis times its angle, rad.
///
/// For a nearly zero turn the result is nearly zero, where [`Rotation3::scaled_axis`] gives NaN as
/// soon as rounding makes the matrix' trace larger than three.
pub fn turn_vector(rotation: &Rotation3<f64>) -> Vector3<f64> {
    UnitQuaternion::from_rotation_matrix(rotation).scaled_axis()
}

/// The smallest turn of one direction onto another; `None` where they are opposite to within a
/// microradian.
///
/// [`Rotation3::rotation_between`] gives NaN where rounding makes the cosine of nearly equal
/// directions larger than one, and resolves small angles only to 1e-8 rad.
pub fn turn_between(from: &Unit<Vector3<f64>>, to: &Unit<Vector3<f64>>) -> Option<Rotation3<f64>> {
    // The quaternion (1 + cos a, n sin a) = 2 cos(a/2) (cos(a/2), n sin(a/2)), as
    // 1 + cos a = 2 cos^2(a/2) and sin a = 2 sin(a/2) cos(a/2): normalised, it is that of a turn by
    // a about n.
    let half = Quaternion::from_parts(1.0 + from.dot(to), from.cross(to));
    Unit::try_new(half, 1e-6).map(|half| half.to_rotation_matrix())
}

impl Pose {
    /// A pose from the matrix `world_from_camera` and the camera's centre in metres.
    ///
    /// A matrix within 1e-5 of a rotation is replaced by the nearest rotation.
    ///
    /// # Errors
    /// [`GeometryError`] if a number is not finite or the matrix is not a proper rotation.
    pub fn new(matrix: Matrix3<f64>, position: Point3<f64>) -> Result<Self, GeometryError> {
        if !matrix.iter().chain(position.iter()).all(|v| v.is_finite()) {
            return Err(GeometryError::NotFinite { what: "a pose" });
        }
        let deviation = (matrix.transpose() * matrix - Matrix3::identity()).amax();
        let determinant = matrix.determinant();
        if deviation > ORTHONORMAL_TOLERANCE || determinant < 0.0 {
            return Err(GeometryError::NotRotation { deviation, determinant });
        }
        // One Newton step towards the polar factor, R (3 I - R'R) / 2: its error is of the order of
        // the squared deviation.
        let nearest = matrix * (Matrix3::identity() * 3.0 - matrix.transpose() * matrix) * 0.5;
        Ok(Self { rotation: Rotation3::from_matrix_unchecked(nearest), position })
    }

    /// A camera at the world's origin whose axes are the world's: a placeholder where no pose is
    /// known.
    pub fn at_origin() -> Self {
        Self { rotation: Rotation3::identity(), position: Point3::origin() }
    }

    /// A level camera at `position` whose optical axis goes through `target`.
    ///
    /// # Errors
    /// [`GeometryError::Aim`] if the target is straight above, below or at the camera.
    pub fn looking_at(position: Point3<f64>, target: Point3<f64>) -> Result<Self, GeometryError> {
        // z forward, x = forward x up (level), y = forward x right (down).
        let forward = (target - position).try_normalize(1e-9).ok_or(GeometryError::Aim)?;
        let right = forward.cross(&Vector3::z()).try_normalize(1e-9).ok_or(GeometryError::Aim)?;
        let down = forward.cross(&right);
        Self::new(Matrix3::from_columns(&[right, down, forward]), position)
    }

    /// The pose of a camera in the same place, turned about its own axes.
    #[must_use]
    pub fn turned(&self, turn: &Rotation3<f64>) -> Self {
        Self { rotation: self.rotation * turn, position: self.position }
    }

    /// The rotation `world_from_camera`.
    pub fn rotation(&self) -> &Rotation3<f64> {
        &self.rotation
    }

    /// The camera's centre in the world, metres.
    pub fn position(&self) -> Point3<f64> {
        self.position
    }

    /// A world point in the camera's frame.
    pub fn camera_from_world(&self, point: Point3<f64>) -> Vector3<f64> {
        self.rotation.inverse_transform_vector(&(point - self.position))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use nalgebra::Vector2;
    use proptest::prelude::*;

    use super::*;
    use crate::tangent_basis;

    #[test]
    fn a_camera_looking_north_sees_east_on_its_right_and_up_above() {
        let pose = Pose::looking_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0)).unwrap();
        let east = pose.camera_from_world(Point3::new(1.0, 10.0, 0.0));
        let up = pose.camera_from_world(Point3::new(0.0, 10.0, 1.0));
        assert!(east.x > 0.99 && east.y.abs() < 1e-12);
        assert!(up.y < -0.99 && up.x.abs() < 1e-12);
    }

    #[test]
    fn a_mirror_and_a_shear_are_refused() {
        let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
        assert!(matches!(
            Pose::new(mirror, Point3::origin()),
            Err(GeometryError::NotRotation { determinant, .. }) if determinant < 0.0
        ));
        let mut shear = Matrix3::identity();
        shear[(0, 1)] = 0.01;
        assert!(Pose::new(shear, Point3::origin()).is_err());
    }

    proptest! {
        #[test]
        fn a_turn_between_directions_is_the_smallest(
            (up, round, about) in (-1.0..1.0f64, 0.0..TAU, 0.0..TAU),
            log_angle in -18.0..0.49f64,
        ) {
            let angle = 10f64.powf(log_angle);
            let level = (1.0 - up * up).sqrt();
            let from = Vector3::new(level * round.cos(), level * round.sin(), up);
            let from = Unit::new_normalize(from);
            let axis = tangent_basis(&from) * Vector2::new(about.cos(), about.sin());
            let axis = Unit::new_normalize(axis);
            let to = Unit::new_normalize(Rotation3::from_axis_angle(&axis, angle) * *from);
            let turn = turn_between(&from, &to).unwrap();
            // Rounding matters the more, the nearer the directions are to opposite.
            let exact = 1e-14 / (angle / 2.0).cos();
            prop_assert!((turn * *from - *to).norm() < exact);
            prop_assert!((turn_vector(&turn) - *axis * angle).norm() < exact);
        }
    }

    #[test]
    fn there_is_no_smallest_turn_between_opposite_directions() {
        let (up, down) = (Vector3::z_axis(), -Vector3::z_axis());
        assert_eq!(turn_between(&up, &down), None);
        assert_eq!(turn_between(&up, &up), Some(Rotation3::identity()));
    }

    #[test]
    fn a_turn_of_next_to_nothing_is_next_to_nothing() {
        // Products of a rotation with its inverse: by rounding, their traces lie on both sides of
        // three.
        for k in 1..1000 {
            let rotation = Rotation3::new(Vector3::new(0.3, -1.1, 0.7) * f64::from(k));
            let turn = turn_vector(&(rotation.inverse() * rotation));
            assert!(turn.norm() < 1e-7, "{turn}");
        }
        let turn = turn_vector(&Rotation3::new(Vector3::new(0.1, 0.2, -0.3)));
        assert!((turn - Vector3::new(0.1, 0.2, -0.3)).norm() < 1e-12);
    }
}
