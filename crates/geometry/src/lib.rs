//! Frames, poses, camera models and bearings: how a pixel becomes a sight
//! line in the world, with its uncertainty, and back; and where on Earth the
//! world frame lies.
//!
//! Frames: the world is local ENU, right-handed; a camera is x right, y down,
//! z forward. Metres and radians.
//!
//! ```
//! use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pixel, PixelCovariance, Pose};
//! use nalgebra::Point3;
//!
//! let intrinsics = Intrinsics {
//!     size: ImageSize { width: 640, height: 480 },
//!     fx: 800.0, fy: 800.0, cx: 319.5, cy: 239.5,
//!     distortion: Distortion::None,
//! };
//! let pose = Pose::looking_at(Point3::new(100.0, 0.0, 2.0), Point3::new(0.0, 0.0, 50.0))?;
//! let camera = Camera::new(intrinsics, pose)?;
//!
//! // The middle of the image looks at the point aimed at.
//! let bearing = camera.model().bearing(Pixel::new(319.5, 239.5), PixelCovariance::isotropic(0.5))?;
//! let sight_line = camera.sight_line(&bearing);
//! assert!(sight_line.miss_distance(Point3::new(0.0, 0.0, 50.0)) < 1e-9);
//! # Ok::<(), crossfix_geometry::GeometryError>(())
//! ```

mod bearing;
mod camera;
mod error;
mod fisheye;
mod geodetic;
mod model;
mod pan_tilt;
mod pose;
mod scanning;

pub use bearing::{Bearing, Ray, SightLine, passing_ranges, tangent_basis};
pub use camera::{Camera, CameraModel, Distortion, ImageSize, Intrinsics, Pixel, PixelCovariance};
pub use error::GeometryError;
pub use geodetic::{Geodetic, LocalFrame};
pub use model::BearingModel;
pub use pan_tilt::PanTilt;
pub use pose::{Pose, turn_between, turn_vector};
pub use scanning::{ScanAngles, ScanMeasurement, camera_from_paper, optical_bearing};
