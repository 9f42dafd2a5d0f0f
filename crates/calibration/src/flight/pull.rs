//! Keeps the prior of the target's trajectory from pulling on the site's size and its clocks' pace.

use crossfix_message::Datum;
use nalgebra::{DMatrix, Matrix3, Vector3};

use super::model::CLOCK;
use super::normal::NormalEquations;
use super::rows::CostSum;
use super::spline::{KNOT_S, SPAN};
use super::state::{Flight, FlightState, Priors};

/// Least size: a trajectory that hovers in a point has no size to be pulled on, m^2. With half of
/// it the same: a size is a sum over all coefficients, five a second, and any flight has far more.
const LEAST_SIZE2: f64 = 1.0;

impl FlightState {
    /// Pull of the jerk's prior on the trajectory's size: by how much its negative log likelihood
    /// falls as the logarithm of the size decreases, to first order.
    ///
    /// A scene that is shrunk as a whole has the same labels and less jerk, and so has one that
    /// goes slower: the likeliest trajectory and site are smaller and slower than the true ones, by
    /// per cents where little else tells. The power of the jerk is estimated from the trajectory,
    /// which is as large as the site and as quick as its clocks: it says nothing of either, so its
    /// pull on both is removed.
    pub(super) fn pull(&self, priors: &Priors) -> f64 {
        if self.cameras.is_empty() {
            return 0.0;
        }
        let mut cost = CostSum(0.0);
        self.jerk_rows(priors, &mut cost);
        // With the power that is estimated from the trajectory each row counts one; those of a
        // rough start count more and would blow the site up.
        cost.0.min(3.0 * self.way.intervals() as f64)
    }

    /// Information on the datum that only the linearisation creates: jerk has no preferred
    /// direction, but a linearised step of turn or growth changes each of its rows.
    pub(super) fn of_linear_jerk(&self, priors: &Priors) -> DMatrix<f64> {
        let scale2 = (priors.jerk * KNOT_S.powi(5)).recip();
        let differences = (0..self.way.intervals()).map(|first| self.way.third_difference(first));
        // A turn w changes d by w x d: the squares sum to w' (I trace(d d') - d d') w.
        let sum: Matrix3<f64> = differences.map(|d| d * d.transpose() * scale2).sum();
        let mut information = DMatrix::zeros(Datum::WAYS, Datum::WAYS);
        let turn = Matrix3::identity() * sum.trace() - sum;
        information.view_mut((Datum::TURN, Datum::TURN), (3, 3)).copy_from(&turn);
        information[(Datum::GROWTH, Datum::GROWTH)] = sum.trace();
        information
    }

    /// The coefficients of the trajectory that some label depends on.
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

    /// Summed squared distance of these coefficients from their mean, m^2.
    fn size2(&self, coefficients: &[usize]) -> f64 {
        let middle = self.middle(coefficients);
        let arms = coefficients.iter().map(|k| self.way.coefficients[*k] - middle);
        arms.map(|arm| arm.norm_squared()).sum::<f64>().max(LEAST_SIZE2)
    }

    /// The term of the cost that cancels a pull. The jerk's cost is proportional to the square of
    /// the size and to the fifth power of the pace.
    pub(super) fn lean(&self, pull: f64, seen: &[usize]) -> f64 {
        if pull <= 0.0 {
            return 0.0;
        }
        let rates = self.cameras.iter().map(|camera| camera.clock.rate).sum::<f64>();
        pull * (5.0 * rates / self.cameras.len() as f64 - self.size2(seen).ln())
    }

    /// Its gradient, on the right side of the equations.
    pub(super) fn lean_against(&self, pull: f64, seen: &[usize], linear: &mut NormalEquations) {
        if pull <= 0.0 {
            return;
        }
        let (order, middle) = (self.order(), self.middle(seen));
        // d(-pull ln S) / dc = -2 pull (c - middle) / S; the right side has minus half of that.
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
