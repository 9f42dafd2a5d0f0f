//! `calibration.toml`: what is known of a site's cameras, as `crossfix calibrate` writes it.

use crossfix_geometry::{
    Bearing, Camera, Distortion, GeometryError, ImageSize, Intrinsics, Pixel, PixelCovariance, Pose,
};
use crossfix_message::{CameraCalibration, CameraName, Datum, LastingNoise, Timestamp};
use nalgebra::{DMatrix, Matrix2, Matrix3, Matrix6, Point3, SMatrix};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::flight::{CameraResult, FlightResult, LabelNoise};
use crate::landmarks::LandmarkResult;
use crate::lens::{self, LensUncertainty};

/// Where the lens may be off by so many times what labels err by, a pixel shows no direction: in
/// the corners of a wide lens that no flight has crossed it is off by 50 pixels. At three a flight of
/// a minute lost two fifths of its places; with twice it tracks are drawn aside.
const MOST_LENS_SHARE: f64 = 5.0;

/// Why a pixel has no bearing.
#[derive(Debug, Error)]
pub enum BearingError {
    /// The lens model cannot be undone there.
    #[error("the lens shows no direction there")]
    Lens(#[from] GeometryError),
    /// The calibration's flight did not cross that part of the image.
    #[error(
        "the lens is known to {sd_px:.0} pixels there: calibrate with a flight through that part of the image"
    )]
    Uncovered {
        /// What it may be off by, pixels.
        sd_px: f64,
    },
}

/// The form of the file that this build writes, and the only one that it reads.
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
    /// Numbers that are no camera's.
    #[error("the numbers of camera `{camera}` describe no camera")]
    Camera {
        /// The camera.
        camera: CameraName,
        /// What is wrong.
        #[source]
        source: GeometryError,
    },
    /// A datum that cannot be.
    #[error("`datum` is impossible")]
    Datum,
    /// A covariance, a clock or a deviation that cannot be.
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

/// One camera of it.
#[derive(Clone, Debug)]
pub struct CalibratedCamera {
    /// Whose it is.
    pub name: CameraName,
    /// Lens and pose.
    pub camera: Camera,
    /// Covariance of the pose: rotation about the camera's axes (rad), then position (m).
    pub pose_covariance: Matrix6<f64>,
    /// What is still unknown of the lens.
    pub lens: LensUncertainty,
    /// Range at which the calibration's targets were seen, in the middle, m.
    pub range_m: f64,
    /// Its clock.
    pub clock: ClockCorrection,
    /// What its bearings err by.
    pub noise: LabelNoise,
    /// Time between its frames, s.
    pub frame_s: f64,
}

/// How a camera's times become common ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClockCorrection {
    /// `[own time, common time less own, standard deviation]`, s, in order of time; between two it
    /// is straight.
    pub knots_s: Vec<[f64; 3]>,
    /// How the difference grows before the first knot and after the last, s/s.
    pub rate: f64,
    /// Standard deviation of that, s/s.
    pub rate_sd: f64,
    /// What the clock wanders beside, s after one second (it grows with the time's root).
    pub wander_s: f64,
    /// Time between the read-out of the image's first row and its last, s; frames have the time of
    /// the middle row.
    pub readout_s: f64,
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
        let cameras = file.cameras.into_iter().map(FileCamera::parse).collect::<Result<_, _>>()?;
        let datum =
            file.datum.map(|datum| datum.parse().ok_or(SiteFileError::Datum)).transpose()?;
        Ok(Self { cameras, datum })
    }

    /// The file's text, without its first lines that say where it is from.
    pub fn to_toml(&self) -> String {
        let cameras = self.cameras.iter().map(FileCamera::of).collect();
        let datum = self.datum.as_ref().map(FileDatum::of);
        toml::to_string(&File { form: FORM, datum, cameras }).unwrap_or_default()
    }

    /// A site of these cameras, of which nobody knows what they are off by together.
    pub fn of(cameras: Vec<CalibratedCamera>) -> Self {
        Self { cameras, datum: None }
    }

    /// Takes a camera in by a picture of it, which tells pose and lens: where the site has one of its
    /// name, that one's clock and noise stay.
    pub fn put(&mut self, picture: &LandmarkResult) {
        let camera = CalibratedCamera::from(picture);
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

    /// What the site may be off by as a whole, if the file says so.
    pub fn datum(&self) -> Option<&Datum> {
        self.datum.as_ref()
    }

    /// What the cameras' channel says of a camera of the file.
    pub fn message(&self, camera: &CalibratedCamera, valid_from: Timestamp) -> CameraCalibration {
        let message = camera.message(valid_from);
        self.datum.iter().fold(message, CameraCalibration::with_datum)
    }

    /// The camera of this name.
    pub fn camera(&self, name: &CameraName) -> Option<&CalibratedCamera> {
        self.cameras.iter().find(|camera| camera.name == *name)
    }
}

