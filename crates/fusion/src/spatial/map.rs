use crossfix_filter::KinematicState;
use nalgebra::{Matrix2x6, Matrix6, Point3, Vector6};

use super::{Observability, TimedLine};

/// Most re-weightings: the ranges settle to a part in a million after three. With half of it
/// chi-square is that of the first solution, which takes all ranges as equal.
const ITERATIONS: usize = 4;
/// The ranges have settled when the position moves by less than this share of the nearest range.
/// With half of it a re-weighting more now and then, for the same result.
const SETTLED: f64 = 1e-5;

/// Maximum a posteriori solution for position and velocity.
#[derive(Clone, Debug, PartialEq)]
pub struct MapSolution {
    /// The state at its own time, with its posterior covariance.
    pub state: KinematicState,
    /// Sum of squared normalised residuals, the prior's included: chi-square with
    /// `2 n - 3` degrees of freedom for n true lines.
    pub chi_square: f64,
    /// Fisher information of the lines alone, and the scales that it is compared with.
    information: Matrix6<f64>,
    position_scale_m: f64,
    velocity_scale_mps: f64,
}

impl MapSolution {
    /// Observability by the lines alone, against the prior scales: the farthest line's length and
    /// the velocity prior. Not computed with the solution, as eigenvalues cost more than that.
    pub fn observability(&self) -> Observability {
        let Self { information, position_scale_m, velocity_scale_mps, .. } = self;
        Observability::of_information(information, *position_scale_m, *velocity_scale_mps)
    }
}

/// The weighted solution for any number of lines at any times: position and velocity at
/// `state_time`, with a zero-mean prior of `velocity_sd` (m/s per axis) on the velocity.
///
/// Where the papers' system is regular this is its solution, with each line weighted by its
/// information; where it is not, the prior stands in for what cannot be observed. `None` for fewer
/// than two lines, or if they do not meet in front of the cameras.
pub fn map(
    lines: &[TimedLine],
    state_time: crossfix_message::Timestamp,
    velocity_sd: f64,
) -> Option<MapSolution> {
    if lines.len() < 2 {
        return None;
    }
    let mut prior = Matrix6::zeros();
    for axis in 3..6 {
        prior[(axis, axis)] = velocity_sd.powi(-2);
    }
    let mut state: Option<Vector6<f64>> = None;
    let mut information = Matrix6::zeros();
    let mut chi_square = 0.0;
    for _ in 0..ITERATIONS {
        let equations = LineNormalEquations::of(lines, state_time, velocity_sd, state.as_ref())?;
        information = equations.information;
        if let Some(x) = &state {
            chi_square = equations.squares + (x.transpose() * prior * x).x;
        }
        // x = (H' W H + P0^-1)^-1 H' W z, where the prior has zero mean.
        let next = (information + prior).cholesky()?.solve(&equations.right);
        let moved = state.map_or(f64::INFINITY, |x| (next - x).fixed_rows::<3>(0).norm());
        state = Some(next);
        // The squares are of the state before this step: it must hardly have been off when the loop
        // ends.
        if moved < SETTLED * equations.nearest {
            break;
        }
    }
    let mean = state?;
    let scale = lines
        .iter()
        .map(|l| (l.line.origin.coords - mean.fixed_rows::<3>(0)).norm())
        .fold(0.0, f64::max);
    in_front(lines, state_time, &mean).then_some(())?;
    // Rounding leaves the inverse of a nearly singular system not quite symmetric.
    let inverse = (information + prior).cholesky()?.inverse();
    let covariance = (inverse + inverse.transpose()) / 2.0;
    Some(MapSolution {
        state: KinematicState { mean, covariance },
        chi_square,
        information,
        position_scale_m: scale,
        velocity_scale_mps: velocity_sd,
    })
}

/// The normal equations of lines at a state, with their residuals there.
struct LineNormalEquations {
    /// Sums of H' W H and of H' W z.
    information: Matrix6<f64>,
    right: Vector6<f64>,
    /// Sum of the squared normalised residuals.
    squares: f64,
    /// The least range, m.
    nearest: f64,
}

impl LineNormalEquations {
    /// At a state at `state_time`; without one all lines are weighted as if they had the same
    /// range.
    fn of(
        lines: &[TimedLine],
        state_time: crossfix_message::Timestamp,
        velocity_sd: f64,
        state: Option<&Vector6<f64>>,
    ) -> Option<Self> {
        let mut sums = Self {
            information: Matrix6::zeros(),
            right: Vector6::zeros(),
            squares: 0.0,
            nearest: f64::INFINITY,
        };
        for timed @ TimedLine { line, time, .. } in lines {
            let dt = time.seconds_since(state_time);
            // A state behind the camera counts as just in front of it here, and is refused at the
            // end.
            let range = state.map_or(1.0, |x| {
                (position_after(x, dt) - line.origin).dot(&line.direction).max(1e-3)
            });
            sums.nearest = sums.nearest.min(range);
            // With the tangents E, H x = z is linear in the state: E' (p + v dt - c) / range = 0.
            let tangents = line.basis.transpose() / range;
            let mut h = Matrix2x6::zeros();
            h.fixed_view_mut::<2, 3>(0, 0).copy_from(&tangents);
            h.fixed_view_mut::<2, 3>(0, 3).copy_from(&(tangents * dt));
            let noise =
                if state.is_some() { timed.noise_at(range, velocity_sd) } else { line.covariance };
            let weight = noise.try_inverse()?;
            let target = tangents * line.origin.coords;
            sums.information += h.transpose() * weight * h;
            sums.right += h.transpose() * weight * target;
            if let Some(x) = state {
                let residual = h * x - target;
                sums.squares += (residual.transpose() * weight * residual).x;
            }
        }
        Some(sums)
    }
}

