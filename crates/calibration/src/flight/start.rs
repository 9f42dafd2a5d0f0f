//! Where to begin: a camera's pose and clock from nothing but its labels and the target's log.

use nalgebra::{DMatrix, Matrix3, Point3, Rotation3, SMatrix, Vector3};

use super::course::Course;
use super::linear::{self, Linear, Seen};
use super::model::frame_time;
use super::model::{CameraLabels, CameraState, Clock, Label};
use super::pieces;
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
/// A start that lies no farther beside the way than this is not looked for again without birds, rad:
/// lens files leave up to 4 mrad, and what birds have bent lies tens beside.
const CLEAR_RAD: f64 = 4e-3;
/// Of all offsets, the linear solutions of so many are made again without what does not fit them, ...
const CLEANED: usize = 60;
/// ... and so many are followed up.
const FOLLOWED: usize = 12;

/// A pose, and by how much the camera's time is behind the common one.
#[derive(Clone, Debug)]
struct Candidate {
    rotation: Rotation3<f64>,
    centre: Point3<f64>,
    offset_s: f64,
    /// What most angles between labels and the log lie below, rad.
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
    let all = rays(camera, &camera.labels);
    let by_all = best_of(&all, &all, course, frame_s);
    let is_clear = by_all.as_ref().is_some_and(|found| found.misfit < CLEAR_RAD);
    let by_pieces = || {
        // Birds bend a linear solution, and not what is refined.
        let pieces = rays(camera, &pieces::longest(camera, frame_s));
        best_of(&pieces, &all, course, frame_s)
    };
    let by_pieces = if is_clear { None } else { by_pieces() };
    let both = by_all.into_iter().chain(by_pieces);
    let best = both.min_by(|a, b| a.misfit.total_cmp(&b.misfit))?;
    let state = state(camera, course, (best.rotation, best.centre, best.offset_s));
    let misfit = misfit_of(camera, &state, course);
    Some((state, misfit))
}

/// Of several things that a camera has followed so many are tried for the target, those that it followed
/// longest.
const THINGS: usize = 6;
/// A piece whose labels lie within this of the course, in the median, is of the target, rad: from a start by
/// a piece of a few seconds, and where a lens file is 50 pixels off in a corner, ...
const NEAR_RAD: f64 = 0.1;
/// ... and of a start by all that are near already.
const NEARER_RAD: f64 = 0.02;

/// What is left out is of another thing if the target was seen in the same frame for this share of it: the
/// parts of a flight that a wrong lens makes fit lie beside the others in time.
const AT_ONCE: f64 = 0.5;

/// What of a camera's labels is the target's, where most are of something else: begun with one piece,
/// joined by those that lie near. `None`: no piece is of the target, or all may be.
pub(super) fn among_others(
    camera: &CameraLabels,
    course: &Course,
    frame_s: f64,
) -> Option<CameraLabels> {
    let (pieces, _) = pieces::of_one_thing(camera, frame_s);
    let ones = pieces.iter().take(THINGS).filter_map(|piece| {
        let own = rays(camera, piece);
        let mut found = best_of(&own, &own, course, frame_s)?;
        let mut labels = piece.clone();
        for near_rad in [NEAR_RAD, NEARER_RAD, NEARER_RAD] {
            let near = |piece: &&Vec<Label>| found.lies_near(camera, piece, course, near_rad);
            labels = pieces.iter().filter(near).flatten().copied().collect();
            found = refined(found, &rays(camera, &labels), course, frame_s)?;
        }
        (found.misfit < NEARER_RAD).then_some(labels)
    });
    let own = of_labels(camera, ones.max_by_key(Vec::len)?);
    let is_own = |label: &Label| at_once(&own.labels, label.time_s, 0.5 * frame_s);
    let left_out = camera.labels.len() - own.labels.len();
    let at_once = camera.labels.iter().filter(|label| is_own(label)).count() - own.labels.len();
    (at_once as f64 > AT_ONCE * left_out as f64).then_some(own)
}

