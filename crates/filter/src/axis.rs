use nalgebra::Matrix2;

/// A measured position on one axis with its variance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisMeasurement {
    /// Position, in the axis' unit.
    pub position: f64,
    /// Its variance, unit^2.
    pub variance: f64,
}

/// Innovation: a measurement less its prediction, with its variance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Innovation {
    /// Measured less predicted.
    pub value: f64,
    /// Innovation variance `S = H P H' + R`.
    pub variance: f64,
}

impl Innovation {
    /// The normalised innovation squared `v^2 / S`: chi-square with one degree of freedom if the
    /// filter is consistent.
    pub fn normalised_squared(&self) -> f64 {
        self.value * self.value / self.variance
    }
}

/// Kalman filter of position and velocity on one axis: the fourth-order filter of Herasymenko 2021,
/// eqs. 2-12, splits into two of these when the errors of the image's axes are taken as
/// independent.
///
/// The motion is constant velocity driven by white acceleration of standard deviation `sigma_a`
/// that is constant between two updates: `G = [T^2/2, T]'`, `Q = sigma_a^2` (erratum: the papers
/// have `sigma_a` in both).
///
/// ```
/// use crossfix_filter::{AxisFilter, AxisMeasurement};
/// let at = |position| AxisMeasurement { position, variance: 0.01 };
/// let mut filter = AxisFilter::start(at(0.0), at(1.0), 0.5, 1.0);
/// filter.time_update(0.5);
/// let innovation = filter.measurement_update(at(2.0));
/// assert!(innovation.value.abs() < 1e-12);
/// assert!((filter.velocity() - 2.0).abs() < 1e-12);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct AxisFilter {
    position: f64,
    velocity: f64,
    /// The covariance: P11 here, then P12 and P22.
    position_variance: f64,
    cross: f64,
    velocity_variance: f64,
    /// `sigma_a^2`.
    acceleration_variance: f64,
}

impl AxisFilter {
    /// Starts from two measurements `interval` seconds apart (Herasymenko 2021, eqs. 13-14;
    /// erratum: the velocity's variance contains `sigma_a^2 T^2 / 4`).
    pub fn start(
        first: AxisMeasurement,
        second: AxisMeasurement,
        interval: f64,
        sigma_a: f64,
    ) -> Self {
        Self {
            position: second.position,
            velocity: (second.position - first.position) / interval,
            position_variance: second.variance,
            cross: second.variance / interval,
            velocity_variance: (second.variance + first.variance) / interval.powi(2)
                + sigma_a.powi(2) * interval.powi(2) / 4.0,
            acceleration_variance: sigma_a.powi(2),
        }
    }

    /// Starts from one measurement and a prior standard deviation of the velocity about zero.
    pub fn start_at_rest(first: AxisMeasurement, velocity_sd: f64, sigma_a: f64) -> Self {
        Self {
            position: first.position,
            velocity: 0.0,
            position_variance: first.variance,
            cross: 0.0,
            velocity_variance: velocity_sd.powi(2),
            acceleration_variance: sigma_a.powi(2),
        }
    }

    /// Moves the state `interval` seconds on (Herasymenko 2021, eqs. 8 and 10).
    #[inline]
    pub fn time_update(&mut self, interval: f64) {
        self.position += interval * self.velocity;
        // F P F' + G Q G', written out: this runs for every axis of every target in every frame.
        let (noise, half) = (self.acceleration_variance * interval * interval, interval / 2.0);
        let cross = self.cross + interval * self.velocity_variance;
        self.position_variance += interval * (self.cross + cross) + noise * half * half;
        self.cross = cross + noise * half;
        self.velocity_variance += noise;
    }

    /// The innovation that a measurement would have; the filter stays as it is.
    #[inline]
    pub fn innovation(&self, measurement: AxisMeasurement) -> Innovation {
        Innovation {
            value: measurement.position - self.position,
            variance: self.position_variance + measurement.variance,
        }
    }

    /// Updates with a measurement (Herasymenko 2021, eqs. 9, 11 and 12) and returns its innovation.
    #[inline]
    pub fn measurement_update(&mut self, measurement: AxisMeasurement) -> Innovation {
        let innovation = self.innovation(measurement);
        // K = P H' S^-1, with H = [1 0]: K_1 = P11 / S and K_2 = P12 / S.
        let share = 1.0 / innovation.variance;
        let (gain, velocity_gain) = (self.position_variance * share, self.cross * share);
        self.position += gain * innovation.value;
        self.velocity += velocity_gain * innovation.value;
        // P+ = (I - K H) P with 1 - K_1 = R / S, so that P11+ = K_1 R and P12+ = K_2 R: no
        // difference of nearly equal numbers in the position's variance.
        self.velocity_variance -= velocity_gain * self.cross;
        self.position_variance = gain * measurement.variance;
        self.cross = velocity_gain * measurement.variance;
        innovation
    }

