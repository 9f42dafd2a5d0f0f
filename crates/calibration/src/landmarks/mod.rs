//! A camera's pose from one picture of landmarks whose places are known, of the sun, or of stars.
//!
//! Pose and lens are adjusted to the clicks. A landmark's own error counts as an error of its
//! click, as seen from where the camera stands; the lens file, and a survey of the camera's place,
//! are measurements, too.

mod adjustment;
pub(crate) mod seen;
mod start;

use crossfix_geometry::{Camera, Intrinsics, Pixel, Pose};
use crossfix_message::CameraName;
use nalgebra::{Matrix2, Matrix3, Matrix6, Point3, Vector2};
use statrs::distribution::{ChiSquared, ContinuousCDF};
use thiserror::Error;

use crate::calibrated_camera::{CalibratedCamera, ClockCorrection, OverImage};
use crate::label_noise::LabelNoise;
use crate::lens::{LensFreedom, LensUncertainty};
use crate::survey::{ENOUGH_FOR_POSE, LandmarkPlace, SurveyedPlace};
use adjustment::AdjustedCamera;

/// A landmark of known place or direction in a picture.
#[derive(Clone, Debug)]
pub struct Landmark {
    /// Its name.
    pub name: String,
    /// Where it was clicked.
    pub pixel: Pixel,
    /// Standard deviation of the click per axis, pixels.
    pub click_sd_px: f64,
    /// Where it is.
    pub at: LandmarkPlace,
}

/// A picture's landmarks.
#[derive(Clone, Debug)]
pub struct LandmarkPicture {
    /// Whose picture it is.
    pub camera: CameraName,
    /// The lens as its file states it.
    pub intrinsics: Intrinsics,
    /// How far the lens may deviate from its file.
    pub freedom: LensFreedom,
    /// Where the camera stands, if that was surveyed.
    pub place: Option<SurveyedPlace>,
    /// The landmarks.
    pub landmarks: Vec<Landmark>,
    /// Covariance of the turn that all its directions have in common, about east, north and up,
    /// rad^2: due to the time at which the sun or stars were seen, for example.
    pub sky_turn: Matrix3<f64>,
}

/// Why landmarks tell no pose.
#[derive(Debug, Error)]
pub enum LandmarkError {
    /// There are too few for what is unknown.
    #[error(
        "camera `{camera}` has {given} landmarks: {needed} are needed{}",
        if *is_surveyed { "" } else { ", or two and where the camera stands (--positions)" }
    )]
    TooFew {
        /// The camera.
        camera: CameraName,
        /// How many there are.
        given: usize,
        /// How many it takes.
        needed: usize,
        /// Whether the camera's place is known.
        is_surveyed: bool,
    },
    /// A click that the lens has no direction for.
    #[error("camera `{camera}`: the lens has no direction where landmark `{landmark}` was clicked")]
    NoDirection {
        /// The camera.
        camera: CameraName,
        /// The landmark.
        landmark: String,
    },
    /// Poses that are far apart fit as well as each other.
    #[error(
        "camera `{camera}`: its landmarks are seen alike from {} and from {}: add one, or say \
         where the camera stands (--positions)",
        place(.places[0]),
        place(.places[1])
    )]
    Ambiguous {
        /// The camera.
        camera: CameraName,
        /// Two of the places.
        places: [Point3<f64>; 2],
    },
    /// No pose fits, or a part of the pose is not determined at all.
    #[error(
        "camera `{camera}`: its landmarks tell no pose (are they in one line, or names exchanged?)"
    )]
    NoSolution {
        /// The camera.
        camera: CameraName,
    },
}

fn place(at: Point3<f64>) -> String {
    format!("{:.1}, {:.1}, {:.1} m", at.x, at.y, at.z)
}

/// Result of a camera's landmarks.
#[derive(Clone, Debug)]
pub struct LandmarkResult {
    /// Whose it is.
    pub name: CameraName,
    /// Lens and pose.
    pub camera: Camera,
    /// Covariance of the pose with the lens fixed at its estimate: rotation about the camera's axes
    /// (rad), then position (m).
    pub pose_covariance: Matrix6<f64>,
    /// Remaining uncertainty of the lens.
    pub lens: LensUncertainty,
    /// Median range of the landmarks, m.
    pub range_m: f64,
    /// The focal length relative to the lens file's.
    pub focal_ratio: f64,
    /// How each landmark fits, in the order that they were given in.
    pub landmarks: Vec<LandmarkFit>,
    /// Where something is wrong, each landmark without which the rest fits.
    pub suspects: Vec<String>,
    /// Probability that clicks, places and lens err by as much as here or more, by the sum of their
    /// squares.
    pub chance: f64,
}

