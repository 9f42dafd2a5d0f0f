//! What is remembered of the errors of all cameras.

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};
use nalgebra::{DMatrix, DVector, SMatrix, SVector};

use super::ERRORS;

/// Information on errors, in units of their own deviations, that is next to none. With half of it
/// the same.
const UNSEEN: f64 = 1e-9;

/// The sums are divided by the weight of what is new when that has grown to this: between two such
/// divisions nothing is computed with all of them. With half of it the same; any number that is far
/// from overflow does.
const LARGEST_WEIGHT: f64 = 1e6;

/// What the lines have said lately about all cameras' errors.
///
/// What is old fades as what is new weighs more: 64 cameras have 200 000 sums, and a site of a
/// thousand targets ages thousands of times a second.
#[derive(Clone, Debug)]
pub(super) struct Memory {
    /// Fisher information on the errors, each in units of its own deviation, times `weight`.
    information: DMatrix<f64>,
    /// Product of the information with the estimate of the errors, times `weight`.
    pull: DVector<f64>,
    /// Sum of the squared misses of the lines, in units of their noise, and the number of
    /// coordinates in it, times `weight`.
    squares: f64,
    coordinates: f64,
    /// The weight of what is new.
    weight: f64,
}

impl Default for Memory {
    fn default() -> Self {
        Self {
            information: DMatrix::zeros(0, 0),
            pull: DVector::zeros(0),
            squares: 0.0,
            coordinates: 0.0,
            weight: 1.0,
        }
    }
}

/// Estimate of all errors.
#[derive(Clone, Debug)]
pub(super) struct ErrorEstimate {
    pub(super) mean: DVector<f64>,
    pub(super) covariance: DMatrix<f64>,
    /// Sum of the squared misses of the lines that the errors do not explain, in units of their
    /// noise, ...
    pub(super) unexplained: f64,
    /// ... and the number of coordinates in it.
    pub(super) coordinates: f64,
}

impl Memory {
    /// Forgets all but this share of what it holds.
    pub(super) fn fade(&mut self, kept: f64) {
        self.weight /= kept;
        if self.weight > LARGEST_WEIGHT {
            self.information /= self.weight;
            self.pull /= self.weight;
            self.squares /= self.weight;
            self.coordinates /= self.weight;
            self.weight = 1.0;
        }
    }

    /// Adds the squared misses of lines of a target, in units of their noise, and the number of
    /// coordinates in them.
    pub(super) fn add_squares(&mut self, squares: f64, coordinates: f64) {
        self.squares += squares * self.weight;
        self.coordinates += coordinates * self.weight;
    }

    /// Adds the pull of a line on the errors of a camera, which begin at `first`.
    pub(super) fn add_pull(&mut self, first: usize, pull: SVector<f64, ERRORS>) {
        let mut own = self.pull.fixed_rows_mut::<ERRORS>(first);
        own += pull * self.weight;
    }

    /// Adds the information of lines on the errors of two cameras, which begin at `row` and
    /// `column`.
    pub(super) fn add_information(
        &mut self,
        [row, column]: [usize; 2],
        information: SMatrix<f64, ERRORS, ERRORS>,
    ) {
        let mut block = self.information.fixed_view_mut::<ERRORS, ERRORS>(row, column);
        block += information * self.weight;
    }

    /// Enlarges to this many errors.
    pub(super) fn widen(&mut self, errors: usize) {
        self.information.resize_mut(errors, errors, 0.0);
        self.pull.resize_vertically_mut(errors, 0.0);
    }

    /// Forgets `count` errors from `first` on, which are other errors from now on. The information
    /// on all others becomes what it is if these may have been anything (the Schur complement);
    /// what those explain is no miss.
    pub(super) fn forget(&mut self, first: usize, count: usize) {
        let own = self.information.view((first, first), (count, count)).into_owned();
        let own_pull = self.pull.rows(first, count).into_owned();
        let mut ties = self.information.columns(first, count).into_owned();
        // Some of them may not have been seen at all.
        let least = DMatrix::identity(count, count) * (UNSEEN * self.weight);
        // I <- I - T I_ff^-1 T', and the same for the pull.
        if let Some(factor) = (own + least).cholesky() {
            self.information -= &ties * factor.solve(&ties.transpose());
            self.pull -= &ties * factor.solve(&own_pull);
            self.squares -= own_pull.dot(&factor.solve(&own_pull));
        } else {
            self.information.fill(0.0);
            self.pull.fill(0.0);
            (self.squares, self.coordinates) = (0.0, 0.0);
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
        let known =
            Mat::from_fn(size, size, |i, j| self.information[(i, j)] / self.weight + prior(i, j));
        let inverse = known.llt(Side::Lower).ok()?.inverse();
        let covariance = DMatrix::from_fn(size, size, |i, j| inverse[(i, j)]);
        let mean = &covariance * (&self.pull / self.weight);
        // The least of z' W z - 2 h' s + s' A s is at s = A^-1 h.
        let unexplained = (self.squares - self.pull.dot(&mean)) / self.weight;
        let coordinates = self.coordinates / self.weight;
        Some(ErrorEstimate { mean, covariance, unexplained, coordinates })
    }
}
