//! Estimation of the lasting errors: those that a camera's bearings of one target keep for a while.
//!
//! An image tracker that sits beside a target's middle does so for a while. The next bearing then
//! has nearly the same error, so what changes between two bearings of a camera is known far better
//! than where they point, and with it the velocity. To use that, the error must be estimated along
//! with position and velocity. An error that is only considered (Schmidt), as those of pose and
//! clock are, counts in each bearing with its full variance.
//!
//! Notation: e are the learnt (estimated) lasting errors, two per camera; s_k all shared errors of
//! camera k, each in units of its own standard deviation; W = cov(e).
//! X_k = cov(state, s_k) and L_k = cov(e, s_k); if camera k is learnt, the last two columns of
//! L_k are part of W. A bearing has the Jacobians H by the state and J by its camera's errors.

use crossfix_message::{CameraName, Timestamp};
use nalgebra::{DMatrix, Dyn, Matrix2, Matrix6, OMatrix, U2, U6, Vector2};

use super::ties::{LearntTies, Rescaling};
use super::{FusedTrack, Ties};
use crate::uncertainty::{
    CONSIDERED, CorrelatedNoise, LASTING, SharedCovariance, SharedErrors, SharedTies,
};
use crate::update::CrossUpdate;

/// Most cameras whose lasting errors a track learns, as an update's cost grows with the square of
/// their number; the errors of the others are considered. With half as many, the velocities of a
/// site of six cameras err by 1 % more.
const MAX_LEARNT: usize = 8;
/// After this many decay times of an error nothing is left of what has been learnt of it (e^-5),
/// and another camera may take its place. With half of it 8 % is thrown away.
const FORGOTTEN: f64 = 5.0;

/// The cameras whose lasting errors a track learns, and the estimates, in units of the errors' own
/// deviations.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Learnt {
    cameras: Vec<CameraName>,
    means: Vec<Vector2<f64>>,
}

impl Learnt {
    fn is_empty(&self) -> bool {
        self.cameras.is_empty()
    }

    /// Number of learnt errors.
    fn count(&self) -> usize {
        2 * self.cameras.len()
    }

    /// The first of the two rows that a camera has in the covariances.
    fn row_of(&self, camera: &CameraName) -> Option<usize> {
        self.cameras.iter().position(|name| name == camera).map(|place| 2 * place)
    }

    /// Each camera with the first of its rows.
    fn rows(&self) -> impl Iterator<Item = (usize, &CameraName)> {
        self.cameras.iter().enumerate().map(|(place, name)| (2 * place, name))
    }
}

impl FusedTrack {
    /// What is known of a camera's shared errors, `interval` seconds after the track's last update.
    pub(super) fn errors_of(&self, camera: &CameraName, interval: f64) -> SharedErrors {
        let Some(ties) = self.ties.get(camera) else {
            return SharedErrors::unknown();
        };
        let mut errors = SharedErrors { ties: ties.predicted(interval), ..SharedErrors::unknown() };
        if let Some(row) = self.learnt.row_of(camera) {
            let kept = ties.kept(interval);
            let known = ties.learnt.fixed_rows::<2>(row);
            // e decays towards 0, its mean before anything is known.
            let mean = self.learnt.means[row / 2] * kept;
            // First-order Gauss-Markov: e' = k e + noise, W' = k^2 W + (1 - k^2) I.
            let own = known.fixed_columns::<2>(LASTING) * kept.powi(2)
                + Matrix2::identity() * (1.0 - kept.powi(2));
            // cov(e', s) = k cov(e, s).
            let considered = known.fixed_columns::<CONSIDERED>(0) * kept;
            let covariance = &mut errors.covariance;
            covariance.fixed_view_mut::<2, 2>(LASTING, LASTING).copy_from(&own);
            covariance.fixed_view_mut::<2, CONSIDERED>(LASTING, 0).copy_from(&considered);
            covariance
                .fixed_view_mut::<CONSIDERED, 2>(0, LASTING)
                .copy_from(&considered.transpose());
            errors.mean.fixed_rows_mut::<2>(LASTING).copy_from(&mean);
            // An error with decay time T is drawn again at a rate of 1/T: P = 1 - exp(-t / T).
            let silent_s = ties.silent_s(self.updated_at).unwrap_or(0.0) + interval;
            errors.renewal = Some(1.0 - ties.kept(silent_s));
        }
        errors
    }

