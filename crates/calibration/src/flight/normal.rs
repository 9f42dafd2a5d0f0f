//! Normal equations of a long chain of unknowns, each tied to its neighbours, and a few that are
//! tied to all: the chain's block is banded and is eliminated by Cholesky.

use nalgebra::{Cholesky, DMatrix, DVector};

/// An unknown that has a part in a residual, and the residual's derivative by it.
pub(super) type Term = (usize, f64);

/// `J'WJ` and `-J'Wr` of weighted residuals, gathered row by row.
///
/// Unknowns are counted with the chain first.
#[derive(Clone, Debug)]
pub(super) struct NormalEquations {
    /// Unknowns of the chain.
    chain: usize,
    /// Its block: `band[k * width + d]` ties unknown k to unknown k - d.
    band: Vec<f64>,
    width: usize,
    /// How the chain (rows) is tied to the others (columns).
    cross: DMatrix<f64>,
    others: DMatrix<f64>,
    right: DVector<f64>,
}

/// The solution, and what is left of the others' block when the chain is eliminated.
pub(super) struct Solution {
    /// A step of all unknowns.
    pub(super) step: DVector<f64>,
    /// Information on the others alone.
    pub(super) schur: DMatrix<f64>,
    factor: Vec<f64>,
    width: usize,
}

/// The covariance of the chain's unknowns with their neighbours, the others held.
pub(super) struct ChainCovariance {
    /// `band[k * width + d]` is of unknowns k and k + d.
    band: Vec<f64>,
    width: usize,
}

impl Solution {
    /// By Takahashi's recursion: from `L' Z = L^-1`, whose upper triangle is diagonal, an element of
    /// `Z = A^-1` within the band hangs on others within it.
    pub(super) fn chain_covariance(&self) -> ChainCovariance {
        let Self { factor, width, .. } = self;
        let (width, chain) = (*width, factor.len() / width);
        let mut band = vec![0.0; factor.len()];
        for row in (0..chain).rev() {
            let inverse_diagonal = factor[row * width];
            let reach = width.min(chain - row);
            for ahead in (0..reach).rev() {
                let column = row + ahead;
                let mut value = if ahead == 0 { inverse_diagonal } else { 0.0 };
                for below in 1..reach {
                    let k = row + below;
                    let (least, most) = (k.min(column), k.max(column));
                    value -= factor[k * width + below] * band[least * width + most - least];
                }
                band[row * width + ahead] = value * inverse_diagonal;
            }
        }
        ChainCovariance { band, width }
    }
}

impl ChainCovariance {
    /// The variance of a sum of the chain's unknowns, all within the band's width.
    pub(super) fn variance(&self, terms: &[Term]) -> f64 {
        let pairs = terms.iter().flat_map(|a| terms.iter().map(move |b| (a, b)));
        pairs
            .map(|(&(i, x), &(j, y))| x * y * self.band[i.min(j) * self.width + i.abs_diff(j)])
            .sum()
    }
}

impl NormalEquations {
    /// Of a chain whose unknowns are tied over less than `width`, and of `others`.
    pub(super) fn new(chain: usize, width: usize, others: usize) -> Self {
        Self {
            chain,
            band: vec![0.0; chain * width],
            width,
            cross: DMatrix::zeros(chain, others),
            others: DMatrix::zeros(others, others),
            right: DVector::zeros(chain + others),
        }
    }

    /// Takes a residual in with its weight. Terms may name an unknown more than once.
    pub(super) fn add(&mut self, terms: &[Term], residual: f64, weight: f64) {
        for &(row, by_row) in terms {
            let weighed = weight * by_row;
            if weighed == 0.0 {
                continue;
            }
            self.right[row] -= weighed * residual;
            for &(column, by_column) in terms {
                if column > row {
                    continue;
                }
                let product = weighed * by_column;
                match (row < self.chain, column < self.chain) {
                    (true, _) => {
                        debug_assert!(row - column < self.width, "beyond the band");
                        self.band[row * self.width + row - column] += product;
                    }
                    (false, true) => self.cross[(column, row - self.chain)] += product,
                    (false, false) => {
                        self.others[(row - self.chain, column - self.chain)] += product;
                    }
                }
            }
        }
    }

