//! The agent's eye: finds small targets in one image stream and follows them
//! by correlation, with a Kalman filter on each image axis (Herasymenko 2021, Lytvynets 2020).
//!
//! [`ImageTracker`] is a pure state machine: images with their times go in,
//! the tracks of each image come out.
//!
//! ```
//! use crossfix_correlation::Plane;
//! use crossfix_message::Timestamp;
//! use crossfix_vision::{ImageTracker, PixelBox, TrackerConfig};
//!
//! // A bright blob that moves 2 px a frame to the right.
//! let image = |x: f32| Plane::from_fn(160, 120, |column, row| {
//!     let (dx, dy) = (column as f32 - x, row as f32 - 60.0);
//!     40.0 + 150.0 * (-(dx * dx + dy * dy) / 8.0).exp()
//! });
//! let mut tracker = ImageTracker::new(TrackerConfig::default())?;
//! tracker.take_up(PixelBox { x: 25.0, y: 56.0, width: 10.0, height: 8.0 });
//! for frame in 0..20 {
//!     let time = Timestamp::from_seconds(f64::from(frame) / 30.0);
//!     let tracks = tracker.step(&image(30.0 + 2.0 * frame as f32), time);
//!     let error = tracks[0].position.x - (30.0 + 2.0 * f64::from(frame));
//!     assert!(error.abs() < 0.6, "frame {frame}: {error}");
//! }
//! # Ok::<(), crossfix_vision::TrackerConfigError>(())
//! ```

mod appearance;
mod arrival;
mod background_energy;
mod centring;
mod coarse;
mod coarse_picture;
mod coarse_turn;
mod config;
mod crop;
mod detector;
mod empty_scene;
mod features;
mod figure;
mod finding;
mod fit;
mod followed;
mod followed_target;
mod frame;
mod gate;
mod hypotheses;
mod identity;
mod jerk;
mod lanes;
mod learning;
mod likelihood;
mod motion;
mod noise;
mod paper;
mod place_map;
mod posterior;
mod reference;
mod registration;
mod scene;
mod scene_turn;
mod scratch;
mod search;
mod search_area;
mod search_memory;
mod sighting;
mod snapshot;
mod state;
mod surroundings;
mod tracker;
mod tracker_part;
mod uneven_turn;

use std::fmt;

use crossfix_correlation::Plane;

pub use config::{
    Algorithm, DetectorConfig, GateRule, PaperConfig, TrackerConfig, TrackerConfigError,
};
pub use features::TargetFeatures;
pub use frame::Measurement;
pub use reference::{ImmConfig, PixelImm, ReferenceStrategy};
pub use tracker::{ImageTrack, ImageTracker, TrackPhase};
pub use tracker_part::TrackerPart;

/// Number of a 2D track, unique within its image stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ImageTrackId(pub u64);

impl fmt::Display for ImageTrackId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// A place in the image, pixels; (0, 0) is the middle of the top left pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImagePoint {
    /// Column.
    pub x: f64,
    /// Row.
    pub y: f64,
}

/// A rectangle of the image, pixels: the top left corner of its top left pixel, and its sides.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelBox {
    /// Left edge; 0 is the left edge of the first column.
    pub x: f64,
    /// Upper edge.
    pub y: f64,
    /// Columns.
    pub width: f64,
    /// Rows.
    pub height: f64,
}

/// Largest coordinate of a place, px: no place of an image is further from its corner. With half of
/// it the same.
const FARTHEST: f64 = 1e6;

impl ImagePoint {
    /// Whether the coordinates are those of a place that an image can have, or that lies not too
    /// far outside of it.
    pub fn is_possible(&self) -> bool {
        // A NaN is not possible.
        self.x.abs() <= FARTHEST && self.y.abs() <= FARTHEST
    }
}

impl PixelBox {
    /// Whether a place is in the box.
    pub(crate) fn holds(&self, place: ImagePoint) -> bool {
        (self.x..self.x + self.width).contains(&place.x)
            && (self.y..self.y + self.height).contains(&place.y)
    }

    /// Whether the middles of two boxes are apart by no more than half the larger side on either
    /// axis.
    pub(crate) fn is_near(&self, other: &Self) -> bool {
        let (a, b) = (self.centre(), other.centre());
        (a.x - b.x).abs() <= self.width.max(other.width) / 2.0
            && (a.y - b.y).abs() <= self.height.max(other.height) / 2.0
    }

    /// Whether two boxes have pixels in common.
    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        let (a, b) = (self.centre(), other.centre());
        (a.x - b.x).abs() < (self.width + other.width) / 2.0
            && (a.y - b.y).abs() < (self.height + other.height) / 2.0
    }

    /// Share of the box that lies within an image.
    pub(crate) fn share_in_view(&self, image: &Plane) -> f64 {
        let share = |first: f64, side: f64, end: usize| {
            ((first + side).min(end as f64) - first.max(0.0)).max(0.0) / side
        };
        share(self.x, self.width, image.width()) * share(self.y, self.height, image.height())
    }

    /// The middle, as a place: the box of one pixel at (0, 0) has its middle at (0, 0).
    pub fn centre(&self) -> ImagePoint {
        ImagePoint { x: self.x + (self.width - 1.0) / 2.0, y: self.y + (self.height - 1.0) / 2.0 }
    }

    /// The box of given sides centred on a place.
    pub fn about(centre: ImagePoint, width: f64, height: f64) -> Self {
        Self {
            x: centre.x - (width - 1.0) / 2.0,
            y: centre.y - (height - 1.0) / 2.0,
            width,
            height,
        }
    }

    /// Whether the numbers describe a box that a target can have.
    pub fn is_possible(&self) -> bool {
        let corner = ImagePoint { x: self.x, y: self.y };
        corner.is_possible()
            && (1.0..=1000.0).contains(&self.width)
            && (1.0..=1000.0).contains(&self.height)
    }
}
