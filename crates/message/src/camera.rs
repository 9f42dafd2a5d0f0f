use crossfix_geometry::{
    Camera, Distortion, GeometryError, ImageSize, Intrinsics, PanTilt, Pose, ScanAngles,
};
use nalgebra::{Matrix3, Matrix6, Point3};
use prost::Message;
use sha2::{Digest, Sha256};
use thiserror::Error;

use crate::covariance::is_covariance;
use crate::{
    CameraCalibration, CameraName, Datum, DistortionModel, NameError, PanTiltMount, Payload,
    Pointing, Timestamp, Vector3,
};

/// Largest standard deviation of a pose's rotation about an axis, rad: beyond this the pose counts
/// as unknown. With half of it a pose known to 30 degrees would be refused; it helps as little.
pub const MOST_ROTATION_SD: f64 = 1.0;
/// Largest standard deviation of a pose's position along an axis, m: some sites are smaller than
/// this. With half of it a pose that is of use to a site of some kilometres might be refused.
pub const MOST_POSITION_SD: f64 = 1000.0;

/// A [`CameraCalibration`] that has been parsed and found possible.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The camera's name.
    pub name: CameraName,
    /// Its model and pose; for a camera on a mount, the pose with both angles at zero.
    pub camera: Camera,
    /// What turns it, if something does.
    pub mount: Option<PanTilt>,
    /// Whether it searches for the targets that cues announce.
    pub takes_cues: bool,
    /// Covariance of the pose in the world's axes, rotation about them (rad), then position (m);
    /// `None`: exact.
    pub pose_covariance: Option<Matrix6<f64>>,
    /// The part of its bearings' noise that is correlated from one bearing to the next; `None`: the
    /// noise is white.
    pub lasting_noise: Option<LastingNoise>,
    /// Random wander of its clock, s after one second.
    pub clock_wander_s: f64,
    /// Uncertainty of the site as a whole, in addition to the pose's covariance.
    pub datum: Option<Datum>,
    /// It is valid from this time on.
    pub valid_from: Timestamp,
}

/// Bearing noise that is correlated from one bearing to the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LastingNoise {
    /// Standard deviation per tangent, rad.
    pub sd_rad: f64,
    /// Correlation time, after which e^-1 of it is left, s.
    pub time_s: f64,
}

/// Why a [`CameraCalibration`] cannot be used.
#[derive(Debug, Error)]
pub enum CalibrationError {
    /// The camera's name is not a valid name.
    #[error("a calibration's camera has an impossible name")]
    Name(#[source] NameError),
    /// The numbers describe no camera.
    #[error("the calibration of camera `{camera}` is impossible")]
    Geometry {
        /// The camera.
        camera: CameraName,
        /// What is wrong.
        #[source]
        source: GeometryError,
    },
    /// It has no pose.
    #[error("camera `{camera}` has a lens and no pose: calibrate it (crossfix calibrate)")]
    NoPose {
        /// The camera.
        camera: CameraName,
    },
    /// The pose's covariance is not one: not finite, not symmetric, or negative along some axis; or
    /// it is so large that the pose counts as unknown ([`MOST_ROTATION_SD`], [`MOST_POSITION_SD`]).
    #[error(
        "the calibration of camera `{camera}`: pose_covariance is no covariance, or of a pose \
         that is not known to {MOST_ROTATION_SD} rad and {MOST_POSITION_SD} m"
    )]
    Covariance {
        /// The camera.
        camera: CameraName,
    },
    /// A list has the wrong number of elements, or a part is missing.
    #[error("the calibration of camera `{camera}`: {part} is missing or has the wrong length")]
    Shape {
        /// The camera.
        camera: CameraName,
        /// The part.
        part: &'static str,
    },
}

impl CalibrationError {
    fn shape(camera: &CameraName, part: &'static str) -> Self {
        Self::Shape { camera: camera.clone(), part }
    }

    fn geometry(camera: &CameraName, source: GeometryError) -> Self {
        Self::Geometry { camera: camera.clone(), source }
    }
}

