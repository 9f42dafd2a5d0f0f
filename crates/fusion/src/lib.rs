//! The fusion centre: time-stamped bearings of three and more unsynchronised
//! cameras in, 3D tracks with velocity and covariance out.
//!
//! [`Fusion`] is a pure state machine. It takes [`BearingFrame`]s in any order
//! of arrival, puts them into the order of their capture times, and returns
//! what follows from each; the same frames give the same output, bit for bit.
//!
//! Inside: bearings that belong to known tracks update them one exposure at a
//! time ([`Track`], interacting models of iterated extended Kalman filters);
//! the others are gathered into observation periods, in which sets of them
//! begin hypotheses that are followed until one reading of the bearings is by
//! far the best. The papers' way is there too: periods solved for fixes
//! ([`spatial`]), and fixes grouped into tracks ([`temporal`]).
//!
//! ```
//! use crossfix_fusion::{Fusion, FusionConfig};
//! use crossfix_message::BearingFrame;
//!
//! let mut fusion = Fusion::new(FusionConfig::default())?;
//! // A frame of a camera whose calibration nobody gave is counted, not used.
//! let frame = BearingFrame { camera: "north".into(), ..Default::default() };
//! let outputs = fusion.ingest(&frame);
//! assert_eq!(outputs.len(), 1);
//! assert_eq!(fusion.counters().get("rejected_unknown_camera"), 1);
//! # Ok::<(), crossfix_fusion::ConfigError>(())
//! ```
//!
//! [`BearingFrame`]: crossfix_message::BearingFrame

mod assignment;
mod calibrations;
mod clocks;
mod config;
mod counters;
mod event_time;
mod fusion;
mod ingress;
mod initiation;
mod motion;
mod noise;
mod pose_scale;
mod prediction;
mod range_chart;
mod ranges;
mod reacquisition;
mod rooted;
pub mod spatial;
mod standing;
pub mod temporal;
mod track;
mod tracker;
mod uncertainty;
mod unmet;
mod update;
mod watch;

pub use clocks::ClockEstimate;
pub use config::{
    Bearings, Clocks, ConfigError, EventTime, FlightModel, FusionConfig, Initiation, InitiationMethod,
    Manoeuvres, SpatialSolver, Tracking, Weighting,
};
pub use counters::Counters;
pub use fusion::{CameraReport, Fusion, Output};
pub use ingress::{Exposure, Rejection, RejectionReason, Sighting};
pub use standing::CameraStanding;
pub use track::{MeasurementResidual, Track, TrackId, TrackStatus};
pub use unmet::{UnmetLines, WhyNothing};
