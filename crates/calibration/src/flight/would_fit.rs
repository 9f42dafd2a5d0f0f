//! What would make a camera fit that does not: the usual mistakes.

use std::fmt;

use crossfix_geometry::Intrinsics;
use crossfix_message::CameraName;
use nalgebra::Matrix3;

use super::course::Course;
use super::linear::AffineMap;
use super::model::CameraLabels;
use super::model::frame_time;
use super::start;

/// A correction must fit this many times better than what was given. With half of it one may be
/// named only because its greater freedom fits the noise.
const CLEARLY_BETTER: f64 = 3.0;
/// Largest median misfit of a correction, rad: lens files leave up to 4 mrad. With half of it none
/// is named for such cameras.
const FITS_RAD: f64 = 8e-3;
/// Another camera's lens fits about as well as any focal length if its misfit is at most this many
/// times as large. With half of it exchanged lenses of one kind are reported as a wrong focal
/// length.
const LITTLE_WORSE: f64 = 1.5;
/// A stretch by less than this share is not reported: lenses change by 2 %, and short flights tell
/// no better. With half of it chance would be named as the cause.
const LEAST_STRETCH: f64 = 0.05;
/// Tolerance of two axes' equality, and of right angles, as a share. With half of it noise hides
/// what is stretched, and nothing is named.
const EQUAL: f64 = 0.05;

/// A correction that would make a camera fit.
#[derive(Clone, Debug, PartialEq)]
pub enum WouldFit {
    /// The mirror image of the trajectory: east and north are exchanged, or the height's sign is
    /// wrong; what cameras see does not tell which.
    MirrorImage,
    /// One axis of the log has a wrong scale against the other two.
    Stretched {
        /// Which.
        axis: Axis,
        /// How many times as long as it should be.
        times: f64,
    },
    /// A focal length other than that of the lens's file.
    Focal {
        /// How many times that of the file.
        times: f64,
    },
    /// Another camera's lens.
    LensOf {
        /// Whose.
        camera: CameraName,
    },
}

/// An axis of the site.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axis {
    /// East.
    East,
    /// North.
    North,
    /// Up.
    Up,
}

impl fmt::Display for WouldFit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MirrorImage => f.write_str(
                "its mirror image fits, so east and north are exchanged in the log, or its height \
                 counts downwards",
            ),
            Self::Stretched { axis: Axis::Up, times } => write!(
                f,
                "it fits if heights in the log are {times:.2} times what they should be against \
                 east and north: feet for metres, or places of a map whose metre is another"
            ),
            Self::Stretched { axis, times } => write!(
                f,
                "it fits if {} in the log is {times:.2} times what it should be: degrees of \
                 longitude are shorter than those of latitude",
                if *axis == Axis::East { "east" } else { "north" }
            ),
            Self::Focal { times } => write!(
                f,
                "it fits with {times:.2} times the focal length of its lens file: a file for \
                 another resolution, or a zoom"
            ),
            Self::LensOf { camera } => {
                write!(f, "it fits with the lens of camera `{camera}`: are their names exchanged?")
            }
        }
    }
}

/// What makes a camera fit that has this misfit to the course, rad.
pub(super) fn find(
    camera: &CameraLabels,
    course: &Course,
    others: &[CameraLabels],
    misfit: f64,
) -> Option<WouldFit> {
    let better = |found: f64| found * CLEARLY_BETTER < misfit && found < FITS_RAD;
    let mirrored = start::find(camera, &course.mirrored(), frame_time(camera));
    if mirrored.is_some_and(|(_, found)| better(found)) {
        return Some(WouldFit::MirrorImage);
    }
    // Where any linear map fits, the labels are of the right target.
    let map = start::mapped(camera, course).filter(|(_, found)| better(*found)).map(|(map, _)| map);
    let stretched = map.as_ref().and_then(stretched);
    if stretched.is_some() {
        return stretched;
    }
    let with_lens =
        |other: &CameraLabels| Some((with_lens_of(camera, course, other)?, other.name.clone()));
    let lent = others.iter().filter(|other| is_another(other, camera)).filter_map(with_lens);
    let lent = lent.min_by(|a, b| a.0.total_cmp(&b.0));
    // Another camera's lens may be close to the zoomed focal length.
    let zoomed =
        map.as_ref().and_then(zoomed).map(|times| (times, with_focal(camera, course, times)));
    let of_zoom = zoomed.map_or(f64::INFINITY, |(_, misfit)| misfit);
    match lent.filter(|(misfit, _)| better(*misfit) && *misfit < LITTLE_WORSE * of_zoom) {
        Some((_, camera)) => Some(WouldFit::LensOf { camera }),
        None => zoomed.map(|(times, _)| WouldFit::Focal { times }),
    }
}