impl CameraCalibration {
    /// The message for a camera; its hash is filled in.
    pub fn new(name: &CameraName, camera: &Camera, valid_from: Timestamp) -> Self {
        let intrinsics = camera.model().intrinsics();
        let (distortion_model, distortion) = match intrinsics.distortion {
            Distortion::None => (DistortionModel::None, vec![]),
            Distortion::BrownConrady(k) => (DistortionModel::BrownConrady, k.to_vec()),
            Distortion::Fisheye(k) => (DistortionModel::Fisheye, k.to_vec()),
        };
        let pose = camera.pose();
        let mut message = Self {
            camera: name.to_string(),
            width: intrinsics.size.width,
            height: intrinsics.size.height,
            fx: intrinsics.fx,
            fy: intrinsics.fy,
            cx: intrinsics.cx,
            cy: intrinsics.cy,
            distortion_model: distortion_model.into(),
            distortion,
            rotation: rows_of(pose),
            position: Some(pose.position().into()),
            valid_from_ns: valid_from.nanos(),
            ..Default::default()
        }
        .stamped();
        message.hash = message.content_hash();
        message
    }

    /// SHA-256 of the message with its hash left empty.
    pub fn content_hash(&self) -> Vec<u8> {
        let bare = Self { hash: Vec::new(), ..self.clone() };
        Sha256::digest(bare.encode_to_vec()).to_vec()
    }

    /// Parses the message into the camera that it describes, or says why it describes none.
    ///
    /// # Errors
    /// [`CalibrationError`] naming the camera and the part.
    pub fn parse(&self) -> Result<Calibration, CalibrationError> {
        let name: CameraName = self.camera.parse().map_err(CalibrationError::Name)?;
        let intrinsics = self.lens(&name)?;
        let mount = self.parse_mount(&name)?;
        let pose = match &mount {
            Some(mount) => *mount.rest(),
            None if self.is_bare() => return Err(CalibrationError::NoPose { camera: name }),
            None => parse_pose(&name, &self.rotation, self.position)?,
        };
        let camera = Camera::new(intrinsics, pose)
            .map_err(|source| CalibrationError::geometry(&name, source))?;
        let pose_covariance = self.parse_pose_covariance(&name, &camera)?;
        let lasting_noise = self.parse_noise(&name)?;
        if !(0.0..1.0).contains(&self.clock_wander_s) {
            return Err(CalibrationError::shape(&name, "clock_wander_s"));
        }
        let datum = self
            .datum
            .as_ref()
            .map(|datum| datum.parse().ok_or_else(|| CalibrationError::shape(&name, "datum")));
        let datum = datum.transpose()?;
        Ok(Calibration {
            name,
            camera,
            mount,
            takes_cues: self.takes_cues,
            pose_covariance,
            lasting_noise,
            clock_wander_s: self.clock_wander_s,
            datum,
            valid_from: Timestamp::from_nanos(self.valid_from_ns),
        })
    }

    /// Whether it has no fixed pose.
    fn is_bare(&self) -> bool {
        self.rotation.is_empty() && self.position.is_none()
    }

    /// The mount, if the camera stands on one.
    fn parse_mount(&self, name: &CameraName) -> Result<Option<PanTilt>, CalibrationError> {
        let Some(mount) = &self.mount else { return Ok(None) };
        // A fixed pose and one that turns contradict each other.
        if !self.is_bare() {
            return Err(CalibrationError::shape(name, "mount"));
        }
        let rest = parse_pose(name, &mount.rotation, mount.position)?;
        let mount = mount.read(rest).map_err(|source| CalibrationError::geometry(name, source))?;
        Ok(Some(mount))
    }

    /// The covariance of the camera's pose in the world's axes; `None`: exact.
    fn parse_pose_covariance(
        &self,
        name: &CameraName,
        camera: &Camera,
    ) -> Result<Option<Matrix6<f64>>, CalibrationError> {
        if self.pose_covariance.is_empty() {
            return Ok(None);
        }
        let values = self.pose_covariance.as_slice().try_into();
        let values = values.map_err(|_| CalibrationError::shape(name, "pose_covariance"))?;
        let covariance = read_pose_covariance(values, camera)
            .ok_or_else(|| CalibrationError::Covariance { camera: name.clone() })?;
        Ok(Some(covariance))
    }

