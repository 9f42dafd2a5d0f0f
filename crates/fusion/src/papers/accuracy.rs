//! Accuracy of ranges, from the angles between the lines alone (Klochko 2020, the section on
//! accuracy).

use nalgebra::{Matrix2, Matrix3};

/// Covariance of the ranges of [`super::pair`], m^2 (Klochko 2020, eq. 12).
///
/// `angle` is the angle between the lines, rad; `equation_sd` the standard deviation of each
/// coordinate of the vector `e_2` of equation 4, m, the coordinates being uncorrelated. The
/// covariance is least at a right angle, where the range is as good as the equation. `None` for
/// parallel lines.
pub fn pair_range_covariance(angle: f64, equation_sd: f64) -> Option<Matrix2<f64>> {
    let (sin, cos) = angle.sin_cos();
    let sine_square = sin * sin;
    (sine_square > f64::EPSILON)
        .then(|| Matrix2::new(1.0, cos, cos, 1.0) * equation_sd.powi(2) / sine_square)
}

/// Covariance of the ranges of three receivers at one time, without velocity, m^2 (Klochko 2020,
/// eq. 13).
///
/// `alpha` is the angle between the first line and the second, `beta` that between the first and
/// the third, rad; `equation_sd` as in [`pair_range_covariance`].
///
/// The formula takes all six coordinates of `e_2` and `e_3` to be uncorrelated. Both contain the
/// error of the first receiver's `r_1 a_1`, so that with equal, isotropic errors of the three
/// points their coordinates have a correlation of one half, and the formula is optimistic
/// (erratum): for three perpendicular lines the true standard deviation of `r_1` is 1.22 times as
/// large. `None` if all lines are parallel.
pub fn triple_range_covariance(alpha: f64, beta: f64, equation_sd: f64) -> Option<Matrix3<f64>> {
    let ((sin_a, cos_a), (sin_b, cos_b)) = (alpha.sin_cos(), beta.sin_cos());
    let (square_a, square_b) = (sin_a * sin_a, sin_b * sin_b);
    let sum = square_a + square_b;
    let both = cos_a * cos_b;
    // The adjugate of A'A, where A has the rows r1 a1 - rk ak (k = 2, 3): A'A = [2 -cos a -cos b;
    // -cos a 1 0; -cos b 0 1], with `sum` as its determinant.
    let (to_a, to_b) = ([cos_a, 1.0 + square_b, both], [cos_b, both, 1.0 + square_a]);
    let adjugate = Matrix3::from_row_slice([[1.0, cos_a, cos_b], to_a, to_b].as_flattened());
    (sum > f64::EPSILON).then(|| adjugate * equation_sd.powi(2) / sum)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3x2, Matrix6x3, SMatrix, SVector, Vector3, Vector6};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const RUNS: u32 = 40_000;
    /// Three standard errors of a variance, relative.
    const TOLERANCE: f64 = 0.0213;
    const SD: f64 = 0.1;
    /// Angles of 50 and 75 degrees with the first line, not in a plane.
    fn directions() -> [Vector3<f64>; 3] {
        let at = |angle: f64, turn: f64| {
            let (sin, cos) = angle.to_radians().sin_cos();
            Vector3::new(cos, sin * turn.cos(), sin * turn.sin())
        };
        [Vector3::x(), at(50.0, 0.0), at(75.0, 1.0)]
    }

    fn angles() -> [f64; 2] {
        [50f64.to_radians(), 75f64.to_radians()]
    }

    /// Covariance of the least squares solutions of a system with this noise on its right-hand
    /// side.
    fn covariance<const E: usize, const U: usize>(
        a: &SMatrix<f64, E, U>,
        mut noise: impl FnMut() -> SVector<f64, E>,
    ) -> SMatrix<f64, U, U> {
        let inverse = (a.transpose() * a).try_inverse().unwrap() * a.transpose();
        let mut sum = SMatrix::zeros();
        for _ in 0..RUNS {
            let error = inverse * noise();
            sum += error * error.transpose();
        }
        sum / f64::from(RUNS)
    }

    fn normals() -> impl FnMut() -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        move || StandardNormal.sample(&mut rng)
    }

    fn system_of_three(a: [Vector3<f64>; 3]) -> Matrix6x3<f64> {
        let mut matrix = Matrix6x3::zeros();
        for (row, k) in [(0, 1), (3, 2)] {
            matrix.fixed_view_mut::<3, 1>(row, 0).copy_from(&a[0]);
            matrix.fixed_view_mut::<3, 1>(row, k).copy_from(&-a[k]);
        }
        matrix
    }

    /// Compares every element, relative to the diagonal.
    fn assert_near<const N: usize>(found: &SMatrix<f64, N, N>, formula: &SMatrix<f64, N, N>) {
        for i in 0..N {
            for j in 0..N {
                let scale = (formula[(i, i)] * formula[(j, j)]).sqrt();
                assert!(
                    (found[(i, j)] - formula[(i, j)]).abs() < TOLERANCE * scale,
                    "{found} {formula}"
                );
            }
        }
    }

    #[test]
    fn equation_12_is_the_covariance_of_uncorrelated_equations() {
        let [a1, a2, _] = directions();
        let mut normal = normals();
        let a = Matrix3x2::from_columns(&[a1, -a2]);
        let found = covariance(&a, || Vector3::from_fn(|_, _| SD * normal()));
        assert_near(&found, &pair_range_covariance(angles()[0], SD).unwrap());
    }

    #[test]
    fn equation_13_is_the_covariance_of_uncorrelated_equations() {
        let mut normal = normals();
        let found =
            covariance(&system_of_three(directions()), || Vector6::from_fn(|_, _| SD * normal()));
        assert_near(&found, &triple_range_covariance(angles()[0], angles()[1], SD).unwrap());
    }

    /// Covariance of the ranges where `e_k` is the error of the first receiver's point less that of
    /// receiver k's. A coordinate of a point has the deviation SD / root 2, and so one of `e_k` has
    /// SD.
    fn of_shared_errors(a: [Vector3<f64>; 3]) -> Matrix3<f64> {
        let mut normal = normals();
        covariance(&system_of_three(a), || {
            let mut point =
                || Vector3::from_fn(|_, _| SD * std::f64::consts::FRAC_1_SQRT_2 * normal());
            let (first, second, third) = (point(), point(), point());
            let (e2, e3) = (first - second, first - third);
            Vector6::new(e2.x, e2.y, e2.z, e3.x, e3.y, e3.z)
        })
    }

    #[test]
    fn equation_13_is_optimistic_as_the_first_receivers_error_is_in_all_equations() {
        let formula = triple_range_covariance(angles()[0], angles()[1], SD).unwrap();
        let found = of_shared_errors(directions());
        assert!(found[(0, 0)] > 1.2 * formula[(0, 0)], "{found} {formula}");

        let right_angle = std::f64::consts::FRAC_PI_2;
        let formula = triple_range_covariance(right_angle, right_angle, SD).unwrap();
        let found = of_shared_errors([Vector3::x(), Vector3::y(), Vector3::z()]);
        let ratio = found[(0, 0)] / formula[(0, 0)];
        assert!((ratio - 1.5).abs() < 1.5 * TOLERANCE, "{ratio}");
    }

    #[test]
    fn right_angles_are_best_and_a_third_receiver_gains_root_two() {
        let right_angle = std::f64::consts::FRAC_PI_2;
        let pair = pair_range_covariance(right_angle, SD).unwrap();
        assert!((pair[(0, 0)].sqrt() - SD).abs() < 1e-12);
        assert!(pair_range_covariance(1.0, SD).unwrap()[(0, 0)] > pair[(0, 0)]);
        let triple = triple_range_covariance(right_angle, right_angle, SD).unwrap();
        assert!((triple[(0, 0)] - pair[(0, 0)] / 2.0).abs() < 1e-12);
        assert!(pair_range_covariance(0.0, SD).is_none());
        assert!(triple_range_covariance(0.0, 0.0, SD).is_none());
    }
}
