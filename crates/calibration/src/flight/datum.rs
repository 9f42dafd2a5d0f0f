//! The datum: the error that a site has as a whole, separate from the errors of its single cameras.
//!
//! A log good to metres shifts all cameras of a site alike. That does not affect tracks within the
//! site, and cameras that were each stated to be off by metres independently would be weighted
//! wrongly.

use crossfix_message::{Datum, Timestamp};
use nalgebra::{DMatrix, DVector, Point3, SMatrix, Vector3};

use super::model::{CLOCK, CameraUnknowns};
use super::state::FlightState;

/// Without a log the common time is one camera's, whose clock may show anything: its deviation, s.
/// With half of it the same.
const UNKNOWN_S: f64 = 1e3;

/// How the unknowns of a site's cameras follow its datum.
pub(super) struct Followers {
    middle: Point3<f64>,
    time_s: f64,
    /// Derivatives of the cameras' own unknowns (rows) by the datum's components (columns).
    by_datum: DMatrix<f64>,
}

/// How the datum follows from the cameras' differences, and how well that is known.
pub(super) struct DatumEstimator {
    /// The datum's components (rows) from the cameras' differences (columns).
    gain: DMatrix<f64>,
    /// Information on the datum, ...
    information: DMatrix<f64>,
    /// ... and the datum's part of the covariance of the cameras' own unknowns.
    of_cameras: DMatrix<f64>,
}

impl Followers {
    /// Those of all cameras.
    pub(super) fn of(state: &FlightState) -> Self {
        let count = state.cameras.len().max(1) as f64;
        let centres = state.cameras.iter().map(|camera| camera.centre.coords);
        let middle = Point3::from(centres.sum::<Vector3<f64>>() / count);
        let reference = |camera: &CameraUnknowns| camera.clock.common_s(camera.clock.reference_s);
        let time_s = state.cameras.iter().map(reference).sum::<f64>() / count;
        let (first, starts) = (state.order().chain(), state.starts());
        let unknowns = starts.last().copied().unwrap_or(first) - first;
        let mut by_datum = DMatrix::zeros(unknowns, Datum::WAYS);
        for (camera, start) in state.cameras.iter().zip(&starts) {
            let arm = camera.centre - middle;
            let mut part = by_datum.rows_mut(start - first, CLOCK + 2);
            // A turn of the site turns each camera (seen in its own axes) and moves its centre by
            // turn x arm = -[arm]x turn; growth moves it along the arm.
            let turn = camera.rotation.matrix().transpose();
            part.view_mut((0, Datum::TURN), (3, 3)).copy_from(&turn);
            part.view_mut((3, 0), (3, 3)).fill_with_identity();
            part.view_mut((3, Datum::TURN), (3, 3)).copy_from(&-arm.cross_matrix());
            part.view_mut((3, Datum::GROWTH), (3, 1)).copy_from(&arm);
            part[(CLOCK, Datum::LATE)] = 1.0;
            // A common time that gains by s: s (t - middle) in the offset at the clock's reference,
            // s in its rate.
            part[(CLOCK, Datum::SLOW)] = reference(camera) - time_s;
            part[(CLOCK + 1, Datum::SLOW)] = 1.0;
        }
        Self { middle, time_s, by_datum }
    }

    /// The followers among these unknowns alone.
    pub(super) fn rows(&self, rows: &[usize]) -> Self {
        Self { by_datum: self.by_datum.select_rows(rows), ..*self }
    }

    /// The datum that cameras show with this information on them.
    ///
    /// Of all splits into a common part and a rest per camera, this is the one in which the two are
    /// uncorrelated: `D = (H' N H)^-1` where the cameras follow the datum by H and N is the
    /// information. Better known cameras count for more in it than poorly known ones. `None`: there
    /// is no information.
    pub(super) fn estimator(&self, information: &DMatrix<f64>) -> Option<DatumEstimator> {
        let weighed = information * &self.by_datum;
        let on_datum = self.by_datum.tr_mul(&weighed);
        let covariance = inverse_of_what_is_shown(&on_datum)?;
        // D H' N gives the datum from the cameras' differences; H D H' is its part of their
        // covariance.
        let gain = &covariance * weighed.transpose();
        let of_cameras = &self.by_datum * &covariance * self.by_datum.transpose();
        Some(DatumEstimator { gain, information: on_datum, of_cameras })
    }

