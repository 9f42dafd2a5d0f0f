//! Start without a log: the relative pose of two cameras from what both saw, up to scale and place.
//!
//! For every offset of their clocks that leaves them enough labels in common, the essential matrix
//! by eight points is computed; the offset that fits best gives the relative pose and where the
//! target was.

use nalgebra::{Matrix3, Point3, Rotation3, SMatrix, Vector3};

use super::model::CameraLabels;
use super::model::frame_time;
use super::plane;
use crate::lens;

/// Offsets of the clocks are tried in steps of this, s, and then in ever finer ones about the best.
/// At 10 m/s and 40 m the best of the first steps is 0.03 rad off at most; with twice as much it
/// may not stand out.
const STEP_S: f64 = 0.25;
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
/// Between two labels farther apart than this the direction is taken as unknown, s: or than this
/// many of the camera's frames. With half of them labels count for nothing wherever three in a row
/// are lost, at 30 frames a second.
const GAP_S: f64 = 0.2;
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
        let seen = |label: &super::Label| {
            Some((label.time_s, lens::direction(&camera.intrinsics, label.pixel)?.normalize()))
        };
        let (times_s, directions) = camera.labels.iter().filter_map(seen).unzip();
        let gap_s = GAP_S.max(GAP_FRAMES * frame_time(camera));
        Self { times_s, directions, gap_s }
    }

    /// The directions of several pieces of one camera's labels, in order of time.
    pub(super) fn together(pieces: &[&Self]) -> Self {
        let gap_s = pieces.iter().map(|piece| piece.gap_s).fold(0.0, f64::max);
        let seen = |piece: &&Self| {
            piece.times_s.iter().copied().zip(piece.directions.iter().copied()).collect::<Vec<_>>()
        };
        let mut all: Vec<(f64, Vector3<f64>)> = pieces.iter().flat_map(seen).collect();
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

    pub(super) fn span(&self) -> Option<(f64, f64)> {
        Some((*self.times_s.first()?, *self.times_s.last()?))
    }

    /// Times and directions of labels, evenly spread, at most `most`.
    fn times(&self, most: usize) -> impl Iterator<Item = (f64, Vector3<f64>)> {
        let stride = self.times_s.len().div_ceil(most).max(1);
        let seen = self.times_s.iter().copied().zip(self.directions.iter().copied());
        seen.step_by(stride)
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
    pub(super) doubt: f64,
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
    let Some((ahead_s, misfit_rad)) = offset(first, second, |seen| essential(seen).1) else {
        return Vec::new();
    };
    let seen = common(first, second, ahead_s);
    let in_space = decomposed(&seen, ahead_s, misfit_rad);
    in_space.into_iter().chain(in_plane(&seen, ahead_s, misfit_rad)).collect()
}

/// The clock offset of two cameras whose relative pose is known. `None` where what they saw does
/// not fit that pose, or is too little.
pub(super) fn known(
    first: &Sights,
    second: &Sights,
    [a, b]: [(&Rotation3<f64>, Point3<f64>); 2],
) -> Option<RelativePose> {
    let second_from_first = (b.0.inverse() * a.0).into_inner();
    let shift = b.0.inverse() * (a.1 - b.1);
    // E = [t]x R, with the second's frame from the first's: b ~ R a + t.
    let matrix = shift.cross_matrix() * second_from_first;
    let (ahead_s, misfit_rad) = offset(first, second, |seen| misfit(&matrix, seen))?;
    let seen = common(first, second, ahead_s);
    let unit = shift.try_normalize(1e-9)?;
    Some(RelativePose::of((second_from_first, unit), &seen, ahead_s, misfit_rad)?.1)
}

/// The clock offset (s) at which what both see fits best, and its misfit.
fn offset(
    first: &Sights,
    second: &Sights,
    misfit_of: impl Fn(&[[Vector3<f64>; 2]]) -> f64,
) -> Option<(f64, f64)> {
    let ((from, to), (other_from, other_to)) = (first.span()?, second.span()?);
    let fewer = first.times_s.len().min(second.times_s.len());
    // Of the tried labels of the first, as many as correspond to that share of the fewer labels.
    let share = LEAST_SHARE * fewer as f64 / first.times_s.len() as f64;
    let tried = first.times(TRIED).count();
    let enough = LEAST_COMMON.max((share * tried as f64) as usize);
    let seen = |ahead_s| Some(common(first, second, ahead_s)).filter(|seen| seen.len() >= enough);
    let misfit = |ahead_s| seen(ahead_s).map_or(f64::INFINITY, |seen| misfit_of(&seen));
    let (least, most) = (from - other_to, to - other_from);
    let steps = ((most - least) / STEP_S) as usize;
    let offsets_s = (0..=steps).map(|k| least + k as f64 * STEP_S);
    let mut best = best_offset((0.0, f64::INFINITY), offsets_s, misfit);
    let mut coarser = STEP_S;
    for step in FINER {
        let about = best.0;
        // One coarser step to either side.
        let reach = (coarser / step) as i32;
        let offsets_s = (-reach..=reach).map(|k| about + f64::from(k) * step);
        best = best_offset(best, offsets_s, misfit);
        coarser = step;
    }
    best.1.is_finite().then_some(best)
}

/// The best of these offsets and one that is known, each with its misfit.
fn best_offset(
    known: (f64, f64),
    offsets_s: impl Iterator<Item = f64>,
    misfit: impl Fn(f64) -> f64,
) -> (f64, f64) {
    let tried = offsets_s.map(|ahead_s| (ahead_s, misfit(ahead_s)));
    tried.fold(known, |best, other| if other.1 < best.1 { other } else { best })
}

/// Of the four poses that an essential matrix allows, the one with most of the target ahead of both
/// cameras.
fn decomposed(seen: &[[Vector3<f64>; 2]], ahead_s: f64, misfit_rad: f64) -> Option<RelativePose> {
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
        let second_from_first = u * quarter * v_t;
        [along, -along].map(|shift| (second_from_first, shift))
    });
    let pairs = poses.filter_map(|pose| RelativePose::of(pose, seen, ahead_s, misfit_rad));
    pairs.max_by_key(|(ahead, _)| *ahead).map(|(_, pair)| pair)
}