    /// The correlated part of the bearings' noise; `None`: it is white.
    fn parse_noise(&self, name: &CameraName) -> Result<Option<LastingNoise>, CalibrationError> {
        let noise = LastingNoise { sd_rad: self.lasting_noise_rad, time_s: self.lasting_noise_s };
        let is_noise = (0.0..1.0).contains(&noise.sd_rad) && (0.0..1e6).contains(&noise.time_s);
        if !is_noise {
            return Err(CalibrationError::shape(name, "lasting_noise"));
        }
        let lasts = noise.sd_rad > 0.0 && noise.time_s > 0.0;
        Ok(lasts.then_some(noise))
    }

    /// The same calibration for a camera on a mount: its pose is that of the mount with both angles
    /// at zero, and it takes cues.
    #[must_use]
    pub fn on_mount(mut self, mount: &PanTilt) -> Self {
        let [azimuth_min, azimuth_max] = mount.azimuth();
        let [elevation_min, elevation_max] = mount.elevation();
        self.mount = Some(PanTiltMount {
            rotation: rows_of(mount.rest()),
            position: Some(mount.rest().position().into()),
            azimuth_min,
            azimuth_max,
            elevation_min,
            elevation_max,
        });
        self.rotation.clear();
        self.position = None;
        self.taking_cues()
    }

    /// The same calibration for a camera that takes cues: it searches for the targets they
    /// announce.
    #[must_use]
    pub fn taking_cues(mut self) -> Self {
        self.takes_cues = true;
        self.hash = self.content_hash();
        self
    }

    /// The camera's lens, whether or not its pose is known.
    ///
    /// # Errors
    /// [`CalibrationError::Shape`] where the coefficients are too few or too many.
    pub fn lens(&self, name: &CameraName) -> Result<Intrinsics, CalibrationError> {
        let shape = || CalibrationError::shape(name, "distortion");
        let distortion = match self.distortion_model() {
            DistortionModel::Unspecified | DistortionModel::None => Distortion::None,
            DistortionModel::BrownConrady => Distortion::BrownConrady(
                self.distortion.as_slice().try_into().map_err(|_| shape())?,
            ),
            DistortionModel::Fisheye => {
                Distortion::Fisheye(self.distortion.as_slice().try_into().map_err(|_| shape())?)
            }
        };
        Ok(Intrinsics {
            size: ImageSize { width: self.width, height: self.height },
            fx: self.fx,
            fy: self.fy,
            cx: self.cx,
            cy: self.cy,
            distortion,
        })
    }

    /// The same calibration with an uncertain pose: the covariance of a small rotation about the
    /// camera's axes (rad), then of the position (m).
    #[must_use]
    pub fn with_pose_covariance(mut self, covariance: &Matrix6<f64>) -> Self {
        self.pose_covariance = covariance.as_slice().to_vec();
        self.hash = self.content_hash();
        self
    }

    /// The same calibration with the correlated part of the bearings' noise, and the wander of the
    /// clock (s after one second).
    #[must_use]
    pub fn with_lasting_errors(mut self, noise: LastingNoise, clock_wander_s: f64) -> Self {
        (self.lasting_noise_rad, self.lasting_noise_s) = (noise.sd_rad, noise.time_s);
        self.clock_wander_s = clock_wander_s;
        self.hash = self.content_hash();
        self
    }

    /// The same calibration with the wander of the clock, s after one second.
    #[must_use]
    pub fn with_clock_wander(mut self, clock_wander_s: f64) -> Self {
        self.clock_wander_s = clock_wander_s;
        self.hash = self.content_hash();
        self
    }

    /// Whether it comes from a flight, which corrects the camera's clock too: the times of bearings
    /// that are published with it are corrected already. A flight alone states both how the noise
    /// lasts and how the clock wanders.
    pub fn corrects_clock(&self) -> bool {
        self.datum.is_some() || (self.clock_wander_s > 0.0 && self.lasting_noise_s > 0.0)
    }

    /// The same calibration with the uncertainty of the site as a whole.
    #[must_use]
    pub fn with_datum(mut self, datum: &Datum) -> Self {
        self.datum = Some(datum.into());
        self.hash = self.content_hash();
        self
    }

    /// The message for a camera whose pose is not known yet: its lens alone.
    ///
    /// # Errors
    /// [`GeometryError::Intrinsics`] where the parameters are no lens's.
    pub fn of_lens(
        name: &CameraName,
        intrinsics: Intrinsics,
        valid_from: Timestamp,
    ) -> Result<Self, GeometryError> {
        let camera = Camera::new(intrinsics, Pose::at_origin())?;
        let mut message = Self::new(name, &camera, valid_from);
        message.rotation.clear();
        message.position = None;
        message.hash = message.content_hash();
        Ok(message)
    }