/// Whether another camera has a different lens.
fn is_another(other: &CameraLabels, camera: &CameraLabels) -> bool {
    other.name != camera.name && other.intrinsics != camera.intrinsics
}

/// A camera's misfit to the course with another camera's lens, rad; `None` where its labels lie
/// outside that camera's image.
fn with_lens_of(camera: &CameraLabels, course: &Course, other: &CameraLabels) -> Option<f64> {
    let is_seen = camera.labels.iter().all(|label| {
        let size = other.intrinsics.size;
        label.pixel.x() <= f64::from(size.width) && label.pixel.y() <= f64::from(size.height)
    });
    let lent = CameraLabels { intrinsics: other.intrinsics, ..camera.clone() };
    let found = is_seen.then(|| start::find(&lent, course, frame_time(camera))).flatten();
    found.map(|(_, misfit)| misfit)
}

/// A camera's misfit to the course with another focal length, rad.
fn with_focal(camera: &CameraLabels, course: &Course, times: f64) -> f64 {
    let own = camera.intrinsics;
    let intrinsics = Intrinsics { fx: own.fx * times, fy: own.fy * times, ..own };
    let zoomed = CameraLabels { intrinsics, ..camera.clone() };
    start::find(&zoomed, course, frame_time(camera)).map_or(f64::INFINITY, |found| found.1)
}

/// The log's odd axis: a place X is seen along M X, so the log's axes are right where M' M is the
/// identity (up to scale).
fn stretched(map: &AffineMap) -> Option<WouldFit> {
    // M = s R D^-1 for axes that are stretched by D, so that M' M = s^2 D^-2.
    let inverse = square(&(map.matrix.transpose() * map.matrix))?;
    let lengths = inverse.map(|square| square.sqrt().recip());
    let [axis, one, other] = odd_one(lengths)?;
    // Against the geometric mean of the other two: the scale of M is arbitrary.
    let times = lengths[axis] / (lengths[one] * lengths[other]).sqrt();
    let axis = [Axis::East, Axis::North, Axis::Up][axis];
    ((times - 1.0).abs() > LEAST_STRETCH).then_some(WouldFit::Stretched { axis, times })
}

/// The focal length relative to the file's: the image is M X, and M M' is the identity (up to
/// scale) where it is right.
fn zoomed(map: &AffineMap) -> Option<f64> {
    let [x, y, ahead] = square(&(map.matrix * map.matrix.transpose()))?;
    // M = s diag(f, f, 1) R gives M M' = s^2 diag(f^2, f^2, 1).
    let times = ((x * y).sqrt() / ahead).sqrt();
    // Both image axes must be stretched alike: otherwise it is no focal length.
    let is_round = (x / y).ln().abs() < 2.0 * EQUAL;
    (is_round && (times - 1.0).abs() > LEAST_STRETCH).then_some(times)
}

/// The diagonal of a matrix that is nearly diagonal.
fn square(matrix: &Matrix3<f64>) -> Option<[f64; 3]> {
    let diagonal = matrix.diagonal();
    let most = |[i, j]: [usize; 2]| 2.0 * EQUAL * (diagonal[i] * diagonal[j]).sqrt();
    let mut others = [[0, 1], [0, 2], [1, 2]].into_iter();
    others.all(|at| matrix[(at[0], at[1])].abs() < most(at)).then_some(diagonal.into())
}

/// The one of three that differs from the other two, which must be equal; its index comes first.
fn odd_one(lengths: [f64; 3]) -> Option<[usize; 3]> {
    // The pair that is most nearly equal leaves the odd one out.
    let apart = |[_, one, other]: [usize; 3]| (lengths[one] / lengths[other]).ln().abs();
    let orders = [[0, 1, 2], [1, 0, 2], [2, 0, 1]];
    let best = orders.into_iter().min_by(|a, b| apart(*a).total_cmp(&apart(*b)))?;
    (apart(best) < 2.0 * EQUAL).then_some(best)
}
