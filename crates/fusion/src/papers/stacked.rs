use faer::{Col, Mat};
use nalgebra::{Unit, Vector3};

use super::displacement::{MotionTerm, displacement};
use super::pair::typical_range;
use super::{Displacement, RangeSolution, pair};
use crate::spatial::{Observability, TimedLine, WeakAxis, determined};

/// The papers' system for n cameras, unweighted: n ranges and the velocity from n lines, 3(n - 1)
/// equations in n + 3 unknowns (Klochko 2020: "with n > 3 only the dimensions change").
///
/// Rank and pseudo-inverse as in [`super::triple`], which is the case n = 3. `None` for fewer than
/// three lines, if all are of one camera, or if the two lines that refine the range are parallel.
pub fn stacked(lines: &[TimedLine], velocity_scale: f64) -> Option<RangeSolution> {
    stacked_with(lines, Displacement::Velocity { velocity_scale })
}

/// The same with a motion of choice (Klochko 2020, eq. 5): n ranges and three unknowns of motion,
/// or six with acceleration, from n lines of any instants; a camera may give several.
///
/// With acceleration there are n + 6 unknowns for 3(n - 1) equations, so that five lines are the
/// least: five cameras, or four of which one gives a second instant, or three with two each. With
/// fewer, or with instants that lie too close together for the noise, the rank is not full, and
/// what cannot be observed is left at zero.
pub fn stacked_with(lines: &[TimedLine], motion: Displacement) -> Option<RangeSolution> {
    let (first, others) = lines.split_first()?;
    if others.len() < 2 {
        return None;
    }
    let n = lines.len();
    let range = typical_range(first, &others.iter().collect::<Vec<_>>());
    // Prior scales of the unknowns: the n ranges, then three axes of each term of the motion.
    let scales: Vec<f64> = std::iter::repeat_n(range, n)
        .chain(motion.terms(0.0).into_iter().flat_map(|term| [term.scale; 3]))
        .collect();
    let (a, b) = system(first, others, motion, &scales);
    let svd = a.thin_svd().ok()?;
    let unknowns = scales.len();
    let values: Vec<f64> = (0..unknowns).map(|i| svd.S()[i]).collect();
    // Noise of the right-hand side, m: the largest deviation of a line times the range.
    let noise = lines.iter().map(|l| l.line.standard_deviation()).fold(0.0, f64::max) * range;
    let observability = Observability::of_singular_values(&values, noise, |worst| {
        let combination: Vec<f64> = (0..unknowns).map(|row| svd.V()[(row, worst)]).collect();
        let directions: Vec<Unit<Vector3<f64>>> = lines.iter().map(|l| l.line.direction).collect();
        WeakAxis::of_ranges(&combination, &directions)
    });

    let largest = values.iter().copied().fold(0.0, f64::max);
    let mut x = vec![0.0; unknowns];
    // Pseudo-inverse over the determined directions, x = D V S^-1 U' b, where the scales D turn the
    // scaled unknowns back into ranges and motion.
    for (i, &value) in values.iter().enumerate().filter(|&(_, &v)| determined(v, noise, largest)) {
        let coefficient = (0..a.nrows()).map(|row| svd.U()[(row, i)] * b[row]).sum::<f64>() / value;
        for (column, unknown) in x.iter_mut().enumerate() {
            *unknown += coefficient * svd.V()[(column, i)] * scales[column];
        }
    }
    let vector = |column: usize| x.get(column..column + 3).map(Vector3::from_column_slice);
    let (velocity, acceleration) = (vector(n)?, vector(n + 3));
    // Refined position: the first line and the widest partner, with the displacement removed.
    let partner = widest_partner(first, others)?;
    let dt = partner.time.seconds_since(first.time);
    let refined = pair(first, partner, displacement(velocity, acceleration, dt))?;
    x.truncate(n);
    Some(RangeSolution {
        ranges: x,
        velocity,
        acceleration,
        position: refined.position,
        observability,
    })
}

/// The matrix with scaled columns, and the right-hand side, of `r1 a1 - r_k a_k' + dM_k = b_k`
/// (Klochko 2020, eqs. 4 and 5); rows of zeros stand in for missing equations.
fn system(
    first: &TimedLine,
    others: &[TimedLine],
    motion: Displacement,
    scales: &[f64],
) -> (Mat<f64>, Col<f64>) {
    // The matrix grows with n, so faer: from 64 cameras on its SVD is the faster one, and the
    // shape is known only at run time (benches/solvers).
    let n = others.len() + 1;
    let unknowns = n + motion.unknowns();
    // As many rows as unknowns at least: the SVD then has a singular value, 0 where need be, for
    // each unknown.
    let rows = (3 * others.len()).max(unknowns);
    let mut a = Mat::<f64>::zeros(rows, unknowns);
    let mut b = Col::<f64>::zeros(rows);
    for (k, other) in others.iter().enumerate() {
        let dt = other.time.seconds_since(first.time);
        let baseline = other.line.origin - first.line.origin;
        for axis in 0..3 {
            let row = 3 * k + axis;
            a[(row, 0)] = first.line.direction[axis] * scales[0];
            a[(row, k + 1)] = -other.line.direction[axis] * scales[k + 1];
            for (term, MotionTerm { scale, factor }) in motion.terms(dt).into_iter().enumerate() {
                a[(row, n + 3 * term + axis)] = factor * scale;
            }
            b[row] = baseline[axis];
        }
    }
    (a, b)
}