    /// The cameras' differences with the datum's part removed.
    pub(super) fn without_datum(
        &self,
        shown: &DatumEstimator,
        differences: &DVector<f64>,
    ) -> DVector<f64> {
        differences - &self.by_datum * (&shown.gain * differences)
    }

    /// The site's datum, where `prior_information` of the information on it comes from no
    /// measurement.
    pub(super) fn datum(
        &self,
        shown: &DatumEstimator,
        prior_information: &DMatrix<f64>,
        is_timeless: bool,
    ) -> Datum {
        let mut covariance = bounded_inverse(&(&shown.information - prior_information));
        if is_timeless {
            // The spline's knots stand at fixed times, which adds a little information on the
            // lateness that no measurement gave.
            covariance[(Datum::LATE, Datum::LATE)] += UNKNOWN_S * UNKNOWN_S;
        }
        Datum {
            middle: self.middle,
            time: Timestamp::EPOCH.plus_seconds(self.time_s),
            covariance: SMatrix::from_fn(|i, j| covariance[(i, j)]),
        }
    }

    /// Number of unknowns.
    pub(super) fn unknowns(&self) -> usize {
        self.by_datum.nrows()
    }
}

impl DatumEstimator {
    /// Matrix that gives the datum's components from the cameras' differences.
    pub(super) fn into_gain(self) -> DMatrix<f64> {
        self.gain
    }

    /// The datum's part of the covariance of the cameras' own unknowns.
    pub(super) fn of_cameras(&self) -> &DMatrix<f64> {
        &self.of_cameras
    }
}

/// Deviations of components that nothing determines, in the place of infinite ones: shift (m), turn
/// (rad), growth, lateness (s), slowness. With half of them a site whose place nobody has surveyed
/// is stated to be known to 150 m, and counts for more than it should beside sites that are known.
const UNKNOWN: [f64; Datum::WAYS] = [300.0, 300.0, 300.0, 3.0, 3.0, 3.0, 3.0, 30.0, 0.1];

/// Inverse of the information on a datum, with no deviation larger than [`UNKNOWN`].
fn bounded_inverse(information: &DMatrix<f64>) -> DMatrix<f64> {
    let scale = DMatrix::from_diagonal(&DVector::from_row_slice(&UNKNOWN));
    // In units of UNKNOWN an eigenvalue below 1 means: known less well than that.
    let scaled = &scale * information * &scale;
    let eigen = ((&scaled + scaled.transpose()) * 0.5).symmetric_eigen();
    let inverse = eigen.eigenvalues.map(|value| value.max(1.0).recip());
    let axes = &scale * &eigen.eigenvectors;
    &axes * DMatrix::from_diagonal(&inverse) * axes.transpose()
}

/// Inverse over the components that have information, zero elsewhere: a single camera has no size
/// that could be wrong.
fn inverse_of_what_is_shown(information: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let mut inverse = DMatrix::zeros(information.nrows(), information.ncols());
    let shown: Vec<usize> =
        (0..information.nrows()).filter(|&way| information[(way, way)] != 0.0).collect();
    let part = information.select_rows(&shown).select_columns(&shown);
    let part = part.cholesky()?.inverse();
    for (i, &row) in shown.iter().enumerate() {
        for (j, &column) in shown.iter().enumerate() {
            // Rounding leaves it not quite symmetric.
            inverse[(row, column)] = f64::midpoint(part[(i, j)], part[(j, i)]);
        }
    }
    Some(inverse)
}
