//! One axis of a target's motion in the image: a linear filter of position, velocity and the
//! reference's offset.

use crossfix_filter::AxisMeasurement;
use nalgebra::{Matrix3, RowVector3, Vector3};

/// Index of the position, px, among the states of an axis.
pub(super) const POSITION: usize = 0;
/// Index of the velocity, px/s.
pub(super) const VELOCITY: usize = 1;
/// Index of the reference's offset, px.
pub(super) const OFFSET: usize = 2;
/// Measurement matrix H: the reference is found at position plus offset.
pub(super) const FOUND_AT: RowVector3<f64> = RowVector3::new(1.0, 0.0, 1.0);

/// Position, velocity and offset on one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct AxisMotion {
    pub(super) mean: Vector3<f64>,
    pub(super) covariance: Matrix3<f64>,
}

impl AxisMotion {
    /// A target at rest whose given place has become the middle of its reference.
    pub(super) fn at_rest(given: AxisMeasurement, velocity_sd: f64) -> Self {
        // P = v o o', o = [1, 0, -1]': H o = 0, so that the given place's error is not in where the
        // reference is found.
        let off = Vector3::new(1.0, 0.0, -1.0);
        let mut covariance = off * off.transpose() * given.variance;
        covariance[(VELOCITY, VELOCITY)] = velocity_sd.powi(2);
        Self { mean: Vector3::new(given.position, 0.0, 0.0), covariance }
    }

    pub(super) fn found(&self) -> AxisMeasurement {
        let position = self.mean[POSITION] + self.mean[OFFSET];
        AxisMeasurement {
            position,
            variance: (FOUND_AT * self.covariance * FOUND_AT.transpose()).x,
        }
    }

    /// Mean and covariance of the mixture of this state, with weight `share`, and another.
    pub(super) fn mixed(&self, share: f64, other: &Self) -> Self {
        let rest = 1.0 - share;
        // P = s P1 + (1 - s) P2 + s (1 - s) d d', d the difference of the means.
        let apart = self.mean - other.mean;
        let covariance = self.covariance * share
            + other.covariance * rest
            + apart * apart.transpose() * (share * rest);
        Self { mean: self.mean * share + other.mean * rest, covariance }
    }

    /// Predicts with constant velocity and white acceleration, given by its variance, that is
    /// constant over the interval (Herasymenko 2021, eqs. 8 and 10; erratum: its variance).
    pub(super) fn predict(&mut self, interval: f64, acceleration: f64) {
        self.mean[POSITION] += interval * self.mean[VELOCITY];
        // P = F P F' + G G' sigma_a^2, G = [T^2/2, T, 0]'; F adds T times the velocity.
        let p = &mut self.covariance;
        let along = p.column(VELOCITY) * interval;
        p.set_column(POSITION, &(p.column(POSITION) + along));
        let across = p.row(VELOCITY) * interval;
        p.set_row(POSITION, &(p.row(POSITION) + across));
        let driven = Vector3::new(interval * interval / 2.0, interval, 0.0);
        *p += driven * driven.transpose() * acceleration;
    }

    /// Regression of the states on where the reference is found: `P H' / (H P H')`.
    pub(super) fn slope(&self) -> Vector3<f64> {
        let with_found = self.covariance * FOUND_AT.transpose();
        with_found / (FOUND_AT * with_found).x.max(f64::MIN_POSITIVE)
    }

    /// Sets mean and variance of where the reference is found; the states follow by regression.
    pub(super) fn condition(&mut self, found: AxisMeasurement) {
        let (slope, before) = (self.slope(), self.found());
        // x += b (z - z0), P += b b' (v - v0), with b the slope and z0, v0 the values so far.
        self.mean += slope * (found.position - before.position);
        self.covariance += slope * slope.transpose() * (found.variance - before.variance);
        self.covariance = (self.covariance + self.covariance.transpose()) / 2.0;
    }
}
