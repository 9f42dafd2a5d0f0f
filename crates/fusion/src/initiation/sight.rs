//! A target as one camera alone sees it: a direction that turns.

use std::f64::consts::PI;

use crossfix_filter::Gate;
use crossfix_geometry::SightLine;
use crossfix_message::Timestamp;
use nalgebra::{Matrix2, Unit, Vector3};

use crate::prediction::{BearingPrediction, Beginning, GivenShift, log_density};

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
    /// Estimate of the shift that the pose gives to all bearings of the camera (rad, world), and
    /// its covariance along the tangents, once the first prediction has given it.
    shift: Vector3<f64>,
    shift_covariance: Option<Matrix2<f64>>,
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
            shift: Vector3::zeros(),
            shift_covariance: None,
            squares: PRIOR_COORDINATES,
            coordinates: PRIOR_COORDINATES,
        }
    }

    /// Estimates the camera's shift from the first line, one of those that the target's position
    /// was made from: the line's residual is divided between shift and noise in proportion to their
    /// covariances.
    pub(super) fn begin_shift(
        &mut self,
        line: &SightLine,
        prediction: &BearingPrediction,
    ) -> Option<()> {
        let Beginning { left, shift, noise, placed } = prediction.beginning(line)?;
        // K = V (V + R)^-1, with V the covariance of the shift; the residual itself has the
        // covariance V + R - H P H', as the target was fitted to the line.
        let total = shift + noise;
        let gain = shift * total.try_inverse()?;
        self.shift = prediction.basis() * (gain * left);
        self.shift_covariance = Some(shift - gain * (total - placed) * gain.transpose());
        Some(())
    }

    /// Predicts to a time; `density` is that of the white acceleration that drives the direction,
    /// rad^2/s^3.
    pub(super) fn predict(&mut self, time: Timestamp, density: f64) {
        let dt = time.seconds_since(self.time);
        self.direction = Unit::new_normalize(self.direction.into_inner() + self.rate * dt);
        // A clock's correction may lead back in time: this must not make the direction surer.
        // Process noise: q [t^3/3, t^2/2; t^2/2, t].
        let noise = density * dt.abs();
        self.variance += dt * (2.0 * self.tie + dt * self.rate_variance) + noise * dt * dt / 3.0;
        self.tie += dt * self.rate_variance + noise * dt / 2.0;
        self.rate_variance += noise;
        self.time = time;
    }

    /// Log-likelihood ratio of a line: the prediction of the target that all cameras see, against
    /// the prediction of this camera alone. Also updates the camera's shift, which is the same in
    /// all its lines.
    pub(super) fn log_ratio(
        &mut self,
        line: &SightLine,
        prediction: &BearingPrediction,
    ) -> Option<f64> {
        let to_tangents = prediction.basis().transpose();
        // The line's covariance is on its own tangents; here all is on those of the prediction.
        let turn = to_tangents * line.basis;
        let own = turn * line.covariance * turn.transpose() * self.factor();
        let seen = to_tangents * line.direction.into_inner();
        let alone = seen - to_tangents * self.direction.into_inner();
        let alone = log_density(&(own + Matrix2::identity() * self.variance), alone)?;
        // With all cameras: z = E' d - L s, where s is the camera's shift, of which this filter
        // knows N(shift, known): S = spread + L known L'.
        let GivenShift { shift, left, spread } = prediction.given_shift(line, self.factor());
        let known = self.shift_covariance.unwrap_or(shift);
        let spread = spread + left * known * left.transpose();
        let off = seen - left * (to_tangents * self.shift);
        let together = log_density(&spread, off)?;
        // The shift's Kalman update: K = known L' S^-1.
        let gain = known * left.transpose() * spread.try_inverse()?;
        self.shift += prediction.basis() * (gain * off);
        self.shift_covariance = Some(known - gain * left * known);
        Some(together - alone)
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
    fn factor(&self) -> f64 {
        (self.squares / self.coordinates).max(1.0)
    }
}
