//! Start without a log: the relative pose of two cameras from what both saw, up to scale and place.
//!
//! For every offset of their clocks that leaves them enough labels in common, the essential matrix
//! by eight points is computed; the offset that fits best gives the relative pose and where the
//! target was.

use std::ops::Range;

use crossfix_geometry::Pose;
use nalgebra::{Matrix3, Point3, Rotation3, SMatrix, Vector3};

use super::model::{CameraLabels, Label, frame_time};
use super::plane::{self, SecondFromFirst};
use super::start::StartPose;
use crate::lens;

/// Offsets of the clocks are tried in steps of this, s, and then in ever finer ones about the best.
/// At 10 m/s and 40 m the best of the first steps is 0.03 rad off at most; with twice as much it
/// may not stand out.
const STEP_S: f64 = 0.25;
/// The finer steps, s, the last of which is how well the offset is known to begin with. With half
/// of them the same, at more tries: the adjustment finds the rest.
const FINER: [f64; 3] = [0.05, 0.01, 0.002];
/// Labels used in one try. With half of it cameras that share only half of their time find no pair,
/// as they need 40 in common.
const TRIED: usize = 150;
/// At least this many of them must be seen by both cameras, ...
const LEAST_COMMON: usize = 40;
/// ... and this share of the smaller camera's labels: an essential matrix has eight free numbers,
/// which fit any short piece of a trajectory. With half of both a wrong offset, at which only two
/// ends of the flight overlap, may fit best.
const LEAST_SHARE: f64 = 0.3;
/// Sight lines needed to tell whether those of a known relative pose meet. With half of it seven
/// lines may meet by chance, and a bird's piece is joined to the target's.
const LEAST_MET: usize = 15;
/// Between two labels farther apart than this the direction counts as unknown, s, ...
const GAP_S: f64 = 0.2;
/// ... if they are also farther apart than this many of the camera's frames. With half of both
/// labels count for nothing wherever three in a row are lost, at 30 frames per second.
const GAP_FRAMES: f64 = 1.5;
/// Sight lines that meet at a smaller angle than this tell no range, rad. Lens files that are off
/// by 4 mrad put such ranges off by 8 %; with half of it by 16 %.
pub(super) const LEAST_PARALLAX_RAD: f64 = 0.05;
/// For a flight in a plane the homography's misfit is at most this many times that of the essential
/// matrix, which is then one of a whole family and fits its noise; for other flights it is hundreds
/// of times as large. With half of it a flight that leaves its plane a little is begun with the
/// essential matrix that its noise has chosen.
const PLANE_TIMES: f64 = 10.0;
/// Distance between two cameras that is assumed until something determines it, m. With half of it
/// the same, as the site is scaled afterwards.
const BASE_M: f64 = 50.0;

/// Directions that a camera saw the target in, by its own clock.
pub(super) struct Sights {
    times_s: Vec<f64>,
    directions: Vec<Vector3<f64>>,
    gap_s: f64,
}

impl Sights {
    pub(super) fn of(camera: &CameraLabels) -> Self {
        let direction = |label: &Label| lens::direction(&camera.intrinsics, label.pixel);
        let seen = camera
            .labels
            .iter()
            .filter_map(|label| Some((label.time_s, direction(label)?.normalize())));
        let (times_s, directions) = seen.unzip();
        let gap_s = GAP_S.max(GAP_FRAMES * frame_time(camera));
        Self { times_s, directions, gap_s }
    }

    /// The directions of several pieces of one camera's labels, in order of time.
    pub(super) fn together(pieces: &[&Self]) -> Self {
        let gap_s = pieces.iter().map(|piece| piece.gap_s).fold(0.0, f64::max);
        let mut all: Vec<(f64, Vector3<f64>)> =
            pieces.iter().flat_map(|piece| piece.timed()).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (times_s, directions) = all.into_iter().unzip();
        Self { times_s, directions, gap_s }
    }

    /// Number of directions.
    pub(super) fn len(&self) -> usize {
        self.times_s.len()
    }

