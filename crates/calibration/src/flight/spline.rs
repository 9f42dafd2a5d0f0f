//! The target's trajectory: a uniform cubic B-spline in time, kept smooth by white jerk.

use std::ops::Range;

use nalgebra::{Point3, Vector3};

use super::model::Knots;

/// Time between knots, s. A small drone turns in a second or two; a knot each tenth of a second
/// would cost twice the time and gain nothing, with one each half second turns are cut.
pub(super) const KNOT_S: f64 = 0.2;

/// Clocks and a log's bias drift between knots of their own, one for this many of the trajectory's:
/// one per second. Between two of them a consumer's receiver drifts by 0.1 m and a phone's clock by
/// 2 ms, less than what is measured in a second; with a knot each 25 s a log of metres was believed
/// too much between two knots.
pub(super) const IN_A_STEP: usize = 5;

/// Number of coefficients that the place at one time depends on.
pub(super) const SPAN: usize = 4;

/// Weights of four coefficients in the place and velocity at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Weights {
    /// The first of the four.
    pub(super) first: usize,
    pub(super) place: [f64; SPAN],
    /// Weights in the velocity, 1/s.
    pub(super) velocity: [f64; SPAN],
}

/// A trajectory over a range of time.
#[derive(Clone, Debug)]
pub(super) struct TrajectorySpline {
    start_s: f64,
    pub(super) coefficients: Vec<Vector3<f64>>,
}

impl TrajectorySpline {
    /// A trajectory that stays at the origin from one time to another, extended to a whole number
    /// of [`IN_A_STEP`] coefficients.
    pub(super) fn over(start_s: f64, end_s: f64) -> Self {
        let intervals = ((end_s - start_s) / KNOT_S).ceil().max(1.0) as usize;
        // n intervals of a cubic have n + 3 coefficients.
        let coefficients = (intervals + SPAN - 1).next_multiple_of(IN_A_STEP).max(2 * IN_A_STEP);
        Self { start_s, coefficients: vec![Vector3::zeros(); coefficients] }
    }

    /// Knots of what drifts beside the trajectory: each stands at the start of [`IN_A_STEP`]
    /// intervals.
    pub(super) fn drift(&self) -> Knots {
        let values = vec![0.0; self.coefficients.len() / IN_A_STEP];
        Knots { start_s: self.start_s, step_s: KNOT_S * IN_A_STEP as f64, values }
    }

    /// The weights at a time; `None` outside of its range.
    pub(super) fn weights(&self, time_s: f64) -> Option<Weights> {
        let at = (time_s - self.start_s) / KNOT_S;
        let intervals = self.coefficients.len() - (SPAN - 1);
        if !(at >= 0.0 && at < intervals as f64) {
            return None;
        }
        let first = at as usize;
        let u = at - first as f64;
        let v = 1.0 - u;
        // Uniform cubic B-spline basis; u is the share of the interval that has passed.
        let place = [
            v * v * v / 6.0,
            (4.0 - 6.0 * u * u + 3.0 * u * u * u) / 6.0,
            (4.0 - 6.0 * v * v + 3.0 * v * v * v) / 6.0,
            u * u * u / 6.0,
        ];
        let velocity = [
            -v * v / 2.0,
            (3.0 * u * u - 4.0 * u) / 2.0,
            (4.0 * v - 3.0 * v * v) / 2.0,
            u * u / 2.0,
        ]
        .map(|weight| weight / KNOT_S);
        Some(Weights { first, place, velocity })
    }

    /// The place for weights that [`Self::weights`] gave.
    pub(super) fn place(&self, weights: &Weights) -> Point3<f64> {
        Point3::from(self.sum(weights.first, &weights.place))
    }

    /// The place at a time; `None` outside of its range.
    pub(super) fn place_at(&self, time_s: f64) -> Option<Point3<f64>> {
        self.weights(time_s).map(|weights| self.place(&weights))
    }

    /// The velocity, m/s.
    pub(super) fn velocity(&self, weights: &Weights) -> Vector3<f64> {
        self.sum(weights.first, &weights.velocity)
    }

    /// Third difference of four coefficients from `first` on: the interval's jerk times the knot
    /// spacing cubed.
    pub(super) fn third_difference(&self, first: usize) -> Vector3<f64> {
        self.sum(first, &THIRD_DIFFERENCE)
    }

    fn sum(&self, first: usize, weights: &[f64; SPAN]) -> Vector3<f64> {
        let terms = self.coefficients[first..first + SPAN].iter().zip(weights);
        terms.map(|(coefficient, weight)| coefficient * *weight).sum()
    }

    /// Sets its coefficients to these places, where there are any.
    pub(super) fn lead(&mut self, place: impl Fn(f64) -> Option<Vector3<f64>>) {
        for (k, coefficient) in self.coefficients.iter_mut().enumerate() {
            // A coefficient has its greatest influence one knot after the start of its first
            // interval.
            let time_s = self.start_s + (k as f64 - 1.0) * KNOT_S;
            *coefficient = place(time_s).unwrap_or(*coefficient);
        }
    }

    /// Its range of time, s.
    pub(super) fn range(&self) -> Range<f64> {
        self.start_s..self.start_s + KNOT_S * self.intervals() as f64
    }

    /// Number of intervals.
    pub(super) fn intervals(&self) -> usize {
        self.coefficients.len() - (SPAN - 1)
    }
}

/// The third difference of four coefficients.
pub(super) const THIRD_DIFFERENCE: [f64; SPAN] = [-1.0, 3.0, -3.0, 1.0];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_holds_a_cubic_exactly_with_its_velocity_and_jerk() {
        let mut spline = TrajectorySpline::over(10.0, 14.0);
        // A cubic's coefficients by its blossom: the product of the knots about each coefficient.
        for (k, coefficient) in spline.coefficients.iter_mut().enumerate() {
            let knot = |offset: f64| (k as f64 + offset) * KNOT_S;
            coefficient.x = knot(-2.0) * knot(-1.0) * knot(0.0);
        }
        for t in [0.0, 0.13, 1.0, 3.99] {
            let weights = spline.weights(10.0 + t).unwrap();
            assert!((spline.place(&weights).x - t.powi(3)).abs() < 1e-9, "{t}");
            assert!((spline.velocity(&weights).x - 3.0 * t * t).abs() < 1e-9, "{t}");
        }
        assert!((spline.third_difference(5).x - 6.0 * KNOT_S.powi(3)).abs() < 1e-9);
        let end = spline.range().end;
        assert!((14.0..15.0).contains(&end));
        assert!(spline.weights(9.99).is_none() && spline.weights(end + 0.01).is_none());
        assert!(spline.weights(f64::NAN).is_none());
    }
}
