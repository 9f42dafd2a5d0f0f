//! Start with a log: a camera's pose and clock from nothing but its labels and the target's log.

use std::ops::Range;

use crossfix_geometry::tangent_basis;
use nalgebra::{DMatrix, DVector, Matrix3, Point3, Rotation3, SMatrix, Unit, Vector2, Vector3};

use super::course::Course;
use super::linear::{self, AffineMap, DirectionToPlace};
use super::model::frame_time;
use super::model::{CameraLabels, CameraUnknowns, ClockModel, Label};
use super::pieces;
use crate::lens;

/// Step in which the clock's offset is tried, s: at 10 m/s and 40 m the target is then 0.03 rad off
/// at most, which a linear solution tolerates. With half of it the same, in twice the time.
const STEP_S: f64 = 0.25;
/// Labels used in one try. With half of it a wrong offset is likelier to fit by chance.
const TRIED: usize = 120;
/// At least this many of them must be within the log (with half of it there are twelve equations
/// for the eleven unknowns of a linear solution, which then fits any offset), ...
const LEAST_TRIED: usize = 12;
/// ... and this share of them. With half of it an offset at which a fifth of the labels lies along
/// a straight piece of the log may fit best.
const LEAST_SHARE: f64 = 0.4;
/// A start with a smaller misfit than this is not searched again without birds, rad: lens files
/// leave up to 4 mrad, and what birds have bent misses by tens of mrad. With half of it most
/// cameras are searched twice, for the same start.
const CLEAR_RAD: f64 = 4e-3;
/// Of all offsets, this many linear solutions are computed again without the labels that do not fit
/// (with half of it the right one may not be among them, where birds have bent it), ...
const CLEANED: usize = 60;
/// ... and this many are refined. With half of it the right one may be left out where wrong ones
/// fit the linear solution as well.
const FOLLOWED: usize = 12;

/// The pose and the clock that a camera's state begins with.
#[derive(Clone, Copy, Debug)]
pub(super) struct StartPose {
    pub(super) rotation: Rotation3<f64>,
    pub(super) centre: Point3<f64>,
    /// How much the camera's clock is behind the common time, s.
    pub(super) offset_s: f64,
}

/// A possible pose, and how much the camera's clock is behind the common time.
#[derive(Clone, Debug)]
struct CandidateStart {
    rotation: Rotation3<f64>,
    centre: Point3<f64>,
    offset_s: f64,
    /// The angle that most misfits between labels and the log lie below ([`linear::typical`]), rad.
    misfit: f64,
}

/// A direction in the camera's frame at its own time.
#[derive(Clone, Copy, Debug)]
struct TimedDirection {
    time_s: f64,
    /// Read-out after the frame's time, as a share of the read-out time.
    row_share: f64,
    direction: Vector3<f64>,
}

impl TimedDirection {
    fn of(camera: &CameraLabels, label: &Label) -> Option<Self> {
        let direction = lens::direction(&camera.intrinsics, label.pixel)?;
        let height = f64::from(camera.intrinsics.size.height);
        Some(Self { time_s: label.time_s, row_share: label.pixel.y() / height - 0.5, direction })
    }

    /// The ray with the target's place at a common time; `None` where that is not known.
    fn met_at(&self, time_s: f64, course: &Course) -> Option<DirectionToPlace> {
        Some((self.direction, course.place_at(time_s)?))
    }
}

/// A camera's state that fits the log's trajectory, and its median misfit (rad); `None`: no offset
/// puts enough of its labels within the log.
pub(super) fn find(
    camera: &CameraLabels,
    course: &Course,
    frame_s: f64,
) -> Option<(CameraUnknowns, f64)> {
    let all = rays(camera, &camera.labels);
    let by_all = best_of(&all, &all, course, frame_s);
    let is_clear = by_all.as_ref().is_some_and(|found| found.misfit < CLEAR_RAD);
    let by_pieces = if is_clear {
        None
    } else {
        // Birds bend a linear solution, but not the robust refinement.
        let pieces = rays(camera, &pieces::longest(camera, frame_s));
        best_of(&pieces, &all, course, frame_s)
    };
    let both = by_all.into_iter().chain(by_pieces);
    let best = both.min_by(|a, b| a.misfit.total_cmp(&b.misfit))?;
    let CandidateStart { rotation, centre, offset_s, .. } = best;
    let state = state(camera, course, StartPose { rotation, centre, offset_s });
    let misfit = misfit_of(camera, &state, course);
    Some((state, misfit))
}