impl From<&FlightResult> for SiteCalibration {
    fn from(result: &FlightResult) -> Self {
        let cameras = result.cameras.iter().map(CalibratedCamera::from).collect();
        Self { cameras, datum: result.datum.clone() }
    }
}

impl From<&CameraResult> for CalibratedCamera {
    fn from(result: &CameraResult) -> Self {
        let clock = &result.clock;
        let knots_s =
            clock.knots.iter().map(|knot| [knot.time_s, knot.ahead_s, knot.sd_s]).collect();
        Self {
            name: result.name.clone(),
            camera: result.camera.clone(),
            pose_covariance: result.pose_covariance,
            lens: result.lens.clone(),
            range_m: result.range_m,
            clock: ClockCorrection {
                knots_s,
                rate: clock.rate,
                rate_sd: clock.rate_sd,
                wander_s: clock.wander.sqrt(),
                readout_s: clock.readout_s,
            },
            noise: result.noise,
            frame_s: result.frame_s,
        }
    }
}

/// What trackers err by where no flight has shown it: the middle of what hands did on the cameras of
/// data sets 1 and 3.
const USUAL_NOISE: LabelNoise = LabelNoise { white_px: 0.2, lasting_px: 0.5, lasting_s: 1.0 };
/// Where nobody has said how often a camera takes pictures, s.
const USUAL_FRAME_S: f64 = 1.0 / 30.0;

impl From<&LandmarkResult> for CalibratedCamera {
    /// A picture tells nothing of the clock: its times stay what they are.
    fn from(result: &LandmarkResult) -> Self {
        Self {
            name: result.name.clone(),
            camera: result.camera.clone(),
            pose_covariance: result.pose_covariance,
            lens: result.lens.clone(),
            range_m: result.range_m,
            clock: ClockCorrection::none(),
            noise: USUAL_NOISE,
            frame_s: USUAL_FRAME_S,
        }
    }
}

/// No camera is said to point better than this, pixels.
const LEAST_POINTING_PX: f64 = 1e-4;

/// How well a camera points over its image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OverImage {
    /// The share of the image whose pixels have a bearing: elsewhere the lens is not known.
    pub share: f64,
    /// Root mean square of their [`CalibratedCamera::pointing_sd_rad`].
    pub sd_rad: f64,
}

/// Columns and rows of the pixels that stand for an image.
const GRID: [usize; 2] = [9, 5];

/// Pixels evenly over an image.
pub(crate) fn grid(size: ImageSize) -> impl Iterator<Item = Pixel> {
    let [columns, rows] = GRID;
    (0..columns * rows).map(move |k| {
        let share = |k: usize, count: usize| (k as f64 + 0.5) / count as f64;
        Pixel::new(
            share(k % columns, columns) * f64::from(size.width),
            share(k / columns, rows) * f64::from(size.height),
        )
    })
}

impl CalibratedCamera {
    /// What the cameras' channel says of it alone.
    fn message(&self, valid_from: Timestamp) -> CameraCalibration {
        CameraCalibration::new(&self.name, &self.camera, valid_from)
            .with_pose_covariance(&self.pose_covariance)
            .with_lasting_errors(self.lasting_noise(), self.clock.wander_s)
    }

    /// What of its bearings' noise lasts.
    fn lasting_noise(&self) -> LastingNoise {
        let focal_px = self.camera.model().intrinsics().fx;
        LastingNoise { sd_rad: self.noise.lasting_px / focal_px, time_s: self.noise.lasting_s }
    }

    /// The bearing of a pixel, with the part of its noise that is new in every frame and what the
    /// lens may be off by there.
    ///
    /// # Errors
    /// [`BearingError`] where the lens has no direction, or nobody knows which.
    pub fn bearing(&self, pixel: Pixel) -> Result<Bearing, BearingError> {
        let model = self.camera.model();
        let place = (self.range_m, self.camera.pose().rotation());
        let direction = model.direction(pixel)?;
        let lens = self.lens.covariance_px2(model.intrinsics(), &direction, place);
        let lens_px = lens.map_or(f64::INFINITY, |lens| (lens.trace() / 2.0).sqrt());
        if lens_px > MOST_LENS_SHARE * self.noise.sd_px() {
            return Err(BearingError::Uncovered { sd_px: lens_px });
        }
        let sd_px = self.noise.white_px.hypot(lens_px);
        Ok(model.bearing(pixel, PixelCovariance::isotropic(sd_px))?)
    }

