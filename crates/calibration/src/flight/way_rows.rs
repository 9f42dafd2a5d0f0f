//! Rows that constrain the target's trajectory: its jerk, and the log with its bias.

use super::model::FlightLog;
use super::noise::Tails;
use super::normal::Derivative;
use super::rows::Sink;
use super::spline::{KNOT_S, SPAN, THIRD_DIFFERENCE, Weights};
use super::state::{FlightState, Priors};

/// Deviation of a coefficient's movement in one step of the adjustment where nothing else
/// constrains the trajectory, m: near enough for ten minutes without a label. With a tenth of it a
/// trajectory that swings out by kilometres in a gap would determine the site's orientation, to
/// 30 mrad.
const REST_M: f64 = 1e5;

impl FlightState {
    /// White jerk: its mean over an interval has the variance power / interval, so that the third
    /// difference has the variance power x interval^5.
    pub(super) fn jerk_rows(&self, priors: &Priors, sink: &mut impl Sink) {
        let scale = (priors.jerk * KNOT_S.powi(5)).sqrt().recip();
        let order = self.order();
        for first in 0..self.way.intervals() {
            let difference = self.way.third_difference(first);
            for axis in 0..3 {
                let term = |k: usize| (order.way(first + k, axis), THIRD_DIFFERENCE[k] * scale);
                let terms = (0..SPAN).map(term).collect();
                sink.take(&[(terms, difference[axis] * scale)], Tails::Normal);
            }
        }
    }

    /// Keeps the trajectory about where it is wherever nothing else constrains it: in a gap of
    /// minutes white jerk alone leaves it to rounding errors.
    pub(super) fn rest_rows(&self, sink: &mut impl Sink) {
        let order = self.order();
        for k in 0..self.way.coefficients.len() {
            for axis in 0..3 {
                sink.take(&[(vec![(order.way(k, axis), 1.0 / REST_M)], 0.0)], Tails::Normal);
            }
        }
    }

    pub(super) fn log_rows(&self, log: &FlightLog, sink: &mut impl Sink) {
        let scale = log.errors.sd_m.recip();
        for sample in &log.samples {
            let Some(weights) = self.way.weights(sample.time_s) else { continue };
            let place = self.way.place(&weights);
            // Residual of a sample: (trajectory + bias - stated place) / sd.
            let stated = |axis: usize| place[axis] + self.bias[axis].at(sample.time_s);
            let rows = [0, 1, 2].map(|axis| {
                let terms = self.log_terms(&weights, sample.time_s, axis, scale);
                (terms, (stated(axis) - sample.position[axis]) * scale)
            });
            sink.take(&rows, Tails::Heavy);
        }
        self.bias_rows(log, sink);
    }

    /// Derivatives of one axis of trajectory and bias together at a time, times a scale.
    fn log_terms(
        &self,
        weights: &Weights,
        time_s: f64,
        axis: usize,
        scale: f64,
    ) -> Vec<Derivative> {
        let order = self.order();
        let of_way = weights.place.iter().enumerate();
        let chain = of_way.map(|(k, weight)| (order.way(weights.first + k, axis), weight * scale));
        let of_bias = self.bias[axis].weights(time_s).into_iter();
        chain.chain(of_bias.map(|(k, weight)| (order.bias(k, axis), weight * scale))).collect()
    }

    /// First-order Gauss-Markov bias: `b' = f b + noise`, with the same deviation at all times.
    pub(super) fn bias_rows(&self, log: &FlightLog, sink: &mut impl Sink) {
        let order = self.order();
        let errors = &log.errors;
        // f = exp(-step / drift time); the noise has the variance sd^2 (1 - f^2).
        let kept = (-self.bias[0].step_s / errors.drift_time_s).exp();
        let first = errors.drift_sd_m.max(1e-9).recip();
        let next = first / (1.0 - kept * kept).sqrt();
        for (axis, bias) in self.bias.iter().enumerate() {
            // The first value has the process' own deviation, so that the bias is stationary.
            let begin = (vec![(order.bias(0, axis), first)], bias.values[0] * first);
            sink.take(&[begin], Tails::Normal);
            for (k, pair) in bias.values.windows(2).enumerate() {
                let terms =
                    vec![(order.bias(k, axis), -kept * next), (order.bias(k + 1, axis), next)];
                sink.take(&[(terms, (pair[1] - kept * pair[0]) * next)], Tails::Normal);
            }
        }
    }
}
