//! What a track's bearings tell of the errors that last.
//!
//! A tracker that sits beside a target's middle does so for a while. The next bearing has all but a
//! little of that error, so what changes between two bearings of a camera is known far better than
//! where they point, and with it the velocity. For that the error must be estimated beside position
//! and velocity. One that is only considered, as those of pose and clock are, stands in each
//! bearing with all of its variance.

use crossfix_message::{CameraName, Timestamp};
use nalgebra::{DMatrix, Dyn, Matrix2, Matrix6, OMatrix, U2, U5, U6, Vector2};

use super::{Ties, Track};
use crate::uncertainty::{CONSIDERED, LASTING, LastingNoise, SharedCovariance, SharedErrors};
use crate::update::Told;

/// Of so many cameras a track learns the errors at most, as an update's cost grows with the square
/// of their number; those of the others are considered. With half as many a site of six cameras errs
/// by 1 % more in velocity.
const MOST_LEARNT: usize = 8;
/// After so many of the times for which an error lasts, what has been learnt of it is gone (e^-5),
/// and another camera's may take its place.
const FORGOTTEN: f64 = 5.0;

/// Covariance of the learnt errors with those that the bearings of one camera share.
pub(super) type LearntTies = OMatrix<f64, Dyn, U5>;

/// Whose errors a track learns, and what they are thought to be, in their own deviations.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Learnt {
    cameras: Vec<CameraName>,
    means: Vec<Vector2<f64>>,
}

impl Learnt {
    fn is_empty(&self) -> bool {
        self.cameras.is_empty()
    }

    /// How many errors they are.
    fn count(&self) -> usize {
        2 * self.cameras.len()
    }

    /// Which rows of a covariance are a camera's: this one and the next.
    fn row_of(&self, camera: &CameraName) -> Option<usize> {
        self.cameras.iter().position(|name| name == camera).map(|place| 2 * place)
    }

    /// Each camera with the first of its rows.
    fn rows(&self) -> impl Iterator<Item = (usize, &CameraName)> {
        self.cameras.iter().enumerate().map(|(place, name)| (2 * place, name))
    }
}

impl Track {
    /// What is known of the errors that a camera's bearings share, `interval` seconds on.
    pub(super) fn errors_of(&self, camera: &CameraName, interval: f64) -> SharedErrors {
        let Some(ties) = self.ties.get(camera) else {
            return SharedErrors::unknown();
        };
        let mut errors = SharedErrors { ties: ties.predicted(interval), ..SharedErrors::unknown() };
        if let Some(row) = self.learnt.row_of(camera) {
            let kept = ties.kept(interval);
            let known = ties.learnt.fixed_rows::<2>(row);
            let mean = self.learnt.means[row / 2] * kept;
            let own = known.fixed_columns::<2>(LASTING) * kept.powi(2)
                + Matrix2::identity() * (1.0 - kept.powi(2));
            let considered = known.fixed_columns::<CONSIDERED>(0) * kept;
            let covariance = &mut errors.covariance;
            covariance.fixed_view_mut::<2, 2>(LASTING, LASTING).copy_from(&own);
            covariance.fixed_view_mut::<2, CONSIDERED>(LASTING, 0).copy_from(&considered);
            covariance
                .fixed_view_mut::<CONSIDERED, 2>(0, LASTING)
                .copy_from(&considered.transpose());
            errors.mean.fixed_rows_mut::<2>(LASTING).copy_from(&mean);
            // An error that lasts T ends at a rate of 1/T.
            let silent_s = ties.silent_s(self.updated).unwrap_or(0.0) + interval;
            errors.renewal = Some(1.0 - ties.kept(silent_s));
        }
        errors
    }

    /// The ties of a camera's errors with the learnt ones, where there are none yet.
    pub(super) fn untied(&self) -> LearntTies {
        LearntTies::zeros(self.learnt.count())
    }