/// How a landmark fits.
#[derive(Clone, Debug)]
pub struct LandmarkFit {
    /// Its name.
    pub name: String,
    /// The click less where the landmark should be seen, pixels.
    pub residual_px: Vector2<f64>,
    /// Distance from where the others and the lens have it, in standard deviations; `None` where
    /// these do not determine that.
    pub deviations: Option<f64>,
}

/// A camera whose turn is more uncertain than this, rad, has no known pose. With half of it poses
/// known to 3 degrees, of landmarks near together, are refused.
const MOST_TURN_RAD: f64 = 0.1;
/// Fits with a smaller probability than this are wrong: one in ten thousand pictures is by chance.
/// With half of it nearly the same.
const LEAST_CHANCE: f64 = 1e-4;

impl LandmarkResult {
    /// Whether something of the picture must be wrong: a click, a place, the lens.
    pub fn is_wrong(&self) -> bool {
        self.chance < LEAST_CHANCE
    }

    /// Whether the pose is determined at all: where nothing determines a turn, or a place, only
    /// rounding errors do.
    fn is_told(&self) -> bool {
        let part = |from: usize| self.pose_covariance.fixed_view::<3, 3>(from, from).trace().sqrt();
        part(0) < MOST_TURN_RAD && part(3) < self.range_m
    }

    /// The landmark farthest, in deviations, from where the others have it.
    pub fn worst(&self) -> Option<&LandmarkFit> {
        self.landmarks
            .iter()
            .filter(|landmark| landmark.deviations.is_some())
            .max_by(|a, b| a.deviations.unwrap_or(0.0).total_cmp(&b.deviations.unwrap_or(0.0)))
    }

    /// As [`CalibratedCamera::pointing_sd_rad`], in the image's middle.
    pub fn pointing_sd_rad(&self, range_m: f64) -> Option<f64> {
        let size = self.camera.model().intrinsics().size;
        let middle = Pixel::new(f64::from(size.width) / 2.0, f64::from(size.height) / 2.0);
        CalibratedCamera::from(self).pointing_sd_rad(middle, range_m)
    }

    /// As [`CalibratedCamera::over_image`], at the landmarks' range.
    pub fn over_image(&self) -> OverImage {
        CalibratedCamera::from(self).over_image()
    }
}

/// Least number of landmarks of a camera whose place is known: with one it may turn about the line
/// to it.
const LEAST_SURVEYED: usize = 2;

/// Finds a camera's pose and lens by its landmarks.
///
/// # Errors
/// [`LandmarkError`], where they do not tell the pose, or tell several.
pub fn calibrate_landmarks(picture: &LandmarkPicture) -> Result<LandmarkResult, LandmarkError> {
    let camera = &picture.camera;
    let with_places = |landmark: &&Landmark| matches!(landmark.at, LandmarkPlace::Place { .. });
    let is_surveyed = picture.place.is_some();
    let (given, needed) = if is_surveyed {
        (picture.landmarks.len(), LEAST_SURVEYED)
    } else {
        // Directions determine the rotation but not the place.
        (picture.landmarks.iter().filter(with_places).count(), ENOUGH_FOR_POSE)
    };
    if given < needed {
        return Err(LandmarkError::TooFew { camera: camera.clone(), given, needed, is_surveyed });
    }
    let starts = start::starts(picture)?;
    let mut found: Vec<AdjustedCamera> =
        starts.into_iter().filter_map(|start| adjustment::adjust(picture, start)).collect();
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let none = || LandmarkError::NoSolution { camera: camera.clone() };
    let best = found.first().ok_or_else(none)?;
    if let Some(other) = found.iter().find(|other| best.is_rivalled_by(other)) {
        let places = [best.state.centre, other.state.centre];
        return Err(LandmarkError::Ambiguous { camera: camera.clone(), places });
    }
    let mut result = result(picture, best).ok_or_else(none)?;
    if !result.is_told() {
        return Err(none());
    }
    if result.is_wrong() {
        result.suspects = suspects(picture, best, &result, needed);
    }
    Ok(result)
}

/// The landmarks without which the rest fits.
fn suspects(
    picture: &LandmarkPicture,
    adjusted: &AdjustedCamera,
    result: &LandmarkResult,
    needed: usize,
) -> Vec<String> {
    if picture.landmarks.len() <= needed {
        return Vec::new();
    }
    let deviations = |index: &usize| result.landmarks[*index].deviations.unwrap_or(0.0);
    let mut likely: Vec<usize> = (0..picture.landmarks.len()).collect();
    likely.sort_by(|a, b| deviations(b).total_cmp(&deviations(a)));
    likely.truncate(MOST_SUSPECTS);
    // Named in the order that they were given in.
    likely.sort_unstable();
    let is_suspect = |index: &usize| fits_without(picture, adjusted, *index);
    let suspects = likely.into_iter().filter(is_suspect);
    suspects.map(|index| picture.landmarks[index].name.clone()).collect()
}