/// The poses of a flight in a plane, if a plane explains it about as well.
fn in_plane(seen: &[[Vector3<f64>; 2]], ahead_s: f64, misfit_rad: f64) -> Vec<RelativePose> {
    let Some((matrix, in_plane_rad)) = plane::homography(seen) else { return Vec::new() };
    // A plane has fewer free numbers: it must not fit much worse than the essential matrix.
    if in_plane_rad > PLANE_TIMES * misfit_rad {
        return Vec::new();
    }
    let pairs = plane::poses(&matrix, seen).into_iter().filter_map(|(turn, shift)| {
        RelativePose::of((turn, shift.try_normalize(1e-9)?), seen, ahead_s, in_plane_rad)
    });
    pairs.map(|(_, pair)| pair).collect()
}

impl RelativePose {
    /// The median angle by which the two cameras' sight lines pass each other, rad; `None` where
    /// too few are simultaneous.
    pub(super) fn aside(&self, first: &Sights, second: &Sights) -> Option<f64> {
        let seen = common(first, second, self.ahead_s);
        let second_from_first = self.first_from_second.inverse();
        let shift = second_from_first * -self.centre.coords;
        let matrix = shift.cross_matrix() * second_from_first.into_inner();
        (seen.len() >= LEAST_MET).then(|| misfit(&matrix, &seen))
    }

    /// The pair for a rotation and a unit shift from the first camera to the second, with the
    /// number of places that lie ahead of both; `None` if less than half do.
    fn of(
        (second_from_first, shift): (Matrix3<f64>, Vector3<f64>),
        seen: &[[Vector3<f64>; 2]],
        ahead_s: f64,
        misfit_rad: f64,
    ) -> Option<(usize, Self)> {
        // b ~ R a + t has its zero, the second's centre, at a = -R' t.
        let centre = Point3::from(-second_from_first.tr_mul(&shift) * BASE_M);
        let rotation = Rotation3::from_matrix_unchecked(second_from_first.transpose());
        let mut pair = Self { ahead_s, first_from_second: rotation, centre, doubt: 0.0 };
        let parallaxes: Vec<f64> = seen.iter().filter_map(|seen| pair.parallax(seen)).collect();
        let ahead = parallaxes.len();
        // sd(r) / r of two lines is their misfit over the angle at which they meet.
        pair.doubt = misfit_rad / median(parallaxes.into_iter()) / (ahead as f64).sqrt();
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