/// The position of a state of position and velocity after `dt` seconds.
fn position_after(mean: &Vector6<f64>, dt: f64) -> Point3<f64> {
    Point3::from(mean.fixed_rows::<3>(0) + mean.fixed_rows::<3>(3) * dt)
}

/// Whether a state at `state_time` lies in front of every line's camera at the line's time.
fn in_front(
    lines: &[TimedLine],
    state_time: crossfix_message::Timestamp,
    mean: &Vector6<f64>,
) -> bool {
    lines.iter().all(|TimedLine { line, time, .. }| {
        let dt = time.seconds_since(state_time);
        let position = position_after(mean, dt);
        (position - line.origin).dot(&line.direction) > 0.0
    })
}

#[cfg(test)]
mod tests {
    use crossfix_message::Timestamp;
    use nalgebra::{Matrix3, Vector3};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::super::Quantity;
    use super::super::tests_support::{
        coplanar_cameras, line_at, noisy_line_at, orthogonal_cameras,
    };
    use super::*;

    /// Root mean squared errors of position and velocity and the mean NEES over `runs` runs.
    fn monte_carlo(cameras: &[Point3<f64>], times: &[f64], runs: u32) -> (f64, f64, f64) {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
        let (mut position_square, mut velocity_square, mut nees) = (0.0, 0.0, 0.0);
        for _ in 0..runs {
            let velocity = Vector3::from_fn(|_, _| 15.6 * normal());
            let position = Point3::from(Vector3::from_fn(|_, _| 4.0 * normal()));
            let lines: Vec<_> = cameras
                .iter()
                .zip(times)
                .map(|(camera, &t)| noisy_line_at(*camera, position + velocity * t, t, &mut normal))
                .collect();
            let found = map(&lines, Timestamp::EPOCH, 15.6).unwrap();
            let error = Vector6::from_iterator(
                (found.state.position() - position)
                    .iter()
                    .chain((found.state.velocity() - velocity).iter())
                    .copied(),
            );
            position_square += error.fixed_rows::<3>(0).norm_squared();
            velocity_square += error.fixed_rows::<3>(3).norm_squared();
            nees += (error.transpose() * found.state.covariance.try_inverse().unwrap() * error).x;
        }
        let mean = |sum: f64| sum / f64::from(runs);
        (mean(position_square).sqrt(), mean(velocity_square).sqrt(), mean(nees))
    }

    #[test]
    fn the_covariance_is_honest_and_the_error_is_the_references() {
        const RUNS: u32 = 2000;
        let (position, velocity, nees) = monte_carlo(&orthogonal_cameras(), &[0.0, 0.1, 0.2], RUNS);
        // NEES: chi-square with 6 degrees of freedom, SD of the mean sqrt(12 / runs).
        assert!((nees - 6.0).abs() < 3.0 * (12.0 / f64::from(RUNS)).sqrt(), "{nees}");
        // The reference implementation's figures: 0.26 m and 2.1 m/s with a 30 m/s prior.
        assert!((position - 0.26).abs() < 0.03, "{position}");
        assert!((velocity - 2.1).abs() < 0.25, "{velocity}");
    }

    #[test]
    fn a_coplanar_fix_reports_the_axis_it_cannot_see() {
        let lines: Vec<_> = coplanar_cameras()
            .iter()
            .zip([0.0, 0.1, 0.2])
            .map(|(camera, t)| line_at(*camera, Point3::new(1.0, 2.0, 0.0), t))
            .collect();
        let found = map(&lines, Timestamp::EPOCH, 15.0).unwrap();
        assert!(!found.observability().is_full());
        let weak = found.observability().weak_axis.unwrap();
        // The second and the third camera look along y, from both sides; the first sees y once.
        assert_eq!(weak.quantity, Quantity::Velocity);
        assert!(weak.direction.y > 0.99, "{weak:?}");
        let velocity: Matrix3<f64> = found.state.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        assert!(velocity.symmetric_eigenvalues().max().sqrt() > 5.0, "the prior's, not a fantasy");
    }

    #[test]
    fn lines_that_part_give_no_fix() {
        let meet = Point3::new(0.0, 0.0, 1000.0);
        let away = |x: f64| {
            let origin = Point3::new(x, 0.0, 0.0);
            line_at(origin, origin + (origin - meet), 0.0)
        };
        assert!(map(&[away(-50.0), away(50.0)], Timestamp::EPOCH, 15.0).is_none());
    }
}