    /// The direction at a time, interpolated between labels; `None` where the target was not seen.
    pub(super) fn at(&self, time_s: f64) -> Option<Vector3<f64>> {
        let next = self.times_s.partition_point(|seen| *seen < time_s);
        let before = next.checked_sub(1)?;
        let (from, to) = (self.times_s[before], *self.times_s.get(next)?);
        // Straight between two labels, then back to length one.
        let share = (time_s - from) / (to - from);
        let between = self.directions[before].lerp(&self.directions[next], share);
        (to - from <= self.gap_s).then(|| between.normalize())
    }

    /// From the first label to the last, by the camera's own clock, s.
    pub(super) fn span(&self) -> Option<Range<f64>> {
        Some(*self.times_s.first()?..*self.times_s.last()?)
    }

    /// Times and directions of labels, evenly spread, at most `most`.
    fn times(&self, most: usize) -> impl Iterator<Item = (f64, Vector3<f64>)> {
        let stride = self.times_s.len().div_ceil(most).max(1);
        self.timed().step_by(stride)
    }

    fn timed(&self) -> impl Iterator<Item = (f64, Vector3<f64>)> {
        self.times_s.iter().copied().zip(self.directions.iter().copied())
    }
}

/// Relative pose and clock offset of two cameras.
#[derive(Clone, Debug)]
pub(super) struct RelativePose {
    /// The time by the first's clock less that by the second's, s.
    pub(super) ahead_s: f64,
    pub(super) first_from_second: Rotation3<f64>,
    /// The second's centre in the first's frame, in metres if the two stand [`BASE_M`] apart.
    pub(super) centre: Point3<f64>,
    /// Relative uncertainty of ranges: the median angle by which sight lines miss each other,
    /// divided by the median angle at which they meet and by the root of how many there are. Less
    /// is better.
    pub(super) range_uncertainty: f64,
}

/// Directions that both see at a clock offset, in the first's frame and in the second's.
fn common(first: &Sights, second: &Sights, ahead_s: f64) -> Vec<[Vector3<f64>; 2]> {
    // The second's time is the first's less `ahead_s`.
    let both =
        |(time_s, direction): (f64, Vector3<f64>)| Some([direction, second.at(time_s - ahead_s)?]);
    first.times(TRIED).filter_map(both).collect()
}

/// The essential matrix by eight points, `b' E a = 0`, and the median angle by which it misses.
fn essential(seen: &[[Vector3<f64>; 2]]) -> (Matrix3<f64>, f64) {
    let mut sum = SMatrix::<f64, 9, 9>::zeros();
    for [a, b] in seen {
        let outer = b * a.transpose();
        let row = SMatrix::<f64, 9, 1>::from_column_slice(outer.as_slice());
        // b' E a = sum of (b a')_ij E_ij: linear in E.
        sum.syger(1.0, &row, &row, 1.0);
    }
    sum.fill_upper_triangle_with_lower_triangle();
    let eigen = sum.symmetric_eigen();
    // The eigenvector of the least eigenvalue, columns first as in `outer`.
    let least = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let matrix = Matrix3::from_column_slice(least.as_slice());
    (matrix, misfit(&matrix, seen))
}

/// The median angle by which an essential matrix misses, rad.
fn misfit(matrix: &Matrix3<f64>, seen: &[[Vector3<f64>; 2]]) -> f64 {
    median(seen.iter().map(|both| from_epipolar_plane(matrix, both)))
}

/// Angle of a direction from the epipolar plane, rad: `|b' E a|` over the root mean square length
/// of `E a` and `E' b`.
fn from_epipolar_plane(matrix: &Matrix3<f64>, [a, b]: &[Vector3<f64>; 2]) -> f64 {
    let (of_a, of_b) = (matrix * a, matrix.tr_mul(b));
    let size2 = f64::midpoint(of_a.norm_squared(), of_b.norm_squared());
    b.dot(&of_a).abs() / size2.sqrt().max(1e-12)
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_unstable_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::INFINITY)
}

/// Possible relative poses of two cameras: a flight in a plane allows two. Empty where they saw too
/// little in common.
pub(super) fn find(first: &Sights, second: &Sights) -> Vec<RelativePose> {
    let Some(offset) = offset(first, second, |seen| essential(seen).1) else {
        return Vec::new();
    };
    let seen = common(first, second, offset.ahead_s);
    decomposed(&seen, offset).into_iter().chain(in_plane(&seen, offset)).collect()
}