    /// Covariance of the learnt errors with those of a camera that has no ties yet: zero.
    pub(super) fn untied(&self) -> LearntTies {
        LearntTies::zeros(self.learnt.count())
    }

    /// Predicts all ties and learnt errors over `interval` seconds.
    pub(super) fn predict_ties(&mut self, interval: f64) {
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
            let own_kept = ties.kept(interval);
            ties.predict(interval, own_kept);
            if kept.is_empty() {
                continue;
            }
            // Each lasting error decays with its own factor k: columns by this camera's, rows by
            // the row's camera, and (1 - k^2) I of new error in the camera's own block.
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

    /// Begins to learn a camera's lasting errors, if it has any and the track is confirmed: while
    /// the track is still weighed against clutter, they are only considered.
    pub(super) fn begin_to_learn(
        &mut self,
        camera: &CameraName,
        lasting: CorrelatedNoise,
        now: Timestamp,
    ) {
        if lasting.sd_rad <= 0.0 || !self.is_confirmed() || self.learnt.row_of(camera).is_some() {
            return;
        }
        if self.learnt.cameras.len() == MAX_LEARNT {
            let Some(row) = self.forgotten(now) else { return };
            self.forget(row);
        }
        self.learnt.cameras.push(camera.clone());
        self.learnt.means.push(Vector2::zeros());
        let count = self.learnt.count();
        // While this camera's errors were only considered they may have become correlated with
        // learnt ones.
        let known =
            self.ties.get(camera).map_or_else(|| LearntTies::zeros(0), |t| t.learnt.clone());
        for (name, ties) in &mut self.ties {
            let old = std::mem::replace(&mut ties.learnt, LearntTies::zeros(0));
            ties.learnt = old.resize_vertically(count, 0.0);
            let mut own = ties.learnt.fixed_view_mut::<2, 2>(count - 2, LASTING);
            if name == camera {
                // Own block: unit variance, as nothing is known of the new errors yet.
                own.fill_with_identity();
            } else if let Some(row) = self.learnt.row_of(name) {
                own.copy_from(&known.fixed_view::<2, 2>(row, LASTING).transpose());
            }
        }
    }

    /// Whether a camera's lasting errors are learnt.
    pub(super) fn learns(&self, camera: &CameraName) -> bool {
        self.learnt.row_of(camera).is_some()
    }

    /// The covariance of the learnt errors, put together from the columns that each camera's ties
    /// hold.
    fn learnt_covariance(&self) -> Option<DMatrix<f64>> {
        let count = self.learnt.count();
        let mut own = DMatrix::<f64>::zeros(count, count);
        for (row, name) in self.learnt.rows() {
            let columns = self.ties.get(name)?.learnt.fixed_columns::<2>(LASTING);
            own.fixed_columns_mut::<2>(row).copy_from(&columns);
        }
        Some(own)
    }

    /// The first row of a camera that has been silent for so long that nothing is left of what was
    /// learnt of its errors.
    fn forgotten(&self, now: Timestamp) -> Option<usize> {
        let mut rows = self.learnt.rows();
        let forgotten =
            rows.find(|(_, name)| self.ties.get(*name).is_none_or(|ties| has_forgotten(ties, now)));
        forgotten.map(|(row, _)| row)
    }

    /// Stops learning the errors in these two rows.
    fn forget(&mut self, row: usize) {
        self.learnt.cameras.remove(row / 2);
        self.learnt.means.remove(row / 2);
        for ties in self.ties.values_mut() {
            let old = std::mem::replace(&mut ties.learnt, LearntTies::zeros(0));
            ties.learnt = old.remove_rows(row, 2);
        }
    }

    /// Resets a camera's lasting errors: they have been drawn again, and nothing is known of them.
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

    /// Stops learning all lasting errors: nothing is known of them.
    fn forget_all(&mut self) {
        self.learnt = Learnt::default();
        self.ties.values_mut().for_each(|ties| ties.learnt = LearntTies::zeros(0));
    }

    /// Updates the ties to all cameras' errors with a bearing of one camera, and the estimates of
    /// the lasting errors.
    pub(super) fn learn(&mut self, camera: &CameraName, update: &CrossUpdate) {
        if self.learnt.is_empty() {
            // Without learnt errors no camera's errors are correlated with another's:
            // X <- (I - K H) X, and for the bearing's own camera X <- (I - K H) X - K J.
            for (name, ties) in &mut self.ties {
                ties.covariance = update.carried * ties.covariance;
                if name == camera {
                    ties.covariance -= update.gained;
                }
            }
            return;
        }
        // A = cov(e, bearing). Means: e += A S^-1 z. Covariances: the usual gain A S^-1, less the
        // spread of S^-1 z over the models where a covariance between estimated quantities is
        // reduced.
        let across = self.across(camera, update);
        let gain = &across * update.weight;
        let known = &across * (update.weight - update.pull_spread);
        let between: Vec<SharedCovariance> =
            self.ties.keys().map(|other| self.between(camera, other)).collect();
        for (mean, row) in self.learnt.means.iter_mut().zip((0..).step_by(2)) {
            *mean += across.fixed_rows::<2>(row) * update.pull;
        }
        for ((name, ties), between) in self.ties.iter_mut().zip(&between) {
            // cov(bearing, s_k) = H X_k + J cov(s, s_k)
            // X_k <- (I - K H) X_k - K J cov(s, s_k)
            let seen = update.by * ties.covariance + update.shifts * between;
            ties.covariance = update.carried * ties.covariance - update.gained * between;
            match self.learnt.row_of(name) {
                None => ties.learnt -= &gain * seen,
                Some(row) => {
                    // This camera's own learnt errors: W <- W - A (S^-1 - spread) A', and X_e gains
                    // the covariance of state and pull over the models.
                    let own = across.fixed_rows::<2>(row).transpose();
                    let mut considered = ties.learnt.fixed_columns_mut::<CONSIDERED>(0);
                    considered -= &gain * seen.fixed_columns::<CONSIDERED>(0);
                    let mut lasting = ties.learnt.fixed_columns_mut::<2>(LASTING);
                    lasting -= &known * own;
                    let mut tied = ties.covariance.fixed_columns_mut::<2>(LASTING);
                    tied += update.moved * own;
                }
            }
        }
        self.balance();
    }

    /// Makes the covariance of the learnt errors symmetric again: rounding errors would grow.
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

    /// Covariance A of the learnt errors with a bearing of a camera: A = L J' + X' H'.
    fn across(&self, camera: &CameraName, update: &CrossUpdate) -> OMatrix<f64, Dyn, U2> {
        let Some(own) = self.ties.get(camera) else {
            return OMatrix::<f64, Dyn, U2>::zeros(self.learnt.count());
        };
        let mut across = &own.learnt * update.shifts.transpose();
        for (row, name) in self.learnt.rows() {
            if let Some(ties) = self.ties.get(name) {
                let tied = ties.covariance.fixed_columns::<2>(LASTING);
                let mut rows = across.fixed_rows_mut::<2>(row);
                rows += tied.transpose() * update.by.transpose();
            }
        }
        across
    }

    /// Covariance of the shared errors of two cameras, which may be the same one.
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
            // Considered errors of two cameras are independent; only what is learnt ties them
            // together.
            let rows = ties.fixed_rows::<2>(row).transpose();
            between.fixed_columns_mut::<2>(LASTING).copy_from(&rows);
        }
        between
    }

    /// Passes on that `N` considered errors of a camera, from `first` on, have another variance
    /// than was assumed. What is correlated with them changes accordingly. Returns the change of
    /// the state's covariance, (ratio - 1) X X'.
    pub(super) fn rescale<const N: usize>(
        &mut self,
        camera: &CameraName,
        first: usize,
        Rescaling { ratio, scale }: Rescaling,
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
                // cov(e) += (q - 1) L L' and cov(state, e) += (q - 1) X L', by columns.
                let own = learnt.fixed_rows::<2>(row).transpose() * (ratio - 1.0);
                let mut lasting = ties.learnt.fixed_columns_mut::<2>(LASTING);
                lasting += &learnt * own;
                let mut tied = ties.covariance.fixed_columns_mut::<2>(LASTING);
                tied += state * own;
            }
        }
        self.rescale_past::<N>(camera, first, Rescaling { ratio, scale }, &state);
        Some(state * state.transpose() * (ratio - 1.0))
    }

    /// Passes on that a camera's considered error was found to be `ahead` of its own deviations:
    /// the estimates move by L times that.
    pub(super) fn shift_learnt(&mut self, camera: &CameraName, error: usize, ahead: f64) {
        let Some(ties) = self.ties.get(camera) else { return };
        for (mean, row) in self.learnt.means.iter_mut().zip((0..).step_by(2)) {
            *mean += ties.learnt.fixed_view::<2, 1>(row, error) * ahead;
        }
    }

    /// The part of the state's covariance that the shared errors cause, which is its lower bound.
    /// If rounding has made the learnt errors' covariance indefinite, they are reset.
    pub(super) fn shared_part(&mut self) -> Matrix6<f64> {
        if let Some(learnt) = self.learnt_part() {
            return self.considered_part() + learnt;
        }
        self.forget_all();
        self.considered_part()
    }

    /// The part that the errors cause that are considered and not learnt: the sum of X X' over the
    /// cameras, as these errors are independent and have unit variance.
    ///
    /// It is summed by size and not by the cameras' names, so that names decide no rounding: a
    /// nearly singular matrix magnifies it.
    fn considered_part(&self) -> Matrix6<f64> {
        let mut parts: Vec<(f64, &CameraName, &SharedTies)> = (self.ties.iter())
            .map(|(name, Ties { covariance, .. })| (covariance.norm_squared(), name, covariance))
            .collect();
        parts.sort_by(|one, other| one.0.total_cmp(&other.0));
        let mut sum = Matrix6::zeros();
        for (_, name, ties) in parts {
            let considered = ties.fixed_columns::<CONSIDERED>(0);
            sum += considered * considered.transpose();
            let lasting = ties.fixed_columns::<2>(LASTING);
            if lasting.amax() > 0.0 && !self.learns(name) {
                sum += lasting * lasting.transpose();
            }
        }
        sum
    }

    /// The part that the learnt errors cause beyond the considered ones; `None` if their covariance
    /// is not positive definite.
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
        // With B = cov(e, considered), conditional on the considered errors e has the covariance W
        // - B B' and X_e - X_s B' with the state. The part is
        // (X_e - X_s B') (W - B B')^-1 (X_e - X_s B')'.
        for (name, ties) in &self.ties {
            let mut with = ties.learnt.clone();
            if self.learnt.row_of(name).is_some() {
                with.fixed_columns_mut::<2>(LASTING).fill(0.0);
            }
            tied -= ties.covariance * with.transpose();
            own -= &with * with.transpose();
        }
        // With C = L L': T C^-1 T' = (L^-1 T')' (L^-1 T').
        let half = own.cholesky()?.l().solve_lower_triangular(&tied.transpose())?;
        Some((half.transpose() * half).fixed_view::<6, 6>(0, 0).into_owned())
    }
}

/// Whether nothing is left of what was learnt of a camera's errors: it has been silent for too
/// long.
fn has_forgotten(ties: &Ties, now: Timestamp) -> bool {
    ties.silent_s(now).is_none_or(|silent_s| silent_s > FORGOTTEN * ties.lasting_s)
}