/// Whether some of the labels, in the order of their times, are of a time.
pub(super) fn at_once(labels: &[Label], time_s: f64, within_s: f64) -> bool {
    let next = labels.partition_point(|label| label.time_s < time_s - within_s);
    labels.get(next).is_some_and(|label| label.time_s < time_s + within_s)
}

/// A camera's labels without the pieces that lie far beside the course by a start: they are of something
/// else.
pub(super) fn without_others(
    camera: &CameraLabels,
    state: &CameraState,
    course: &Course,
) -> CameraLabels {
    let (pieces, mut labels) = pieces::of_one_thing(camera, frame_time(camera));
    let CameraState { rotation, centre, clock, .. } = state;
    let (rotation, centre) = (*rotation, *centre);
    let start = Candidate { rotation, centre, offset_s: clock.offset_s, misfit: 0.0 };
    let near = |piece: &&Vec<Label>| start.lies_near(camera, piece, course, NEAR_RAD);
    labels.extend(pieces.iter().filter(near).flatten());
    of_labels(camera, labels)
}

/// A camera with other labels than its own.
pub(super) fn of_labels(camera: &CameraLabels, mut labels: Vec<Label>) -> CameraLabels {
    labels.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    let CameraLabels { name, intrinsics, freedom, .. } = camera;
    CameraLabels { name: name.clone(), intrinsics: *intrinsics, freedom: *freedom, labels }
}

/// The best pose over all offsets that begins with a linear solution of some rays, refined by all.
fn best_of(some: &[Ray], all: &[Ray], course: &Course, frame_s: f64) -> Option<Candidate> {
    let mut found: Vec<Candidate> =
        offsets(some, course)?.flat_map(|offset_s| candidates(some, course, offset_s)).collect();
    found.sort_by(|a, b| a.misfit.total_cmp(&b.misfit));
    let cleaned = found.iter().take(CLEANED).filter_map(|one| cleaned(some, course, one.offset_s));
    let cleaned: Vec<Candidate> = cleaned.collect();
    found.extend(cleaned);
    found.sort_by(|a, b| a.misfit.total_cmp(&b.misfit));
    let followed = found.into_iter().take(FOLLOWED);
    let refined = followed.filter_map(|candidate| refined(candidate, all, course, frame_s));
    refined.min_by(|a, b| a.misfit.total_cmp(&b.misfit))
}

/// All offsets of a clock at which some of its rays fall into the course, s.
fn offsets(rays: &[Ray], course: &Course) -> Option<impl Iterator<Item = f64> + use<>> {
    let (first, last) = (rays.first()?.time_s, rays.last()?.time_s);
    let (from, to) = course.range();
    let count = ((to - from + last - first) / STEP_S) as usize;
    Some((0..=count).map(move |k| from - last + k as f64 * STEP_S))
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
    let rays = rays(camera, &camera.labels);
    let pairs: Vec<Seen> = rays.iter().filter_map(at).collect();
    linear::median(angles(&pairs, &state.rotation, state.centre))
}

/// A camera's labels, evenly spread over all of these.
fn rays(camera: &CameraLabels, labels: &[Label]) -> Vec<Ray> {
    let stride = labels.len().div_ceil(TRIED).max(1);
    let height = f64::from(camera.intrinsics.size.height);
    let ray = |label: &Label| {
        let direction = lens::direction(&camera.intrinsics, label.pixel)?;
        Some(Ray { time_s: label.time_s, row_share: label.pixel.y() / height - 0.5, direction })
    };
    labels.iter().step_by(stride).filter_map(ray).collect()
}

/// The linear solutions at an offset.
fn candidates(rays: &[Ray], course: &Course, offset_s: f64) -> Vec<Candidate> {
    let Some(pairs) = seen_at(rays, course, offset_s) else { return Vec::new() };
    let maps = [linear::in_space(&pairs), linear::in_plane(&pairs)].into_iter().flatten();
    maps.filter_map(|map| Candidate::of(&map, &pairs, offset_s)).collect()
}