    /// Takes all ties, and what is known of the errors that last, `interval` seconds on.
    pub(super) fn pass(&mut self, interval: f64) {
        let kept: Vec<f64> = self
            .learnt
            .cameras
            .iter()
            .map(|name| self.ties.get(name).map_or(1.0, |ties| ties.kept(interval)))
            .collect();
        for (mean, kept) in self.learnt.means.iter_mut().zip(&kept) {
            *mean *= *kept;
        }
        for (name, ties) in &mut self.ties {
            ties.covariance = ties.predicted(interval);
            if kept.is_empty() {
                continue;
            }
            let own_kept = ties.kept(interval);
            let mut lasting = ties.learnt.fixed_columns_mut::<2>(LASTING);
            lasting *= own_kept;
            for (place, kept) in kept.iter().enumerate() {
                let mut rows = ties.learnt.fixed_rows_mut::<2>(2 * place);
                rows *= *kept;
            }
            if let Some(row) = self.learnt.row_of(name) {
                let mut own = ties.learnt.fixed_view_mut::<2, 2>(row, LASTING);
                own += Matrix2::identity() * (1.0 - own_kept.powi(2));
            }
        }
    }

    /// Makes room for what is to be learnt of a camera's errors, if they last and the track is sure
    /// to be a target's: while it is weighed against clutter, they are considered.
    pub(super) fn begin_to_learn(
        &mut self,
        camera: &CameraName,
        lasting: LastingNoise,
        now: Timestamp,
    ) {
        if lasting.sd_rad <= 0.0 || !self.is_confirmed() || self.learnt.row_of(camera).is_some() {
            return;
        }
        if self.learnt.cameras.len() == MOST_LEARNT {
            let Some(row) = self.forgotten(now) else { return };
            self.forget(row);
        }
        self.learnt.cameras.push(camera.clone());
        self.learnt.means.push(Vector2::zeros());
        let count = self.learnt.count();
        // While it was considered its errors may have come to go with learnt ones.
        let known =
            self.ties.get(camera).map_or_else(|| LearntTies::zeros(0), |t| t.learnt.clone());
        for (name, ties) in &mut self.ties {
            let old = std::mem::replace(&mut ties.learnt, LearntTies::zeros(0));
            ties.learnt = old.resize_vertically(count, 0.0);
            let mut own = ties.learnt.fixed_view_mut::<2, 2>(count - 2, LASTING);
            if name == camera {
                own.fill_with_identity();
            } else if let Some(row) = self.learnt.row_of(name) {
                own.copy_from(&known.fixed_view::<2, 2>(row, LASTING).transpose());
            }
        }
    }

    /// Whether a camera's errors that last are learnt.
    pub(super) fn learns(&self, camera: &CameraName) -> bool {
        self.learnt.row_of(camera).is_some()
    }

    /// The covariance of the learnt errors, as each camera's ties hold its columns.
    fn learnt_covariance(&self) -> Option<DMatrix<f64>> {
        let count = self.learnt.count();
        let mut own = DMatrix::<f64>::zeros(count, count);
        for (row, name) in self.learnt.rows() {
            let columns = self.ties.get(name)?.learnt.fixed_columns::<2>(LASTING);
            own.fixed_columns_mut::<2>(row).copy_from(&columns);
        }
        Some(own)
    }

    /// The rows of a camera that has been silent for so long that nothing is left to know.
    fn forgotten(&self, now: Timestamp) -> Option<usize> {
        let is_forgotten = |name: &CameraName| {
            self.ties.get(name).is_none_or(|ties| {
                ties.silent_s(now).is_none_or(|silent_s| silent_s > FORGOTTEN * ties.lasting_s)
            })
        };
        self.learnt.rows().find(|(_, name)| is_forgotten(name)).map(|(row, _)| row)
    }

    fn forget(&mut self, row: usize) {
        self.learnt.cameras.remove(row / 2);
        self.learnt.means.remove(row / 2);
        for ties in self.ties.values_mut() {
            let old = std::mem::replace(&mut ties.learnt, LearntTies::zeros(0));
            ties.learnt = old.remove_rows(row, 2);
        }
    }

    /// Takes a camera's errors that last for drawn anew: nothing is known of them.
    pub(super) fn renew(&mut self, camera: &CameraName) {
        self.renew_past(camera);
        let Some(row) = self.learnt.row_of(camera) else { return };
        self.learnt.means[row / 2] = Vector2::zeros();
        for (name, ties) in &mut self.ties {
            ties.learnt.fixed_rows_mut::<2>(row).fill(0.0);
            if name == camera {
                ties.covariance.fixed_columns_mut::<2>(LASTING).fill(0.0);
                ties.learnt.fixed_columns_mut::<2>(LASTING).fill(0.0);
                ties.learnt.fixed_view_mut::<2, 2>(row, LASTING).fill_with_identity();
            }
        }
    }

