//! Normal equations of a long chain of unknowns, each tied to its neighbours, and a few others that
//! are tied to all: the chain's block is banded and is eliminated by Cholesky.

use nalgebra::{Cholesky, DMatrix, DVector};

/// An unknown that a residual depends on, and the residual's derivative with respect to it.
pub(super) type Derivative = (usize, f64);

/// A residual divided by its standard deviation, with the unknowns that it depends on.
pub(super) type ResidualRow = (Vec<Derivative>, f64);

/// An unknown that two residuals depend on, with both derivatives.
type TwoTerms = (usize, [f64; 2]);

/// Normal equations, `J'WJ` and `-J'Wr` of weighted residuals, summed row by row.
///
/// The unknowns of the chain come first, then the others.
#[derive(Clone, Debug)]
pub(super) struct NormalEquations {
    /// Number of unknowns in the chain.
    chain: usize,
    /// The chain's block: `band[k * width + d]` is the element of unknowns k and k - d.
    band: Vec<f64>,
    width: usize,
    /// Block of the others (rows) and the chain (columns).
    cross: DMatrix<f64>,
    others: DMatrix<f64>,
    right: DVector<f64>,
    /// Buffers for the terms of two rows.
    of_chain: Vec<TwoTerms>,
    of_others: Vec<TwoTerms>,
}

/// The solution, and the others' block once the chain is eliminated (its Schur complement).
pub(super) struct Solution {
    /// Step of all unknowns.
    pub(super) step: DVector<f64>,
    /// Information on the others, with the chain marginalised out.
    schur: DMatrix<f64>,
    /// The chain block's factor L, and the cross block B solved by it, `B L'^-1`.
    factor: Vec<f64>,
    cross: DMatrix<f64>,
    width: usize,
}

/// Covariance of the unknowns, within the chain only as far as rows tie them.
pub(super) struct Covariance {
    /// Covariance of the chain's unknowns with the others fixed: `band[k * width + d]` is the
    /// element of unknowns k and k + d.
    band: Vec<f64>,
    width: usize,
    /// Derivative of the chain (columns) with respect to the others (rows), `-B A^-1`.
    follows: DMatrix<f64>,
    /// Covariance of the others.
    others: DMatrix<f64>,
    /// Information on the others, with the chain marginalised out.
    information: DMatrix<f64>,
}

impl Solution {
    /// Covariance by Takahashi's recursion: from `L' Z = L^-1`, where `L^-1` has only its diagonal
    /// in the upper triangle, an element of `Z = A^-1` within the band depends only on others
    /// within the band.
    pub(super) fn covariance(self) -> Option<Covariance> {
        let Self { schur, factor, mut cross, width, .. } = self;
        let chain = factor.len() / width;
        let mut band = vec![0.0; factor.len()];
        // A copy of `band`, indexed by the later unknown with the farthest first, so that both
        // products below run over adjacent memory.
        let mut back = vec![0.0; factor.len()];
        let mut below = vec![0.0; width];
        for row in (0..chain).rev() {
            // `factor` stores the inverted diagonal, 1 / L[row][row].
            let inverse_diagonal = factor[row * width];
            let reach = width.min(chain - row);
            let below = &mut below[..reach];
            below.iter_mut().enumerate().for_each(|(d, l)| *l = factor[(row + d) * width + d]);
            for ahead in (0..reach).rev() {
                let column = row + ahead;
                let nearer = &back[(column + 1) * width - ahead..][..ahead];
                let farther = &band[column * width + 1..][..reach - ahead - 1];
                // Sum over k > row of L[k][row] Z[k][column], with k before the column and from it
                // on.
                let known =
                    dot(&below[1..ahead + 1], &nearer[..ahead]) + dot(&below[ahead + 1..], farther);
                let diagonal = if ahead == 0 { inverse_diagonal } else { 0.0 };
                // Z[row][column] = ((L^-1)[row][column] - sum) / L[row][row]
                let value = (diagonal - known) * inverse_diagonal;
                band[row * width + ahead] = value;
                back[column * width + width - 1 - ahead] = value;
            }
        }
        let others = cross.nrows();
        // `cross` was B L'^-1 and becomes B A^-1.
        backward(&factor, width, cross.as_mut_slice(), others);
        cross.neg_mut();
        let others = Cholesky::new(schur.clone())?.inverse();
        Some(Covariance { band, width, follows: cross, others, information: schur })
    }
}