    /// Replaces the distribution of the position by `posterior`, with mean m and variance c; the
    /// velocity follows by regression on the position, `x+ = x + P_xp / P_pp (m - p)`,
    /// `P+ = P - P_xp P_px / P_pp^2 (P_pp - c)`.
    ///
    /// A measurement update (Herasymenko 2021, eqs. 9-12) is the special case where `posterior` is
    /// the product of prior and likelihood.
    pub fn condition(&mut self, posterior: AxisMeasurement) {
        // b = P_vp / P_pp: regression of the velocity on the position.
        let slope = self.cross / self.position_variance;
        self.velocity += slope * (posterior.position - self.position);
        self.position = posterior.position;
        // Velocity variance that the position does not explain: P_vv - b P_vp.
        let rest = (self.velocity_variance - slope * self.cross).max(0.0);
        self.position_variance = posterior.variance;
        self.cross = slope * posterior.variance;
        self.velocity_variance = rest + slope * self.cross;
    }

    /// Position, in the axis' unit.
    pub fn position(&self) -> f64 {
        self.position
    }

    /// Velocity, units per second.
    pub fn velocity(&self) -> f64 {
        self.velocity
    }

    /// Variance of the position.
    pub fn position_variance(&self) -> f64 {
        self.position_variance
    }

    /// Covariance of position and velocity.
    pub fn covariance(&self) -> Matrix2<f64> {
        Matrix2::new(self.position_variance, self.cross, self.cross, self.velocity_variance)
    }

    /// Moves the origin of the axis: every position becomes itself plus `by`; velocity and
    /// covariance stay.
    pub fn move_by(&mut self, by: f64) {
        self.position += by;
    }

    /// Sets position and zero velocity, keeping the covariance.
    pub fn hold_at(&mut self, position: f64) {
        (self.position, self.velocity) = (position, 0.0);
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector2;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    #[test]
    fn the_start_is_the_papers_with_its_erratum() {
        let at = |position, variance| AxisMeasurement { position, variance };
        let filter = AxisFilter::start(at(1.0, 4.0), at(3.0, 1.0), 0.5, 2.0);
        assert_eq!(filter.velocity(), 4.0);
        assert_eq!(filter.covariance(), Matrix2::new(1.0, 2.0, 2.0, 20.0 + 0.25));
    }

    /// Mean NEES over `runs` runs of 20 steps, simulated by the filter's own motion model.
    fn mean_nees(sigma_a: f64, runs: u32) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
        let mut sum = 0.0;
        for _ in 0..runs {
            let (mut position, mut velocity) = (0.0, 10.0);
            let mut step = |normal: &mut dyn FnMut() -> f64| {
                let acceleration = sigma_a * normal();
                position += velocity + acceleration / 2.0;
                velocity += acceleration;
                (
                    position,
                    velocity,
                    AxisMeasurement { position: position + normal(), variance: 1.0 },
                )
            };
            let first = step(&mut normal).2;
            let second = step(&mut normal).2;
            let mut filter = AxisFilter::start(first, second, 1.0, sigma_a);
            let mut truth = (0.0, 0.0);
            for _ in 0..18 {
                let (position, velocity, measurement) = step(&mut normal);
                filter.time_update(1.0);
                filter.measurement_update(measurement);
                truth = (position, velocity);
            }
            let error = Vector2::new(truth.0 - filter.position(), truth.1 - filter.velocity());
            sum += (error.transpose() * filter.covariance().try_inverse().unwrap() * error).x;
        }
        sum / f64::from(runs)
    }

    #[test]
    fn the_covariance_is_honest_at_every_manoeuvrability() {
        // NEES is chi-square with 2 degrees of freedom; the mean of 4000 has SD 2/sqrt(4000).
        for sigma_a in [0.3, 1.0, 3.0] {
            let nees = mean_nees(sigma_a, 4000);
            assert!((nees - 2.0).abs() < 3.0 * 2.0 / 4000f64.sqrt(), "sigma_a {sigma_a}: {nees}");
        }
    }
}