/// The linear map that fits the labels best over all offsets, whatever its lens and its log's axes, and
/// by how much it misses them in the median, rad.
pub(super) fn mapped(camera: &CameraLabels, course: &Course) -> Option<(Linear, f64)> {
    let rays = rays(camera, &pieces::longest(camera, frame_time(camera)));
    let maps = offsets(&rays, course)?.filter_map(|offset_s| {
        let pairs = seen_at(&rays, course, offset_s)?;
        let map = linear::robust(&pairs)?;
        let misfit = map.typical_misfit(&pairs);
        Some((map, misfit))
    });
    maps.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// The linear solution at an offset of what fits it.
fn cleaned(rays: &[Ray], course: &Course, offset_s: f64) -> Option<Candidate> {
    let pairs = seen_at(rays, course, offset_s)?;
    Candidate::of(&linear::robust(&pairs)?, &pairs, offset_s)
}

/// The directions with what is there at an offset, if there are enough.
fn seen_at(rays: &[Ray], course: &Course, offset_s: f64) -> Option<Vec<Seen>> {
    let at = |ray: &Ray| {
        let weights = course.weights(ray.time_s + offset_s)?;
        Some((ray.direction, course.way.place(&weights)))
    };
    let pairs: Vec<Seen> = rays.iter().filter_map(at).collect();
    let enough = LEAST_TRIED.max((LEAST_SHARE * rays.len() as f64) as usize);
    (pairs.len() >= enough).then_some(pairs)
}

impl Candidate {
    fn of(map: &Linear, pairs: &[Seen], offset_s: f64) -> Option<Self> {
        let (rotation, centre) = map.pose()?;
        let misfit = linear::typical(angles(pairs, &rotation, centre));
        Some(Self { rotation, centre, offset_s, misfit })
    }

    /// Whether most labels of a piece lie near a course, or at no time of it.
    fn lies_near(
        &self,
        camera: &CameraLabels,
        piece: &[Label],
        course: &Course,
        near_rad: f64,
    ) -> bool {
        let at = |ray: &Ray| {
            let weights = course.weights(ray.time_s + self.offset_s)?;
            Some((ray.direction, course.way.place(&weights)))
        };
        let seen: Vec<Seen> = rays(camera, piece).iter().filter_map(at).collect();
        seen.is_empty() || linear::median(angles(&seen, &self.rotation, self.centre)) < near_rad
    }
}

/// The angles between directions and where a camera that stands so has their places, rad.
fn angles(
    pairs: &[Seen],
    rotation: &Rotation3<f64>,
    centre: Point3<f64>,
) -> impl Iterator<Item = f64> {
    pairs.iter().map(move |(direction, place)| {
        rotation.inverse_transform_vector(&(place - centre)).angle(direction)
    })
}

/// Gauss and Newton's steps of pose, offset and read-out against the log's way, with weights
/// against outliers; `None` if too few of them fall into the course.
fn refined(start: Candidate, rays: &[Ray], course: &Course, frame_s: f64) -> Option<Candidate> {
    const STEPS: usize = 25;
    let mut best: Option<Candidate> = None;
    let mut now = start;
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
        now.misfit = linear::typical(angles(&seen, &now.rotation, now.centre));
        if best.as_ref().is_none_or(|best| now.misfit < best.misfit) {
            best = Some(now.clone());
        }
        let Some(step) = normal.cholesky().map(|factor| factor.solve(&right)) else { break };
        now.rotation *= Rotation3::new(step.fixed_rows::<3>(0).into_owned());
        now.centre += step.fixed_rows::<3>(3).into_owned();
        now.offset_s += step[6].clamp(-STEP_S, STEP_S);
    }
    best
}