/// The clock offset of two cameras whose relative pose is known. `None` where what they saw does
/// not fit that pose, or is too little.
pub(super) fn known(first: &Sights, second: &Sights, [a, b]: [&Pose; 2]) -> Option<RelativePose> {
    let second_from_first = b.rotation().inverse();
    let rotation = (second_from_first * a.rotation()).into_inner();
    let shift = second_from_first * (a.position() - b.position());
    // E = [t]x R, with the second's frame from the first's: b ~ R a + t.
    let matrix = shift.cross_matrix() * rotation;
    let offset = offset(first, second, |seen| misfit(&matrix, seen))?;
    let seen = common(first, second, offset.ahead_s);
    let shift = shift.try_normalize(1e-9)?;
    Some(RelativePose::of(&SecondFromFirst { rotation, shift }, &seen, offset)?.1)
}

/// An offset of two cameras' clocks, and how well what both see fits with it.
#[derive(Clone, Copy, Debug)]
struct TriedOffset {
    /// As [`RelativePose::ahead_s`].
    ahead_s: f64,
    /// Median angle by which what both see misses, rad.
    misfit_rad: f64,
}

/// The clock offset at which what both see fits best.
fn offset(
    first: &Sights,
    second: &Sights,
    misfit_of: impl Fn(&[[Vector3<f64>; 2]]) -> f64,
) -> Option<TriedOffset> {
    let (own, other) = (first.span()?, second.span()?);
    let fewer = first.times_s.len().min(second.times_s.len());
    // Of the tried labels of the first, as many as correspond to that share of the fewer labels.
    let share = LEAST_SHARE * fewer as f64 / first.times_s.len() as f64;
    let tried = first.times(TRIED).count();
    let enough = LEAST_COMMON.max((share * tried as f64) as usize);
    let seen = |ahead_s| Some(common(first, second, ahead_s)).filter(|seen| seen.len() >= enough);
    let misfit = |ahead_s| seen(ahead_s).map_or(f64::INFINITY, |seen| misfit_of(&seen));
    let (least, most) = (own.start - other.end, own.end - other.start);
    let steps = ((most - least) / STEP_S) as usize;
    let offsets_s = (0..=steps).map(|k| least + k as f64 * STEP_S);
    let nothing = TriedOffset { ahead_s: 0.0, misfit_rad: f64::INFINITY };
    let mut best = best_offset(nothing, offsets_s, misfit);
    let mut coarser = STEP_S;
    for step in FINER {
        let about = best.ahead_s;
        // One coarser step to either side.
        let reach = (coarser / step) as i32;
        let offsets_s = (-reach..=reach).map(|k| about + f64::from(k) * step);
        best = best_offset(best, offsets_s, misfit);
        coarser = step;
    }
    best.misfit_rad.is_finite().then_some(best)
}

/// The best of these offsets and one that has been tried.
fn best_offset(
    known: TriedOffset,
    offsets_s: impl Iterator<Item = f64>,
    misfit: impl Fn(f64) -> f64,
) -> TriedOffset {
    let tried = offsets_s.map(|ahead_s| TriedOffset { ahead_s, misfit_rad: misfit(ahead_s) });
    tried.fold(known, |best, one| if one.misfit_rad < best.misfit_rad { one } else { best })
}

/// Of the four poses that an essential matrix allows, the one with most of the target ahead of both
/// cameras.
fn decomposed(seen: &[[Vector3<f64>; 2]], offset: TriedOffset) -> Option<RelativePose> {
    // E = U diag(1, 1, 0) V': R = U W V' or U W' V' with W a quarter turn about z, and t = +-u3.
    let factors = essential(seen).0.svd(true, true);
    let (mut u, mut v_t) = (factors.u?, factors.v_t?);
    // nalgebra sorts the singular values, so that the last is the zero.
    if u.determinant() < 0.0 {
        u.neg_mut();
    }
    if v_t.determinant() < 0.0 {
        v_t.neg_mut();
    }
    let quarter = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    // u3' E = 0: the base line, whose sign and length E does not tell.
    let along: Vector3<f64> = u.column(2).into_owned();
    let poses = [quarter, quarter.transpose()].into_iter().flat_map(|quarter| {
        let rotation = u * quarter * v_t;
        [along, -along].map(|shift| SecondFromFirst { rotation, shift })
    });
    let pairs = poses.filter_map(|pose| RelativePose::of(&pose, seen, offset));
    pairs.max_by_key(|(ahead, _)| *ahead).map(|(_, pair)| pair)
}

