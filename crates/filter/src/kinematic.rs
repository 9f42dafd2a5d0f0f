use nalgebra::{Matrix3, Matrix6, Point3, Vector3, Vector6};

/// Position and velocity in space with their covariance.
///
/// Metres and metres a second, world frame; the order is x, y, z, vx, vy, vz.
///
/// ```
/// use crossfix_filter::KinematicState;
/// use nalgebra::{Matrix6, Vector6};
/// let mut state = KinematicState {
///     mean: Vector6::new(0.0, 0.0, 50.0, 10.0, 0.0, 0.0),
///     covariance: Matrix6::identity(),
/// };
/// state.time_update(2.0, 1.0);
/// assert_eq!(state.position().x, 20.0);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct KinematicState {
    /// Position, then velocity.
    pub mean: Vector6<f64>,
    /// Covariance of the mean.
    pub covariance: Matrix6<f64>,
}

impl KinematicState {
    /// Position, metres.
    pub fn position(&self) -> Point3<f64> {
        Point3::from(self.mean.fixed_rows::<3>(0).into_owned())
    }

    /// Velocity, metres a second.
    pub fn velocity(&self) -> Vector3<f64> {
        self.mean.fixed_rows::<3>(3).into_owned()
    }

    /// Covariance of the position, metres^2.
    pub fn position_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(0, 0).into_owned()
    }

    /// Standard deviation along the worst axis of the position, metres.
    pub fn worst_position_sd(&self) -> f64 {
        self.position_covariance().symmetric_eigenvalues().max().max(0.0).sqrt()
    }

    /// Moves the state `interval` seconds on: constant velocity driven by continuous white
    /// acceleration of power spectral density `density`, m^2/s^3.
    ///
    /// Continuous, so that the noise of a second does not depend on how many updates cut it.
    pub fn time_update(&mut self, interval: f64, density: f64) {
        let mut f = Matrix6::identity();
        f.fixed_view_mut::<3, 3>(0, 3).copy_from(&(Matrix3::identity() * interval));
        self.mean = f * self.mean;
        self.covariance = f * self.covariance * f.transpose();
        let noise = density * interval.abs();
        for axis in 0..3 {
            self.covariance[(axis, axis)] += noise * interval.powi(2) / 3.0;
            self.covariance[(axis, axis + 3)] += noise * interval / 2.0;
            self.covariance[(axis + 3, axis)] += noise * interval / 2.0;
            self.covariance[(axis + 3, axis + 3)] += noise;
        }
    }

    /// The state `interval` seconds on, leaving this one as it is.
    #[must_use]
    pub fn predicted(&self, interval: f64, density: f64) -> Self {
        let mut moved = self.clone();
        moved.time_update(interval, density);
        moved
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn two_halves_of_an_interval_are_the_whole(interval in 0.0..3.0, density in 0.0..10.0) {
            let start = KinematicState { mean: Vector6::repeat(1.0), covariance: Matrix6::identity() };
            let whole = start.predicted(interval, density);
            let halves = start.predicted(interval / 2.0, density).predicted(interval / 2.0, density);
            prop_assert!((whole.mean - halves.mean).norm() < 1e-9);
            prop_assert!((whole.covariance - halves.covariance).norm() < 1e-9);
        }
    }
}
