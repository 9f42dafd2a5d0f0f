use std::collections::BTreeSet;
use std::ops::RangeInclusive;

use crossfix_geometry::{Camera, Distortion, GeometryError, ImageSize, Intrinsics, Pose};
use crossfix_message::CameraName;
use nalgebra::Point3;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{FlightPath, SceneClutter, SceneMount, SimulatedClock, World};

/// Longest scene, s, and the farthest from its start that anything in it begins.
const LONGEST_S: f64 = 1e5;

/// A scene as it is written in a file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Seed of everything random: sky, noise.
    #[serde(default)]
    pub seed: u64,
    /// How long it lasts, s.
    pub duration_s: f64,
    /// The targets.
    pub targets: Vec<SceneTarget>,
    /// The cameras.
    pub cameras: Vec<SceneCamera>,
    /// What the cameras see beside the targets: in images alone, not in bearings.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub clutter: Vec<SceneClutter>,
}

/// A target of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneTarget {
    /// Its number.
    pub id: u64,
    /// Its span, m.
    pub span_m: f64,
    /// Time at which it appears, s from the start.
    #[serde(default)]
    pub appears_s: f64,
    /// Its path.
    pub path: FlightPath,
}

/// A camera of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneCamera {
    /// Its name.
    pub name: CameraName,
    /// Its optical centre, world, m.
    pub position_m: [f64; 3],
    /// The point that its optical axis goes through, m.
    pub look_at_m: [f64; 3],
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Brown-Conrady coefficients k1 k2 p1 p2 k3.
    #[serde(default)]
    pub distortion: [f64; 5],
    /// Frames per second.
    pub rate_hz: f64,
    /// True time of the first frame, s.
    #[serde(default)]
    pub phase_s: f64,
    /// How long the shutter is open, s.
    pub exposure_s: f64,
    /// Standard deviation of the image's noise, 8-bit levels.
    pub noise_levels: f64,
    /// Standard deviation of the lens' blur, pixels.
    pub blur_px: f64,
    /// Its clock.
    #[serde(default)]
    pub clock: SimulatedClock,
    /// Its mount, if it has one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mount: Option<SceneMount>,
}

/// What is wrong with a scene.
#[derive(Debug, Error)]
pub enum SceneError {
    /// A number that makes no sense.
    #[error("{what} is {value}: it must be {must}")]
    Number {
        /// The parameter, and of what.
        what: String,
        /// Its value.
        value: f64,
        /// What it must be.
        must: &'static str,
    },
    /// A path with impossible numbers.
    #[error("the path of target {target} has a number that is not finite, or a period of zero")]
    Path {
        /// The target.
        target: u64,
    },
    /// A thing beside the targets with impossible numbers.
    #[error(
        "thing {index} of the clutter has a size that is not positive, a place or size beyond \
         1000 km, more than 80 beats a second, an impossible path, or a brightness outside 0 to \
         255 levels"
    )]
    Clutter {
        /// Its place in the list, from 0.
        index: usize,
    },
    /// Two cameras of the same name or two targets of the same number.
    #[error("`{name}` is there twice")]
    Twice {
        /// The name or number.
        name: String,
    },
    /// An impossible camera.
    #[error("camera `{camera}` of the scene is impossible")]
    Camera {
        /// The camera.
        camera: CameraName,
        /// What is wrong.
        #[source]
        source: GeometryError,
    },
}

impl SceneCamera {
    /// Its model and pose.
    ///
    /// # Errors
    /// [`GeometryError`] if the numbers are no camera's.
    pub fn camera(&self) -> Result<Camera, GeometryError> {
        let [width, height] = self.size_px;
        let straight = self.distortion.iter().all(|k| *k == 0.0);
        let intrinsics = Intrinsics {
            size: ImageSize { width, height },
            fx: self.focal_px,
            fy: self.focal_px,
            cx: (f64::from(width) - 1.0) / 2.0,
            cy: (f64::from(height) - 1.0) / 2.0,
            distortion: if straight {
                Distortion::None
            } else {
                Distortion::BrownConrady(self.distortion)
            },
        };
        let pose = Pose::looking_at(Point3::from(self.position_m), Point3::from(self.look_at_m))?;
        Camera::new(intrinsics, pose)
    }
}

