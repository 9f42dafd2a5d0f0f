//! Where a track was, as the bearings since have told: a smoother of fixed lag.
//!
//! A state that has gone out is kept as one more thing that is unknown, tied to where the target is
//! now and to the cameras' errors. Each bearing then tells of it what it tells of any error that is
//! learnt, with what poses and clocks may be off by considered as in the track itself.

use crossfix_filter::KinematicState;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix2x5, Matrix6, Matrix6x2, Vector6};

use super::Track;
use crate::motion::Motion;
use crate::uncertainty::{LASTING, SharedTies};
use crate::update::Told;

/// Where it is tells no more than this share of what is unknown of where it was: rounding takes the
/// rest.
const CLOSEST: f64 = 1.0 - 1e-9;

/// Where a track was at a time.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Past {
    time: Timestamp,
    state: KinematicState,
    /// Covariance of where the track is at `carried_to` with where it was.
    with_now: Matrix6<f64>,
    carried_to: Timestamp,
    /// Whether nothing more is told of it.
    is_settled: bool,
    /// What ties it to the shared errors of each camera; in the order of their names.
    ties: Vec<(CameraName, SharedTies)>,
}

impl Past {
    /// Goes on with the target to a time.
    fn pass(&mut self, to: Timestamp, interval: f64) {
        let velocity = self.with_now.fixed_rows::<3>(3).into_owned();
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

    /// Takes in a bearing of a camera; what it tells of each camera's errors is `seen`.
    fn learn(&mut self, camera: &CameraName, told: &Told, seen: &[Seen<'_>]) {
        let own = *self.ties_to(camera);
        let across: Matrix6x2<f64> =
            self.with_now.transpose() * told.by.transpose() + own * told.shifts.transpose();
        let known = across * (told.weight - told.pull_spread);
        let covariance = self.state.covariance - known * across.transpose();
        let covariance = (covariance + covariance.transpose()) / 2.0;
        if covariance.cholesky().is_none() {
            // The mean over the models has promised too much: nothing more is believed.
            return self.settle();
        }
        self.state.covariance = covariance;
        self.state.mean += across * told.pull;
        self.with_now = told.carried * self.with_now - told.gained * own.transpose()
            + told.moved * across.transpose();
        let gain = across * told.weight;
        for Seen { camera, by_errors, is_learnt } in seen {
            let change = if *is_learnt {
                let mut change = gain * by_errors;
                let mut lasting = change.fixed_columns_mut::<2>(LASTING);
                lasting.copy_from(&(known * by_errors.fixed_columns::<2>(LASTING)));
                change
            } else {
                gain * by_errors
            };
            *self.ties_to(camera) -= change;
        }
    }

    /// Makes the tie to where the target is now no closer than two states can be tied, by the inverse
    /// covariance of that: the models' weights change it otherwise than any bearing does, and what a
    /// tie that is too close promises is not there.
    fn keep_possible(&mut self, now: &Matrix6<f64>) {
        let explained = self.with_now.transpose() * now * self.with_now;
        if (self.state.covariance * CLOSEST - explained).cholesky().is_some() {
            return;
        }
        // The largest eigenvalue of L^-1 E L^-T, with L L' the covariance and E what of it the tie
        // explains.
        let largest = self.state.covariance.cholesky().and_then(|factor| {
            let half = factor.l().solve_lower_triangular(&explained)?;
            let whole = factor.l().solve_lower_triangular(&half.transpose())?;
            Some(whole.symmetric_eigenvalues().max())
        });
        match largest.filter(|largest| largest.is_finite() && *largest > 0.0) {
            Some(largest) => self.with_now *= (CLOSEST / largest).min(1.0).sqrt(),
            None => self.settle(),
        }
    }

    /// Is told nothing more.
    fn settle(&mut self) {
        self.is_settled = true;
        self.with_now = Matrix6::zeros();
        self.ties.clear();
    }
}

/// How a bearing goes with the shared errors of a camera.
struct Seen<'a> {
    camera: &'a CameraName,
    by_errors: Matrix2x5<f64>,
    /// Whether those that last are learnt.
    is_learnt: bool,
}

impl Track {
    /// Keeps where the track is at a time, so that later bearings tell of it.
    pub(crate) fn remember(&mut self, time: Timestamp, motion: &Motion) {
        let state = self.predicted(time, motion);
        let interval = time.seconds_since(self.updated);
        let ties =
            self.ties.iter().map(|(name, ties)| (name.clone(), ties.predicted(interval))).collect();
        let with_now = state.covariance;
        self.past.push_back(Past {
            time,
            state,
            with_now,
            carried_to: time,
            is_settled: false,
            ties,
        });
    }

