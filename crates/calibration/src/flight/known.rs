//! Priors of cameras from an earlier calibration.

use crossfix_geometry::turn_vector;
use nalgebra::{DMatrix, DVector, Rotation3};

use super::model::{CameraLabels, POSE_AND_CLOCK};
use super::noise::Tails;
use super::normal::Derivative;
use super::rows::{ResidualRow, Sink};
use super::state::{Flight, FlightState};
use crate::calibrated_camera::CalibratedCamera;
use crate::lens;

/// Least standard deviation of a known pose or lens: a covariance of zeros has no Cholesky factor.
/// In the unknowns' units (rad and m of a pose). With half of it the same.
const LEAST_SD: f64 = 1e-6;

impl Flight<'_> {
    /// An earlier calibration of a camera, if that has the same kind of lens.
    pub(super) fn known(&self, index: usize) -> Option<&CalibratedCamera> {
        let CameraLabels { name, intrinsics, .. } = &self.cameras[index];
        let known = self.survey.known(name)?;
        let has_same_kind =
            lens::numbers(known.camera.model().intrinsics()) == lens::numbers(intrinsics);
        has_same_kind.then_some(known)
    }
}

impl FlightState {
    /// Rows of a camera's pose and lens by an earlier calibration. The pose is correlated with the
    /// lens; the stated pose covariance is what remains once the lens is known. The camera may have
    /// been moved since, so its tails are heavy.
    pub(super) fn known_rows(
        &self,
        index: usize,
        start: usize,
        flight: &Flight<'_>,
        sink: &mut impl Sink,
    ) {
        let Some(known) = flight.known(index) else { return };
        let camera = &self.cameras[index];
        let lens = lens_step(known, camera);
        let pose = pose_step(known, camera);
        let by_lens = &known.lens.pose_by_lens;
        let covariance = DMatrix::from_column_slice(6, 6, known.pose_covariance.as_slice());
        if let Some(whitened) = whitening(&covariance) {
            // L^-1 (pose - B lens), B the pose's regression on the lens: what the lens does not
            // explain of the pose.
            let beside = &whitened * (&pose - by_lens * &lens);
            let follows = -(&whitened * by_lens);
            let rows = (0..6).map(|axis| {
                let of_lens = terms(start + POSE_AND_CLOCK, &follows, axis);
                (terms(start, &whitened, axis).chain(of_lens).collect(), beside[axis])
            });
            sink.take(&rows.collect::<Vec<ResidualRow>>(), Tails::Known);
        }
        if let Some(whitened) = whitening(&known.lens.covariance) {
            let beside = &whitened * &lens;
            let rows = (0..beside.len()).map(|axis| {
                (terms(start + POSE_AND_CLOCK, &whitened, axis).collect(), beside[axis])
            });
            sink.take(&rows.collect::<Vec<ResidualRow>>(), Tails::Known);
        }
    }
}

/// A row of a matrix as derivatives by successive unknowns, from the one at `start` on.
fn terms(start: usize, matrix: &DMatrix<f64>, row: usize) -> impl Iterator<Item = Derivative> {
    (0..matrix.ncols()).map(move |k| (start + k, matrix[(row, k)]))
}

/// Step from the known pose to the state's: a turn about the camera's axes (rad), and its centre
/// (m).
fn pose_step(known: &CalibratedCamera, camera: &super::model::CameraUnknowns) -> DVector<f64> {
    let pose = known.camera.pose();
    let turn = Rotation3::from_matrix_unchecked(
        pose.rotation().matrix().transpose() * camera.rotation.matrix(),
    );
    let moved = camera.centre - pose.position();
    DVector::from_iterator(6, turn_vector(&turn).iter().chain(moved.iter()).copied())
}

fn lens_step(known: &CalibratedCamera, camera: &super::model::CameraUnknowns) -> DVector<f64> {
    let known = lens::values(known.camera.model().intrinsics());
    let now = lens::values(&camera.intrinsics);
    DVector::from_iterator(known.len().min(now.len()), now.iter().zip(&known).map(|(a, b)| a - b))
}

/// The matrix that makes errors with this covariance independent with unit variance, L^-1 of
/// `P = L L'`.
fn whitening(covariance: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let size = covariance.nrows();
    let least = DMatrix::identity(size, size) * LEAST_SD.powi(2);
    (covariance + least).cholesky()?.l().try_inverse()
}