    /// Solves them, each diagonal element made larger by a share of itself. `None`: they have no
    /// solution, as some unknown is tied to nothing.
    pub(super) fn solve(mut self, damping: f64) -> Option<Solution> {
        for k in 0..self.chain {
            self.band[k * self.width] *= 1.0 + damping;
        }
        for k in 0..self.others.nrows() {
            self.others[(k, k)] *= 1.0 + damping;
        }
        self.factor_band()?;
        let Self { chain, ref mut cross, ref mut others, ref right, .. } = self;
        let mut ahead = right.rows(0, chain).into_owned();
        forward(&self.band, self.width, ahead.as_mut_slice());
        for mut column in cross.column_iter_mut() {
            forward(&self.band, self.width, column.as_mut_slice());
        }
        others.fill_upper_triangle_with_lower_triangle();
        // S = D - B A^-1 B' with A = L L': the chain is gone.
        others.gemm(-1.0, &cross.transpose(), cross, 1.0);
        let reduced = right.rows(chain, others.nrows()) - cross.tr_mul(&ahead);
        let schur = others.clone();
        let other_step = Cholesky::new(schur.clone())?.solve(&reduced);
        ahead -= &*cross * &other_step;
        backward(&self.band, self.width, ahead.as_mut_slice());
        let mut step = DVector::zeros(right.len());
        step.rows_mut(0, chain).copy_from(&ahead);
        step.rows_mut(chain, other_step.len()).copy_from(&other_step);
        Some(Solution { step, schur, factor: self.band, width: self.width })
    }

    /// The chain's block becomes its lower triangular factor, whose diagonal is inverted.
    fn factor_band(&mut self) -> Option<()> {
        let width = self.width;
        for row in 0..self.chain {
            let reach = width.min(row + 1);
            for back in (0..reach).rev() {
                let column = row - back;
                // Elements left of both, that exist in both rows.
                let shared = (width - 1 - back).min(column);
                let own = row * width + back + 1;
                let their = column * width + 1;
                let product: f64 = self.band[own..own + shared]
                    .iter()
                    .zip(&self.band[their..their + shared])
                    .map(|(a, b)| a * b)
                    .sum();
                let left = self.band[row * width + back] - product;
                self.band[row * width + back] = if back > 0 {
                    left * self.band[column * width]
                } else if left > 0.0 && left.is_finite() {
                    left.sqrt().recip()
                } else {
                    return None;
                };
            }
        }
        Some(())
    }
}

/// Solves `L x = b` in place.
fn forward(band: &[f64], width: usize, values: &mut [f64]) {
    let start = values.iter().position(|value| *value != 0.0).unwrap_or(values.len());
    for row in start..values.len() {
        let reach = (width - 1).min(row - start);
        let factor = &band[row * width..][..=reach];
        let known = &values[row - reach..row];
        let sum: f64 = factor[1..].iter().zip(known.iter().rev()).map(|(l, x)| l * x).sum();
        values[row] = (values[row] - sum) * factor[0];
    }
}

/// Solves `L' x = b` in place.
fn backward(band: &[f64], width: usize, values: &mut [f64]) {
    for row in (0..values.len()).rev() {
        let reach = (width - 1).min(row);
        let factor = &band[row * width..][..=reach];
        let value = values[row] * factor[0];
        values[row] = value;
        for (back, l) in factor.iter().enumerate().skip(1) {
            values[row - back] -= l * value;
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn the_solution_and_the_information_are_those_of_the_dense_equations() {
        const CHAIN: usize = 30;
        const WIDTH: usize = 6;
        const OTHERS: usize = 5;
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut equations = NormalEquations::new(CHAIN, WIDTH, OTHERS);
        let mut dense = DMatrix::<f64>::zeros(CHAIN + OTHERS, CHAIN + OTHERS);
        let mut right = DVector::zeros(CHAIN + OTHERS);
        for _ in 0..400 {
            let first = random.random_range(0..=CHAIN - WIDTH);
            let other = CHAIN + random.random_range(0..OTHERS);
            let columns = (first..first + WIDTH).chain([other]);
            let terms: Vec<Term> = columns.map(|c| (c, random.random_range(-1.0..1.0))).collect();
            let residual = random.random_range(-1.0..1.0);
            equations.add(&terms, residual, 2.0);
            for &(row, by_row) in &terms {
                right[row] -= 2.0 * by_row * residual;
                for &(column, by_column) in &terms {
                    dense[(row, column)] += 2.0 * by_row * by_column;
                }
            }
        }
        let expected = dense.clone().lu().solve(&right).unwrap();
        let solution = equations.solve(0.0).unwrap();
        assert!((&solution.step - expected).amax() < 1e-9);
        let covariance = dense.clone().try_inverse().unwrap();
        let marginal = covariance.view((CHAIN, CHAIN), (OTHERS, OTHERS));
        let held = dense.view((0, 0), (CHAIN, CHAIN)).into_owned().try_inverse().unwrap();
        let terms = [(7, 0.5), (9, -2.0), (12, 1.0)];
        let expected: f64 =
            terms.iter().flat_map(|a| terms.iter().map(|b| a.1 * b.1 * held[(a.0, b.0)])).sum();
        let found = solution.chain_covariance().variance(&terms);
        assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        let product = solution.schur * marginal;
        assert!((product - DMatrix::identity(OTHERS, OTHERS)).amax() < 1e-9);
    }

    #[test]
    fn an_unknown_that_is_tied_to_nothing_has_no_solution() {
        let mut equations = NormalEquations::new(3, 2, 1);
        equations.add(&[(0, 1.0)], 1.0, 1.0);
        assert!(equations.solve(0.0).is_none());
    }
}
