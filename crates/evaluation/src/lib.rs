//! Comparison of tracks with the truth: root mean squared errors, NEES, OSPA and GOSPA,
//! completeness, false tracks, changes of identity, latency. And, before anything flies: how well a
//! site's cameras can do at best ([`bound`]).
//!
//! ```
//! use crossfix_evaluation::{Estimate, Evaluator, TrueTarget};
//! use crossfix_message::{Timestamp, TrackState};
//! use nalgebra::{Matrix6, Point3, Vector3, Vector6};
//! use crossfix_filter::KinematicState;
//!
//! let mut evaluator = Evaluator::new(5.0);
//! let truth = [TrueTarget { id: 1, position: Point3::new(0.0, 0.0, 50.0), velocity: Vector3::zeros() }];
//! let state = KinematicState { mean: Vector6::new(0.3, 0.0, 50.4, 0.0, 0.0, 0.0), covariance: Matrix6::identity() };
//! let said = Estimate { id: 7, status: TrackState::Confirmed, cameras: 3, state, time_sd_s: 0.0 };
//! evaluator.add(Timestamp::EPOCH, &truth, &[said]);
//! let report = evaluator.report();
//! assert!((report.position_rmse_m.unwrap() - 0.5).abs() < 1e-12);
//! assert_eq!(report.completeness, 1.0);
//! ```

mod ablation;
pub mod bound;
mod history;
mod latency;
mod metrics;
mod papers;
mod sightings;
mod stretches;

pub use ablation::{ClipAblation, ClipTrials, ablate_drawn};
pub use history::TrackHistory;
pub use latency::{Latency, LatencyRecorder};
pub use metrics::{Estimate, Evaluator, Nees, Report, TargetReport, TrueTarget};
pub use papers::{
    Limit, SampleStatistic, Table, TableRow, ValidationOptions, Verdict, validate_fusion,
    validate_tracker,
};
pub use sightings::Sightings;
pub use stretches::Delays;
