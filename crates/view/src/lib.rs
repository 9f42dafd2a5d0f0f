//! The picture of a site in Rerun: cameras with their frustums and images,
//! sight lines, 3D tracks with trails, velocities and covariances, residuals
//! and latency, on the timeline of capture time.
//!
//! One [`Picture`] draws live messages and recorded ones alike: it is given
//! the bytes of the wire. What it draws a second is bounded, so that a viewer
//! left open does not fill the memory.

mod arrivals;
mod blueprint;
mod colour;
mod draw;
mod extent;
mod eye;
mod ground;
mod image;
mod legend;
mod limiter;
mod paths;
mod picture;
mod sink;
mod tracking;
mod volume;

pub use picture::Picture;
pub use rerun::RecordingStream;
pub use sink::{ViewError, ViewerWatch, connect, save, save_without_end, spawn_viewer};
pub use tracking::{FollowedTarget, ImageBox, Sight, TrackingPicture};
pub use volume::{Landmark, VolumeCell, VolumePicture};
