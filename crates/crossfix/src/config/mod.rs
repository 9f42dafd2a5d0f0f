//! Configuration files: read, checked and explained before anything starts.

mod camera;
mod file;
mod fusion;
mod site;

pub use camera::{CameraFile, ClockConfig, ClockSourceName, PoseConfig, SourceConfig};
pub use file::{Kind, load, parse};
pub use fusion::FusionFile;
pub use site::{Site, load_cameras, load_network};
