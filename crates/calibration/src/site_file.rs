//! `calibration.toml`: the calibration of a site's cameras, as `crossfix calibrate` writes it.

use crossfix_geometry::{Camera, Distortion, GeometryError, ImageSize, Intrinsics, Pose};
use crossfix_message::{CameraCalibration, CameraName, Datum, Timestamp};
use nalgebra::{DMatrix, Matrix3, Matrix6, Point3, SMatrix};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::calibrated_camera::{CalibratedCamera, ClockCorrection};
use crate::label_noise::LabelNoise;
use crate::lens::{self, LensUncertainty};

/// Largest place (m), deviation or variance that is accepted: beyond it sums and squares overflow.
/// With half of it the same.
const LARGEST: f64 = 1e12;
/// Version of the file's form that this build writes, and the only one that it reads.
const FORM: u32 = 1;

/// What is wrong with a calibration file.
#[derive(Debug, Error)]
pub enum SiteFileError {
    /// No TOML, or without a key that it needs.
    #[error("the file is no calibration of a site")]
    Toml(#[source] Box<toml::de::Error>),
    /// A file of another form.
    #[error("the file has the form {0}: this build reads form {FORM}")]
    Form(u32),
    /// Numbers that describe no camera.
    #[error("the numbers of camera `{camera}` describe no camera")]
    Camera {
        /// The camera.
        camera: CameraName,
        /// What is wrong.
        #[source]
        source: GeometryError,
    },
    /// Two cameras of one name.
    #[error("camera `{0}` is there twice")]
    Twice(CameraName),
    /// A datum that is impossible.
    #[error("`datum` is impossible")]
    Datum,
    /// A covariance, a clock or a deviation that is impossible.
    #[error("camera `{camera}`: `{key}` is impossible")]
    Number {
        /// The camera.
        camera: CameraName,
        /// The key.
        key: &'static str,
    },
}

/// The calibration of a site.
///
/// ```no_run
/// use crossfix_calibration::SiteCalibration;
///
/// let text = std::fs::read_to_string("my-site/calibration.toml")?;
/// for camera in SiteCalibration::from_toml(&text)?.cameras() {
///     println!("{} stands at {}", camera.name, camera.camera.pose().position());
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct SiteCalibration {
    cameras: Vec<CalibratedCamera>,
    datum: Option<Datum>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    form: u32,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    datum: Option<FileDatum>,
    #[serde(rename = "camera")]
    cameras: Vec<FileCamera>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileDatum {
    middle_m: [f64; 3],
    time_s: f64,
    covariance: [[f64; Datum::WAYS]; Datum::WAYS],
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileCamera {
    name: CameraName,
    position_m: [f64; 3],
    rotation: [[f64; 3]; 3],
    pose_covariance: [[f64; 6]; 6],
    lens: FileLens,
    range_m: f64,
    clock: ClockCorrection,
    noise: FileNoise,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileLens {
    model: LensModel,
    size: [u32; 2],
    focal_px: [f64; 2],
    centre_px: [f64; 2],
    distortion: Vec<f64>,
    covariance: Vec<Vec<f64>>,
    pose_by_lens: Vec<Vec<f64>>,
}

#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum LensModel {
    Pinhole,
    BrownConrady,
    Fisheye,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileNoise {
    white_px: f64,
    lasting_px: f64,
    lasting_s: f64,
    frame_s: f64,
}

impl SiteCalibration {
    /// Reads a file.
    ///
    /// # Errors
    /// [`SiteFileError`] naming the camera and what is wrong.
    pub fn from_toml(text: &str) -> Result<Self, SiteFileError> {
        let file: File =
            toml::from_str(text).map_err(|error| SiteFileError::Toml(Box::new(error)))?;
        if file.form != FORM {
            return Err(SiteFileError::Form(file.form));
        }
        let cameras: Vec<CalibratedCamera> =
            file.cameras.into_iter().map(FileCamera::parse).collect::<Result<_, _>>()?;
        let named_before =
            |k: usize| cameras[..k].iter().any(|other| other.name == cameras[k].name);
        if let Some(twice) = (0..cameras.len()).find(|k| named_before(*k)) {
            return Err(SiteFileError::Twice(cameras[twice].name.clone()));
        }
        let datum =
            file.datum.map(|datum| datum.parse().ok_or(SiteFileError::Datum)).transpose()?;
        Ok(Self { cameras, datum })
    }

    /// The file's text, without its first lines, which say where it is from.
    pub fn to_toml(&self) -> String {
        let cameras = self.cameras.iter().map(FileCamera::of).collect();
        let datum = self.datum.as_ref().map(FileDatum::of);
        toml::to_string(&File { form: FORM, datum, cameras }).unwrap_or_default()
    }

    /// A site of these cameras, without a datum: what they are off by together is not stated.
    pub fn of(cameras: Vec<CalibratedCamera>) -> Self {
        Self { cameras, datum: None }
    }

    /// The same with a datum, if that is known.
    pub(crate) fn with_datum(cameras: Vec<CalibratedCamera>, datum: Option<Datum>) -> Self {
        Self { cameras, datum }
    }

    /// Adds the pose and lens of a camera: where the site has one of its name, that one's clock and
    /// noise are kept.
    pub fn put(&mut self, camera: CalibratedCamera) {
        match self.cameras.iter_mut().find(|known| known.name == camera.name) {
            Some(known) => {
                let (clock, noise, frame_s) = (known.clock.clone(), known.noise, known.frame_s);
                *known = CalibratedCamera { clock, noise, frame_s, ..camera };
            }
            None => self.cameras.push(camera),
        }
    }

    /// The cameras, as the file has them.
    pub fn cameras(&self) -> &[CalibratedCamera] {
        &self.cameras
    }

    /// What the site may be off by as a whole, if the file states it.
    pub fn datum(&self) -> Option<&Datum> {
        self.datum.as_ref()
    }

    /// Message for the cameras' channel of a camera of the file.
    pub fn message(&self, camera: &CalibratedCamera, valid_from: Timestamp) -> CameraCalibration {
        let message = camera.message(valid_from);
        self.datum.iter().fold(message, CameraCalibration::with_datum)
    }

    /// The camera of this name.
    pub fn camera(&self, name: &CameraName) -> Option<&CalibratedCamera> {
        self.cameras.iter().find(|camera| camera.name == *name)
    }
}

impl FileDatum {
    fn of(datum: &Datum) -> Self {
        Self {
            middle_m: datum.middle.coords.into(),
            time_s: datum.time.seconds(),
            covariance: datum.covariance.into(),
        }
    }

    fn parse(self) -> Option<Datum> {
        let is_time = self.time_s.abs() < 1e12;
        let datum = Datum {
            middle: Point3::from(self.middle_m),
            time: Timestamp::EPOCH.plus_seconds(if is_time { self.time_s } else { 0.0 }),
            covariance: SMatrix::from(self.covariance),
        };
        (is_time && datum.is_possible()).then_some(datum)
    }
}

impl FileCamera {
    fn of(camera: &CalibratedCamera) -> Self {
        let intrinsics = camera.camera.model().intrinsics();
        let pose = camera.camera.pose();
        let (model, distortion) = match intrinsics.distortion {
            Distortion::None => (LensModel::Pinhole, Vec::new()),
            Distortion::BrownConrady(k) => (LensModel::BrownConrady, k.to_vec()),
            Distortion::Fisheye(k) => (LensModel::Fisheye, k.to_vec()),
        };
        let rotation = pose.rotation().matrix();
        Self {
            name: camera.name.clone(),
            position_m: pose.position().coords.into(),
            // nalgebra stores matrices by columns.
            rotation: rotation.transpose().into(),
            pose_covariance: camera.pose_covariance.into(),
            lens: FileLens {
                model,
                size: [intrinsics.size.width, intrinsics.size.height],
                focal_px: [intrinsics.fx, intrinsics.fy],
                centre_px: [intrinsics.cx, intrinsics.cy],
                distortion,
                covariance: rows(&camera.lens.covariance),
                pose_by_lens: rows(&camera.lens.pose_by_lens),
            },
            range_m: camera.range_m,
            clock: camera.clock.clone(),
            noise: FileNoise {
                white_px: camera.noise.white_px,
                lasting_px: camera.noise.lasting_px,
                lasting_s: camera.noise.lasting_s,
                frame_s: camera.frame_s,
            },
        }
    }

    fn parse(self) -> Result<CalibratedCamera, SiteFileError> {
        let name = self.name;
        let impossible = |key| SiteFileError::Number { camera: name.clone(), key };
        let geometry = |source| SiteFileError::Camera { camera: name.clone(), source };
        let intrinsics = self.lens.parse().ok_or_else(|| impossible("lens.distortion"))?;
        let lens = self.lens.uncertainty().ok_or_else(|| impossible("lens.covariance"))?;
        if !(self.range_m > 0.0 && self.range_m < 1e6) {
            return Err(impossible("range_m"));
        }
        let rotation = Matrix3::from(self.rotation).transpose();
        if self.position_m.iter().any(|metres| metres.abs() > LARGEST) {
            return Err(impossible("position_m"));
        }
        let pose = Pose::new(rotation, Point3::from(self.position_m)).map_err(geometry)?;
        let camera = Camera::new(intrinsics, pose).map_err(geometry)?;
        if !self.clock.is_possible() {
            return Err(impossible("clock"));
        }
        let FileNoise { white_px, lasting_px, lasting_s, frame_s } = self.noise;
        let is_noise =
            [white_px, lasting_px, lasting_s, frame_s].iter().all(|n| (0.0..1e3).contains(n))
                && white_px > 0.0
                && lasting_s > 0.0
                && frame_s > 0.0;
        if !is_noise {
            return Err(impossible("noise"));
        }
        let pose_covariance = Matrix6::from(self.pose_covariance);
        if !is_covariance(&DMatrix::from_column_slice(6, 6, pose_covariance.as_slice())) {
            return Err(impossible("pose_covariance"));
        }
        let noise = LabelNoise { white_px, lasting_px, lasting_s };
        Ok(CalibratedCamera {
            name,
            camera,
            pose_covariance,
            lens,
            range_m: self.range_m,
            clock: self.clock,
            noise,
            frame_s,
        })
    }
}

/// A matrix row by row.
fn rows(matrix: &DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// Whether a matrix may be a covariance. Its numbers have different units, so it is judged as a
/// correlation matrix.
fn is_covariance(matrix: &DMatrix<f64>) -> bool {
    /// Tolerance for rounding, and for a person who has shortened the numbers. With half of it
    /// numbers shortened to five digits may be refused.
    const ABOUT: f64 = 1e-4;
    if !matrix.iter().all(|value| value.abs() < LARGEST) || matrix.diagonal().min() < 0.0 {
        return false;
    }
    let by = matrix
        .diagonal()
        .map(|variance| if variance > 0.0 { variance.sqrt().recip() } else { 0.0 });
    let correlation =
        DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |i, j| by[i] * matrix[(i, j)] * by[j]);
    let is_symmetric = (&correlation - correlation.transpose()).amax() <= ABOUT;
    is_symmetric && correlation.symmetric_eigenvalues().min() >= -ABOUT
}

/// The matrix of these rows, if they have this size and plausible numbers.
fn matrix(rows: &[Vec<f64>], size: (usize, usize)) -> Option<DMatrix<f64>> {
    let is_whole = rows.len() == size.0 && rows.iter().all(|row| row.len() == size.1);
    let is_number = rows.iter().flatten().all(|value| value.abs() < LARGEST);
    (is_whole && is_number).then(|| DMatrix::from_fn(size.0, size.1, |i, j| rows[i][j]))
}

impl FileLens {
    fn uncertainty(&self) -> Option<LensUncertainty> {
        let count = lens::numbers(&self.parse()?);
        Some(LensUncertainty {
            covariance: matrix(&self.covariance, (count, count)).filter(is_covariance)?,
            pose_by_lens: matrix(&self.pose_by_lens, (6, count))?,
        })
    }

    fn parse(&self) -> Option<Intrinsics> {
        let distortion = match self.model {
            LensModel::Pinhole => Distortion::None,
            LensModel::BrownConrady => {
                Distortion::BrownConrady(self.distortion.as_slice().try_into().ok()?)
            }
            LensModel::Fisheye => Distortion::Fisheye(self.distortion.as_slice().try_into().ok()?),
        };
        let [width, height] = self.size;
        let ([fx, fy], [cx, cy]) = (self.focal_px, self.centre_px);
        Some(Intrinsics { size: ImageSize { width, height }, fx, fy, cx, cy, distortion })
    }
}
