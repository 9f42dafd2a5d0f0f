//! Fixed-lag smoothing: where a track was, as the later bearings tell.
//!
//! A published state is kept as one more unknown, correlated with the present state and with the
//! cameras' errors. Each bearing then updates it as it updates a learnt error ([`super::learnt`]),
//! with the errors of poses and clocks considered as in the track itself.

use crossfix_filter::KinematicState;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix2x5, Matrix6, Matrix6x2, Vector6};

use super::FusedTrack;
use super::ties::Rescaling;
use crate::motion::MotionSetup;
use crate::uncertainty::{LASTING, SharedTies};
use crate::update::CrossUpdate;

/// Upper limit of the share of a past state's covariance that the present state explains: rounding
/// takes the rest. With half of that rest the same.
const CLOSEST: f64 = 1.0 - 1e-9;

/// The state of a track at an earlier time, with what later bearings tell of it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct PastState {
    time: Timestamp,
    state: KinematicState,
    /// Covariance of the track's state at `carried_to` (rows) with this past state (columns).
    with_now: Matrix6<f64>,
    carried_to: Timestamp,
    /// Whether it no longer changes.
    is_settled: bool,
    /// Covariance of the past state with the shared errors of each camera, ordered by name.
    ties: Vec<(CameraName, SharedTies)>,
}

impl PastState {
    /// Carries `with_now` on to a later present time: the position moves with the velocity.
    fn predict(&mut self, to: Timestamp, interval: f64) {
        let velocity = self.with_now.fixed_rows::<3>(3).into_owned();
        // N <- F N; the past state itself does not move.
        let mut position = self.with_now.fixed_rows_mut::<3>(0);
        position += velocity * interval;
        self.carried_to = to;
    }

    fn ties_to(&mut self, camera: &CameraName) -> &mut SharedTies {
        let place = match self.ties.binary_search_by(|(name, _)| name.cmp(camera)) {
            Ok(place) => place,
            Err(place) => {
                self.ties.insert(place, (camera.clone(), SharedTies::zeros()));
                place
            }
        };
        &mut self.ties[place].1
    }

    /// Updates the past state with a bearing of a camera; `seen` says how the bearing is correlated
    /// with each camera's errors.
    fn learn(
        &mut self,
        camera: &CameraName,
        update: &CrossUpdate,
        seen: &[BearingErrorCovariance<'_>],
    ) {
        let own = *self.ties_to(camera);
        // A = cov(past, bearing) = N' H' + X J', with N = `with_now` and X the ties to the
        // bearing's camera. Mean += A S^-1 z; covariance -= A (S^-1 - spread over the models) A'.
        let across: Matrix6x2<f64> =
            self.with_now.transpose() * update.by.transpose() + own * update.shifts.transpose();
        let known = across * (update.weight - update.pull_spread);
        let covariance = self.state.covariance - known * across.transpose();
        let covariance = (covariance + covariance.transpose()) / 2.0;
        if covariance.cholesky().is_none() {
            // The mean over the models has promised more information than there is: the state is
            // left as it is.
            return self.settle();
        }
        self.state.covariance = covariance;
        self.state.mean += across * update.pull;
        // N <- (I - K H) N - K J X', and the covariance over the models of state and S^-1 z.
        self.with_now = update.carried * self.with_now - update.gained * own.transpose()
            + update.moved * across.transpose();
        let gain = across * update.weight;
        for BearingErrorCovariance { camera, by_errors, is_learnt } in seen {
            let change = if *is_learnt {
                let mut change = gain * by_errors;
                let mut lasting = change.fixed_columns_mut::<2>(LASTING);
                lasting.copy_from(&(known * by_errors.fixed_columns::<2>(LASTING)));
                change
            } else {
                gain * by_errors
            };
            // X_past <- X_past - A S^-1 cov(bearing, s), as for the state.
            *self.ties_to(camera) -= change;
        }
    }

    /// Limits the covariance with the present state to what two states can have, given the inverse
    /// of the present covariance, `now`: the models' weights change that covariance in ways that no
    /// bearing explains, and a correlation that is too strong promises information that is not
    /// there.
    fn keep_possible(&mut self, now: &Matrix6<f64>) {
        let explained = self.with_now.transpose() * now * self.with_now;
        if (self.state.covariance * CLOSEST - explained).cholesky().is_some() {
            return;
        }
        // The largest eigenvalue of L^-1 E L^-T, with L L' the past covariance and E the part of it
        // that the present state explains, N' P^-1 N.
        let largest = self.state.covariance.cholesky().and_then(|factor| {
            let half = factor.l().solve_lower_triangular(&explained)?;
            let whole = factor.l().solve_lower_triangular(&half.transpose())?;
            Some(whole.symmetric_eigenvalues().max())
        });
        match largest.filter(|largest| largest.is_finite() && *largest > 0.0) {
            // N enters the explained part squared: scaled by sqrt(c), that is scaled by c.
            Some(largest) => self.with_now *= (CLOSEST / largest).min(1.0).sqrt(),
            None => self.settle(),
        }
    }

    /// Freezes the state: no later bearing changes it.
    fn settle(&mut self) {
        self.is_settled = true;
        self.with_now = Matrix6::zeros();
        self.ties.clear();
    }
}

/// The covariance of a bearing with the shared errors of one camera.
struct BearingErrorCovariance<'a> {
    camera: &'a CameraName,
    by_errors: Matrix2x5<f64>,
    /// Whether the camera's lasting errors are learnt.
    is_learnt: bool,
}

