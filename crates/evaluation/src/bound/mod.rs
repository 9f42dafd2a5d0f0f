//! How well a site's cameras can determine a target's position and velocity: the Cramer-Rao bound
//! of their bearings, over a volume.

mod advice;
mod information;
mod plan;
mod summary;
mod volume;

pub use advice::{Advice, CandidatePlace, Score, advise};
pub use information::{
    BearingInformation, CameraInformation, CommonErrors, FisherInformation, LineGeometry,
    TimeOffsets,
};
pub use plan::{
    Accuracy, Assumptions, Cell, DEGENERATE_RATIO, PlannedCamera, TargetSize, predict,
    smallest_target,
};
pub use summary::{Contribution, Summary, contributions, layers};
pub use volume::{Volume, VolumeError};
