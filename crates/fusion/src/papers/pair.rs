use nalgebra::{Matrix3x2, Point3, Vector3};

use crate::spatial::TimedLine;

/// Rough range of a target, m: the longer range of the first line and the one that crosses it at
/// the widest angle, the target taken to stand still; not less than the longest baseline.
pub(super) fn typical_range(first: &TimedLine, others: &[&TimedLine]) -> f64 {
    let base = others
        .iter()
        .map(|other| (other.line.origin - first.line.origin).norm())
        .fold(0.0, f64::max);
    let along = |other: &TimedLine| first.line.direction.dot(&other.line.direction).abs();
    let elsewhere = others.iter().filter(|other| other.line.origin != first.line.origin);
    // The least |cos| is the widest angle.
    let widest = elsewhere.min_by(|one, other| along(one).total_cmp(&along(other)));
    let solution = widest.and_then(|other| pair(first, other, Vector3::zeros()));
    let range = solution.map_or(base, |solution| solution.first_range.max(solution.second_range));
    if range.is_finite() { range.max(base) } else { base }
}

/// Two ranges, and by how much the lines miss each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairSolution {
    /// Range from the first camera, m.
    pub first_range: f64,
    /// Range from the second camera, m.
    pub second_range: f64,
    /// The point on the first line, `M_1`.
    pub position: Point3<f64>,
    /// `J = |e_2|^2`, m^2 (Klochko 2020, eq. 9).
    pub indicator: f64,
}

/// The two-receiver algorithm: ranges along two lines by least squares (Klochko 2020, eqs. 7-9).
///
/// `displacement` is how far the target moves between the first line's time and the second's
/// (zero in the alternative algorithm, `V dt` in the proposed one's second step). `None` if the
/// lines are parallel.
///
/// ```
/// use crossfix_fusion::papers::pair;
/// use crossfix_fusion::spatial::TimedLine;
/// # use crossfix_geometry::*;
/// # use crossfix_message::Timestamp;
/// # use nalgebra::{Matrix2, Point3, Vector3};
/// # let line = |origin: Point3<f64>, target: Point3<f64>| {
/// #     let pose = Pose::looking_at(origin, target).unwrap();
/// #     let intrinsics = Intrinsics { size: ImageSize { width: 640, height: 480 }, fx: 800.0, fy: 800.0,
/// #         cx: 319.5, cy: 239.5, distortion: Distortion::None };
/// #     let camera = Camera::new(intrinsics, pose).unwrap();
/// #     let bearing = Bearing::new(Vector3::z(), Matrix2::identity() * 1e-6).unwrap();
/// #     TimedLine::exact(camera.sight_line(&bearing), Timestamp::EPOCH)
/// # };
/// let target = Point3::new(10.0, 20.0, 50.0);
/// let first = line(Point3::new(100.0, 0.0, 0.0), target);
/// let second = line(Point3::new(0.0, -100.0, 0.0), target);
/// let fix = pair(&first, &second, Vector3::zeros()).ok_or("parallel")?;
/// assert!((fix.position - target).norm() < 1e-9);
/// # Ok::<(), &str>(())
/// ```
pub fn pair(
    first: &TimedLine,
    second: &TimedLine,
    displacement: Vector3<f64>,
) -> Option<PairSolution> {
    let a1 = first.line.direction.into_inner();
    let a2 = second.line.direction.into_inner();
    // r1 a1 - r2 a2' + dM - b2 = e2 (Klochko 2020, eq. 4)
    let a = Matrix3x2::from_columns(&[a1, -a2]);
    let b = (second.line.origin - first.line.origin) - displacement;
    // Least squares: r = (A'A)^-1 A' b.
    let ranges = (a.transpose() * a).try_inverse()? * a.transpose() * b;
    let residual = a * ranges - b;
    Some(PairSolution {
        first_range: ranges.x,
        second_range: ranges.y,
        position: first.line.origin + a1 * ranges.x,
        indicator: residual.norm_squared(),
    })
}
