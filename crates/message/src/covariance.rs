use std::ops::Range;

use nalgebra::{DMatrix, SMatrix, SVector};

/// Whether a matrix is a covariance: finite, symmetric and positive semidefinite, to within
/// rounding relative to the largest variance of each unit. `units` are the index ranges that share
/// a unit.
pub(crate) fn is_covariance<const N: usize>(
    matrix: &SMatrix<f64, N, N>,
    units: &[Range<usize>],
) -> bool {
    if !matrix.iter().all(|value| value.is_finite()) {
        return false;
    }
    // Scaled by one over the largest standard deviation of each unit, all numbers are comparable.
    let mut by = SVector::<f64, N>::zeros();
    for unit in units {
        let largest = unit.clone().map(|place| matrix[(place, place)]).fold(0.0, f64::max);
        if largest > 0.0 {
            by.rows_range_mut(unit.clone()).fill(largest.sqrt().recip());
        } else if matrix.rows_range(unit.clone()).amax() > 0.0
            || matrix.columns_range(unit.clone()).amax() > 0.0
        {
            // A parameter without variance cannot correlate with anything.
            return false;
        }
    }
    let scale = SMatrix::from_diagonal(&by);
    let scaled = scale * matrix * scale;
    let is_symmetric = (scaled - scaled.transpose()).amax() <= 1e-9;
    // No negative variance along any axis: all eigenvalues are at least 0 to within rounding.
    let axes = DMatrix::from_column_slice(N, N, scaled.as_slice()).symmetric_eigenvalues();
    is_symmetric && axes.min() >= -1e-9
}

#[cfg(test)]
mod tests {
    use std::slice;

    use nalgebra::{Matrix2, Matrix3, Rotation3, Vector3};

    use super::*;

    #[test]
    fn what_ties_numbers_of_two_units_is_held_to_both() {
        let possible = |xx, xy, yx, yy| is_covariance(&Matrix2::new(xx, xy, yx, yy), &[0..1, 1..2]);
        assert!(possible(0.0, 0.0, 0.0, 0.0));
        assert!(possible(1e-6, 0.99, 0.99, 1e6));
        assert!(!possible(1e-6, 1.01, 1.01, 1e6));
        assert!(!possible(1e-6, 0.5, 0.4, 1e6));
        assert!(!possible(1.0, 0.0, 0.0, -1e-12));
        assert!(!possible(0.0, 0.1, 0.1, 1.0));
        assert!(!possible(0.0, 0.0, 0.1, 1.0));
        assert!(!possible(f64::NAN, 0.0, 0.0, 1.0));
    }

    /// Some variances are nearly zero after the turn, and may be slightly negative.
    #[test]
    fn what_is_unknown_about_one_axis_alone_may_be_turned() {
        let about_up = Matrix3::from_diagonal(&Vector3::new(0.0, 0.0, 1e-4));
        for step in 0..1000 {
            let turn = Rotation3::new(Vector3::new(0.1, 0.7, -0.3) * f64::from(step));
            let turned = turn.matrix() * about_up * turn.matrix().transpose();
            assert!(is_covariance(&turned, slice::from_ref(&(0..3))), "{turned}");
        }
    }
}
