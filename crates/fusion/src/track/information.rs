//! Which directions of position and velocity the recent bearings of a track determine: their Fisher
//! information, without what the track believed before.

use crossfix_geometry::{BearingModel, SightLine};
use nalgebra::{Matrix2, Matrix3, Matrix6, Point3};

use super::{FusedTrack, TrackBearing};
use crate::spatial::{Observability, VAGUE_VELOCITY_SD};
use crate::uncertainty::CameraUncertainty;

/// Time constant with which the Fisher information of past bearings fades, s. With half of it the
/// last bearing but one of a camera of 1 Hz keeps 13 % of its weight and not 37 %; with twice as
/// much a lost camera counts for twice as long.
const INFORMATION_S: f64 = 1.0;
/// Prior scale of the position in the observability test, m: a position counts as observable if it
/// is known better than this. With half of it a position known to 15 m no longer counts.
const POSITION_SCALE_M: f64 = 20.0;

impl FusedTrack {
    /// Adds a bearing's Fisher information to that of the recent bearings, which is carried on to
    /// its time and faded with [`INFORMATION_S`].
    pub(super) fn gather_information(&mut self, bearing: &TrackBearing<'_>) {
        let TrackBearing { camera, time: now, line, uncertainty } = *bearing;
        let interval = now.seconds_since(self.updated_at);
        let old = &self.information;
        let block = |row: usize, column: usize| old.fixed_view::<3, 3>(row, column).into_owned();
        let (places, ties, speeds) = (block(0, 0), block(0, 3), block(3, 3));
        // Information to the new time: I <- F^-T I F^-1 with F^-1 = [1, -dt; 0, 1].
        let tied = ties - places * interval;
        let moved = speeds - (ties + ties.transpose()) * interval + places * interval.powi(2);
        let mut next = Matrix6::zeros();
        next.fixed_view_mut::<3, 3>(0, 0).copy_from(&places);
        next.fixed_view_mut::<3, 3>(0, 3).copy_from(&tied);
        next.fixed_view_mut::<3, 3>(3, 0).copy_from(&tied.transpose());
        next.fixed_view_mut::<3, 3>(3, 3).copy_from(&moved);
        // Old information fades by exp(-dt / T): a bearing of long ago says little of the motion
        // now.
        next *= (-interval.abs() / INFORMATION_S).exp();
        let since_s = self.ties.get(camera).and_then(|ties| ties.silent_s(now));
        let since_s = since_s.unwrap_or(f64::INFINITY);
        let place = self.state().position();
        if let Some(told) = told_of_position(place, line, since_s, uncertainty) {
            let mut position = next.fixed_view_mut::<3, 3>(0, 0);
            position += told;
        }
        self.information =
            if next.iter().all(|value| value.is_finite()) { next } else { Matrix6::zeros() };
    }

    /// Computes the observability again if that was last done [`INFORMATION_S`] ago: until then more
    /// than a third of the information is the same, and the eigenvalues cost more than an update.
    pub(crate) fn observe_again(&mut self) {
        if self.updated_at.seconds_since(self.observed) >= INFORMATION_S {
            self.observe();
        }
    }

    /// Computes which directions of position and velocity the recent bearings determine.
    pub(crate) fn observe(&mut self) {
        self.observed = self.updated_at;
        self.observability =
            Observability::of_information(&self.information, POSITION_SCALE_M, VAGUE_VELOCITY_SD);
    }
}

/// Fisher information of a bearing on the position, H' R^-1 H, where its camera gave the one before
/// `since_s` seconds earlier: what lasts of the noise counts as white noise that averages out as
/// slowly.
fn told_of_position(
    place: Point3<f64>,
    line: &SightLine,
    since_s: f64,
    uncertainty: &CameraUncertainty,
) -> Option<Matrix3<f64>> {
    let model = BearingModel::new(line.origin, place)?;
    let by = model.by_position();
    let white = model.covariance_of(line) * uncertainty.factor;
    let noise = white + Matrix2::identity() * uncertainty.lasting.as_white(since_s);
    Some(by.transpose() * noise.try_inverse()? * by)
}
