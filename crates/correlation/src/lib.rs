//! Similarity of a reference image with a gate (search window) of the current image: the measures
//! of Herasymenko 2021 and Lytvynets 2020 (chapter 3), computed by planned real FFTs or sample by
//! sample; and the place of their peak between the samples, with its covariance.
//!
//! ```
//! use crossfix_correlation::{Correlator, Extent, Plane, Reference, Similarity, Window};
//!
//! // A bright spot at (13, 9) of a gate; the reference has it in its middle, (2, 2).
//! let spot = |width, height, x: f32, y: f32| Plane::from_fn(width, height, |column, row| {
//!     let (dx, dy) = (column as f32 - x, row as f32 - y);
//!     100.0 * (-(dx * dx + dy * dy) / 2.0).exp()
//! });
//! let reference = Reference::new(spot(5, 5, 2.0, 2.0), Window::uniform(5, 5));
//! let mut scores = Plane::default();
//! Correlator::default().similarity(
//!     &spot(24, 20, 13.0, 9.0), &reference, Similarity::default(), Extent::Linear, 1.0, &mut scores,
//! );
//! let peak = scores.peak().refined(&scores);
//! assert!((peak.x - 11.0).abs() < 0.05 && (peak.y - 7.0).abs() < 0.05, "{peak:?}");
//! ```

mod correlator;
mod direct;
mod fft;
mod fit;
mod interpolation;
mod lowpass;
mod measure;
mod moments;
mod peak;
mod plane;
mod reference;

pub use correlator::{Correlator, Route, Statistics};
pub use fit::{Fit, FitOptions, Fitter, Freedom};
pub use interpolation::{Resampler, View};
pub use lowpass::{LowPass, LowPassMemory};
pub use measure::{Extent, Similarity, SpectralWeight};
pub use peak::{Peak, SubPixelPeak};
pub use plane::Plane;
pub use reference::{Reference, Window};
