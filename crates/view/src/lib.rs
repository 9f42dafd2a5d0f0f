//! The picture of a site in Rerun: cameras with their frustums and images, sight lines, 3D tracks
//! with trails, velocities and covariances, residuals and latency, on a timeline of capture time.
//!
//! A [`SitePicture`] draws live messages and recorded ones in the same way: it takes the bytes as
//! they were sent. The rate of drawing is bounded, so that a viewer left open does not fill the
//! memory.
//!
//! Drawing a recording:
//!
//! ```
//! use crossfix_recording::RecordingReader;
//! use crossfix_view::{SitePicture, ViewError};
//!
//! # let recording = concat!(env!("CARGO_MANIFEST_DIR"), "/../../recordings/two-uavs.mcap").as_ref();
//! # let folder = tempfile::tempdir()?;
//! # let file = folder.path().join("two-uavs.rrd");
//! let mut picture = SitePicture::new(crossfix_view::save(&file)?)?;
//! RecordingReader::open(recording)?.for_each(|entry| {
//!     // What is no message of this version is said, and left out.
//!     let unread = picture.show(&entry.key.channel, entry.arrival, &entry.data)?;
//!     assert!(unread.is_none());
//!     Ok::<_, ViewError>(())
//! })?;
//! picture.finish()?;
//! assert!(std::fs::metadata(&file)?.len() > 100_000);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod arrivals;
mod blueprint;
mod colour;
mod comparison;
mod draw;
mod earth;
mod extent;
mod eye;
mod flight;
mod ground;
mod image;
mod legend;
mod limiter;
mod paths;
mod picture;
mod sink;
mod tracking;
mod trail;
mod volume;

pub use comparison::{ComparedRun, ComparisonPicture, PlaceInTime};
pub use earth::GroundPicture;
pub use flight::{FlightCamera, FlightPicture, LoggedPlace, SeenTarget};
pub use picture::SitePicture;
pub use rerun::RecordingStream;
pub use sink::{ViewError, ViewerWatch, connect, save, save_without_end, spawn_viewer};
pub use tracking::{FollowedTarget, ImageBox, Sight, TrackingPicture};
pub use volume::{DrawnPlace, VolumeCell, VolumePicture};