impl Covariance {
    /// Variance of a linear combination of the chain's unknowns, all within the band's width, the
    /// others fixed.
    pub(super) fn variance_with_others_fixed(&self, terms: &[Derivative]) -> f64 {
        let covariance = |i: usize, j: usize| self.band[i.min(j) * self.width + i.abs_diff(j)];
        let mut sum = 0.0;
        for (at, &(i, x)) in terms.iter().enumerate() {
            let before = terms[..at].iter().map(|&(j, y)| y * covariance(i, j)).sum::<f64>();
            sum += x * (x * covariance(i, i) + 2.0 * before);
        }
        sum
    }

    /// Variance of a linear combination of unknowns, those of the chain within the band's width.
    pub(super) fn variance(&self, terms: &[Derivative]) -> f64 {
        let chain = self.follows.ncols();
        let (of_chain, of_others): (Vec<Derivative>, Vec<Derivative>) =
            terms.iter().partition(|(unknown, _)| *unknown < chain);
        let mut by_others = DVector::zeros(self.others.nrows());
        for &(unknown, by) in &of_chain {
            by_others.axpy(by, &self.follows.column(unknown), 1.0);
        }
        for (unknown, by) in of_others {
            by_others[unknown - chain] += by;
        }
        // Law of total variance: c' Z c with the others fixed, plus g' P g, where g is the
        // combination's total derivative by the others and P their covariance.
        self.variance_with_others_fixed(&of_chain) + by_others.dot(&(&self.others * &by_others))
    }

    /// Covariance of all unknowns outside the chain.
    pub(super) fn others(&self) -> &DMatrix<f64> {
        &self.others
    }

    /// Information on all unknowns outside the chain.
    pub(super) fn information(&self) -> &DMatrix<f64> {
        &self.information
    }

    /// Subtracts a part of the others' covariance that is stated elsewhere.
    pub(super) fn take_off(&mut self, part: &DMatrix<f64>) {
        self.others -= part;
    }
}

impl NormalEquations {
    /// Empty equations of a chain whose unknowns are tied over less than `width`, and of `others`.
    pub(super) fn new(chain: usize, width: usize, others: usize) -> Self {
        Self {
            chain,
            band: vec![0.0; chain * width],
            width,
            cross: DMatrix::zeros(others, chain),
            others: DMatrix::zeros(others, others),
            right: DVector::zeros(chain + others),
            of_chain: Vec::new(),
            of_others: Vec::new(),
        }
    }

    /// Adds residuals with their weight. Terms may name an unknown more than once.
    pub(super) fn add(&mut self, rows: &[ResidualRow], weight: f64) {
        if let [(first, a), (second, b)] = rows
            && first.len() == second.len()
            && first.iter().zip(second).all(|(first, second)| first.0 == second.0)
        {
            // Both axes of a label depend on the same unknowns: their indices are looked up once
            // for both.
            let pairs = first.iter().zip(second);
            return self.add_two(pairs.map(|(a, b)| (a.0, [a.1, b.1])), [*a, *b], weight);
        }
        for (terms, residual) in rows {
            let terms = terms.iter().map(|(unknown, by)| (*unknown, [*by, 0.0]));
            self.add_two(terms, [*residual, 0.0], weight);
        }
    }

