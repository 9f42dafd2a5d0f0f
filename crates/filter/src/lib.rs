//! Small linear filters and gates: what tracks a point, whatever the point is.
//!
//! [`AxisFilter`] is one axis of an image (papers 000 and 001);
//! [`KinematicState`] is position and velocity in space; [`Gate`] decides
//! whether a measurement can belong to a track.

mod axis;
mod gate;
mod kinematic;

pub use axis::{AxisFilter, AxisMeasurement, Innovation};
pub use gate::Gate;
pub use kinematic::KinematicState;
