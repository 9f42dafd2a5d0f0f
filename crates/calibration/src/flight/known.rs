//! What an earlier calibration says of cameras.

use crossfix_geometry::turn_vector;
use nalgebra::{DMatrix, DVector, Rotation3};

use super::adjustment::{Flight, Row, Sink, State};
use super::model::{CameraLabels, POSE_AND_CLOCK};
use super::noise::Tails;
use super::results::{CameraResult, FlightResult};
use crate::calibrated_camera::CalibratedCamera;
use crate::lens;
use crate::survey::Survey;

/// No pose is said to be known better than this, rad and m: of zeros there is no root.
const LEAST_SD: f64 = 1e-6;

impl Flight<'_> {
    /// What an earlier calibration says of a camera, if that is of the same kind of lens.
    pub(super) fn known(&self, index: usize) -> Option<&CalibratedCamera> {
        let CameraLabels { name, intrinsics, .. } = &self.cameras[index];
        let is_alike = |known: &&CalibratedCamera| {
            lens::numbers(known.camera.model().intrinsics()) == lens::numbers(intrinsics)
        };
        self.survey.known(name).filter(is_alike)
    }
}

impl State {
    /// A camera's pose and lens by an earlier calibration. The pose follows the lens, and what is said of
    /// it is beside that. The camera may have been moved since, so its tails are heavy.
    pub(super) fn known_rows(
        &self,
        index: usize,
        start: usize,
        flight: &Flight<'_>,
        sink: &mut impl Sink,
    ) {
        let Some(known) = flight.known(index) else { return };
        let camera = &self.cameras[index];
        let count = lens::numbers(&camera.intrinsics);
        let lens = lens_step(known, camera);
        let pose = pose_step(known, camera);
        let by_lens = &known.lens.pose_by_lens;
        let covariance = DMatrix::from_column_slice(6, 6, known.pose_covariance.as_slice());
        if let Some(whitened) = whitening(&covariance) {
            let beside = &whitened * (&pose - by_lens * &lens);
            let follows = &whitened * by_lens;
            let row = |axis: usize| -> Row {
                let of_pose = (0..6).map(|k| (start + k, whitened[(axis, k)]));
                let of_lens = (0..count).map(|k| (start + POSE_AND_CLOCK + k, -follows[(axis, k)]));
                (of_pose.chain(of_lens).collect(), beside[axis])
            };
            sink.take(&(0..6).map(row).collect::<Vec<_>>(), Tails::Known);
        }
        if let Some(whitened) = whitening(&known.lens.covariance) {
            let beside = &whitened * &lens;
            let row = |axis: usize| -> Row {
                let terms = (0..count).map(|k| (start + POSE_AND_CLOCK + k, whitened[(axis, k)]));
                (terms.collect(), beside[axis])
            };
            sink.take(&(0..count).map(row).collect::<Vec<_>>(), Tails::Known);
        }
    }
}

/// No clock is taken to be known better than this at another time than it was calibrated, s: of zeros there
/// is no mean.
const LEAST_CLOCK_SD_S: f64 = 1e-3;
/// The lateness among a datum's ways.
const LATE: usize = 7;

/// Holds a site as a whole where an earlier calibration has it: it may be off by what was said then. Its
/// common time is that which the cameras' clocks showed by what was known of them.
pub(super) fn hold_site(result: &mut FlightResult, survey: &Survey) {
    if let (Some(datum), Some(known)) = (&mut result.datum, survey.known_datum()) {
        *datum = known.clone();
    }
    let Some((later_s, sd_s)) = later(result, survey) else { return };
    for camera in &mut result.cameras {
        camera.clock.knots.iter_mut().for_each(|knot| knot.ahead_s += later_s);
        camera.fitted.iter_mut().for_each(|label| label.time_s += later_s);
    }
    if let Some(datum) = &mut result.datum {
        datum.covariance[(LATE, LATE)] += sd_s * sd_s;
    }
}

/// By how much the common time is later by what was known of the clocks, and its standard deviation, s: the
/// middle of what the cameras say, as one may have been set anew. Clocks that no flight has calibrated say
/// nothing.
fn later(result: &FlightResult, survey: &Survey) -> Option<(f64, f64)> {
    let says = |found: &CameraResult| {
        let known = survey.known(&found.name)?;
        known.clock.knots_s.first()?;
        let middle = found.clock.knots.get(found.clock.knots.len() / 2)?;
        let (ahead_s, sd_s) = known.clock.at(middle.time_s);
        Some((ahead_s - middle.ahead_s, sd_s.max(LEAST_CLOCK_SD_S)))
    };
    let mut said: Vec<(f64, f64)> = result.cameras.iter().filter_map(says).collect();
    said.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half: f64 = said.iter().map(|(_, sd_s)| sd_s.powi(-2)).sum::<f64>() / 2.0;
    let mut below = 0.0;
    let (middle, _) = *said.iter().find(|(_, sd_s)| {
        below += sd_s.powi(-2);
        below >= half
    })?;
    // A median's variance is pi / 2 times a mean's, or more where the cameras lie farther apart than they say.
    let beside: f64 =
        said.iter().map(|(later_s, sd_s)| ((later_s - middle) / sd_s).abs().min(3.0).powi(2)).sum();
    let spread = (beside / said.len() as f64).max(1.0);
    Some((middle, (std::f64::consts::FRAC_PI_2 * spread / (2.0 * half)).sqrt()))
}

/// From the known pose to the state's: a turn about the camera's axes (rad), and its centre (m).
fn pose_step(known: &CalibratedCamera, camera: &super::model::CameraState) -> DVector<f64> {
    let pose = known.camera.pose();
    let turn = Rotation3::from_matrix_unchecked(
        pose.rotation().matrix().transpose() * camera.rotation.matrix(),
    );
    let moved = camera.centre - pose.position();
    DVector::from_iterator(6, turn_vector(&turn).iter().chain(moved.iter()).copied())
}

fn lens_step(known: &CalibratedCamera, camera: &super::model::CameraState) -> DVector<f64> {
    let known = lens::values(known.camera.model().intrinsics());
    let now = lens::values(&camera.intrinsics);
    DVector::from_iterator(known.len().min(now.len()), now.iter().zip(&known).map(|(a, b)| a - b))
}

/// What makes errors of a covariance independent and of deviation one.
fn whitening(covariance: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let size = covariance.nrows();
    let least = DMatrix::identity(size, size) * LEAST_SD.powi(2);
    (covariance + least).cholesky()?.l().try_inverse()
}