impl FusedTrack {
    /// Stores the track's state at a time, so that later bearings can smooth it.
    pub(crate) fn remember(&mut self, time: Timestamp, motion: &MotionSetup) {
        let state = self.predicted(time, motion);
        let interval = time.seconds_since(self.updated_at);
        let ties =
            self.ties.iter().map(|(name, ties)| (name.clone(), ties.predicted(interval))).collect();
        // At first the past state is the present one: N = P.
        let with_now = state.covariance;
        self.past.push_back(PastState {
            time,
            state,
            with_now,
            carried_to: time,
            is_settled: false,
            ties,
        });
    }

    /// The smoothed state at a time, if it is stored.
    pub(crate) fn remembered(&self, time: Timestamp) -> Option<&KinematicState> {
        self.past.iter().find(|past| past.time == time).map(|past| &past.state)
    }

    /// Drops the stored states up to a time.
    pub(crate) fn forget_until(&mut self, time: Timestamp) {
        while self.past.front().is_some_and(|past| past.time <= time) {
            self.past.pop_front();
        }
    }

    /// Takes over the stored states of another track of the same target that are newer than all of
    /// this track's own, or all of them if it has none; they no longer change.
    pub(crate) fn inherit(&mut self, old: &mut Self) {
        let last = self.past.back().map(|past| past.time);
        let newer = old.past.drain(..).filter(|past| last.is_none_or(|last| past.time > last));
        self.past.extend(newer.map(|mut past| {
            past.settle();
            past
        }));
    }

    /// The stored states that later bearings still change.
    fn open_past(&mut self) -> impl Iterator<Item = &mut PastState> {
        self.past.iter_mut().filter(|past| !past.is_settled)
    }

    /// Carries the stored states' correlations to a new present time.
    pub(super) fn predict_past(&mut self, to: Timestamp) {
        for past in self.past.iter_mut().filter(|past| !past.is_settled) {
            let interval = to.seconds_since(past.carried_to);
            for (name, own) in &mut past.ties {
                let Some(ties) = self.ties.get(name) else { continue };
                // A covariance with an error decays as the error does, by exp(-t / T).
                let mut lasting = own.fixed_columns_mut::<2>(LASTING);
                lasting *= ties.kept(interval);
            }
            past.predict(to, interval);
        }
    }

    /// Updates the stored states with a bearing; called before the track's own ties are updated
    /// with it.
    pub(super) fn update_past(&mut self, camera: &CameraName, update: &CrossUpdate) {
        if self.past.is_empty() {
            return;
        }
        let seen: Vec<BearingErrorCovariance<'_>> = self
            .ties
            .iter()
            .map(|(name, ties)| BearingErrorCovariance {
                camera: name,
                by_errors: update.by * ties.covariance + update.shifts * self.between(camera, name),
                is_learnt: self.learns(name),
            })
            .collect();
        let mut past = std::mem::take(&mut self.past);
        let now = self.imm.combined().covariance.cholesky().map(|factor| factor.inverse());
        for past in past.iter_mut().filter(|past| !past.is_settled) {
            past.learn(camera, update, &seen);
            match &now {
                Some(now) => past.keep_possible(now),
                None => past.settle(),
            }
        }
        self.past = past;
    }

    /// Freezes all stored states: the target may now be anywhere, and later bearings tell nothing
    /// of them.
    pub(super) fn settle_past(&mut self) {
        self.past.iter_mut().for_each(PastState::settle);
    }

    /// Drops the stored states' ties to a camera's lasting errors, which have been drawn again.
    pub(super) fn renew_past(&mut self, camera: &CameraName) {
        for past in self.open_past() {
            past.ties_to(camera).fixed_columns_mut::<2>(LASTING).fill(0.0);
        }
    }

    /// Passes on that a camera's shared error was found to be `ahead` of its own deviations, ...
    pub(super) fn shift_past(&mut self, camera: &CameraName, error: usize, ahead: f64) {
        for past in self.open_past() {
            let moved: Vector6<f64> = past.ties_to(camera).column(error) * ahead;
            past.state.mean += moved;
        }
    }

    /// ... and that `N` of them, from `first` on, have another variance. `with_now` is the present
    /// state's tie to these errors.
    pub(super) fn rescale_past<const N: usize>(
        &mut self,
        camera: &CameraName,
        first: usize,
        Rescaling { ratio, scale }: Rescaling,
        with_now: &nalgebra::SMatrix<f64, 6, N>,
    ) {
        for past in self.open_past() {
            let ties = past.ties_to(camera);
            let own = ties.fixed_columns::<N>(first).into_owned();
            let mut columns = ties.fixed_columns_mut::<N>(first);
            columns *= scale;
            // P += (q - 1) X X' and N += (q - 1) X_now X_past', as for the track's own state.
            let changed = past.state.covariance + own * own.transpose() * (ratio - 1.0);
            if changed.cholesky().is_some() {
                past.state.covariance = changed;
                past.with_now += with_now * own.transpose() * (ratio - 1.0);
            }
        }
    }
}