    /// Takes all errors that last for unknown again.
    fn forget_all(&mut self) {
        self.learnt = Learnt::default();
        self.ties.values_mut().for_each(|ties| ties.learnt = LearntTies::zeros(0));
    }

    /// Carries the ties to all cameras' errors through a bearing of one of them, and learns of those
    /// that last.
    pub(super) fn learn(&mut self, camera: &CameraName, told: &Told) {
        if self.learnt.is_empty() {
            // No camera's errors go with another's.
            for (name, ties) in &mut self.ties {
                ties.covariance = told.carried * ties.covariance;
                if name == camera {
                    ties.covariance -= told.gained;
                }
            }
            return;
        }
        let across = self.across(camera, told);
        let gain = &across * told.weight;
        let known = &across * (told.weight - told.pull_spread);
        let between: Vec<SharedCovariance> =
            self.ties.keys().map(|other| self.between(camera, other)).collect();
        for (mean, row) in self.learnt.means.iter_mut().zip((0..).step_by(2)) {
            *mean += across.fixed_rows::<2>(row) * told.pull;
        }
        for ((name, ties), between) in self.ties.iter_mut().zip(&between) {
            let seen = told.by * ties.covariance + told.shifts * between;
            ties.covariance = told.carried * ties.covariance - told.gained * between;
            match self.learnt.row_of(name) {
                None => ties.learnt -= &gain * seen,
                Some(row) => {
                    let own = across.fixed_rows::<2>(row).transpose();
                    let mut considered = ties.learnt.fixed_columns_mut::<CONSIDERED>(0);
                    considered -= &gain * seen.fixed_columns::<CONSIDERED>(0);
                    let mut lasting = ties.learnt.fixed_columns_mut::<2>(LASTING);
                    lasting -= &known * own;
                    let mut tied = ties.covariance.fixed_columns_mut::<2>(LASTING);
                    tied += told.moved * own;
                }
            }
        }
        self.balance();
    }

    /// Makes the covariance of the learnt errors its own transpose again: rounding grows.
    fn balance(&mut self) {
        let Some(own) = self.learnt_covariance() else { return };
        let own = (&own + own.transpose()) * 0.5;
        for (row, name) in self.learnt.rows() {
            if let Some(ties) = self.ties.get_mut(name) {
                let mut columns = ties.learnt.fixed_columns_mut::<2>(LASTING);
                columns.copy_from(&own.fixed_columns::<2>(row));
            }
        }
    }

    /// Covariance of the learnt errors with a bearing of a camera.
    fn across(&self, camera: &CameraName, told: &Told) -> OMatrix<f64, Dyn, U2> {
        let Some(own) = self.ties.get(camera) else {
            return OMatrix::<f64, Dyn, U2>::zeros(self.learnt.count());
        };
        let mut across = &own.learnt * told.shifts.transpose();
        for (row, name) in self.learnt.rows() {
            if let Some(ties) = self.ties.get(name) {
                let tied = ties.covariance.fixed_columns::<2>(LASTING);
                let mut rows = across.fixed_rows_mut::<2>(row);
                rows += tied.transpose() * told.by.transpose();
            }
        }
        across
    }

    /// Covariance of the shared errors of one camera with those of another.
    pub(super) fn between(&self, one: &CameraName, other: &CameraName) -> SharedCovariance {
        if one == other {
            return self.errors_of(one, 0.0).covariance;
        }
        let mut between = SharedCovariance::zeros();
        let of = |name: &CameraName| self.ties.get(name).map(|ties| &ties.learnt);
        if let (Some(row), Some(ties)) = (self.learnt.row_of(one), of(other)) {
            between.fixed_rows_mut::<2>(LASTING).copy_from(&ties.fixed_rows::<2>(row));
        }
        if let (Some(row), Some(ties)) = (self.learnt.row_of(other), of(one)) {
            let rows = ties.fixed_rows::<2>(row).transpose();
            between.fixed_columns_mut::<2>(LASTING).copy_from(&rows);
        }
        between
    }

