//! Cameras and targets of the experiments, and their bearings.

use crossfix_fusion::spatial::TimedLine;
use crossfix_geometry::{
    Bearing, Camera, Distortion, GeometryError, ImageSize, Intrinsics, Pose, tangent_basis,
};
use crossfix_message::Timestamp;
use nalgebra::{Matrix2, Point3, Unit, Vector2, Vector3};

use super::super::runs::Noise;
use super::VELOCITY_SD;

/// Distance of the cameras from the origin, m. With half of it and
/// the same [`BEARING_SD`] errors would be half as large.
const RANGE: f64 = 150.0;
/// Standard deviation of a bearing on each tangent, rad: 0.1 m at that distance (Klochko 2020).
/// With half of it errors would be half as large as the paper's.
pub(super) const BEARING_SD: f64 = 0.1 / RANGE;
/// Observation periods, of 1 s each: the paper's. With half of it a group would rest on two or
/// three fixes.
pub(super) const PERIODS: usize = 5;

/// Elevation of the lines of sight at which three of them, 120 degrees apart, are perpendicular,
/// deg: `atan(1 / sqrt(2))`.
const ORTHOGONAL: f64 = 35.264_389_682_754_654;

/// Three cameras round the origin, and their delays within each period.
#[derive(Clone, Copy, Debug)]
pub(super) struct PaperSite {
    pub name: &'static str,
    /// Azimuths of the lines of sight to the origin, deg.
    azimuths: [f64; 3],
    /// Their elevation, deg.
    elevation: f64,
    /// The cameras' delays within a period, s.
    pub delays: [f64; 3],
}

impl PaperSite {
    pub const fn orthogonal(name: &'static str, delays: [f64; 3]) -> Self {
        Self { name, azimuths: [0.0, 120.0, 240.0], elevation: ORTHOGONAL, delays }
    }

    pub const fn arc(name: &'static str, elevation: f64) -> Self {
        Self { name, azimuths: [0.0, -90.0, 90.0], elevation, delays: [0.0, 0.1, 0.2] }
    }

    /// The cameras, with a field of view that no target leaves.
    pub fn cameras(&self) -> Result<Vec<Camera>, GeometryError> {
        self.azimuths.into_iter().map(|azimuth| self.camera(azimuth)).collect()
    }

    fn camera(&self, azimuth: f64) -> Result<Camera, GeometryError> {
        let (azimuth, elevation) = (azimuth.to_radians(), self.elevation.to_radians());
        let level = elevation.cos();
        let sight = Vector3::new(level * azimuth.cos(), level * azimuth.sin(), elevation.sin());
        let intrinsics = Intrinsics {
            size: ImageSize { width: 4000, height: 4000 },
            fx: 800.0,
            fy: 800.0,
            cx: 1999.5,
            cy: 1999.5,
            distortion: Distortion::None,
        };
        Camera::new(intrinsics, Pose::looking_at(Point3::from(sight * -RANGE), Point3::origin())?)
    }
}

/// The layouts in which the paper's system of equations breaks down, and two in which it does not.
pub(super) const LAYOUTS: [PaperSite; 8] = [
    PaperSite::orthogonal("orthogonal, 0.1/0.2", [0.0, 0.1, 0.2]),
    PaperSite::orthogonal("orthogonal, 0.1/0.11", [0.0, 0.1, 0.11]),
    PaperSite::orthogonal("equal delays 0.2/0.2", [0.0, 0.2, 0.2]),
    PaperSite::orthogonal("dt2 = 0, dt3 = 0.2", [0.0, 0.0, 0.2]),
    PaperSite::orthogonal("synchronous", [0.0, 0.0, 0.0]),
    PaperSite::arc("90 degree arc, 5 degrees up", 5.0),
    PaperSite::arc("90 degree arc, 1 degree up", 1.0),
    PaperSite::arc("coplanar", 0.0),
];

/// A target on a straight line.
#[derive(Clone, Copy, Debug)]
pub(super) struct StraightTarget {
    middle: Point3<f64>,
    /// Time at which it is at `middle`, s.
    middle_time: f64,
    pub velocity: Vector3<f64>,
}

impl StraightTarget {
    /// A random target: uniform within 10 m of the origin on each axis at the middle of the
    /// periods, with a velocity of [`VELOCITY_SD`]. The independent implementation only says
    /// "within 10 m"; drawing from a ball, or another middle time, leaves all layouts but the
    /// coplanar one unchanged, and takes that one farther from the independent implementation's
    /// figures.
    pub fn random(noise: &mut Noise) -> Self {
        let middle_time = PERIODS as f64 / 2.0;
        let middle = Point3::from(Vector3::from_fn(|_, _| 20.0 * noise.uniform() - 10.0));
        Self {
            middle,
            middle_time,
            velocity: Vector3::from_fn(|_, _| VELOCITY_SD * noise.normal()),
        }
    }

    /// A target at rest.
    pub fn at_rest(place: Point3<f64>) -> Self {
        Self { middle: place, middle_time: 0.0, velocity: Vector3::zeros() }
    }

    pub fn at(&self, time_s: f64) -> Point3<f64> {
        self.middle + self.velocity * (time_s - self.middle_time)
    }
}

/// Offset of a bearing on its tangents, rad: zero without `noise`, else with [`BEARING_SD`] on
/// both.
pub(super) fn tangent_noise(noise: Option<&mut Noise>) -> Vector2<f64> {
    noise.map_or_else(Vector2::zeros, |noise| Vector2::from_fn(|_, _| BEARING_SD * noise.normal()))
}

/// The bearing of a place, moved by `offset` on its tangents, rad. `None` at the camera itself.
pub(super) fn bearing(
    camera: &Camera,
    place: Point3<f64>,
    offset: Vector2<f64>,
) -> Option<Bearing> {
    let direction = Unit::try_new(camera.pose().camera_from_world(place), 1e-9)?;
    let moved = (direction.into_inner() + tangent_basis(&direction) * offset).normalize();
    Bearing::new(moved, Matrix2::identity() * BEARING_SD.powi(2)).ok()
}

/// The same bearing as a sight line in the world.
pub(super) fn line(
    camera: &Camera,
    place: Point3<f64>,
    offset: Vector2<f64>,
    time_s: f64,
) -> Option<TimedLine> {
    let line = camera.sight_line(&bearing(camera, place, offset)?);
    Some(TimedLine::exact(line, Timestamp::from_seconds(time_s)))
}