/// Whether a picture fits once a landmark is left out.
fn fits_without(picture: &LandmarkPicture, adjusted: &AdjustedCamera, index: usize) -> bool {
    let mut rest = picture.clone();
    rest.landmarks.remove(index);
    // Not only the state that the wrong landmark has bent is a start.
    let mut starts = start::starts(&rest).unwrap_or_default();
    starts.push(adjusted.state.clone());
    let adjusted = starts.into_iter().filter_map(|start| adjustment::adjust(&rest, start));
    let best = adjusted.min_by(|a, b| a.cost.total_cmp(&b.cost));
    best.and_then(|best| result(&rest, &best)).is_some_and(|result| !result.is_wrong())
}

/// Number of landmarks that are left out in turn, those with the largest deviations: each takes a
/// calibration. With half of it the wrong one may not be among them, as it bends the fit so that
/// others deviate, too.
const MOST_SUSPECTS: usize = 12;

fn result(picture: &LandmarkPicture, adjusted: &AdjustedCamera) -> Option<LandmarkResult> {
    let state = &adjusted.state;
    let pose = Pose::new(*state.rotation.matrix(), state.centre).ok()?;
    let (pose_covariance, lens) = adjusted.pose_and_lens()?;
    let fits: Option<Vec<LandmarkFit>> =
        picture.landmarks.iter().map(|landmark| fit(landmark, adjusted)).collect();
    let mut ranges: Vec<f64> = picture
        .landmarks
        .iter()
        .filter_map(|landmark| match landmark.at {
            LandmarkPlace::Place { position, .. } => Some((position - state.centre).norm()),
            LandmarkPlace::Direction { .. } => None,
        })
        .collect();
    ranges.sort_unstable_by(f64::total_cmp);
    // Two numbers per click; the lens's free parameters are balanced by as many from its file.
    let measured = 2 * picture.landmarks.len() + if picture.place.is_some() { 3 } else { 0 };
    // P(chi^2 > cost), with the pose's six unknowns taken off the number of measurements.
    let chance = ChiSquared::new((measured - 6) as f64).ok()?.sf(adjusted.cost);
    Some(LandmarkResult {
        name: picture.camera.clone(),
        camera: Camera::new(state.intrinsics, pose).ok()?,
        pose_covariance,
        lens,
        range_m: ranges.get(ranges.len() / 2).copied().unwrap_or(DISTANT_M),
        focal_ratio: state.intrinsics.fx / picture.intrinsics.fx,
        landmarks: fits?,
        suspects: Vec::new(),
        chance,
    })
}

/// Range that is assumed where only directions were seen, m. With half of it an error of the
/// camera's place counts twice in its pointing.
const DISTANT_M: f64 = 1000.0;

/// How a landmark fits, compared with what the others leave open: its own influence on the estimate
/// is taken out of the residual's covariance.
fn fit(landmark: &Landmark, adjusted: &AdjustedCamera) -> Option<LandmarkFit> {
    let seen = seen::see(&landmark.at, landmark.pixel, &adjusted.state)?;
    let noise = seen.noise(landmark.click_sd_px);
    let by = &seen.by;
    // Covariance of the residual after the fit: R - J P J'.
    let explained = by * &adjusted.covariance * by.transpose();
    let left: Matrix2<f64> = noise - explained.fixed_view::<2, 2>(0, 0);
    // That covariance is nearly zero where this landmark alone determines something.
    let is_told = left.symmetric_eigenvalues().min() > 1e-3 * noise.trace();
    let weight = left.try_inverse().filter(|_| is_told);
    let squared = weight.map(|weight| seen.residual.dot(&(weight * seen.residual)));
    Some(LandmarkFit {
        name: landmark.name.clone(),
        residual_px: -seen.residual,
        deviations: squared.map(|squared| squared.max(0.0).sqrt()),
    })
}

/// Label noise of trackers that is assumed where no flight has shown it: the middle of that of
/// hand-made labels of the cameras of data sets 1 and 3. With half of it bearings weigh four times
/// as much beside cameras whose noise is known.
const USUAL_NOISE: LabelNoise = LabelNoise { white_px: 0.2, lasting_px: 0.5, lasting_s: 1.0 };
/// Time between frames that is assumed where none is stated, s. With half of it a plan of the site
/// counts on 60 measurements a second.
const USUAL_FRAME_S: f64 = 1.0 / 30.0;

impl From<&LandmarkResult> for CalibratedCamera {
    /// A picture tells nothing of the clock: its times stay what they are.
    fn from(result: &LandmarkResult) -> Self {
        Self {
            name: result.name.clone(),
            camera: result.camera.clone(),
            pose_covariance: result.pose_covariance,
            lens: result.lens.clone(),
            range_m: result.range_m,
            clock: ClockCorrection::none(),
            noise: USUAL_NOISE,
            frame_s: USUAL_FRAME_S,
        }
    }
}
