//! The normal equations of a registration's step.

use nalgebra::{SMatrix, SVector};

use super::LEAST_COMMON;

/// Longest step, pixels, of the shift, and at the picture's reach of roll and zoom: a longer one is
/// a mistake, and is cut to this. With half of it turns of more than six pixels are not reached.
const LONGEST_STEP: f32 = 2.0;
/// Sums of a pixel's products that are made at a time, for vector instructions: six are needed, and
/// half of it has no room for them.
const PADDED_TERMS: usize = 8;
/// Pixels, of those that are summed, that tell as much as an independent one: the pictures are
/// smooth. With half of it roll and zoom are freer, by the root of two.
const INDEPENDENT: f32 = 18.0;
/// Least variance of a pixel's difference, levels^2: that of rounding. With half of it the same.
const LEAST_VARIANCE: f32 = 1e-4;

/// Normal equations of one step of the registration: for the shift, for zoom and roll in pixels at
/// the reach of the picture, and for the change of brightness.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RegistrationEquations {
    /// Weighted sums of the products of all pairs of a pixel's four slopes, 1, and its difference.
    sums: [[f32; PADDED_TERMS]; 6],
}

impl RegistrationEquations {
    /// Sum of the weights.
    fn weight(&self) -> f32 {
        self.sums[4][4]
    }

    /// Mean difference of brightness, levels; 0 where nothing is in common.
    pub(super) fn brighter(&self) -> f32 {
        self.sums[4][5] / self.weight().max(1.0)
    }

    #[inline(always)]
    pub(super) fn add(&mut self, weight: f32, [a, b, c, d]: [f32; 4], off: f32) {
        let row = [a, b, c, d, 1.0, off, 0.0, 0.0];
        for (sums, of) in self.sums.iter_mut().zip(row) {
            for (sum, with) in sums.iter_mut().zip(row) {
                *sum += weight * of * with;
            }
        }
    }

    /// By how much the squared differences become less by the step, in units of one pixel's mean.
    pub(super) fn gain(&self, off: [f32; 2], sd: f32) -> f32 {
        let Some(step) = self.solution(off, sd) else { return 0.0 };
        let (n, brighter) = (self.weight(), self.brighter());
        // b' A^-1 b, less what a change of brightness alone explains.
        let explained: f32 = (0..5).map(|i| step[i] * self.sums[i][5]).sum();
        let squares = self.sums[5][5] - n * brighter.powi(2);
        (explained - n * brighter.powi(2)) / (squares / n).max(LEAST_VARIANCE)
    }

    /// The step of the shift, of zoom and of roll; `None` where the equations do not determine the
    /// shift. See [`Self::solution`].
    pub(super) fn step(&self, off: [f32; 2], sd: f32) -> Option<[f32; 4]> {
        let solution = self.solution(off, sd)?;
        Some(std::array::from_fn(|i| solution[i].clamp(-LONGEST_STEP, LONGEST_STEP)))
    }

    /// The step that solves the equations, with the change of brightness. `off` is by how much zoom
    /// and roll, each in pixels at the picture's reach, are short of what is expected of them, and
    /// `sd` the standard deviation of that.
    fn solution(&self, off: [f32; 2], sd: f32) -> Option<SVector<f32, 5>> {
        let n = self.weight();
        if n < LEAST_COMMON {
            return None;
        }
        let about_mean =
            |i: usize, j: usize| self.sums[i][j] - self.sums[i][4] * self.sums[j][4] / n;
        let [xx, xy, yy] = [about_mean(0, 0), about_mean(0, 1), about_mean(1, 1)];
        // A single straight edge shows no shift along itself: the determinant vanishes against the
        // squared trace.
        let determinant = xx * yy - xy * xy;
        if determinant <= 1e-6 * (xx + yy).powi(2) || determinant <= 0.0 {
            return None;
        }
        let mut normal = SMatrix::<f32, 5, 5>::from_fn(|i, j| self.sums[i][j]);
        let mut right = SVector::<f32, 5>::from_fn(|i, _| self.sums[i][5]);
        let variance = (self.sums[5][5] / n - self.brighter().powi(2)).max(LEAST_VARIANCE);
        for (i, off) in [2, 3].into_iter().zip(off) {
            // A pixel's information is that of one in `INDEPENDENT`; with no deviation at all, next
            // to nothing moves them.
            let prior =
                if sd > 0.0 { INDEPENDENT * variance / sd.powi(2) } else { 1e6 * (xx + yy) };
            normal[(i, i)] += prior;
            right[i] += prior * off;
        }
        Some(normal.cholesky()?.solve(&right))
    }
}
