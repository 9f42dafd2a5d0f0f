//! Calibration of cameras: poses, clocks and lenses with their covariance, from the flight of one
//! target ([`calibrate_flight`]) or from landmarks in a picture ([`calibrate_landmarks`]); the file
//! of a site that holds them ([`SiteCalibration`]); and intrinsics as OpenCV, ROS and Kalibr write
//! them:
//!
//! ```
//! use crossfix_calibration::intrinsics_from_yaml;
//! use crossfix_geometry::Distortion;
//!
//! let intrinsics = intrinsics_from_yaml(
//!     "image_width: 640\n\
//!      image_height: 480\n\
//!      camera_matrix: {rows: 3, cols: 3, data: [700.0, 0.0, 319.5, 0.0, 701.0, 239.5, 0.0, 0.0, 1.0]}\n\
//!      distortion_model: plumb_bob\n\
//!      distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.0, 0.0, 0.0]}\n",
//! )?;
//! assert_eq!(intrinsics.fy, 701.0);
//! assert!(matches!(intrinsics.distortion, Distortion::BrownConrady(_)));
//! # Ok::<(), crossfix_calibration::IntrinsicsError>(())
//! ```

mod calibrated_camera;
mod comparison;
mod flight;
mod intrinsics;
mod label_noise;
mod landmarks;
mod lens;
mod site_file;
mod survey;

pub use calibrated_camera::{BearingError, CalibratedCamera, ClockCorrection, OverImage};
pub use comparison::{CameraComparison, SiteComparison, SiteMove, compare_sites};
pub use flight::{
    Axis, CameraLabels, CameraResult, ClockKnot, ClockResult, FittedLabel, FittedSample,
    FlightError, FlightLog, FlightResult, Label, LandmarkMisfit, LogErrors, LogFit, LogSample,
    MovedAt, Refusal, WouldFit, calibrate_flight,
};
pub use intrinsics::{
    IntrinsicsError, intrinsics_from_camchain, intrinsics_from_yaml, intrinsics_to_yaml,
};
pub use label_noise::LabelNoise;
pub use landmarks::{
    Landmark, LandmarkError, LandmarkFit, LandmarkPicture, LandmarkResult, calibrate_landmarks,
};
pub use lens::{LensFreedom, LensUncertainty};
pub use site_file::{SiteCalibration, SiteFileError};
pub use survey::{Click, LandmarkPlace, Survey, SurveyedLandmark, SurveyedPlace, TapedDistance};