    /// One of a camera's considered errors, or several from `first` on, has been found to have
    /// `ratio` times its variance, and what it does to the track with it; `scale` is what becomes of
    /// the ties. Returns what the state's covariance changes by.
    pub(super) fn rescale<const N: usize>(
        &mut self,
        camera: &CameraName,
        first: usize,
        (ratio, scale): (f64, f64),
    ) -> Option<Matrix6<f64>> {
        let ties = self.ties.get_mut(camera)?;
        let state = ties.covariance.fixed_columns::<N>(first).into_owned();
        let learnt = ties.learnt.fixed_columns::<N>(first).into_owned();
        let mut columns = ties.covariance.fixed_columns_mut::<N>(first);
        columns *= scale;
        let mut columns = ties.learnt.fixed_columns_mut::<N>(first);
        columns *= scale;
        for (row, name) in self.learnt.rows() {
            if let Some(ties) = self.ties.get_mut(name) {
                let own = learnt.fixed_rows::<2>(row).transpose() * (ratio - 1.0);
                let mut lasting = ties.learnt.fixed_columns_mut::<2>(LASTING);
                lasting += &learnt * own;
                let mut tied = ties.covariance.fixed_columns_mut::<2>(LASTING);
                tied += state * own;
            }
        }
        self.rescale_past::<N>(camera, first, (ratio, scale), &state);
        Some(state * state.transpose() * (ratio - 1.0))
    }

    /// A camera's considered error has been found to be `ahead` of its own deviations.
    pub(super) fn shift_learnt(&mut self, camera: &CameraName, error: usize, ahead: f64) {
        let Some(ties) = self.ties.get(camera) else { return };
        for (mean, row) in self.learnt.means.iter_mut().zip((0..).step_by(2)) {
            *mean += ties.learnt.fixed_view::<2, 1>(row, error) * ahead;
        }
    }

    /// What the shared errors do to the state: no less can be unknown of it. Where rounding has left
    /// less than nothing of the learnt ones, they are taken for unknown again.
    pub(super) fn shared_part(&mut self) -> Matrix6<f64> {
        // Summed by size and not by the cameras' names: what is nearly singular magnifies rounding.
        let sum = |mut parts: Vec<Matrix6<f64>>| -> Matrix6<f64> {
            parts.sort_by(|one, other| one.trace().total_cmp(&other.trace()));
            parts.iter().sum()
        };
        let square = |(name, ties): (&CameraName, &Ties)| {
            let mut considered = ties.covariance;
            if self.learnt.row_of(name).is_some() {
                considered.fixed_columns_mut::<2>(LASTING).fill(0.0);
            }
            considered * considered.transpose()
        };
        let considered = sum(self.ties.iter().map(square).collect());
        match self.learnt_part() {
            Some(learnt) => considered + learnt,
            None => {
                self.forget_all();
                sum(self.ties.values().map(|t| t.covariance * t.covariance.transpose()).collect())
            }
        }
    }

    /// What the learnt errors do to the state beside those that are considered; `None` if by their
    /// numbers there is less than nothing to know of them.
    fn learnt_part(&self) -> Option<Matrix6<f64>> {
        if self.learnt.is_empty() {
            return Some(Matrix6::zeros());
        }
        let mut own = self.learnt_covariance()?;
        let mut tied = OMatrix::<f64, U6, Dyn>::zeros(self.learnt.count());
        for (row, name) in self.learnt.rows() {
            let columns = self.ties.get(name)?.covariance.fixed_columns::<2>(LASTING);
            tied.fixed_columns_mut::<2>(row).copy_from(&columns);
        }
        for (name, ties) in &self.ties {
            let mut with = ties.learnt.clone();
            if self.learnt.row_of(name).is_some() {
                with.fixed_columns_mut::<2>(LASTING).fill(0.0);
            }
            tied -= ties.covariance * with.transpose();
            own -= &with * with.transpose();
        }
        let half = own.cholesky()?.l().solve_lower_triangular(&tied.transpose())?;
        Some((half.transpose() * half).fixed_view::<6, 6>(0, 0).into_owned())
    }
}
