//! Calibration of cameras: poses, clocks and lenses with their covariance, from the flight of one
//! target ([`calibrate_flight`]) or from landmarks in a picture ([`calibrate_landmarks`]); the file
//! of a site that holds them ([`SiteCalibration`]); and intrinsics as OpenCV, ROS and Kalibr write
//! them ([`intrinsics_from_yaml`]).
//!
//! A camera that nobody has surveyed labels a minute of a flight whose log there is:
//!
//! ```
//! use crossfix_calibration::{
//!     CameraLabels, FlightLog, Label, LensFreedom, LogErrors, LogSample, Survey, calibrate_flight,
//! };
//! use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pixel, Pose};
//! use nalgebra::Point3;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // The flight, and the camera as it stands; its clock is 0.7 s ahead of the log's.
//! let flight = |t: f64| {
//!     Point3::new(30.0 * (0.4 * t).sin(), 25.0 * (0.6 * t).cos(), 32.0 + 12.0 * (0.5 * t).sin())
//! };
//! let size = ImageSize { width: 1920, height: 1080 };
//! let distortion = Distortion::None;
//! let intrinsics =
//!     Intrinsics { size, fx: 1100.0, fy: 1100.0, cx: 959.5, cy: 539.5, distortion };
//! let pose = Pose::looking_at([60.0, 10.0, 1.5].into(), [0.0, 0.0, 30.0].into())?;
//! let camera = Camera::new(intrinsics, pose)?;
//!
//! let times = || (0..600).map(|k| f64::from(k) / 10.0);
//! let samples = times().map(|time_s| LogSample { time_s, position: flight(time_s) }).collect();
//! let errors = LogErrors { sd_m: 0.02, drift_sd_m: 0.02, drift_time_s: 200.0 };
//! // Labels to a tenth of a pixel.
//! let tenth = |pixel: f64| (10.0 * pixel).round() / 10.0;
//! let label = |t: f64| {
//!     let seen = camera.project(flight(t))?;
//!     Some(Label { time_s: t + 0.7, pixel: Pixel::new(tenth(seen.x()), tenth(seen.y())) })
//! };
//! let labels = times().filter_map(label).collect();
//! let north =
//!     CameraLabels { name: "north".parse()?, intrinsics, freedom: LensFreedom::Keep, labels };
//!
//! let log = FlightLog { samples, errors };
//! let result = calibrate_flight(&[north], Some(&log), &Survey::default())?;
//! let found = &result.cameras[0];
//! let off = found.camera.pose().position() - camera.pose().position();
//! assert!(off.norm() < 0.1, "{off}");
//! assert!((found.clock.knots[0].ahead_s + 0.7).abs() < 0.01);
//! # Ok(()) }
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

pub use calibrated_camera::{
    BearingError, CalibratedCamera, ClockCorrection, ClockOffset, OverImage,
};
pub use comparison::{CameraComparison, ShownPixel, SiteComparison, SiteMove, compare_sites};
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
