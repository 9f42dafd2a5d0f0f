//! Where to begin: a camera's pose and clock from nothing but its labels and the target's log.

use nalgebra::{DMatrix, Matrix3, Point3, Rotation3, SMatrix, SVector, Vector3};

use super::begin::frame_time;
use super::course::Course;
use super::model::{CameraLabels, CameraState, Clock};
use crate::lens;

/// The clock's offset is tried in steps of this, s: at 10 m/s and 40 m the target is then 0.03 rad
/// off at most, which a linear solution stands.
const STEP_S: f64 = 0.25;
/// Labels that one try takes.
const TRIED: usize = 120;
/// A try must have so many of them within the log.
const LEAST_TRIED: usize = 12;
/// And this share of them.
const LEAST_SHARE: f64 = 0.4;
/// Of all offsets, so many are followed up.
const FOLLOWED: usize = 12;

/// A pose, and by how much the camera's time is behind the common one.
#[derive(Clone, Debug)]
struct Candidate {
    rotation: Rotation3<f64>,
    centre: Point3<f64>,
    offset_s: f64,
    /// Median angle between labels and the log, rad.
    misfit: f64,
}

/// A direction in the camera's frame at its own time.
#[derive(Clone, Copy, Debug)]
struct Ray {
    time_s: f64,
    /// After the frame's time, as a share of the read-out.
    row_share: f64,
    direction: Vector3<f64>,
}

/// A camera's state that fits the log's way, and its median misfit (rad); `None`: no offset makes
/// enough of its labels fall into the log.
pub(super) fn find(
    camera: &CameraLabels,
    course: &Course,
    frame_s: f64,
) -> Option<(CameraState, f64)> {
    let rays = rays(camera);
    let (first, last) = (rays.first()?.time_s, rays.last()?.time_s);
    let (from, to) = course.range();
    let offsets = ((to - from + last - first) / STEP_S) as usize;
    let offset = |k: usize| from - last + k as f64 * STEP_S;
    let mut found: Vec<Candidate> =
        (0..=offsets).flat_map(|k| candidates(&rays, course, offset(k))).collect();
    found.sort_by(|a, b| a.misfit.total_cmp(&b.misfit));
    let mut best: Option<Candidate> = None;
    for candidate in found.into_iter().take(FOLLOWED) {
        let refined = refined(candidate, &rays, course, frame_s);
        if best.as_ref().is_none_or(|best| refined.misfit < best.misfit) {
            best = Some(refined);
        }
    }
    let Candidate { rotation, centre, offset_s, misfit } = best?;
    Some((state(camera, course, (rotation, centre, offset_s)), misfit))
}

/// A camera that stands so, its clock behind by an offset (s).
pub(super) fn state(
    camera: &CameraLabels,
    course: &Course,
    (rotation, centre, offset_s): (Rotation3<f64>, Point3<f64>, f64),
) -> CameraState {
    let times = camera.labels.iter().map(|label| label.time_s);
    let (start, end) = times.fold((f64::INFINITY, f64::NEG_INFINITY), |(start, end), time_s| {
        (start.min(time_s), end.max(time_s))
    });
    let clock = Clock {
        reference_s: f64::midpoint(start, end),
        offset_s,
        rate: 0.0,
        readout_s: frame_time(camera) / 2.0,
        wander: course.way.drift(),
    };
    CameraState { rotation, centre, clock, intrinsics: camera.intrinsics }
}

/// The median angle between a camera's labels and a course, rad.
pub(super) fn misfit_of(camera: &CameraLabels, state: &CameraState, course: &Course) -> f64 {
    let at = |ray: &Ray| {
        let weights = course.weights(state.clock.common_s(ray.time_s))?;
        Some((ray.direction, course.way.place(&weights)))
    };
    let pairs: Vec<_> = rays(camera).iter().filter_map(at).collect();
    if pairs.is_empty() { f64::INFINITY } else { misfit(&pairs, &state.rotation, state.centre) }
}

/// Labels evenly spread over all.
fn rays(camera: &CameraLabels) -> Vec<Ray> {
    let stride = camera.labels.len().div_ceil(TRIED).max(1);
    let height = f64::from(camera.intrinsics.size.height);
    let ray = |label: &super::Label| {
        let direction = lens::direction(&camera.intrinsics, label.pixel)?;
        Some(Ray { time_s: label.time_s, row_share: label.pixel.y() / height - 0.5, direction })
    };
    camera.labels.iter().step_by(stride).filter_map(ray).collect()
}

