//! Similarity of a reference image with a gate of the current image: the
//! normalised cross-correlation of 000 and 001 (chapter 3) by planned real
//! FFTs, and its sub-pixel peak.
//!
//! ```
//! use crossfix_correlation::{Correlator, Plane, Reference, Window};
//!
//! // A bright spot at (13, 9) of a gate; the reference has it in its middle, (2, 2).
//! let spot = |width, height, x: f32, y: f32| Plane::from_fn(width, height, |column, row| {
//!     let (dx, dy) = (column as f32 - x, row as f32 - y);
//!     100.0 * (-(dx * dx + dy * dy) / 2.0).exp()
//! });
//! let reference = Reference::new(spot(5, 5, 2.0, 2.0), &Window::uniform(5, 5));
//! let scores = Correlator::default().scores(&spot(24, 20, 13.0, 9.0), &reference, 1.0);
//! let peak = scores.peak().refined(&scores);
//! assert!((peak.x - 11.0).abs() < 0.05 && (peak.y - 7.0).abs() < 0.05, "{peak:?}");
//! ```

mod correlator;
mod fft;
mod peak;
mod plane;

pub use correlator::{Correlator, Reference, Window};
pub use peak::{Peak, SubPixelPeak};
pub use plane::Plane;