/// The poses of a flight in a plane, if a plane explains it about as well.
fn in_plane(seen: &[[Vector3<f64>; 2]], offset: TriedOffset) -> Vec<RelativePose> {
    let Some((matrix, in_plane_rad)) = plane::homography(seen) else { return Vec::new() };
    // A plane has fewer free numbers: it must not fit much worse than the essential matrix.
    if in_plane_rad > PLANE_TIMES * offset.misfit_rad {
        return Vec::new();
    }
    let offset = TriedOffset { misfit_rad: in_plane_rad, ..offset };
    let pairs = plane::poses(&matrix, seen).into_iter().filter_map(|pose| {
        let shift = pose.shift.try_normalize(1e-9)?;
        RelativePose::of(&SecondFromFirst { shift, ..pose }, seen, offset)
    });
    pairs.map(|(_, pair)| pair).collect()
}

impl RelativePose {
    /// The poses of the two cameras in the first's frame, by the first's clock.
    pub(super) fn start_poses(&self) -> [StartPose; 2] {
        let (rotation, centre) = (self.first_from_second, self.centre);
        [
            StartPose { rotation: Rotation3::identity(), centre: Point3::origin(), offset_s: 0.0 },
            StartPose { rotation, centre, offset_s: self.ahead_s },
        ]
    }

    /// The median angle by which the two cameras' sight lines pass each other, rad; `None` where
    /// too few are simultaneous.
    pub(super) fn aside(&self, first: &Sights, second: &Sights) -> Option<f64> {
        let seen = common(first, second, self.ahead_s);
        let second_from_first = self.first_from_second.inverse();
        let shift = second_from_first * -self.centre.coords;
        let matrix = shift.cross_matrix() * second_from_first.into_inner();
        (seen.len() >= LEAST_MET).then(|| misfit(&matrix, &seen))
    }

    /// The pair for a rotation and a shift of length one, with the number of places that lie ahead
    /// of both; `None` if less than half do.
    fn of(
        SecondFromFirst { rotation, shift }: &SecondFromFirst,
        seen: &[[Vector3<f64>; 2]],
        TriedOffset { ahead_s, misfit_rad }: TriedOffset,
    ) -> Option<(usize, Self)> {
        // b ~ R a + t has its zero, the second's centre, at a = -R' t.
        let centre = Point3::from(-rotation.tr_mul(shift) * BASE_M);
        let first_from_second = Rotation3::from_matrix_unchecked(rotation.transpose());
        let mut pair = Self { ahead_s, first_from_second, centre, range_uncertainty: 0.0 };
        let parallaxes: Vec<f64> = seen.iter().filter_map(|seen| pair.parallax(seen)).collect();
        let ahead = parallaxes.len();
        // sd(r) / r of two lines is their misfit over the angle at which they meet.
        pair.range_uncertainty =
            misfit_rad / median(parallaxes.into_iter()) / (ahead as f64).sqrt();
        (2 * ahead >= seen.len()).then_some((ahead, pair))
    }

    /// The angle at which the sight lines of a place ahead of both meet; `None` where the angle is
    /// too small to tell.
    fn parallax(&self, [a, b]: &[Vector3<f64>; 2]) -> Option<f64> {
        let b = self.first_from_second * b;
        let (base, cosine) = (self.centre.coords, a.dot(&b));
        let sine2 = 1.0 - cosine * cosine;
        // The lines' nearest points lie at (base.a - cos base.b) / sin^2 and (cos base.a - base.b)
        // / sin^2 along a and b: both must be positive.
        let is_ahead = base.dot(a) > base.dot(&b) * cosine && base.dot(a) * cosine > base.dot(&b);
        (is_ahead && sine2 > LEAST_PARALLAX_RAD * LEAST_PARALLAX_RAD).then(|| sine2.sqrt())
    }
}
