//! The prior of the target's way is kept from pulling on the site's size and its clocks' pace.

use crossfix_message::Datum;
use nalgebra::{DMatrix, Matrix3, Vector3};

use super::model::CLOCK;
use super::normal::NormalEquations;
use super::rows::Cost;
use super::spline::{KNOT_S, SPAN};
use super::state::{Flight, Priors, State};

/// A way that hovers in a point has no size to be pulled on, m^2.
const LEAST_SIZE2: f64 = 1.0;

impl State {
    /// The pull of the jerk's prior on the way's size: by how much its cost falls as the way is drawn
    /// together by one e-th.
    ///
    /// A scene that is drawn together as a whole has the same labels and less jerk, and so has one that
    /// goes slower: the likeliest way and site are smaller and slower than they are, by percents where
    /// little else tells. The power of the jerk is found from the way, which is as large as the site is
    /// and as quick as its clocks: it says nothing of either, and its pull on both is taken off.
    pub(super) fn pull(&self, priors: &Priors) -> f64 {
        if self.cameras.is_empty() {
            return 0.0;
        }
        let mut cost = Cost(0.0);
        self.jerk_rows(priors, &mut cost);
        // By the power that is found from the way each counts one; a rough start's count more, and
        // would drive the site asunder.
        cost.0.min(3.0 * self.way.intervals() as f64)
    }

    /// The information on the datum that is only the linear equations': jerk has no direction, but
    /// turned or grown by a step each of its rows changes.
    pub(super) fn of_linear_jerk(&self, priors: &Priors) -> DMatrix<f64> {
        let scale2 = (priors.jerk * KNOT_S.powi(5)).recip();
        let differences = (0..self.way.intervals()).map(|first| self.way.third_difference(first));
        let sum: Matrix3<f64> = differences.map(|d| d * d.transpose() * scale2).sum();
        let mut information = DMatrix::zeros(Datum::WAYS, Datum::WAYS);
        let turn = Matrix3::identity() * sum.trace() - sum;
        information.view_mut((Datum::TURN, Datum::TURN), (3, 3)).copy_from(&turn);
        information[(Datum::GROWTH, Datum::GROWTH)] = sum.trace();
        information
    }

    /// The coefficients of the way that some label hangs on.
    pub(super) fn seen_coefficients(&self, flight: &Flight<'_>) -> Vec<usize> {
        let mut is_seen = vec![false; self.way.coefficients.len()];
        for (camera, labels) in self.cameras.iter().zip(flight.cameras) {
            for label in &labels.labels {
                if let Some(weights) = self.way.weights(camera.time_s(label)) {
                    is_seen[weights.first..weights.first + SPAN].fill(true);
                }
            }
        }
        (0..is_seen.len()).filter(|k| is_seen[*k]).collect()
    }

    fn middle(&self, coefficients: &[usize]) -> Vector3<f64> {
        let places = coefficients.iter().map(|k| self.way.coefficients[*k]);
        places.sum::<Vector3<f64>>() / coefficients.len().max(1) as f64
    }

    /// The square of the size of these coefficients about their middle, m^2.
    fn size2(&self, coefficients: &[usize]) -> f64 {
        let middle = self.middle(coefficients);
        let arms = coefficients.iter().map(|k| self.way.coefficients[*k] - middle);
        arms.map(|arm| arm.norm_squared()).sum::<f64>().max(LEAST_SIZE2)
    }

    /// What takes a pull off. The jerk's cost goes with the square of the size and with the fifth power
    /// of the pace.
    pub(super) fn lean(&self, pull: f64, seen: &[usize]) -> f64 {
        if pull <= 0.0 {
            return 0.0;
        }
        let rates = self.cameras.iter().map(|camera| camera.clock.rate).sum::<f64>();
        pull * (5.0 * rates / self.cameras.len() as f64 - self.size2(seen).ln())
    }

    /// Its gradient.
    pub(super) fn lean_against(&self, pull: f64, seen: &[usize], linear: &mut NormalEquations) {
        if pull <= 0.0 {
            return;
        }
        let (order, middle) = (self.order(), self.middle(seen));
        let by_size2 = pull / self.size2(seen);
        for &k in seen {
            let arm = self.way.coefficients[k] - middle;
            (0..3).for_each(|axis| linear.push(order.way(k, axis), by_size2 * arm[axis]));
        }
        for start in &self.starts()[..self.cameras.len()] {
            linear.push(start + CLOCK + 1, -2.5 * pull / self.cameras.len() as f64);
        }
    }
}
