use nalgebra::{Matrix2, Matrix3, Matrix6, Matrix6x3, Point3, Vector3, Vector6};

/// Covariance of position and velocity along one axis that continuous white acceleration of power
/// spectral density `density` (m^2/s^3 in space, rad^2/s^3 of a direction) adds in `interval`
/// seconds; going back in time it adds as much, with the sign of the correlation turned.
///
/// ```
/// use crossfix_filter::process_noise;
/// // 2 m^2/s^3 for 3 s: 2 * 3^3 / 3, 2 * 3^2 / 2 and 2 * 3.
/// assert_eq!(process_noise(3.0, 2.0), nalgebra::Matrix2::new(18.0, 9.0, 9.0, 6.0));
/// ```
pub fn process_noise(interval: f64, density: f64) -> Matrix2<f64> {
    // Q = q [T^3/3 T^2/2; T^2/2 T].
    let speed = density * interval.abs();
    let across = speed * interval / 2.0;
    Matrix2::new(speed * interval.powi(2) / 3.0, across, across, speed)
}

/// Position and velocity in space with their covariance.
///
/// Metres and metres per second, world frame; the order is x, y, z, vx, vy, vz.
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

    /// Velocity, metres per second.
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
    /// Continuous, so that the process noise of a second does not depend on the number of updates
    /// in it.
    pub fn time_update(&mut self, interval: f64, density: f64) {
        // F = [I, I dt; 0, I], so F x and F P F' are sums of blocks. With P_pp, P_pv and P_vv the
        // blocks of P: P_pp + (P_pv + P_vp) dt + P_vv dt^2 for positions, P_pv + P_vv dt across.
        let velocity = self.velocity();
        let mut position = self.mean.fixed_rows_mut::<3>(0);
        position += velocity * interval;
        let ties: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(0, 3).into_owned();
        let speeds: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let growth = (ties + ties.transpose()) * interval + speeds * interval.powi(2);
        let mut positions = self.covariance.fixed_view_mut::<3, 3>(0, 0);
        positions += growth;
        let tied = ties + speeds * interval;
        self.covariance.fixed_view_mut::<3, 3>(0, 3).copy_from(&tied);
        self.covariance.fixed_view_mut::<3, 3>(3, 0).copy_from(&tied.transpose());
        let noise = process_noise(interval, density);
        for axis in 0..3 {
            self.covariance[(axis, axis)] += noise.m11;
            self.covariance[(axis, axis + 3)] += noise.m12;
            self.covariance[(axis + 3, axis)] += noise.m12;
            self.covariance[(axis + 3, axis + 3)] += noise.m22;
        }
    }

    /// The state after a measurement of its position (covariance `noise`, metres^2), with the
    /// logarithm of the measurement's likelihood: a plain Kalman update (Kalinov 2019, eqs. 6 and
    /// 9; erratum: the update is `(I - K H) P`). `None` if the innovation's covariance is not
    /// positive definite.
    pub fn position_updated(
        &self,
        measured: Point3<f64>,
        noise: &Matrix3<f64>,
    ) -> Option<(Self, f64)> {
        let innovation = measured - self.position();
        // S = H P H' + R, by its Cholesky factor: nis = v' S^-1 v, K = P H' S^-1.
        let spread = self.position_covariance() + noise;
        let factor = spread.cholesky()?;
        let nis = innovation.dot(&factor.solve(&innovation));
        let across: Matrix6x3<f64> = self.covariance.fixed_columns::<3>(0).into_owned();
        let gain = across * factor.inverse();
        let covariance = self.covariance - gain * across.transpose();
        let state = Self {
            mean: self.mean + gain * innovation,
            // Symmetric in spite of rounding.
            covariance: (covariance + covariance.transpose()) / 2.0,
        };
        // -2 ln N(v; 0, S) = nis + 3 ln 2 pi + ln |S|, with ln |S| = 2 sum ln L_ii for S = L L'.
        let normaliser = 3.0 * (2.0 * std::f64::consts::PI).ln()
            + 2.0 * factor.l().diagonal().map(f64::ln).sum();
        Some((state, -(nis + normaliser) / 2.0))
    }

    /// Forgets: position and velocity become independent, and the squares of the standard
    /// deviations given are added to the variances of each axis, so that neither is known better
    /// than by these (Kalinov 2019, eq. 8).
    pub fn reinitialise(&mut self, position_sd: f64, velocity_sd: f64) {
        let mut covariance = Matrix6::zeros();
        for (block, sd) in [(0, position_sd), (3, velocity_sd)] {
            let old: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(block, block).into_owned();
            let widened = old + Matrix3::identity() * (sd * sd);
            covariance.fixed_view_mut::<3, 3>(block, block).copy_from(&widened);
        }
        self.covariance = covariance;
    }

    /// Whether all numbers are finite.
    pub fn is_finite(&self) -> bool {
        let numbers = self.mean.as_slice().iter().chain(self.covariance.as_slice());
        numbers.fold(true, |all, value| all & value.is_finite())
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

    #[test]
    fn a_measured_position_by_hand() {
        let state = KinematicState { mean: Vector6::zeros(), covariance: Matrix6::identity() };
        let (updated, logarithm) =
            state.position_updated(Point3::new(2.0, 0.0, 0.0), &Matrix3::identity()).unwrap();
        assert!((updated.position().x - 1.0).abs() < 1e-12);
        assert!((updated.covariance[(0, 0)] - 0.5).abs() < 1e-12);
        // N(2; 0, 2) on x, N(0; 0, 2) on y and z.
        let by_hand = -1.0 - 1.5 * (2.0 * std::f64::consts::PI * 2.0).ln();
        assert!((logarithm - by_hand).abs() < 1e-12);
    }

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
