//! The fusion centre: time-stamped bearings of three or more unsynchronised
//! cameras in, 3D tracks with velocity and covariance out.
//!
//! [`Fusion`] is a pure state machine. It takes [`BearingFrame`]s in any order
//! of arrival, puts them into the order of their capture times, and returns
//! what follows from each; the same frames give the same output, bit for bit.
//!
//! Inside: bearings that belong to known tracks update them one exposure at a
//! time ([`FusedTrack`], interacting models of iterated extended Kalman filters);
//! the others are gathered into observation periods, in which sets of them
//! start hypotheses that are followed until one explanation of the bearings is
//! by far the best. The papers' method can be chosen instead ([`papers`]).
//!
//! Three cameras look at a place over which a target flies; from two seconds of their bearings, no
//! two of them taken at the same time, comes a track:
//!
//! ```
//! use crossfix_fusion::{Fusion, FusionConfig};
//! use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pose};
//! use crossfix_message::{BearingFrame, BearingTrack, CameraCalibration, ImageTrackState, Timestamp};
//! use nalgebra::{Point3, Vector3};
//!
//! let size = ImageSize { width: 1920, height: 1080 };
//! let lens = Intrinsics { size, fx: 1400.0, fy: 1400.0, cx: 959.5, cy: 539.5, distortion: Distortion::None };
//! let mut cameras = Vec::new();
//! let mut fusion = Fusion::new(FusionConfig::default())?;
//! for (name, place) in [("west", [-150.0, 0.0, 2.0]), ("south", [0.0, -140.0, 5.0]), ("east", [160.0, 20.0, 3.0])] {
//!     let camera = Camera::new(lens, Pose::looking_at(place.into(), [0.0, 0.0, 40.0].into())?)?;
//!     fusion.calibrate(&CameraCalibration::new(&name.parse()?, &camera, Timestamp::EPOCH))?;
//!     cameras.push((name, camera));
//! }
//! for k in 0..120 {
//!     let (name, camera) = &cameras[k % 3];
//!     let seconds = k as f64 / 60.0;
//!     let target = Point3::new(-10.0 + 8.0 * seconds, 5.0, 40.0);
//!     let direction: Vector3<f64> = camera.pose().camera_from_world(target).normalize();
//!     let (bearing, variance) = (Some(direction.into()), 0.0005_f64.powi(2));
//!     let state = ImageTrackState::Tracking.into();
//!     let seen = BearingTrack { bearing, covariance_xx: variance, covariance_yy: variance, state, ..Default::default() };
//!     let capture_time_ns = Timestamp::EPOCH.plus_seconds(1.0 + seconds).nanos();
//!     fusion.ingest(&BearingFrame {
//!         camera: (*name).into(), sequence: k as u64, capture_time_ns, tracks: vec![seen], ..Default::default()
//!     });
//! }
//! fusion.flush();
//! let track = fusion.tracks().find(|track| track.is_confirmed()).ok_or("no track")?;
//! assert!((track.state().position() - Point3::new(-10.0 + 8.0 * 119.0 / 60.0, 5.0, 40.0)).norm() < 0.05);
//! assert!((track.state().velocity() - Vector3::new(8.0, 0.0, 0.0)).norm() < 0.2);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! [`BearingFrame`]: crossfix_message::BearingFrame

mod assignment;
mod cameras;
mod clocks;
mod comparison;
mod config;
mod counters;
mod cueing;
mod event_time;
mod evidence;
mod fusion;
mod ingress;
mod initiation;
mod messages;
mod motion;
mod neighbours;
pub mod papers;
mod prediction;
mod range_chart;
mod ranges;
mod reacquisition;
mod site_time;
pub mod spatial;
mod track;
mod tracker;
mod uncertainty;
mod unmet;
mod update;
mod visibility;

pub use cameras::{PoseFinding, Standing};
pub use clocks::ClockEstimate;
pub use config::{
    Bearings, Clocks, EventTime, FlightModel, FusionConfig, FusionConfigError, Initiation,
    InitiationMethod, Manoeuvres, SpatialSolver, Tracking, Weighting,
};
pub use counters::Counters;
pub use fusion::{CameraReport, Fusion, Output};
pub use ingress::{Exposure, Rejection, RejectionReason, Sighting};
pub use neighbours::{Neighbours, Share};
pub use track::{FusedTrack, MeasurementResidual, TrackId, TrackStatus};
pub use uncertainty::pose_covariance_of_careful_survey;
pub use unmet::{UnmetLines, WhyNothing};
