use nalgebra::{Matrix6, Vector3, Vector6};

use super::pair::typical_range;
use super::{RangeSolution, pair};
use crate::spatial::{Observability, TimedLine, WeakAxis, determined};

/// The three-receiver algorithm: three ranges and the velocity from three lines of three times
/// (Klochko 2020, eqs. 10-11), by the pseudo-inverse where the system does not determine all six.
///
/// The system is regular only if the three times differ and the lines do not lie in a plane (`det A
/// = -dt2 dt3 (dt3 - dt2) det[a1 a2' a3']`). The rank is decided against the noise of the lines,
/// their deviation times the range: unknowns are scaled by the range and by `velocity_scale`, and a
/// singular direction counts if the noise leaves it better known than its scale. `None` if even the
/// first two lines are parallel.
pub fn triple(lines: [&TimedLine; 3], velocity_scale: f64) -> Option<RangeSolution> {
    let [first, second, third] = lines;
    let (a, b) = system(lines);

    // Fixed size, so nalgebra: faer's SVD of a 6x6 takes two to three times as long
    // (benches/solvers).
    let range = typical_range(first, &[second, third]);
    let scale = Matrix6::from_diagonal(&Vector6::new(
        range,
        range,
        range,
        velocity_scale,
        velocity_scale,
        velocity_scale,
    ));
    let svd = (a * scale).try_svd(true, true, f64::EPSILON, 200)?;
    let (u, v_t) = (svd.u?, svd.v_t?);
    let noise = lines.iter().map(|l| l.line.standard_deviation()).fold(0.0, f64::max) * range;
    let values = svd.singular_values;
    let mut observability = Observability::of_singular_values(values.as_slice(), noise, |worst| {
        let combination: Vec<f64> = v_t.row(worst).iter().copied().collect();
        WeakAxis::of_ranges(&combination, &lines.map(|l| l.line.direction))
    });
    // Of the system as it is, not of the scaled one.
    observability.condition_number = condition_number(&a);

    // A regular system is solved as it is: the scales decide the rank and the pseudo-inverse alone.
    let x = if observability.is_full() {
        a.lu().solve(&b)?
    } else {
        let largest = values.max();
        // Pseudo-inverse: a singular direction that the noise hides stays at zero.
        let projected = u.transpose() * b;
        let kept = Vector6::from_fn(|i, _| {
            if determined(values[i], noise, largest) { projected[i] / values[i] } else { 0.0 }
        });
        scale * v_t.transpose() * kept
    };
    let velocity = Vector3::new(x[3], x[4], x[5]);
    // The position is refined by the first pair, with the displacement V dt2 removed.
    let refined = pair(first, second, velocity * second.time.seconds_since(first.time))?;
    Some(RangeSolution {
        ranges: vec![x[0], x[1], x[2]],
        velocity,
        acceleration: None,
        position: refined.position,
        observability,
    })
}

/// A and b of the system A x = b for the three ranges and the velocity.
fn system(lines: [&TimedLine; 3]) -> (Matrix6<f64>, Vector6<f64>) {
    let [first, second, third] = lines;
    let [a1, a2, a3] = lines.map(|l| l.line.direction.into_inner());
    let [b2, b3] = [second, third].map(|l| l.line.origin - first.line.origin);
    let [dt2, dt3] = [second, third].map(|l| l.time.seconds_since(first.time));
    let mut a = Matrix6::zeros();
    // Rows of line k: r1 a1 - r_k a_k' + V dt_k = b_k.
    for (rows, line_column, line, dt) in [(0, 1, a2, dt2), (3, 2, a3, dt3)] {
        a.fixed_view_mut::<3, 1>(rows, 0).copy_from(&a1);
        a.fixed_view_mut::<3, 1>(rows, line_column).copy_from(&-line);
        a.fixed_view_mut::<3, 3>(rows, 3).fill_with_identity();
        a.fixed_view_mut::<3, 3>(rows, 3).scale_mut(dt);
    }
    (a, Vector6::new(b2.x, b2.y, b2.z, b3.x, b3.y, b3.z))
}

