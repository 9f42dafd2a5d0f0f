//! What a site is off by as a whole, and what its cameras are off by beside that.
//!
//! A log of metres puts all cameras of a site aside alike. Tracks within the site do not feel it, and
//! cameras that were each said to be off by metres of their own would be weighed wrongly.

use nalgebra::{DMatrix, Point3, SMatrix, Vector3};

use super::adjustment::State;
use super::model::{CLOCK, CameraState};
use super::normal::Covariance;

/// Ways in which a site may be off as a whole: shifted (3), turned (3), too large, late, slow.
const WAYS: usize = 9;
const TURN: usize = 3;
const SCALE: usize = 6;
const TIME: usize = 7;
const RATE: usize = 8;

/// What a site may be off by as a whole.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Datum {
    /// Where it turns and grows about: the middle of its cameras, local ENU, m.
    pub middle: Point3<f64>,
    /// The time at which its clocks are late together, s.
    pub time_s: f64,
    /// Covariance of shift (m), turn (rad), growth (a ratio), lateness (s) and slowness (a ratio).
    pub covariance: SMatrix<f64, WAYS, WAYS>,
}

impl Datum {
    /// Standard deviations, in the order of the covariance.
    pub fn sd(&self) -> [f64; WAYS] {
        std::array::from_fn(|k| self.covariance[(k, k)].max(0.0).sqrt())
    }

    /// The covariance of a place in the site that is at rest, m^2.
    pub fn of_place(&self, place: Point3<f64>) -> nalgebra::Matrix3<f64> {
        let arm = place - self.middle;
        let mut by_datum = SMatrix::<f64, 3, TIME>::zeros();
        by_datum.fixed_columns_mut::<3>(0).fill_with_identity();
        by_datum.fixed_columns_mut::<3>(TURN).copy_from(&-arm.cross_matrix());
        by_datum.set_column(SCALE, &arm);
        by_datum * self.covariance.fixed_view::<TIME, TIME>(0, 0) * by_datum.transpose()
    }
}

impl Datum {
    /// The datum's part of what is unknown of a site's cameras, and how they follow it.
    ///
    /// Of all splits into a common part and a rest that is each camera's, this is the one in which the
    /// two are uncorrelated: `D = (H' N H)^-1` where the cameras follow the datum by H and N is the
    /// information on them. Good cameras count for more in it than poor ones.
    pub(super) fn of(state: &State, covariance: &Covariance) -> (Self, DMatrix<f64>) {
        let ((middle, time_s), follows) = Self::followers(state);
        let information = follows.tr_mul(&(covariance.information() * &follows));
        let inverse = inverse_of_what_is_shown(&information);
        let datum = Self { middle, time_s, covariance: SMatrix::from_fn(|i, j| inverse[(i, j)]) };
        (datum, follows)
    }

    /// How the cameras' own unknowns follow a datum, and the place and time that it turns about.
    pub(super) fn followers(state: &State) -> ((Point3<f64>, f64), DMatrix<f64>) {
        let count = state.cameras.len().max(1) as f64;
        let centres = state.cameras.iter().map(|camera| camera.centre.coords);
        let middle = Point3::from(centres.sum::<Vector3<f64>>() / count);
        let reference = |camera: &CameraState| camera.clock.common_s(camera.clock.reference_s);
        let time_s = state.cameras.iter().map(reference).sum::<f64>() / count;
        let (first, starts) = (state.order().chain(), state.starts());
        let unknowns = starts.last().copied().unwrap_or(first) - first;
        let mut follows = DMatrix::zeros(unknowns, WAYS);
        for (camera, start) in state.cameras.iter().zip(&starts) {
            let arm = camera.centre - middle;
            let mut part = follows.rows_mut(start - first, CLOCK + 2);
            part.view_mut((0, TURN), (3, 3)).copy_from(&camera.rotation.matrix().transpose());
            part.view_mut((3, 0), (3, 3)).fill_with_identity();
            part.view_mut((3, TURN), (3, 3)).copy_from(&-arm.cross_matrix());
            part.view_mut((3, SCALE), (3, 1)).copy_from(&arm);
            part[(CLOCK, TIME)] = 1.0;
            part[(CLOCK, RATE)] = reference(camera) - time_s;
            part[(CLOCK + 1, RATE)] = 1.0;
        }
        ((middle, time_s), follows)
    }

    /// The covariance of the cameras' own unknowns that is the datum's.
    pub(super) fn of_cameras(&self, follows: &DMatrix<f64>) -> DMatrix<f64> {
        follows * self.covariance * follows.transpose()
    }
}

/// The inverse where there is information, and nought where there is none: one camera alone has no
/// size that could be wrong.
pub(super) fn inverse_of_what_is_shown(information: &DMatrix<f64>) -> DMatrix<f64> {
    let shown: Vec<usize> =
        (0..information.nrows()).filter(|&k| information[(k, k)] > 0.0).collect();
    let part = information.select_rows(&shown).select_columns(&shown);
    let mut inverse = DMatrix::zeros(information.nrows(), information.ncols());
    if let Some(factor) = part.cholesky() {
        let part = factor.inverse();
        for (i, &row) in shown.iter().enumerate() {
            for (j, &column) in shown.iter().enumerate() {
                inverse[(row, column)] = part[(i, j)];
            }
        }
    }
    inverse
}