    /// Where the track was at a time, if that is kept.
    pub(crate) fn remembered(&self, time: Timestamp) -> Option<&KinematicState> {
        self.past.iter().find(|past| past.time == time).map(|past| &past.state)
    }

    /// Keeps nothing of until a time.
    pub(crate) fn forget_until(&mut self, time: Timestamp) {
        while self.past.front().is_some_and(|past| past.time <= time) {
            self.past.pop_front();
        }
    }

    /// Takes over what another track of the same target has kept since this one has anything; nothing
    /// more is told of it.
    pub(crate) fn inherit(&mut self, old: &mut Self) {
        let last = self.past.back().map(|past| past.time);
        let newer = old.past.drain(..).filter(|past| last.is_none_or(|last| past.time > last));
        self.past.extend(newer.map(|mut past| {
            past.settle();
            past
        }));
    }

    /// What is kept and may still be told more of.
    fn open_past(&mut self) -> impl Iterator<Item = &mut Past> {
        self.past.iter_mut().filter(|past| !past.is_settled)
    }

    /// Takes what is kept on to a time.
    pub(super) fn pass_past(&mut self, to: Timestamp) {
        for past in self.past.iter_mut().filter(|past| !past.is_settled) {
            let interval = to.seconds_since(past.carried_to);
            for (name, own) in &mut past.ties {
                let Some(ties) = self.ties.get(name) else { continue };
                let mut lasting = own.fixed_columns_mut::<2>(LASTING);
                lasting *= ties.kept(interval);
            }
            past.pass(to, interval);
        }
    }

    /// Takes a bearing of a camera in for all that is kept; before the ties themselves take it in.
    pub(super) fn look_back(&mut self, camera: &CameraName, told: &Told) {
        if self.past.is_empty() {
            return;
        }
        let seen: Vec<Seen<'_>> = self
            .ties
            .iter()
            .map(|(name, ties)| Seen {
                camera: name,
                by_errors: told.by * ties.covariance + told.shifts * self.between(camera, name),
                is_learnt: self.learns(name),
            })
            .collect();
        let mut past = std::mem::take(&mut self.past);
        let now = self.imm.combined().covariance.cholesky().map(|factor| factor.inverse());
        for past in past.iter_mut().filter(|past| !past.is_settled) {
            past.learn(camera, told, &seen);
            match &now {
                Some(now) => past.keep_possible(now),
                None => past.settle(),
            }
        }
        self.past = past;
    }

    /// What is kept is no longer tied to where the target is: it may be anywhere.
    pub(super) fn settle_past(&mut self) {
        self.past.iter_mut().for_each(Past::settle);
    }

    /// A camera's errors that last have been drawn anew.
    pub(super) fn renew_past(&mut self, camera: &CameraName) {
        for past in self.open_past() {
            past.ties_to(camera).fixed_columns_mut::<2>(LASTING).fill(0.0);
        }
    }

    /// A camera's shared error has been found to be `ahead` of its own deviations, ...
    pub(super) fn shift_past(&mut self, camera: &CameraName, error: usize, ahead: f64) {
        for past in self.open_past() {
            let moved: Vector6<f64> = past.ties_to(camera).column(error) * ahead;
            past.state.mean += moved;
        }
    }

    /// ... and `N` of them, from `first` on, to have `ratio` times their variance, so that the ties
    /// are `scale` times what they were.
    pub(super) fn rescale_past<const N: usize>(
        &mut self,
        camera: &CameraName,
        first: usize,
        (ratio, scale): (f64, f64),
        with_now: &nalgebra::SMatrix<f64, 6, N>,
    ) {
        for past in self.open_past() {
            let ties = past.ties_to(camera);
            let own = ties.fixed_columns::<N>(first).into_owned();
            let mut columns = ties.fixed_columns_mut::<N>(first);
            columns *= scale;
            let changed = past.state.covariance + own * own.transpose() * (ratio - 1.0);
            if changed.cholesky().is_some() {
                past.state.covariance = changed;
                past.with_now += with_now * own.transpose() * (ratio - 1.0);
            }
        }
    }
}