/// The linear solutions at an offset.
fn candidates(rays: &[Ray], course: &Course, offset_s: f64) -> Vec<Candidate> {
    let at = |ray: &Ray| {
        let weights = course.weights(ray.time_s + offset_s)?;
        Some((ray.direction, course.way.place(&weights)))
    };
    let pairs: Vec<(Vector3<f64>, Point3<f64>)> = rays.iter().filter_map(at).collect();
    let enough = LEAST_TRIED.max((LEAST_SHARE * rays.len() as f64) as usize);
    if pairs.len() < enough {
        return Vec::new();
    }
    let poses = [in_space(&pairs), in_plane(&pairs)].into_iter().flatten();
    poses
        .map(|(rotation, centre)| {
            let misfit = misfit(&pairs, &rotation, centre);
            Candidate { rotation, centre, offset_s, misfit }
        })
        .collect()
}

fn misfit(
    pairs: &[(Vector3<f64>, Point3<f64>)],
    rotation: &Rotation3<f64>,
    centre: Point3<f64>,
) -> f64 {
    let angle = |(direction, place): &(Vector3<f64>, Point3<f64>)| {
        rotation.inverse_transform_vector(&(place - centre)).angle(direction)
    };
    let mut angles: Vec<f64> = pairs.iter().map(angle).collect();
    angles.sort_unstable_by(f64::total_cmp);
    angles[angles.len() / 2]
}

/// Places in axes of their own: about their middle, along their widest spread first, of size one.
struct Normalised {
    middle: Point3<f64>,
    axes: Matrix3<f64>,
    scale: f64,
}

impl Normalised {
    fn of(pairs: &[(Vector3<f64>, Point3<f64>)]) -> Option<Self> {
        let count = pairs.len() as f64;
        let middle =
            Point3::from(pairs.iter().map(|(_, p)| p.coords).sum::<Vector3<f64>>() / count);
        let spread = |sum: Matrix3<f64>, (_, p): &(_, Point3<f64>)| {
            let offset = p - middle;
            sum + offset * offset.transpose()
        };
        let spread = pairs.iter().fold(Matrix3::zeros(), spread) / count;
        let eigen = spread.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
        let columns = order.map(|k| eigen.eigenvectors.column(k).into_owned());
        let mut axes = Matrix3::from_columns(&columns);
        if axes.determinant() < 0.0 {
            axes.column_mut(2).neg_mut();
        }
        let scale = spread.trace().sqrt();
        (scale > 0.0).then_some(Self { middle, axes, scale })
    }

    fn place(&self, place: Point3<f64>) -> Vector3<f64> {
        self.axes.transpose() * (place - self.middle) / self.scale
    }

    /// The pose of the world from that of these axes, up to the scale and the sign of both.
    fn pose(
        &self,
        matrix: Matrix3<f64>,
        shift: Vector3<f64>,
        pairs: &[(Vector3<f64>, Point3<f64>)],
    ) -> Option<(Rotation3<f64>, Point3<f64>)> {
        let factors = matrix.svd(true, true);
        let (u, v_t) = (factors.u?, factors.v_t?);
        let size = factors.singular_values.mean();
        // In front of the camera there are more than behind it.
        let ahead = pairs.iter().filter(|(direction, place)| {
            direction.dot(&(matrix * self.place(*place) + shift)) > 0.0
        });
        let sign = if 2 * ahead.count() >= pairs.len() { 1.0 } else { -1.0 };
        let camera_from_axes = u * v_t * sign;
        if size <= 0.0 || camera_from_axes.determinant() < 0.0 {
            return None;
        }
        let centre = -(camera_from_axes.transpose() * shift) * (sign / size);
        let centre = self.middle + self.axes * centre * self.scale;
        let rotation = self.axes * camera_from_axes.transpose();
        Some((Rotation3::from_matrix_unchecked(rotation), centre))
    }
}

/// The direct linear transformation: `d x (M X + m) = 0` for every direction d and place X.
fn in_space(pairs: &[(Vector3<f64>, Point3<f64>)]) -> Option<(Rotation3<f64>, Point3<f64>)> {
    let axes = Normalised::of(pairs)?;
    let mut sum = SMatrix::<f64, 12, 12>::zeros();
    for (direction, place) in pairs {
        let place = axes.place(*place);
        let across = direction.cross_matrix();
        let mut rows = SMatrix::<f64, 3, 12>::zeros();
        for k in 0..3 {
            rows.fixed_columns_mut::<3>(3 * k).copy_from(&(across * place[k]));
        }
        rows.fixed_columns_mut::<3>(9).copy_from(&across);
        sum += rows.transpose() * rows;
    }
    let eigen = sum.symmetric_eigen();
    let least = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let matrix = Matrix3::from_column_slice(&least.as_slice()[..9]);
    axes.pose(matrix, least.fixed_rows::<3>(9).into_owned(), pairs)
}