    /// Adds two residuals that depend on the same unknowns.
    fn add_two(&mut self, terms: impl Iterator<Item = TwoTerms>, residuals: [f64; 2], weight: f64) {
        let (mut of_chain, mut of_others) =
            (std::mem::take(&mut self.of_chain), std::mem::take(&mut self.of_others));
        for (unknown, by) in terms.filter(|(_, by)| *by != [0.0; 2]) {
            self.right[unknown] -= weight * (by[0] * residuals[0] + by[1] * residuals[1]);
            if unknown < self.chain {
                of_chain.push((unknown, by));
            } else {
                of_others.push((unknown - self.chain, by));
            }
        }
        in_order(&mut of_chain);
        in_order(&mut of_others);
        for (at, &(row, by_row)) in of_chain.iter().enumerate() {
            let weighed = by_row.map(|by| weight * by);
            let band = &mut self.band[row * self.width..][..self.width];
            for &(column, by) in &of_chain[..=at] {
                band[row - column] += weighed[0] * by[0] + weighed[1] * by[1];
            }
            let mut ties = self.cross.column_mut(row);
            let ties = ties.as_mut_slice();
            for &(other, by) in &of_others {
                ties[other] += weighed[0] * by[0] + weighed[1] * by[1];
            }
        }
        for (at, &(column, by_column)) in of_others.iter().enumerate() {
            let weighed = by_column.map(|by| weight * by);
            let mut ties = self.others.column_mut(column);
            let ties = ties.as_mut_slice();
            // The lower triangle.
            for &(row, by) in &of_others[at..] {
                ties[row] += weighed[0] * by[0] + weighed[1] * by[1];
            }
        }
        of_chain.clear();
        of_others.clear();
        (self.of_chain, self.of_others) = (of_chain, of_others);
    }

    /// Adds to the right side: a term of the cost whose derivative with respect to the unknown is
    /// minus twice this.
    pub(super) fn push(&mut self, unknown: usize, by: f64) {
        self.right[unknown] += by;
    }

    /// Solves the equations, each diagonal element enlarged by the share `damping` of itself.
    /// `None`: no solution, as some unknown is tied to nothing.
    pub(super) fn solve(mut self, damping: f64) -> Option<Solution> {
        for k in 0..self.chain {
            self.band[k * self.width] *= 1.0 + damping;
        }
        for k in 0..self.others.nrows() {
            self.others[(k, k)] *= 1.0 + damping;
        }
        self.factor_band()?;
        let Self { chain, ref mut cross, ref mut others, ref right, .. } = self;
        // ahead = L^-1 b, cross = B L'^-1.
        let mut ahead = right.rows(0, chain).into_owned();
        forward(&self.band, self.width, ahead.as_mut_slice(), 1);
        let count = others.nrows();
        forward(&self.band, self.width, cross.as_mut_slice(), count);
        others.fill_upper_triangle_with_lower_triangle();
        // S = D - B A^-1 B' with A = L L': the Schur complement, in which the chain is eliminated.
        others.gemm(-1.0, cross, &cross.transpose(), 1.0);
        // S x = c - B A^-1 b for the others, then L' y = L^-1 b - (B L'^-1)' x for the chain.
        let reduced = right.rows(chain, count) - &*cross * &ahead;
        let schur = others.clone();
        let other_step = Cholesky::new(schur.clone())?.solve(&reduced);
        ahead -= cross.tr_mul(&other_step);
        backward(&self.band, self.width, ahead.as_mut_slice(), 1);
        let mut step = DVector::zeros(right.len());
        step.rows_mut(0, chain).copy_from(&ahead);
        step.rows_mut(chain, other_step.len()).copy_from(&other_step);
        Some(Solution { step, schur, factor: self.band, cross: self.cross, width: self.width })
    }