    /// Standard deviation across the line to a target that a pixel shows at a range, pose and lens
    /// together, rad per axis; `None` where the lens shows nothing.
    pub fn pointing_sd_rad(&self, pixel: Pixel, range_m: f64) -> Option<f64> {
        let model = self.camera.model();
        let intrinsics = model.intrinsics();
        let direction = model.direction(pixel).ok()?.into_inner();
        let place = (range_m, self.camera.pose().rotation());
        let pose = lens::pose_covariance_px2(intrinsics, &direction, place, &self.pose_covariance)?;
        let lens = self.lens.covariance_px2(intrinsics, &direction, place)?;
        // No covariance of a bearing is nothing.
        let least = Matrix2::identity() * LEAST_POINTING_PX.powi(2);
        let bearing = model.bearing(pixel, PixelCovariance(pose + lens + least)).ok()?;
        Some((bearing.covariance().trace() / 2.0).sqrt())
    }

    /// How well targets are pointed at over the whole image, at the calibration's range.
    pub fn over_image(&self) -> OverImage {
        let pixels = grid(self.camera.model().intrinsics().size);
        let known: Vec<Pixel> = pixels.filter(|pixel| self.bearing(*pixel).is_ok()).collect();
        let deviations = known.iter().filter_map(|p| self.pointing_sd_rad(*p, self.range_m));
        let squares: f64 = deviations.map(|sd| sd * sd).sum();
        let share = known.len() as f64 / (GRID[0] * GRID[1]) as f64;
        OverImage { share, sd_rad: (squares / known.len().max(1) as f64).sqrt() }
    }

    /// The common time of a row of a frame, from the frame's by the camera's own clock, and the
    /// standard deviation, s.
    pub fn common_time(&self, own: Timestamp, row: f64) -> (Timestamp, f64) {
        let height = f64::from(self.camera.model().intrinsics().size.height);
        let (ahead_s, sd_s) = self.clock.at(own.seconds());
        let row_s = self.clock.readout_s * (row / height - 0.5);
        (own.plus_seconds(ahead_s + row_s), sd_s)
    }
}

impl ClockCorrection {
    /// None: the camera's times are the common ones, as good as the camera says.
    fn none() -> Self {
        Self { knots_s: Vec::new(), rate: 0.0, rate_sd: 0.0, wander_s: 0.0, readout_s: 0.0 }
    }

    /// What one of its times is to be corrected by, and the standard deviation, s.
    pub fn at(&self, own_s: f64) -> (f64, f64) {
        let after = self.knots_s.partition_point(|knot| knot[0] <= own_s);
        let beyond = |knot: &[f64; 3]| {
            let away = own_s - knot[0];
            let variance = knot[2].powi(2)
                + (self.rate_sd * away).powi(2)
                + self.wander_s.powi(2) * away.abs();
            (knot[1] + self.rate * away, variance.sqrt())
        };
        match (after.checked_sub(1).and_then(|k| self.knots_s.get(k)), self.knots_s.get(after)) {
            (Some(before), Some(next)) => {
                let share = (own_s - before[0]) / (next[0] - before[0]);
                let between = |k: usize| before[k] + (next[k] - before[k]) * share;
                (between(1), between(2))
            }
            (Some(last), None) => beyond(last),
            (None, Some(first)) => beyond(first),
            (None, None) => (0.0, 0.0),
        }
    }

    fn is_possible(&self) -> bool {
        let numbers = self.knots_s.iter().flatten();
        let rest = [self.rate, self.rate_sd, self.wander_s, self.readout_s];
        numbers.chain(&rest).all(|value| value.is_finite())
            && self.knots_s.windows(2).all(|pair| pair[0][0] < pair[1][0])
            && self.knots_s.iter().all(|knot| knot[2] >= 0.0)
            && self.rate.abs() < 0.1
            && self.rate_sd >= 0.0
            && self.wander_s >= 0.0
            && self.readout_s.abs() < 1.0
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
            // nalgebra stores columns first.
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
        let is_covariance = pose_covariance.iter().all(|value| value.is_finite())
            && pose_covariance.symmetric_eigenvalues().min() >= -1e-9 * pose_covariance.amax();
        if !is_covariance {
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

/// The matrix of these rows, if they make one of this size and of finite numbers.
fn matrix(rows: &[Vec<f64>], size: (usize, usize)) -> Option<DMatrix<f64>> {
    let is_whole = rows.len() == size.0 && rows.iter().all(|row| row.len() == size.1);
    let is_finite = rows.iter().flatten().all(|value| value.is_finite());
    (is_whole && is_finite).then(|| DMatrix::from_fn(size.0, size.1, |i, j| rows[i][j]))
}

impl FileLens {
    fn uncertainty(&self) -> Option<LensUncertainty> {
        let count = lens::numbers(&self.parse()?);
        Some(LensUncertainty {
            covariance: matrix(&self.covariance, (count, count))?,
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
