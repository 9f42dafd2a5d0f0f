//! What is known of a site apart from its cameras' labels of a target: where cameras stand, how far
//! apart they are, and landmarks in their pictures.

use crossfix_geometry::Pixel;
use crossfix_message::{CameraName, Datum};
use nalgebra::{Point3, Unit, Vector3};

use crate::calibrated_camera::CalibratedCamera;
use crate::site_file::SiteCalibration;

/// What is known of a site apart from its cameras' labels of a target.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    /// Places of cameras.
    pub places: Vec<SurveyedPlace>,
    /// Distances between cameras.
    pub distances: Vec<TapedDistance>,
    /// Things at known places that were clicked in pictures.
    pub landmarks: Vec<SurveyedLandmark>,
    /// An earlier calibration of the site, set by [`Survey::with_known`].
    pub known: Option<SiteCalibration>,
}

/// Where a camera stands.
#[derive(Clone, Debug)]
pub struct SurveyedPlace {
    /// The camera.
    pub camera: CameraName,
    /// Local ENU, m.
    pub position: Point3<f64>,
    /// Standard deviation per axis, m.
    pub sd_m: Vector3<f64>,
}

/// How far two cameras are apart.
#[derive(Clone, Debug)]
pub struct TapedDistance {
    /// The cameras.
    pub between: [CameraName; 2],
    /// Their distance, m.
    pub metres: f64,
    /// Standard deviation, m.
    pub sd_m: f64,
}

/// Where a landmark is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LandmarkPlace {
    /// A place.
    Place {
        /// Local ENU, m.
        position: Point3<f64>,
        /// Standard deviation per axis, m.
        sd_m: Vector3<f64>,
    },
    /// A direction only, as it is far away: the sun, a star.
    Direction {
        /// Local ENU.
        direction: Unit<Vector3<f64>>,
        /// Standard deviation across it, rad.
        sd_rad: f64,
    },
}

/// A landmark that was clicked in the pictures of some cameras.
#[derive(Clone, Debug)]
pub struct SurveyedLandmark {
    /// Its name.
    pub name: String,
    /// Where it is.
    pub at: LandmarkPlace,
    /// Its clicks in the pictures, one per camera.
    pub clicks: Vec<Click>,
}

impl SurveyedLandmark {
    /// Its click in a camera's picture.
    pub(crate) fn click_of(&self, camera: &CameraName) -> Option<&Click> {
        self.clicks.iter().find(|click| click.camera == *camera)
    }
}

/// Where something was clicked in a camera's picture.
#[derive(Clone, Debug)]
pub struct Click {
    /// The camera.
    pub camera: CameraName,
    /// Where.
    pub pixel: Pixel,
    /// Standard deviation per axis, pixels.
    pub sd_px: f64,
}

/// Landmarks in a picture that determine its camera's pose: three are seen alike from up to four
/// places, and two (half of it) from infinitely many.
pub(crate) const ENOUGH_FOR_POSE: usize = 4;
/// Places that determine which way is up, and how large a site is whatever sees them: about the
/// line through two of them a site may turn.
pub(crate) const ENOUGH_PLACES: usize = 3;

impl Survey {
    /// Adds an earlier calibration of the site as prior knowledge of poses and lenses, in the place
    /// of the survey of its cameras. The site as a whole stays where that calibration has it, so no
    /// log and no landmark may contradict it.
    #[must_use]
    pub fn with_known(mut self, site: SiteCalibration) -> Self {
        self.places.retain(|place| site.camera(&place.camera).is_none());
        self.places.extend(site.cameras().iter().map(|camera| SurveyedPlace {
            camera: camera.name.clone(),
            position: camera.camera.pose().position(),
            sd_m: camera.pose_covariance.fixed_view::<3, 3>(3, 3).diagonal().map(f64::sqrt),
        }));
        self.known = Some(site);
        self
    }

    /// A camera in the earlier calibration; its lens is the start of the new one.
    pub(crate) fn known(&self, camera: &CameraName) -> Option<&CalibratedCamera> {
        self.known.as_ref()?.camera(camera)
    }

    /// The datum of the earlier calibration: what a site that it places may be off by as a whole.
    pub(crate) fn known_datum(&self) -> Option<&Datum> {
        self.known.as_ref()?.datum()
    }

    /// Whether it determines the size of the site of these cameras.
    pub fn determines_size(&self, cameras: &[&CameraName]) -> bool {
        let stands = |place: &&SurveyedPlace| cameras.contains(&&place.camera);
        let mut taped = self.distances.iter().map(|distance| &distance.between);
        self.places.iter().filter(stands).count() > 1
            || taped.any(|between| between.iter().all(|camera| cameras.contains(&camera)))
            || self.placing_landmarks(cameras) >= ENOUGH_PLACES
    }

    /// Number of landmarks that tell these cameras where they are: those that two of them see, and
    /// those of a camera that sees enough for its pose.
    pub(crate) fn placing_landmarks(&self, cameras: &[&CameraName]) -> usize {
        self.placed_landmarks()
            .filter(|(landmark, _)| self.places_cameras(landmark, cameras))
            .count()
    }

    fn places_cameras(&self, landmark: &SurveyedLandmark, cameras: &[&CameraName]) -> bool {
        let by: Vec<&CameraName> = landmark
            .clicks
            .iter()
            .map(|click| &click.camera)
            .filter(|camera| cameras.contains(camera))
            .collect();
        by.len() > 1 || by.iter().any(|camera| self.landmarks_seen_by(camera) >= ENOUGH_FOR_POSE)
    }

    fn landmarks_seen_by(&self, camera: &CameraName) -> usize {
        self.placed_landmarks().filter(|(landmark, _)| landmark.click_of(camera).is_some()).count()
    }

    /// Landmarks with a place, and not only a direction.
    pub(crate) fn placed_landmarks(
        &self,
    ) -> impl Iterator<Item = (&SurveyedLandmark, Point3<f64>)> {
        self.landmarks.iter().filter_map(|landmark| match landmark.at {
            LandmarkPlace::Place { position, .. } => Some((landmark, position)),
            LandmarkPlace::Direction { .. } => None,
        })
    }

    /// The place of a camera.
    pub fn place(&self, camera: &CameraName) -> Option<&SurveyedPlace> {
        self.places.iter().find(|place| place.camera == *camera)
    }
}
