//! Small linear filters and gates: what tracks a point, whatever the point is.
//!
//! [`AxisFilter`] is one axis of an image (papers 000 and 001);
//! [`KinematicState`] is position and velocity in space, [`Imm`] a bank of them
//! that differ in how hard the target accelerates; [`SmoothedResidual`] and
//! [`NormalisedInnovation`] tell when one filter is left behind (paper 004);
//! [`Gate`] decides whether a measurement can belong to a track, [`normal_score`] says how
//! much one surprises where several were expected.

mod axis;
mod gate;
mod imm;
mod kinematic;
mod manoeuvre;
mod mixture;
mod models;

pub use axis::{AxisFilter, AxisMeasurement, Innovation};
pub use gate::Gate;
pub use imm::Imm;
pub use kinematic::KinematicState;
pub use manoeuvre::{NormalisedInnovation, SmoothedResidual};
pub use mixture::normal_score;
pub use models::{MAX_MODELS, ModeRates, ModelWeights, MotionModel, MotionModels};
