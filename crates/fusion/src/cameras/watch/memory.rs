//! What is remembered of the errors of all cameras.

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};
use nalgebra::{DMatrix, DVector};

use super::ERRORS;

/// Information on errors, in units of their own deviations, that is next to none. With half of it
/// the same.
const UNSEEN: f64 = 1e-9;

/// What the lines have said lately about all cameras' errors.
#[derive(Clone, Debug, Default)]
pub(super) struct Memory {
    /// Fisher information on the errors, each in units of its own deviation.
    pub(super) information: DMatrix<f64>,
    /// Product of the information with the estimate of the errors.
    pub(super) pull: DVector<f64>,
}

/// Estimate of all errors.
#[derive(Clone, Debug)]
pub(super) struct ErrorEstimate {
    pub(super) mean: DVector<f64>,
    pub(super) covariance: DMatrix<f64>,
}

impl Memory {
    /// Enlarges to this many errors.
    pub(super) fn widen(&mut self, errors: usize) {
        self.information.resize_mut(errors, errors, 0.0);
        self.pull.resize_vertically_mut(errors, 0.0);
    }

    /// Forgets `count` errors from `first` on, which are other errors from now on. The information
    /// on all others becomes what it is if these may have been anything (the Schur complement).
    pub(super) fn forget(&mut self, first: usize, count: usize) {
        let own = self.information.view((first, first), (count, count)).into_owned();
        let own_pull = self.pull.rows(first, count).into_owned();
        let mut ties = self.information.columns(first, count).into_owned();
        // Some of them may not have been seen at all.
        let least = DMatrix::identity(count, count) * UNSEEN;
        // I <- I - T I_ff^-1 T', and the same for the pull.
        if let Some(factor) = (own + least).cholesky() {
            self.information -= &ties * factor.solve(&ties.transpose());
            self.pull -= &ties * factor.solve(&own_pull);
        } else {
            self.information.fill(0.0);
            self.pull.fill(0.0);
        }
        ties.fill(0.0);
        self.information.columns_mut(first, count).copy_from(&ties);
        self.information.rows_mut(first, count).copy_from(&ties.transpose());
        self.pull.rows_mut(first, count).fill(0.0);
    }

    /// Removes a camera, whose errors begin at `first`.
    pub(super) fn remove(&mut self, first: usize) {
        self.forget(first, ERRORS);
        let information = std::mem::take(&mut self.information);
        self.information = information.remove_rows(first, ERRORS).remove_columns(first, ERRORS);
        self.pull = std::mem::take(&mut self.pull).remove_rows(first, ERRORS);
    }

    /// The errors if no camera has been moved: their prior has unit variance.
    pub(super) fn estimate(&self) -> Option<ErrorEstimate> {
        let size = self.pull.len();
        let prior = |row: usize, column: usize| if row == column { 1.0 } else { 0.0 };
        // faer: of 64 cameras nalgebra's inverse takes four times as long.
        let known = Mat::from_fn(size, size, |i, j| self.information[(i, j)] + prior(i, j));
        let inverse = known.llt(Side::Lower).ok()?.inverse();
        let covariance = DMatrix::from_fn(size, size, |i, j| inverse[(i, j)]);
        Some(ErrorEstimate { mean: &covariance * &self.pull, covariance })
    }
}
