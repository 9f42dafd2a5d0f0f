//! Configuration files: read, checked and explained before anything starts.

mod camera;
mod file;
#[cfg(feature = "centre")]
mod fusion;
mod mount;
mod pose;
mod site;
mod source;
mod stream;

pub use camera::{CameraFile, ClockConfig, ClockSourceName};
pub use file::{FileKind, load, parse};
#[cfg(feature = "centre")]
pub use fusion::FusionFile;
pub use mount::{MountConfig, OnvifConfig};
pub use pose::PoseConfig;
pub use site::{SiteFolder, anchor_of, load_cameras, load_network};
pub use source::SourceConfig;
pub use stream::{GstreamerConfig, StreamConfig, login};

#[cfg(test)]
mod tests;