/// Of several things that a camera has followed, this many are tried as the target, those that it
/// followed longest. With half of it a target is missed that was followed for less time than three
/// others.
const THINGS: usize = 6;
/// A piece whose median misfit to the course is below this is of the target, rad: first with a
/// start from a piece of a few seconds, where a lens file may be 50 pixels off in a corner (with
/// half of it pieces there are left out), ...
const NEAR_RAD: f64 = 0.1;
/// ... then with a start from all pieces that are near already. With half of it a lens file that is
/// 10 mrad off in a corner has pieces left out.
const NEARER_RAD: f64 = 0.02;

/// What is left out is taken to be of another thing if the target was seen in the same frame for
/// this share of it: with a wrong lens only parts of a flight fit, but these are not simultaneous
/// with the rest. With half of it a wrong lens and a few birds suffice, and the camera is
/// calibrated by the parts that happen to fit.
const AT_ONCE: f64 = 0.5;

/// A camera's labels of the target, where most are of something else: begun with one piece, joined
/// by those that lie near. `None`: no piece is of the target, or all may be.
pub(super) fn among_others(
    camera: &CameraLabels,
    course: &Course,
    frame_s: f64,
) -> Option<CameraLabels> {
    let (pieces, _) = pieces::of_one_thing(camera, frame_s);
    let first = pieces.iter().take(THINGS);
    let ones = first.filter_map(|piece| joined_to(piece, &pieces, camera, course, frame_s));
    let own = of_labels(camera, ones.max_by_key(Vec::len)?);
    let is_own = |label: &Label| at_once(&own.labels, label.time_s, 0.5 * frame_s);
    let left_out = camera.labels.len() - own.labels.len();
    // Labels of other things in frames that show the target too.
    let at_once = camera.labels.iter().filter(|label| is_own(label)).count() - own.labels.len();
    (at_once as f64 > AT_ONCE * left_out as f64).then_some(own)
}

/// The labels of all pieces that are of the target if this one is; `None` if it is not.
fn joined_to(
    piece: &[Label],
    pieces: &[Vec<Label>],
    camera: &CameraLabels,
    course: &Course,
    frame_s: f64,
) -> Option<Vec<Label>> {
    let own = rays(camera, piece);
    let mut found = best_of(&own, &own, course, frame_s)?;
    let mut labels = piece.to_vec();
    for near_rad in [NEAR_RAD, NEARER_RAD, NEARER_RAD] {
        let near = |piece: &&Vec<Label>| found.lies_near(camera, piece, course, near_rad);
        labels = pieces.iter().filter(near).flatten().copied().collect();
        found = refined(found, &rays(camera, &labels), course, frame_s)?;
    }
    // Where even the joined pieces do not fit, the piece was of another thing.
    (found.misfit < NEARER_RAD).then_some(labels)
}

/// Whether a time has a label within `within_s`, of labels in order of time.
pub(super) fn at_once(labels: &[Label], time_s: f64, within_s: f64) -> bool {
    let next = labels.partition_point(|label| label.time_s < time_s - within_s);
    labels.get(next).is_some_and(|label| label.time_s < time_s + within_s)
}

/// A camera's labels without the pieces that, by a start, lie far from the course: they are of
/// something else.
pub(super) fn without_others(
    camera: &CameraLabels,
    state: &CameraUnknowns,
    course: &Course,
) -> CameraLabels {
    let (pieces, mut labels) = pieces::of_one_thing(camera, frame_time(camera));
    let CameraUnknowns { rotation, centre, clock, .. } = state;
    let (rotation, centre) = (*rotation, *centre);
    let start = CandidateStart { rotation, centre, offset_s: clock.offset_s, misfit: 0.0 };
    let near = |piece: &&Vec<Label>| start.lies_near(camera, piece, course, NEAR_RAD);
    labels.extend(pieces.iter().filter(near).flatten());
    of_labels(camera, labels)
}

/// A camera with other labels in the place of its own.
pub(super) fn of_labels(camera: &CameraLabels, mut labels: Vec<Label>) -> CameraLabels {
    labels.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    let CameraLabels { name, intrinsics, freedom, .. } = camera;
    CameraLabels { name: name.clone(), intrinsics: *intrinsics, freedom: *freedom, labels }
}

/// The best pose over all offsets: begun with linear solutions of some rays, refined with all.
fn best_of(
    some: &[TimedDirection],
    all: &[TimedDirection],
    course: &Course,
    frame_s: f64,
) -> Option<CandidateStart> {
    let mut found: Vec<CandidateStart> =
        offsets(some, course)?.flat_map(|offset_s| candidates(some, course, offset_s)).collect();
    found.sort_by(|a, b| a.misfit.total_cmp(&b.misfit));
    // A robust solution costs several plain ones: only the best offsets get it.
    let cleaned = found.iter().take(CLEANED).filter_map(|one| cleaned(some, course, one.offset_s));
    let cleaned: Vec<CandidateStart> = cleaned.collect();
    found.extend(cleaned);
    found.sort_by(|a, b| a.misfit.total_cmp(&b.misfit));
    let followed = found.into_iter().take(FOLLOWED);
    let refined = followed.filter_map(|candidate| refined(candidate, all, course, frame_s));
    refined.min_by(|a, b| a.misfit.total_cmp(&b.misfit))
}