/// The line of another camera that is most nearly perpendicular to the first: there the pair's
/// range is best (Klochko 2020, eq. 12).
fn widest_partner<'a>(first: &TimedLine, others: &'a [TimedLine]) -> Option<&'a TimedLine> {
    let along = |l: &TimedLine| l.line.direction.dot(&first.line.direction).abs();
    let elsewhere = others.iter().filter(|l| l.line.origin != first.line.origin);
    elsewhere.min_by(|a, b| along(a).total_cmp(&along(b)))
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::super::triple;
    use super::*;
    use crate::spatial::Quantity;
    use crate::spatial::tests_support::{line_at, noisy_line_at, orthogonal_cameras};

    const POSITION: Point3<f64> = Point3::new(3.0, -5.0, 2.0);
    const VELOCITY: Vector3<f64> = Vector3::new(10.0, -4.0, 1.5);
    const ACCELERATION: Vector3<f64> = Vector3::new(-3.0, 2.0, 4.0);
    const MOTION: Displacement =
        Displacement::Acceleration { velocity_scale: 15.0, acceleration_scale: 5.0 };

    fn five_cameras() -> Vec<Point3<f64>> {
        let mut cameras = orthogonal_cameras().to_vec();
        cameras.extend([Point3::new(90.0, 60.0, -80.0), Point3::new(-20.0, 120.0, -60.0)]);
        cameras
    }

    fn turning(t: f64) -> Point3<f64> {
        POSITION + VELOCITY * t + ACCELERATION * (t * t / 2.0)
    }

    #[test]
    fn three_cameras_give_what_the_triple_gives() {
        let lines: Vec<_> = orthogonal_cameras()
            .iter()
            .zip([0.0, 0.1, 0.2])
            .map(|(camera, t)| line_at(*camera, POSITION + VELOCITY * t, t))
            .collect();
        let ours = stacked(&lines, 15.0).unwrap();
        let papers = triple([&lines[0], &lines[1], &lines[2]], 15.0).unwrap();
        assert!((ours.velocity - papers.velocity).norm() < 1e-7);
        assert!((ours.position - papers.position).norm() < 1e-7);
        assert_eq!(ours.acceleration, None);
    }

    #[test]
    fn five_cameras_are_solved_exactly() {
        let cameras = five_cameras();
        let lines: Vec<_> = cameras
            .iter()
            .enumerate()
            .map(|(i, camera)| {
                let t = 0.07 * i as f64;
                line_at(*camera, POSITION + VELOCITY * t, t)
            })
            .collect();
        let solution = stacked(&lines, 15.0).unwrap();
        assert!((solution.velocity - VELOCITY).norm() < 1e-8);
        for (range, camera) in solution.ranges.iter().zip(&cameras).take(1) {
            assert!((range - (POSITION - camera).norm()).abs() < 1e-8);
        }
    }

    #[test]
    fn acceleration_comes_out_of_five_cameras_or_of_three_with_two_instants() {
        let five = five_cameras();
        let three = orthogonal_cameras();
        let once: Vec<_> = (0..5).map(|k| (five[k], 0.3 * k as f64)).collect();
        let twice: Vec<_> = (0..6).map(|k| (three[k % 3], 0.25 * k as f64)).collect();
        for seen in [once, twice] {
            let lines: Vec<_> =
                seen.iter().map(|&(camera, t)| line_at(camera, turning(t), t)).collect();
            let solution = stacked_with(&lines, MOTION).unwrap();
            assert!(solution.observability.is_full(), "{:?}", solution.observability);
            assert!((solution.velocity - VELOCITY).norm() < 1e-6, "{:?}", solution.velocity);
            assert!((solution.acceleration.unwrap() - ACCELERATION).norm() < 1e-6);
            assert!((solution.position - POSITION).norm() < 1e-7);
        }
    }

    #[test]
    fn four_lines_cannot_carry_an_acceleration_and_say_so() {
        let lines: Vec<_> = (0..4)
            .map(|k| {
                let t = 0.3 * k as f64;
                line_at(five_cameras()[k], turning(t), t)
            })
            .collect();
        let solution = stacked_with(&lines, MOTION).unwrap();
        assert_eq!(solution.observability.unknowns, 10);
        assert!(solution.observability.rank < 10);
        assert!(solution.observability.weak_axis.is_some());
        assert!(solution.velocity.norm() < 60.0 && solution.acceleration.unwrap().norm() < 20.0);
        // They do determine the velocity alone.
        assert!(stacked(&lines, 15.0).unwrap().observability.is_full());
    }

    #[test]
    fn instants_too_close_for_the_noise_show_an_acceleration_that_cannot_be_seen() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
        for (step, seen) in [(0.02, false), (0.5, true)] {
            let lines: Vec<_> = (0..9)
                .map(|k| {
                    let t = step * k as f64;
                    noisy_line_at(orthogonal_cameras()[k % 3], turning(t), t, &mut normal)
                })
                .collect();
            let solution = stacked_with(&lines, MOTION).unwrap();
            assert_eq!(solution.observability.is_full(), seen, "{:?}", solution.observability);
            if seen {
                assert!((solution.acceleration.unwrap() - ACCELERATION).norm() < 1.0);
            } else {
                let weak = solution.observability.weak_axis.unwrap();
                assert_eq!(weak.quantity, Quantity::Acceleration);
                assert!(solution.acceleration.unwrap().norm() < 20.0, "no nonsense instead");
            }
        }
    }

    #[test]
    fn one_camera_alone_sees_no_range() {
        let camera = orthogonal_cameras()[0];
        let lines: Vec<_> =
            (0..6).map(|k| line_at(camera, turning(0.2 * k as f64), 0.2 * k as f64)).collect();
        assert!(stacked_with(&lines, MOTION).is_none());
    }
}
