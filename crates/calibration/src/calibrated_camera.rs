//! Calibration of one camera.

use crossfix_geometry::{Bearing, Camera, GeometryError, ImageSize, Pixel, PixelCovariance};
use crossfix_message::{CameraCalibration, CameraName, LastingNoise, Timestamp};
use nalgebra::{Matrix2, Matrix6, Unit, Vector3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::label_noise::LabelNoise;
use crate::lens::{self, LensUncertainty, TargetView};

/// A pixel has no bearing where the lens may be off by more than this many deviations of the
/// labels: in the corners of a wide lens that no flight has crossed it is off by 50 pixels. At
/// three a flight of a minute lost two fifths of its places; with twice it tracks are drawn aside.
const MOST_LENS_SHARE: f64 = 5.0;

/// Why a pixel has no bearing.
#[derive(Debug, Error)]
pub enum BearingError {
    /// The lens model cannot be undone there.
    #[error("the lens shows no direction there")]
    Lens(#[from] GeometryError),
    /// The calibration saw nothing in that part of the image.
    #[error(
        "the lens is known to {sd_px:.0} pixels there: calibrate with a flight or landmarks in \
         that part of the image"
    )]
    Uncovered {
        /// Standard deviation of the lens there, pixels.
        sd_px: f64,
    },
}

/// One camera of a calibrated site.
#[derive(Clone, Debug)]
pub struct CalibratedCamera {
    /// Whose it is.
    pub name: CameraName,
    /// Lens and pose.
    pub camera: Camera,
    /// Covariance of the pose: rotation about the camera's axes (rad), then position (m).
    pub pose_covariance: Matrix6<f64>,
    /// Remaining uncertainty of the lens.
    pub lens: LensUncertainty,
    /// Median range at which the calibration's targets were seen, m.
    pub range_m: f64,
    /// Its clock.
    pub clock: ClockCorrection,
    /// Error of its bearings.
    pub noise: LabelNoise,
    /// Time between its frames, s.
    pub frame_s: f64,
}

/// Correction from a camera's times to common ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClockCorrection {
    /// `[own time, common time less own, standard deviation]`, s, in order of time; linear between
    /// two.
    pub knots_s: Vec<[f64; 3]>,
    /// Rate at which the difference grows before the first knot and after the last, s/s.
    pub rate: f64,
    /// Standard deviation of that, s/s.
    pub rate_sd: f64,
    /// Random walk of the clock in addition, s after one second (it grows with the root of time).
    pub wander_s: f64,
    /// Time between the read-out of the image's first row and its last, s; frames have the time of
    /// the middle row.
    pub readout_s: f64,
}

/// Largest time or clock error that is accepted, s: 30 000 years. With half of it the same.
const LARGEST_S: f64 = 1e12;
/// Least stated pointing error of a camera, pixels. It keeps a covariance from being zero; with
/// half of it the same.
const LEAST_POINTING_PX: f64 = 1e-4;

/// How well a camera points over its image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OverImage {
    /// The share of the image whose pixels have a bearing: elsewhere the lens is not known.
    pub share: f64,
    /// Root mean square of their [`CalibratedCamera::pointing_sd_rad`].
    pub sd_rad: f64,
}

/// Columns and rows of the grid of pixels that stands for an image. With half as many the outermost
/// pixels lie an eighth of the width from the sides, and not an eighteenth: corners that the lens
/// is not known in would not count.
const GRID: [usize; 2] = [9, 5];

/// Pixels evenly spread over an image.
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

/// How far the common time is ahead of a camera's own clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockOffset {
    /// The common time less the camera's own, s.
    pub ahead_s: f64,
    /// Its standard deviation, s.
    pub sd_s: f64,
}

impl CalibratedCamera {
    /// Its message for the cameras' channel, without the site's datum.
    pub(crate) fn message(&self, valid_from: Timestamp) -> CameraCalibration {
        CameraCalibration::new(&self.name, &self.camera, valid_from)
            .with_pose_covariance(&self.pose_covariance)
            .with_lasting_errors(self.lasting_noise(), self.clock.wander_s)
    }

    /// The lasting part of its bearings' noise.
    fn lasting_noise(&self) -> LastingNoise {
        let focal_px = self.camera.model().intrinsics().fx;
        LastingNoise { sd_rad: self.noise.lasting_px / focal_px, time_s: self.noise.lasting_s }
    }

    /// The bearing of a pixel, whose covariance has the white part of the noise and the lens's
    /// uncertainty there.
    ///
    /// # Errors
    /// [`BearingError`] where the lens has no direction, or the lens is not known well enough.
    pub fn bearing(&self, pixel: Pixel) -> Result<Bearing, BearingError> {
        let model = self.camera.model();
        let target = self.seen_target(model.direction(pixel)?, self.range_m);
        let lens = self.lens.covariance_px2(model.intrinsics(), &target);
        // sqrt(tr C / 2): root mean variance over both axes.
        let lens_px = lens.map_or(f64::INFINITY, |lens| (lens.trace() / 2.0).sqrt());
        if lens_px > MOST_LENS_SHARE * self.noise.sd_px() {
            return Err(BearingError::Uncovered { sd_px: lens_px });
        }
        // The lasting part is said in the calibration's message: white noise would average it away.
        let sd_px = self.noise.white_px.hypot(lens_px);
        Ok(model.bearing(pixel, PixelCovariance::isotropic(sd_px))?)
    }

