use faer::{Col, Mat};
use nalgebra::Vector3;

use super::observability::determined;
use super::{Observability, RangeSolution, TimedLine, pair};

/// The papers' system for n cameras: n ranges and the velocity from n lines, 3(n - 1) equations in
/// n + 3 unknowns (002: "with n > 3 only the dimensions change"), unweighted.
///
/// Rank and pseudo-inverse as in [`super::triple`], which is the case n = 3. `None` for fewer than
/// three lines or if the first two are parallel.
pub fn stacked(lines: &[TimedLine], velocity_scale: f64) -> Option<RangeSolution> {
    let (first, others) = lines.split_first()?;
    if others.len() < 2 {
        return None;
    }
    let n = lines.len();
    let base = others.iter().map(|l| (l.line.origin - first.line.origin).norm()).fold(0.0, f64::max);
    let scale = |column: usize| if column < n { base } else { velocity_scale };

    // The matrix grows with n, so faer: from 64 cameras on its SVD is the faster one, and the
    // shape is known only at run time (benches/solvers).
    let mut a = Mat::<f64>::zeros(3 * (n - 1), n + 3);
    let mut b = Col::<f64>::zeros(3 * (n - 1));
    for (k, other) in others.iter().enumerate() {
        let dt = other.time.seconds_since(first.time);
        let baseline = other.line.origin - first.line.origin;
        for axis in 0..3 {
            let row = 3 * k + axis;
            a[(row, 0)] = first.line.direction[axis] * scale(0);
            a[(row, k + 1)] = -other.line.direction[axis] * scale(k + 1);
            a[(row, n + axis)] = dt * scale(n + axis);
            b[row] = baseline[axis];
        }
    }
    let svd = a.thin_svd().ok()?;
    let unknowns = n + 3;
    let values: Vec<f64> = (0..unknowns).map(|i| svd.S()[i]).collect();
    let noise = lines.iter().map(|l| l.line.standard_deviation()).fold(0.0, f64::max) * base;
    let observability = Observability::of_singular_values(&values, noise);

    let largest = values.iter().copied().fold(0.0, f64::max);
    let mut x = vec![0.0; unknowns];
    for (i, &value) in values.iter().enumerate().filter(|&(_, &v)| determined(v, noise, largest)) {
        let coefficient = (0..a.nrows()).map(|row| svd.U()[(row, i)] * b[row]).sum::<f64>() / value;
        for (column, unknown) in x.iter_mut().enumerate() {
            *unknown += coefficient * svd.V()[(column, i)] * scale(column);
        }
    }
    let velocity = Vector3::new(x[n], x[n + 1], x[n + 2]);
    let partner = widest_partner(first, others)?;
    let refined = pair(first, partner, velocity * partner.time.seconds_since(first.time))?;
    x.truncate(n);
    Some(RangeSolution { ranges: x, velocity, position: refined.position, observability })
}

/// The line most nearly perpendicular to the first: there the pair's range is best (002, equation 12).
fn widest_partner<'a>(first: &TimedLine, others: &'a [TimedLine]) -> Option<&'a TimedLine> {
    let along = |l: &TimedLine| l.line.direction.dot(&first.line.direction).abs();
    others.iter().min_by(|a, b| along(a).total_cmp(&along(b)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::super::tests_support::{line_at, orthogonal_cameras};
    use super::super::triple;
    use super::*;

    #[test]
    fn three_cameras_give_what_the_triple_gives() {
        let (position, velocity) = (Point3::new(3.0, -5.0, 2.0), Vector3::new(10.0, -4.0, 1.5));
        let lines: Vec<_> = orthogonal_cameras()
            .iter()
            .zip([0.0, 0.1, 0.2])
            .map(|(camera, t)| line_at(*camera, position + velocity * t, t))
            .collect();
        let ours = stacked(&lines, 15.0).unwrap();
        let papers = triple([&lines[0], &lines[1], &lines[2]], 15.0).unwrap();
        assert!((ours.velocity - papers.velocity).norm() < 1e-7);
        assert!((ours.position - papers.position).norm() < 1e-7);
    }

    #[test]
    fn five_cameras_are_solved_exactly() {
        let (position, velocity) = (Point3::new(3.0, -5.0, 2.0), Vector3::new(10.0, -4.0, 1.5));
        let mut cameras = orthogonal_cameras().to_vec();
        cameras.extend([Point3::new(90.0, 60.0, -80.0), Point3::new(-20.0, 120.0, -60.0)]);
        let lines: Vec<_> = cameras
            .iter()
            .enumerate()
            .map(|(i, camera)| {
                let t = 0.07 * i as f64;
                line_at(*camera, position + velocity * t, t)
            })
            .collect();
        let solution = stacked(&lines, 15.0).unwrap();
        assert!((solution.velocity - velocity).norm() < 1e-8);
        for (range, camera) in solution.ranges.iter().zip(&cameras).take(1) {
            assert!((range - (position - camera).norm()).abs() < 1e-8);
        }
    }
}