fn condition_number(a: &Matrix6<f64>) -> f64 {
    let values = a.singular_values();
    if values.min() > 0.0 { values.max() / values.min() } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;
    use crate::spatial::Quantity;
    use crate::spatial::tests_support::{coplanar_cameras, line_at, orthogonal_cameras};

    #[test]
    fn exact_lines_give_exact_ranges_and_velocity() {
        let (position, velocity) = (Point3::new(3.0, -5.0, 2.0), Vector3::new(10.0, -4.0, 1.5));
        let times = [0.0, 0.1, 0.2];
        let lines: Vec<_> = orthogonal_cameras()
            .iter()
            .zip(times)
            .map(|(camera, t)| line_at(*camera, position + velocity * t, t))
            .collect();
        let solution = triple([&lines[0], &lines[1], &lines[2]], 15.0).unwrap();
        assert!(solution.observability.is_full());
        assert_eq!(solution.observability.weak_axis, None);
        assert!((solution.velocity - velocity).norm() < 1e-8);
        assert!((solution.position - position).norm() < 1e-8);
        // The independent implementation has 20 for this geometry and these delays.
        assert!(
            (solution.observability.condition_number - 20.0).abs() < 2.0,
            "{:?}",
            solution.observability
        );
    }

    #[test]
    fn simultaneous_lines_fall_back_to_the_pseudo_inverse_and_still_fix() {
        let position = Point3::new(3.0, -5.0, 2.0);
        let lines: Vec<_> =
            orthogonal_cameras().iter().map(|camera| line_at(*camera, position, 0.0)).collect();
        let solution = triple([&lines[0], &lines[1], &lines[2]], 15.0).unwrap();
        assert_eq!(solution.observability.rank, 3);
        assert_eq!(solution.observability.weak_axis.unwrap().quantity, Quantity::Velocity);
        assert!((solution.position - position).norm() < 1e-6);
        assert!(solution.velocity.norm() < 1e-6);
    }

    #[test]
    fn a_base_of_20_m_tells_no_velocity_of_what_is_a_kilometre_away() {
        let cameras = [[-10.0, 0.0, 0.0], [10.0, 0.0, 1.0], [0.0, 5.0, 0.0]].map(Point3::from);
        let velocity = Vector3::new(5.0, 8.0, -1.0);
        let solve = |position: Point3<f64>| {
            let timed = cameras.iter().zip([0.0, 0.1, 0.2]);
            let lines: Vec<_> =
                timed.map(|(c, t)| line_at(*c, position + velocity * t, t)).collect();
            triple([&lines[0], &lines[1], &lines[2]], 15.0).unwrap().observability
        };
        assert!(!solve(Point3::new(30.0, 1000.0, 50.0)).is_full());
        assert!(solve(Point3::new(3.0, 10.0, 12.0)).is_full());
    }

    #[test]
    fn equal_delays_are_not_full_rank_although_noise_makes_them_look_regular() {
        let position = Point3::new(3.0, -5.0, 2.0);
        let nudge = Vector3::new(0.05, -0.08, 0.06);
        let times = [0.0, 0.2, 0.2];
        let lines: Vec<_> = orthogonal_cameras()
            .iter()
            .zip(times)
            .enumerate()
            .map(|(i, (camera, t))| line_at(*camera, position + nudge * i as f64, t))
            .collect();
        let solution = triple([&lines[0], &lines[1], &lines[2]], 15.0).unwrap();
        assert!(!solution.observability.is_full(), "{:?}", solution.observability);
    }
    #[test]
    fn coplanar_lines_do_not_see_the_velocity_that_only_one_camera_sees_across() {
        let lines: Vec<_> = coplanar_cameras()
            .iter()
            .zip([0.0, 0.1, 0.2])
            .map(|(camera, t)| line_at(*camera, Point3::new(1.0, 2.0, 0.0), t))
            .collect();
        let solution = triple([&lines[0], &lines[1], &lines[2]], 15.0).unwrap();
        // The second and the third look along y, from both sides; the first sees y once.
        let weak = solution.observability.weak_axis.unwrap();
        assert_eq!(weak.quantity, Quantity::Velocity);
        assert!(weak.direction.y > 0.99, "{weak:?}");
    }
}