/// All clock offsets at which some of the rays fall into the course, s.
fn offsets(rays: &[TimedDirection], course: &Course) -> Option<impl Iterator<Item = f64> + use<>> {
    let (first, last) = (rays.first()?.time_s, rays.last()?.time_s);
    let Range { start: from, end: to } = course.range();
    // From the last ray at the course's beginning to the first one at its end.
    let count = ((to - from + last - first) / STEP_S) as usize;
    Some((0..=count).map(move |k| from - last + k as f64 * STEP_S))
}

/// A camera's state that begins with this pose and offset.
pub(super) fn state(
    camera: &CameraLabels,
    course: &Course,
    StartPose { rotation, centre, offset_s }: StartPose,
) -> CameraUnknowns {
    let times = camera.labels.iter().map(|label| label.time_s);
    let (start, end) = times.fold((f64::INFINITY, f64::NEG_INFINITY), |(start, end), time_s| {
        (start.min(time_s), end.max(time_s))
    });
    let clock = ClockModel {
        reference_s: f64::midpoint(start, end),
        offset_s,
        rate: 0.0,
        // The middle of the prior (`READOUT_SHARE`).
        readout_s: frame_time(camera) / 2.0,
        wander: course.way.drift(),
    };
    CameraUnknowns { rotation, centre, clock, intrinsics: camera.intrinsics }
}

/// The median angle between a camera's labels and a course, rad.
pub(super) fn misfit_of(camera: &CameraLabels, state: &CameraUnknowns, course: &Course) -> f64 {
    let at = |ray: &TimedDirection| ray.met_at(state.clock.common_s(ray.time_s), course);
    let rays = rays(camera, &camera.labels);
    let pairs: Vec<DirectionToPlace> = rays.iter().filter_map(at).collect();
    linear::median(angles(&pairs, &state.rotation, state.centre))
}

/// Rays of a camera's labels, at most [`TRIED`], evenly spread.
fn rays(camera: &CameraLabels, labels: &[Label]) -> Vec<TimedDirection> {
    let stride = labels.len().div_ceil(TRIED).max(1);
    labels.iter().step_by(stride).filter_map(|label| TimedDirection::of(camera, label)).collect()
}

/// The linear solutions at a clock offset.
fn candidates(rays: &[TimedDirection], course: &Course, offset_s: f64) -> Vec<CandidateStart> {
    let Some(pairs) = seen_at(rays, course, offset_s) else { return Vec::new() };
    let maps = [linear::in_space(&pairs), linear::in_plane(&pairs)].into_iter().flatten();
    maps.filter_map(|map| CandidateStart::of(&map, &pairs, offset_s)).collect()
}