    /// Standard deviation across the line to a target that a pixel shows at a range, from pose and
    /// lens together, rad per axis; `None` where the lens has no direction.
    pub fn pointing_sd_rad(&self, pixel: Pixel, range_m: f64) -> Option<f64> {
        let model = self.camera.model();
        let intrinsics = model.intrinsics();
        let target = self.seen_target(model.direction(pixel).ok()?, range_m);
        let pose = lens::pose_covariance_px2(intrinsics, &target, &self.pose_covariance)?;
        let lens = self.lens.covariance_px2(intrinsics, &target)?;
        // A bearing's covariance must not be zero.
        let least = Matrix2::identity() * LEAST_POINTING_PX.powi(2);
        let bearing = model.bearing(pixel, PixelCovariance(pose + lens + least)).ok()?;
        Some((bearing.covariance().trace() / 2.0).sqrt())
    }

    fn seen_target(&self, direction: Unit<Vector3<f64>>, range_m: f64) -> TargetView<'_> {
        let world_from_camera = self.camera.pose().rotation();
        TargetView { direction: direction.into_inner(), range_m, world_from_camera }
    }

    /// Standard deviation of a bearing due to the lens alone, at the calibration's range: root mean
    /// square over the pixels that have a bearing, rad per axis.
    pub fn lens_sd_rad(&self) -> f64 {
        let exact = Self { pose_covariance: Matrix6::zeros(), ..self.clone() };
        exact.over_image().sd_rad
    }

    /// How well it points over the whole image, at the calibration's range.
    pub fn over_image(&self) -> OverImage {
        let pixels = grid(self.camera.model().intrinsics().size);
        let known: Vec<Pixel> = pixels.filter(|pixel| self.bearing(*pixel).is_ok()).collect();
        let deviations = known.iter().filter_map(|p| self.pointing_sd_rad(*p, self.range_m));
        let squares: f64 = deviations.map(|sd| sd * sd).sum();
        let share = known.len() as f64 / (GRID[0] * GRID[1]) as f64;
        OverImage { share, sd_rad: (squares / known.len().max(1) as f64).sqrt() }
    }

    /// The common time of a row of a frame, from the frame's time by the camera's own clock, and
    /// its standard deviation, s.
    pub fn common_time(&self, own: Timestamp, row: f64) -> (Timestamp, f64) {
        let height = f64::from(self.camera.model().intrinsics().size.height);
        let ClockOffset { ahead_s, sd_s } = self.clock.at(own.seconds());
        // The frame's time is that of the middle row.
        let row_s = self.clock.readout_s * (row / height - 0.5);
        (own.plus_seconds(ahead_s + row_s), sd_s)
    }
}

impl ClockCorrection {
    /// No correction: the camera's times are the common ones, as good as the camera states.
    pub(crate) fn none() -> Self {
        Self { knots_s: Vec::new(), rate: 0.0, rate_sd: 0.0, wander_s: 0.0, readout_s: 0.0 }
    }

    /// The correction at one of its times.
    pub fn at(&self, own_s: f64) -> ClockOffset {
        let after = self.knots_s.partition_point(|knot| knot[0] <= own_s);
        match (after.checked_sub(1).and_then(|k| self.knots_s.get(k)), self.knots_s.get(after)) {
            (Some(before), Some(next)) => {
                let share = (own_s - before[0]) / (next[0] - before[0]);
                let between = |k: usize| before[k] + (next[k] - before[k]) * share;
                ClockOffset { ahead_s: between(1), sd_s: between(2) }
            }
            (Some(last), None) => self.extrapolated(last, own_s),
            (None, Some(first)) => self.extrapolated(first, own_s),
            (None, None) => ClockOffset { ahead_s: 0.0, sd_s: 0.0 },
        }
    }

    /// The correction before the first knot or after the last.
    fn extrapolated(&self, knot: &[f64; 3], own_s: f64) -> ClockOffset {
        let away = own_s - knot[0];
        // Beyond the knots: the end's variance, the rate's times away^2, and the random walk's
        // times |away|.
        let variance =
            knot[2].powi(2) + (self.rate_sd * away).powi(2) + self.wander_s.powi(2) * away.abs();
        ClockOffset { ahead_s: knot[1] + self.rate * away, sd_s: variance.sqrt() }
    }

    pub(crate) fn is_possible(&self) -> bool {
        let numbers = self.knots_s.iter().flatten();
        let rest = [self.rate, self.rate_sd, self.wander_s, self.readout_s];
        numbers.chain(&rest).all(|value| value.abs() < LARGEST_S)
            && self.knots_s.windows(2).all(|pair| pair[0][0] < pair[1][0])
            && self.knots_s.iter().all(|knot| knot[2] >= 0.0)
            && self.rate.abs() < 0.1
            && (0.0..1.0).contains(&self.rate_sd)
            && (0.0..1.0).contains(&self.wander_s)
            && self.readout_s.abs() < 1.0
    }
}
