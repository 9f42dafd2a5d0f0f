//! What is known of a site beside what its cameras saw of a target: where cameras stand, how far
//! apart, and landmarks in their pictures.

use crossfix_geometry::Pixel;
use crossfix_message::CameraName;
use nalgebra::{Point3, Unit, Vector3};

/// What is known of a site beside what its cameras saw of a target.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    /// Places of cameras.
    pub places: Vec<SurveyedPlace>,
    /// Distances between cameras.
    pub distances: Vec<TapedDistance>,
    /// Things of known places that were clicked in pictures.
    pub landmarks: Vec<SurveyedLandmark>,
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
    /// m.
    pub metres: f64,
    /// Standard deviation, m.
    pub sd_m: f64,
}

/// Where a landmark is.
#[derive(Clone, Copy, Debug)]
pub enum LandmarkPlace {
    /// At a place.
    Place {
        /// Local ENU, m.
        position: Point3<f64>,
        /// Standard deviation per axis, m.
        sd_m: Vector3<f64>,
    },
    /// So far away that only its direction counts: the sun, a star.
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
    /// What it is called.
    pub name: String,
    /// Where it is.
    pub at: LandmarkPlace,
    /// Where it is in the pictures, of each camera once.
    pub clicks: Vec<Click>,
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

/// So many places say which way is up, and how large a site is whatever sees them.
pub(crate) const ENOUGH_PLACES: usize = 3;

impl Survey {
    /// Whether it tells how large the site is.
    pub fn tells_size(&self) -> bool {
        self.places.len() > 1
            || !self.distances.is_empty()
            || self.placed_landmarks().count() >= ENOUGH_PLACES
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