impl Scene {
    /// Checks the scene and builds the world that can be rendered.
    ///
    /// # Errors
    /// [`SceneError`] naming what is wrong.
    pub fn build(&self) -> Result<World, SceneError> {
        self.check()?;
        World::new(self)
    }

    fn check(&self) -> Result<(), SceneError> {
        let lasts = self.duration_s;
        check_number(
            "duration_s".into(),
            lasts,
            is_positive(lasts) && lasts < LONGEST_S,
            "from 0 to 100000 s",
        )?;
        let mut seen = BTreeSet::new();
        for target in &self.targets {
            target.check()?;
            if !seen.insert(format!("target {}", target.id)) {
                return Err(SceneError::Twice { name: format!("target {}", target.id) });
            }
        }
        for camera in &self.cameras {
            camera.check()?;
            if !seen.insert(camera.name.to_string()) {
                return Err(SceneError::Twice { name: camera.name.to_string() });
            }
        }
        let impossible = self.clutter.iter().position(|thing| !thing.is_possible());
        impossible.map_or(Ok(()), |index| Err(SceneError::Clutter { index }))
    }
}

impl SceneTarget {
    fn check(&self) -> Result<(), SceneError> {
        let span = format!("span_m of target {}", self.id);
        check_number(span, self.span_m, is_positive(self.span_m), "a positive number of metres")?;
        let appears = format!("appears_s of target {}", self.id);
        check_range(appears, self.appears_s, -LONGEST_S..=LONGEST_S, "within 100000 s")?;
        if self.path.is_possible() { Ok(()) } else { Err(SceneError::Path { target: self.id }) }
    }
}

impl SceneCamera {
    fn check(&self) -> Result<(), SceneError> {
        self.check_range(
            "rate_hz",
            self.rate_hz,
            0.01..=1000.0,
            "from 0.01 to 1000 frames a second",
        )?;
        self.check_range("noise_levels", self.noise_levels, 0.0..=100.0, "from 0 to 100 levels")?;
        self.check_range("blur_px", self.blur_px, 0.0..=20.0, "from 0 to 20 px")?;
        self.check_range("exposure_s", self.exposure_s, 0.0..=1.0, "from 0 to 1 s")?;
        self.check_range("phase_s", self.phase_s, 0.0..=LONGEST_S, "from 0 to 100000 s")?;
        let SimulatedClock { offset_s, drift_ppm } = self.clock;
        self.check_range("clock.offset_s", offset_s, -1e9..=1e9, "within 1000000000 s")?;
        self.check_range("clock.drift_ppm", drift_ppm, -1e5..=1e5, "within 100000 ppm")?;
        if let Some(SceneMount { rate_deg_per_s: rate, angle_sd_mrad: sd, .. }) = self.mount {
            let turns = "from 0.01 to 1000 degrees a second";
            self.check_range("mount.rate_deg_per_s", rate, 0.01..=1000.0, turns)?;
            self.check_range("mount.angle_sd_mrad", sd, 0.0..=100.0, "from 0 to 100 mrad")?;
        }
        let most = self.size_px.iter().copied().max().unwrap_or(0);
        self.check_range("size_px", f64::from(most), 0.0..=8192.0, "at most 8192 px")
    }

    /// An error where a number of it is not in its range.
    fn check_range(
        &self,
        key: &str,
        value: f64,
        range: RangeInclusive<f64>,
        must: &'static str,
    ) -> Result<(), SceneError> {
        check_range(format!("{key} of camera {}", self.name), value, range, must)
    }
}

fn is_positive(value: f64) -> bool {
    value.is_finite() && value > 0.0
}

/// An error where a number is not in its range.
pub(crate) fn check_range(
    what: impl Into<String>,
    value: f64,
    range: RangeInclusive<f64>,
    must: &'static str,
) -> Result<(), SceneError> {
    check_number(what.into(), value, range.contains(&value), must)
}

/// An error where a number is not good.
fn check_number(
    what: String,
    value: f64,
    good: bool,
    must: &'static str,
) -> Result<(), SceneError> {
    if good { Ok(()) } else { Err(SceneError::Number { what, value, must }) }
}