    /// Replaces the chain's block by its lower triangular factor, whose diagonal is stored
    /// inverted.
    fn factor_band(&mut self) -> Option<()> {
        let width = self.width;
        for row in 0..self.chain {
            let reach = width.min(row + 1);
            for back in (0..reach).rev() {
                let column = row - back;
                // Elements left of both that exist in both rows.
                let shared = (width - 1 - back).min(column);
                let own = row * width + back + 1;
                let their = column * width + 1;
                let product = dot(&self.band[own..own + shared], &self.band[their..their + shared]);
                let left = self.band[row * width + back] - product;
                // L[i][j] = (A[i][j] - sum over k < j of L[i][k] L[j][k]) / L[j][j]; on the
                // diagonal the root.
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

/// Sorts terms by their unknowns and sums those of the same unknown.
fn in_order(terms: &mut Vec<TwoTerms>) {
    terms.sort_unstable_by_key(|(unknown, _)| *unknown);
    terms.dedup_by(|next, first| {
        let is_same = next.0 == first.0;
        if is_same {
            (0..2).for_each(|row| first.1[row] += next.1[row]);
        }
        is_same
    });
}

/// Solves `L x = b` in place, for `sides` right sides that are interleaved in memory.
fn forward(band: &[f64], width: usize, values: &mut [f64], sides: usize) {
    let rows = values.len() / sides.max(1);
    for row in 0..rows {
        let (known, rest) = values.split_at_mut(row * sides);
        let own = &mut rest[..sides];
        let factor = &band[row * width..][..width.min(row + 1)];
        for (back, &l) in factor.iter().enumerate().skip(1) {
            less(own, l, &known[(row - back) * sides..][..sides]);
        }
        own.iter_mut().for_each(|value| *value *= factor[0]);
    }
}

/// Solves `L' x = b` in place, for right sides stored alike.
fn backward(band: &[f64], width: usize, values: &mut [f64], sides: usize) {
    let rows = values.len() / sides.max(1);
    for row in (0..rows).rev() {
        let (before, rest) = values.split_at_mut(row * sides);
        let own = &mut rest[..sides];
        let factor = &band[row * width..][..width.min(row + 1)];
        own.iter_mut().for_each(|value| *value *= factor[0]);
        for (back, &l) in factor.iter().enumerate().skip(1) {
            less(&mut before[(row - back) * sides..][..sides], l, own);
        }
    }
}

/// Scalar product, as four partial sums that a processor can compute in parallel.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a, b) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum::<f64>();
    let mut sums = [0.0; 4];
    for (a, b) in a.zip(b) {
        (0..4).for_each(|k| sums[k] += a[k] * b[k]);
    }
    sums.iter().sum::<f64>() + rest
}

/// Subtracts a multiple of other values.
fn less(values: &mut [f64], times: f64, others: &[f64]) {
    if times != 0.0 {
        values.iter_mut().zip(others).for_each(|(value, other)| *value -= times * other);
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
            let terms: Vec<Derivative> =
                columns.map(|c| (c, random.random_range(-1.0..1.0))).collect();
            let residual = random.random_range(-1.0..1.0);
            // Another row with the same unknowns, and one that names an unknown twice.
            let turned = terms.iter().rev().map(|(_, by)| *by).zip(&terms);
            let second: Vec<Derivative> = turned.map(|(by, (c, _))| (*c, by)).collect();
            let twice: Vec<Derivative> = terms.iter().chain(&second[..2]).copied().collect();
            equations.add(&[(terms.clone(), residual), (second.clone(), 0.3)], 2.0);
            equations.add(&[(twice.clone(), -residual)], 2.0);
            for (terms, residual) in [(terms, residual), (second, 0.3), (twice, -residual)] {
                for &(row, by_row) in &terms {
                    right[row] -= 2.0 * by_row * residual;
                    for &(column, by_column) in &terms {
                        dense[(row, column)] += 2.0 * by_row * by_column;
                    }
                }
            }
        }
        let expected = dense.clone().lu().solve(&right).unwrap();
        let solution = equations.solve(0.0).unwrap();
        assert!((&solution.step - expected).amax() < 1e-9);
        let covariance = dense.clone().try_inverse().unwrap();
        let marginal = covariance.view((CHAIN, CHAIN), (OTHERS, OTHERS));
        let inverse = dense.view((0, 0), (CHAIN, CHAIN)).into_owned().try_inverse().unwrap();
        let found = solution.covariance().unwrap();
        assert!((found.others() - marginal).amax() < 1e-9);
        let sum = |terms: &[Derivative], of: &DMatrix<f64>| -> f64 {
            terms.iter().flat_map(|a| terms.iter().map(|b| a.1 * b.1 * of[(a.0, b.0)])).sum()
        };
        let terms = [(7, 0.5), (9, -2.0), (12, 1.0)];
        assert!((found.variance_with_others_fixed(&terms) - sum(&terms, &inverse)).abs() < 1e-9);
        let terms = [(7, 0.5), (CHAIN + 2, 0.7), (9, -2.0), (12, 1.0), (CHAIN, -0.3)];
        assert!((found.variance(&terms) - sum(&terms, &covariance)).abs() < 1e-9);
    }

    #[test]
    fn an_unknown_that_is_tied_to_nothing_has_no_solution() {
        let mut equations = NormalEquations::new(3, 2, 1);
        equations.add(&[(vec![(0, 1.0)], 1.0)], 1.0);
        assert!(equations.solve(0.0).is_none());
    }
}