    /// The same calibration with an uncertain pose: standard deviations of the rotation about each
    /// of the camera's axes (rad) and of the position along each of the world's (m).
    #[must_use]
    pub fn with_pose_sd(self, rotation_sd: f64, position_sd: f64) -> Self {
        let mut covariance = Matrix6::<f64>::zeros();
        for axis in 0..3 {
            covariance[(axis, axis)] = rotation_sd.powi(2);
            covariance[(axis + 3, axis + 3)] = position_sd.powi(2);
        }
        self.with_pose_covariance(&covariance)
    }
}

/// A rotation `world_from_camera` as nine elements, row by row.
fn rows_of(pose: &Pose) -> Vec<f64> {
    // nalgebra stores columns first.
    pose.rotation().matrix().transpose().as_slice().to_vec()
}

impl Calibration {
    /// The camera with the pose that it had in a frame whose pointing this is; a camera without a
    /// mount as it is. `None` if it is on a mount and the frame does not say where it pointed.
    pub fn pointed(&self, pointing: Option<&Pointing>) -> Option<Camera> {
        let Some(mount) = &self.mount else { return Some(self.camera.clone()) };
        Some(self.camera.posed(mount.pose(pointing?.angles()?)))
    }
}

impl Pointing {
    /// The angles; `None` if they are impossible.
    pub fn angles(&self) -> Option<ScanAngles> {
        let Self { azimuth, elevation, .. } = *self;
        let within = |angle: f64, turns: f64| angle.abs() <= turns * std::f64::consts::TAU;
        let possible = within(azimuth, 1.0) && within(elevation, 0.25);
        possible.then_some(ScanAngles { azimuth, elevation })
    }
}

impl PanTiltMount {
    fn read(&self, rest: Pose) -> Result<PanTilt, GeometryError> {
        PanTilt::new(
            rest,
            [self.azimuth_min, self.azimuth_max],
            [self.elevation_min, self.elevation_max],
        )
    }
}

/// A pose from a rotation `world_from_camera`, row by row, and a position.
fn parse_pose(
    name: &CameraName,
    rotation: &[f64],
    position: Option<Vector3>,
) -> Result<Pose, CalibrationError> {
    let rotation: [f64; 9] =
        rotation.try_into().map_err(|_| CalibrationError::shape(name, "rotation"))?;
    let position = position.ok_or_else(|| CalibrationError::shape(name, "position"))?;
    Pose::new(Matrix3::from_row_slice(&rotation), position.into())
        .map_err(|source| CalibrationError::geometry(name, source))
}

/// The covariance on the wire (rotation about the camera's axes) transformed to the world's axes;
/// `None` if it is not a covariance, or so large that the pose counts as unknown.
fn read_pose_covariance(values: &[f64; 36], camera: &Camera) -> Option<Matrix6<f64>> {
    let own = Matrix6::from_row_slice(values);
    let sd = own.diagonal().map(|variance| variance.max(0.0).sqrt());
    let is_known = sd.fixed_rows::<3>(0).max() <= MOST_ROTATION_SD
        && sd.fixed_rows::<3>(3).max() <= MOST_POSITION_SD;
    let mut turn = Matrix6::identity();
    turn.fixed_view_mut::<3, 3>(0, 0).copy_from(camera.pose().rotation().matrix());
    (is_known && is_covariance(&own, &[0..3, 3..6])).then(|| turn * own * turn.transpose())
}

impl From<Point3<f64>> for Vector3 {
    fn from(p: Point3<f64>) -> Self {
        Self { x: p.x, y: p.y, z: p.z }
    }
}

impl From<Vector3> for Point3<f64> {
    fn from(v: Vector3) -> Self {
        Self::new(v.x, v.y, v.z)
    }
}

impl From<nalgebra::Vector3<f64>> for Vector3 {
    fn from(v: nalgebra::Vector3<f64>) -> Self {
        Self { x: v.x, y: v.y, z: v.z }
    }
}

impl From<Vector3> for nalgebra::Vector3<f64> {
    fn from(v: Vector3) -> Self {
        Self::new(v.x, v.y, v.z)
    }
}

#[cfg(test)]
mod tests;
