//! Small linear filters and gates for tracking a point, independent of what the point is.
//!
//! [`AxisFilter`] tracks along one axis of an image (Herasymenko 2021 and Lytvynets 2020);
//! [`KinematicState`] holds position and velocity in space; [`Imm`] is a bank of these that differ
//! in how hard the target accelerates; [`SmoothedResidual`] and [`NormalisedInnovation`] detect
//! that a single filter is left behind by a manoeuvre (Kalinov 2019); [`Gate`] decides whether a
//! measurement can belong to a track; [`normal_score`] says how surprising a measurement is when a
//! mixture of normal distributions was expected.
//!
//! A target that moves by 2 px from image to image, measured to half a pixel:
//!
//! ```
//! use crossfix_filter::{AxisFilter, AxisMeasurement};
//!
//! let measured = |position: f64| AxisMeasurement { position, variance: 0.25 };
//! // Thirty images per second, and an acceleration of some 20 px/s^2.
//! let interval = 1.0 / 30.0;
//! let mut filter = AxisFilter::start(measured(10.3), measured(11.8), interval, 20.0);
//! for (image, position) in [14.2, 15.7, 18.4, 19.9, 22.1].into_iter().enumerate() {
//!     filter.time_update(interval);
//!     let innovation = filter.measurement_update(measured(position));
//!     assert!(innovation.normalised_squared() < 4.0, "image {image} fits");
//! }
//! assert!((filter.position() - 22.0).abs() < 0.4);
//! assert!((filter.velocity() - 60.0).abs() < 5.0, "pixels per second");
//! ```

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
pub use kinematic::{KinematicState, process_noise};
pub use manoeuvre::{NormalisedInnovation, SmoothedResidual};
pub use mixture::normal_score;
pub use models::{MAX_MODELS, ModeRates, ModelWeights, MotionModel, MotionModels};
