//! What is uncertain of a camera as a whole, beside the noise of each bearing.

use nalgebra::{Matrix2, Matrix2x6, Matrix3x2, Matrix6, Unit, Vector2, Vector3};

/// What all bearings of an exposure have in common: the uncertainty of its time and of the
/// camera's pose, and how much worse than it says the camera has been found to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CameraUncertainty {
    /// Standard deviation of the capture time, s.
    pub(crate) time_sd_s: f64,
    /// The reported covariances count this many times.
    pub(crate) factor: f64,
    /// Covariance of the pose in the world's axes: rotation (rad), then position (m).
    pub(crate) pose: Option<Matrix6<f64>>,
}

/// A target as a camera sees it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct View {
    /// Direction to it, world.
    pub(crate) direction: Unit<Vector3<f64>>,
    /// Tangents in which covariances are expressed, world.
    pub(crate) basis: Matrix3x2<f64>,
    /// Its range, m.
    pub(crate) range: f64,
    /// Speed of the direction on the tangents, rad/s.
    pub(crate) rate: Vector2<f64>,
}

impl CameraUncertainty {
    /// A camera of exact pose and clock, with the time's standard deviation.
    pub(crate) fn of_time(time_sd_s: f64) -> Self {
        Self { time_sd_s, factor: 1.0, pose: None }
    }

    /// Covariance of what pose and clock shift all bearings of the camera by, rad^2: a target that
    /// moves across the sight line is elsewhere a moment later, and so is one seen from elsewhere.
    pub(crate) fn common(&self, view: &View) -> Matrix2<f64> {
        let clock = view.rate * view.rate.transpose() * self.time_sd_s.powi(2);
        let Some(pose) = self.pose else {
            return clock;
        };
        // A rotation d turns the direction u by d x u; a step c of the camera turns it by -c / range.
        let turned = view.basis.transpose() * view.direction.cross_matrix();
        let mut jacobian = Matrix2x6::zeros();
        jacobian.fixed_view_mut::<2, 3>(0, 0).copy_from(&-turned);
        jacobian.fixed_view_mut::<2, 3>(0, 3).copy_from(&(-view.basis.transpose() / view.range));
        clock + jacobian * pose * jacobian.transpose()
    }

    /// Covariance of a bearing whose own is `own`, rad^2.
    pub(crate) fn noise(&self, own: &Matrix2<f64>, view: &View) -> Matrix2<f64> {
        own * self.factor + self.common(view)
    }
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::tangent_basis;

    use super::*;

    #[test]
    fn rotation_position_and_clock_add_what_they_shift() {
        let direction = Unit::new_normalize(Vector3::new(0.3, 0.8, 0.2));
        let view =
            View { direction, basis: tangent_basis(&direction), range: 50.0, rate: Vector2::new(0.2, 0.0) };
        let mut pose = Matrix6::zeros();
        for axis in 0..3 {
            pose[(axis, axis)] = 1e-6;
            pose[(axis + 3, axis + 3)] = 0.01;
        }
        let camera = CameraUncertainty { time_sd_s: 0.01, factor: 4.0, pose: Some(pose) };
        let noise = camera.noise(&(Matrix2::identity() * 1e-6), &view);
        // 4 x 1e-6 of its own, 1e-6 of the rotation, (0.1 m / 50 m)^2, and (0.2 rad/s x 0.01 s)^2 on x.
        assert!((noise.m22 - (4e-6 + 1e-6 + 4e-6)).abs() < 1e-12);
        assert!((noise.m11 - noise.m22 - 4e-6).abs() < 1e-12);
        assert!(noise.m12.abs() < 1e-12);
    }
}