/// The same for places in a plane, as of a flight at one height: the third axis follows from two.
fn in_plane(pairs: &[(Vector3<f64>, Point3<f64>)]) -> Option<(Rotation3<f64>, Point3<f64>)> {
    let axes = Normalised::of(pairs)?;
    let mut sum = SMatrix::<f64, 9, 9>::zeros();
    for (direction, place) in pairs {
        let place = axes.place(*place);
        let across = direction.cross_matrix();
        let mut rows = SMatrix::<f64, 3, 9>::zeros();
        for k in 0..2 {
            rows.fixed_columns_mut::<3>(3 * k).copy_from(&(across * place[k]));
        }
        rows.fixed_columns_mut::<3>(6).copy_from(&across);
        sum += rows.transpose() * rows;
    }
    let eigen = sum.symmetric_eigen();
    let least: SVector<f64, 9> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let (x, y) = (least.fixed_rows::<3>(0).into_owned(), least.fixed_rows::<3>(3).into_owned());
    let shift = least.fixed_rows::<3>(6).into_owned();
    let size = f64::midpoint(x.norm(), y.norm());
    if size <= 0.0 {
        return None;
    }
    let (x, y, shift) = (x / size, y / size, shift / size);
    // Both signs of what has none: that of the third axis follows.
    let ahead = pairs.iter().filter(|(direction, place)| {
        let place = axes.place(*place);
        direction.dot(&(x * place.x + y * place.y + shift)) > 0.0
    });
    let sign = if 2 * ahead.count() >= pairs.len() { 1.0 } else { -1.0 };
    let (x, y) = (x * sign, y * sign);
    axes.pose(Matrix3::from_columns(&[x, y, x.cross(&y)]), shift * sign, pairs)
}

/// Gauss and Newton's steps of pose, offset and read-out against the log's way, with weights
/// against outliers.
fn refined(start: Candidate, rays: &[Ray], course: &Course, frame_s: f64) -> Candidate {
    const STEPS: usize = 25;
    let mut best = start;
    let mut now = best.clone();
    for _ in 0..STEPS {
        let scale = now.misfit.max(1e-4);
        let mut normal = DMatrix::<f64>::zeros(7, 7);
        let mut right = nalgebra::DVector::<f64>::zeros(7);
        let mut seen = Vec::new();
        for ray in rays {
            let time_s = ray.time_s + now.offset_s + 0.5 * frame_s * ray.row_share;
            let Some(weights) = course.weights(time_s) else { continue };
            let (place, velocity) = (course.way.place(&weights), course.way.velocity(&weights));
            seen.push((ray.direction, place));
            let offset = now.rotation.inverse_transform_vector(&(place - now.centre));
            let range = offset.norm();
            let tangents =
                crossfix_geometry::tangent_basis(&nalgebra::Unit::new_normalize(ray.direction));
            let seen_at = offset / range;
            let residual = tangents.transpose() * seen_at;
            let by_offset = tangents.transpose()
                * (Matrix3::identity() - seen_at * seen_at.transpose())
                / range;
            let by_place = by_offset * now.rotation.matrix().transpose();
            let by_rotation = by_offset * offset.cross_matrix();
            let by_time = by_place * velocity;
            let weight = (1.0 + residual.norm_squared() / (scale * scale)).recip();
            let mut rows = SMatrix::<f64, 2, 7>::zeros();
            rows.fixed_columns_mut::<3>(0).copy_from(&by_rotation);
            rows.fixed_columns_mut::<3>(3).copy_from(&-by_place);
            rows.set_column(6, &by_time);
            normal += rows.transpose() * rows * weight;
            right -= rows.transpose() * residual * weight;
        }
        if seen.len() < LEAST_TRIED.max((LEAST_SHARE * rays.len() as f64) as usize) {
            break;
        }
        for k in 0..7 {
            normal[(k, k)] *= 1.0 + 1e-3;
        }
        now.misfit = misfit(&seen, &now.rotation, now.centre);
        if now.misfit < best.misfit {
            best = now.clone();
        }
        let Some(step) = normal.cholesky().map(|factor| factor.solve(&right)) else { break };
        now.rotation *= Rotation3::new(step.fixed_rows::<3>(0).into_owned());
        now.centre += step.fixed_rows::<3>(3).into_owned();
        now.offset_s += step[6].clamp(-STEP_S, STEP_S);
    }
    best
}