/// The linear map that fits the labels best over all offsets, whatever its lens and its log's axes,
/// and the misfit that most labels stay below, rad.
pub(super) fn mapped(camera: &CameraLabels, course: &Course) -> Option<(AffineMap, f64)> {
    let rays = rays(camera, &pieces::longest(camera, frame_time(camera)));
    let maps = offsets(&rays, course)?.filter_map(|offset_s| {
        let pairs = seen_at(&rays, course, offset_s)?;
        let map = linear::robust(&pairs)?;
        let misfit = map.typical_misfit(&pairs);
        Some((map, misfit))
    });
    maps.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// The linear solution at a clock offset with outliers given less weight.
fn cleaned(rays: &[TimedDirection], course: &Course, offset_s: f64) -> Option<CandidateStart> {
    let pairs = seen_at(rays, course, offset_s)?;
    CandidateStart::of(&linear::robust(&pairs)?, &pairs, offset_s)
}

/// Directions with the target's places at a clock offset, if there are enough.
fn seen_at(
    rays: &[TimedDirection],
    course: &Course,
    offset_s: f64,
) -> Option<Vec<DirectionToPlace>> {
    let at = |ray: &TimedDirection| ray.met_at(ray.time_s + offset_s, course);
    let pairs: Vec<DirectionToPlace> = rays.iter().filter_map(at).collect();
    // Otherwise an offset that leaves a few rays within the log would always fit best.
    let enough = LEAST_TRIED.max((LEAST_SHARE * rays.len() as f64) as usize);
    (pairs.len() >= enough).then_some(pairs)
}

impl CandidateStart {
    fn of(map: &AffineMap, pairs: &[DirectionToPlace], offset_s: f64) -> Option<Self> {
        let (rotation, centre) = map.pose()?;
        let misfit = linear::typical(angles(pairs, &rotation, centre));
        Some(Self { rotation, centre, offset_s, misfit })
    }

    /// Whether most labels of a piece lie near a course, or none is within its time.
    fn lies_near(
        &self,
        camera: &CameraLabels,
        piece: &[Label],
        course: &Course,
        near_rad: f64,
    ) -> bool {
        let at = |ray: &TimedDirection| ray.met_at(ray.time_s + self.offset_s, course);
        let seen: Vec<DirectionToPlace> = rays(camera, piece).iter().filter_map(at).collect();
        seen.is_empty() || linear::median(angles(&seen, &self.rotation, self.centre)) < near_rad
    }

    /// Where the target's place is seen in the tangent plane of the observed direction, and the
    /// derivatives of that by a rotation about the camera's axes, by its centre and by the offset.
    fn residual(
        &self,
        observed: &Vector3<f64>,
        place: Point3<f64>,
        velocity: Vector3<f64>,
    ) -> (Vector2<f64>, SMatrix<f64, 2, 7>) {
        let to_place = self.rotation.inverse_transform_vector(&(place - self.centre));
        let range = to_place.norm();
        let tangents = tangent_basis(&Unit::new_normalize(*observed));
        let seen_at = to_place / range;
        // d(to_place / range) / d(to_place) = (I - s s') / range
        let by_point =
            tangents.transpose() * (Matrix3::identity() - seen_at * seen_at.transpose()) / range;
        let by_place = by_point * self.rotation.matrix().transpose();
        let mut by = SMatrix::<f64, 2, 7>::zeros();
        by.fixed_columns_mut::<3>(0).copy_from(&(by_point * to_place.cross_matrix()));
        by.fixed_columns_mut::<3>(3).copy_from(&-by_place);
        // d(residual) / d(offset) = d(residual) / d(place) v.
        by.set_column(6, &(by_place * velocity));
        (tangents.transpose() * seen_at, by)
    }
}

/// Angles between directions and the places as seen by a camera of this pose, rad.
fn angles(
    pairs: &[DirectionToPlace],
    rotation: &Rotation3<f64>,
    centre: Point3<f64>,
) -> impl Iterator<Item = f64> {
    pairs.iter().map(move |(direction, place)| {
        rotation.inverse_transform_vector(&(place - centre)).angle(direction)
    })
}

/// Gauss-Newton refinement of pose and offset against the log's trajectory, with weights against
/// outliers; `None` if too few rays fall into the course.
fn refined(
    start: CandidateStart,
    rays: &[TimedDirection],
    course: &Course,
    frame_s: f64,
) -> Option<CandidateStart> {
    /// Number of steps. With half of it outliers still pull at what is returned.
    const STEPS: usize = 25;
    let mut best: Option<CandidateStart> = None;
    let mut now = start;
    for _ in 0..STEPS {
        // The weights sharpen as the fit improves: what is far off by then pulls less and less.
        let scale = now.misfit.max(1e-4);
        let mut normal = DMatrix::<f64>::zeros(7, 7);
        let mut right = DVector::<f64>::zeros(7);
        let mut seen = Vec::new();
        for ray in rays {
            // The read-out time is taken to be half of the frame time.
            let time_s = ray.time_s + now.offset_s + 0.5 * frame_s * ray.row_share;
            let Some(weights) = course.weights(time_s) else { continue };
            let (place, velocity) = (course.way.place(&weights), course.way.velocity(&weights));
            seen.push((ray.direction, place));
            let (residual, rows) = now.residual(&ray.direction, place, velocity);
            // Cauchy's weights, with the scale of the current misfit.
            let weight = (1.0 + residual.norm_squared() / (scale * scale)).recip();
            normal += rows.transpose() * rows * weight;
            right -= rows.transpose() * residual * weight;
        }
        if seen.len() < LEAST_TRIED.max((LEAST_SHARE * rays.len() as f64) as usize) {
            break;
        }
        // A little Levenberg damping.
        for k in 0..7 {
            normal[(k, k)] *= 1.0 + 1e-3;
        }
        now.misfit = linear::typical(angles(&seen, &now.rotation, now.centre));
        if best.as_ref().is_none_or(|best| now.misfit < best.misfit) {
            best = Some(now.clone());
        }
        let Some(step) = normal.cholesky().map(|factor| factor.solve(&right)) else { break };
        // R <- R exp(d), about the camera's own axes.
        now.rotation *= Rotation3::new(step.fixed_rows::<3>(0).into_owned());
        now.centre += step.fixed_rows::<3>(3).into_owned();
        now.offset_s += step[6].clamp(-STEP_S, STEP_S);
    }
    best
}
