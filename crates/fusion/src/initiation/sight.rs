//! A target as one camera alone sees it: a direction that turns.

use std::f64::consts::PI;

use crossfix_filter::{Gate, process_noise};
use crossfix_geometry::SightLine;
use crossfix_message::Timestamp;
use nalgebra::{Matrix2, Unit, Vector3};

use crate::prediction::log_density;

/// Weight of the prior that the noise is as reported, as a number of coordinates (two per bearing).
/// With half of it a few large innovations make a camera count as noisy, and true differences count
/// less; with twice as much, noise that is larger than reported passes for evidence for twice as
/// long.
const PRIOR_COORDINATES: f64 = 10.0;

/// Filter for the direction in which one camera alone follows a target: a constant turning rate
/// driven by white acceleration.
#[derive(Clone, Debug)]
pub(super) struct DirectionFilter {
    pub(super) direction: Unit<Vector3<f64>>,
    /// Turning rate of the direction, rad/s.
    pub(super) rate: Vector3<f64>,
    /// Variances of the direction (rad^2) and its rate (rad^2/s^2) along each tangent, and their
    /// covariance.
    pub(super) variance: f64,
    pub(super) rate_variance: f64,
    pub(super) tie: f64,
    pub(super) time: Timestamp,
    /// Sum of the squared innovations in units of the variance expected with the reported noise,
    /// and the number of coordinates in it.
    squares: f64,
    coordinates: f64,
}

impl DirectionFilter {
    /// The filter after a first line, of a target that may move across it at `rate_sd` (rad/s).
    pub(super) fn first(line: &SightLine, time: Timestamp, rate_sd: f64) -> Self {
        Self {
            direction: line.direction,
            rate: Vector3::zeros(),
            variance: line.covariance.trace() / 2.0,
            rate_variance: rate_sd.powi(2),
            tie: 0.0,
            time,
            squares: PRIOR_COORDINATES,
            coordinates: PRIOR_COORDINATES,
        }
    }

    /// Whether it has had one line so far.
    pub(super) fn is_first(&self) -> bool {
        self.coordinates <= PRIOR_COORDINATES
    }

    /// Predicts to a time; `density` is that of the white acceleration that drives the direction,
    /// rad^2/s^3.
    pub(super) fn predict(&mut self, time: Timestamp, density: f64) {
        let dt = time.seconds_since(self.time);
        self.direction = Unit::new_normalize(self.direction.into_inner() + self.rate * dt);
        // A clock's correction may lead back in time: this must not make the direction surer.
        let noise = process_noise(dt, density);
        self.variance += dt * (2.0 * self.tie + dt * self.rate_variance) + noise.m11;
        self.tie += dt * self.rate_variance + noise.m12;
        self.rate_variance += noise.m22;
        self.time = time;
    }

    /// Logarithm of the probability density of a line, 1/sr, if this camera alone sees what gives
    /// it; the line's covariance counts `factor` times. `None` if the numbers fail.
    pub(super) fn log_density(&self, line: &SightLine, factor: f64) -> Option<f64> {
        let own = line.covariance * factor;
        let off =
            line.basis.transpose() * (line.direction.into_inner() - self.direction.into_inner());
        log_density(&(own + Matrix2::identity() * self.variance), off)
    }

    /// Logarithm of the probability density of a line, 1/sr, whose reported covariance counts at
    /// least `factor` times; `None` if it lies outside the gate.
    pub(super) fn density(&self, line: &SightLine, factor: f64, gate: Gate) -> Option<f64> {
        let variance = self.variance + line.covariance.trace() / 2.0 * factor.max(self.factor());
        let squared =
            (line.direction.into_inner() - self.direction.into_inner()).norm_squared() / variance;
        gate.holds(squared).then(|| -squared / 2.0 - (2.0 * PI * variance).ln())
    }

    /// Updates the filter with a line.
    pub(super) fn update(&mut self, line: &SightLine) {
        let reported = line.covariance.trace() / 2.0;
        let off = line.direction.into_inner() - self.direction.into_inner();
        // z' z / S, with S by the reported noise: 2 is expected of two coordinates.
        self.squares += off.norm_squared() / (self.variance + reported);
        self.coordinates += 2.0;
        // Kalman update of the two states direction and rate by the direction alone, with the gains
        // P_dd / S and P_dr / S.
        let spread = self.variance + reported * self.factor();
        let (gain, rate_gain) = (self.variance / spread, self.tie / spread);
        self.direction = Unit::new_normalize(self.direction.into_inner() + off * gain);
        self.rate += off * rate_gain;
        self.rate_variance -= rate_gain * self.tie;
        self.tie -= gain * self.tie;
        self.variance -= gain * self.variance;
    }

    /// Factor on the lines' reported covariances, at least 1, estimated from the innovations: if
    /// the noise is larger than reported, every small difference would otherwise pass for evidence.
    pub(super) fn factor(&self) -> f64 {
        (self.squares / self.coordinates).max(1.0)
    }
}
