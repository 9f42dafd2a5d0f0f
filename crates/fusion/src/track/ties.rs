//! The cross-covariance ("ties") of a track with the errors that all bearings of a camera share,
//! and what the track's bearings tell of these errors.
//!
//! The shared errors of a camera are two of its pose, one of its clock, and two that last from one
//! bearing of the target to the next, each in units of its own standard deviation
//! (`uncertainty.rs`).

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Dyn, OMatrix, U5, Unit, Vector2};

use super::draw::{Course, DRAW_S, Draw, Drawn, LONGEST_COURSE_S, speed_sd};
use super::{FusedTrack, TrackBearing};
use crate::cameras::{ClockChange, RecentBearings, ThirdDifferences};
use crate::uncertainty::{CorrelatedNoise, LASTING, OF_CLOCK, OF_POSE, SharedTies};
use crate::update::{CrossUpdate, ModelUpdate, Updated};
use crate::visibility::Visibility;

/// L_k: covariance of the learnt errors with the shared errors of one camera.
pub(super) type LearntTies = OMatrix<f64, Dyn, U5>;

/// A change of the variance of errors that a track is tied to.
#[derive(Clone, Copy, Debug)]
pub(super) struct Rescaling {
    /// Factor on the variance that was assumed.
    pub(super) ratio: f64,
    /// Factor on the ties.
    pub(super) scale: f64,
}

/// Longest interval between bearings whose third difference is used, as a share of the holding time
/// ([`FusedTrack::holding_s`], how long after a bearing its camera still supports the track): over
/// longer intervals noise cannot be told from jerk. By default that is 0.15 s: with half of it
/// cameras of 10 Hz show nothing of their white noise.
const CLOSE_BEARINGS: f64 = 0.1;
/// A camera supports the track for at least this many times the interval between its last two
/// bearings: the next one may be late (with half of it every next one is too late), but none may
/// be missed, ...
const HOLDING_PERIODS: f64 = 1.5;
/// ... with intervals counted as no longer than this many times the holding time. With half of it a
/// camera with a bearing every other holding time loses the target between any two.
const LONGEST_PERIOD: f64 = 2.0;

/// A camera that has missed the target for no longer than this share of the holding time has not
/// lost it: 0.3 s by default. In that time a small drone's speed changes by a metre a second or
/// two, unseen along the sight line of the other camera; with half of it a detector's ordinary
/// misses are taken for a loss.
const MISSED: f64 = 0.2;

/// Something beside the target is steady if from draw to draw its residual changes by less than
/// this share of the residual, ...
const STEADY: f64 = 0.2;
/// ... for this many draws in a row, a second and a half. With half of it, what flies past in the
/// same direction is taken for the target. With half of the share, the track's own wander ends the
/// row.
const STEADY_DRAWS: u32 = 5;
/// At least this many cameras must have it beside the target for the size of their errors to be
/// learnt from it: a single one (half of it) may be turned, and the watch for moved cameras finds
/// that.
const LEAST_BESIDE: usize = 2;

/// The ties of a track to one camera that has seen it, and how that camera sees the target.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Ties {
    /// Covariance of position and velocity with the camera's shared errors, each in units of its
    /// own deviation.
    pub(super) covariance: SharedTies,
    /// Covariance of the lasting errors that the track estimates (rows) with this camera's shared
    /// errors.
    pub(super) learnt: LearntTies,
    /// Decay time of the camera's lasting errors, s.
    pub(super) lasting_s: f64,
    /// Whether the target is visible to the camera, by its last exposure.
    pub(super) visibility: Visibility,
    /// Time of its last bearing of the track, ...
    seen: Option<Timestamp>,
    /// ... and the interval to the one before, s.
    period_s: Option<f64>,
    pub(super) recent: RecentBearings,
    pub(super) drawn: Option<Drawn>,
    /// The same for what it has seen beside the target, when it has not seen the target itself, ...
    beside: Option<Drawn>,
    /// ... and whether all of that may be the target, as a camera that is turned sees it.
    may_be_it: bool,
    /// The residual of that in the last draw (rad), and for how many draws it has stayed there.
    steady: (Vector2<f64>, u32),
}

impl Ties {
    /// What the camera has seen beside the target since the last draw, if that has stayed in the
    /// same place for at least [`STEADY_DRAWS`] draws.
    fn steady_beside(&mut self) -> Option<Drawn> {
        let beside = self.beside.take().filter(|_| self.drawn.is_none());
        let place = beside.map(|drawn| drawn.mean());
        let (before, draws) = self.steady;
        // The residual may change by a share of itself: what passes by changes it by more.
        let stays = place.is_some_and(|place| (place - before).norm() < STEADY * before.norm());
        self.steady =
            place.map_or((Vector2::zeros(), 0), |place| (place, if stays { draws + 1 } else { 0 }));
        beside.filter(|_| self.steady.1 >= STEADY_DRAWS)
    }

    pub(super) fn new(time: Timestamp) -> Self {
        Self {
            covariance: SharedTies::zeros(),
            learnt: LearntTies::zeros(0),
            lasting_s: CorrelatedNoise::NONE.time_s,
            visibility: Visibility::new(time),
            seen: None,
            period_s: None,
            recent: RecentBearings::default(),
            drawn: None,
            beside: None,
            may_be_it: true,
            steady: (Vector2::zeros(), 0),
        }
    }

    /// For a camera whose bearing is one of those that the track starts from.
    pub(super) fn begun(time: Timestamp, covariance: SharedTies, lasting: CorrelatedNoise) -> Self {
        let lasting_s = lasting.time_s;
        Self {
            covariance,
            lasting_s,
            visibility: Visibility::seen(time),
            seen: Some(time),
            ..Self::new(time)
        }
    }

    /// Moves all times: all clocks have stepped by `step_s` seconds.
    pub(super) fn step_time(&mut self, step_s: f64) {
        self.visibility.step_time(step_s);
        self.seen = self.seen.map(|seen| seen.plus_seconds(step_s));
        self.recent = RecentBearings::default();
    }

    /// Time since the camera's last bearing of the track, s; `None` if there was none.
    pub(super) fn silent_s(&self, now: Timestamp) -> Option<f64> {
        Some(now.seconds_since(self.seen?))
    }

    /// Sets the velocity's ties to zero.
    pub(super) fn forget_velocity(&mut self) {
        self.covariance.fixed_rows_mut::<3>(3).fill(0.0);
    }

    /// Notes a bearing of the track by the camera.
    pub(super) fn see(&mut self, time: Timestamp) {
        self.period_s = self.seen.map(|seen| time.seconds_since(seen).abs());
        self.seen = Some(time);
    }

    /// Whether the camera's last bearing of the track is recent enough to support it: within
    /// `holding_s` seconds, or longer for a slow camera. One that sees the target every two seconds
    /// has not lost it after one and a half.
    pub(super) fn has_seen_lately(&self, now: Timestamp, holding_s: f64) -> bool {
        let period_s = self.period_s.unwrap_or(0.0).min(LONGEST_PERIOD * holding_s);
        self.seen.is_some_and(|seen| {
            now.seconds_since(seen) <= holding_s.max(HOLDING_PERIODS * period_s)
        })
    }

    /// Whether the camera sees the target now: it has missed it for no longer than a detector's
    /// ordinary misses last, or than its bearings are apart. After one bearing nobody knows how far
    /// they are apart: it sees the target for as long as it supports the track.
    pub(super) fn sees(&self, now: Timestamp, holding_s: f64) -> bool {
        let missed_s = match self.period_s {
            None => holding_s,
            Some(period_s) => {
                let period_s = period_s.min(LONGEST_PERIOD * holding_s);
                (MISSED * holding_s).max(HOLDING_PERIODS * period_s)
            }
        };
        self.seen.is_some_and(|seen| now.seconds_since(seen) <= missed_s)
    }

    /// The ties `interval` seconds later: the position moves on with the velocity, and the lasting
    /// errors have partly decayed.
    pub(super) fn predicted(&self, interval: f64) -> SharedTies {
        let mut covariance = self.covariance;
        predict(&mut covariance, interval, self.kept(interval));
        covariance
    }

    /// Moves the ties on by an interval over which this share of the lasting errors is left.
    pub(super) fn predict(&mut self, interval: f64, kept: f64) {
        predict(&mut self.covariance, interval, kept);
    }

    /// Share of a lasting error that is left after an interval (s): exp(-t / T).
    pub(super) fn kept(&self, interval: f64) -> f64 {
        (-interval.abs() / self.lasting_s).exp()
    }
}

/// X <- F X k: the position moves on with the velocity, and of the errors that last a share k is
/// left.
fn predict(ties: &mut SharedTies, interval: f64, kept: f64) {
    for (error, mut tie) in ties.column_iter_mut().enumerate() {
        for axis in 0..3 {
            tie[axis] += tie[axis + 3] * interval;
        }
        if error >= LASTING {
            tie *= kept;
        }
    }
}

impl FusedTrack {
    /// The cameras with whose errors it is correlated, the most first, each with the
    /// cross-covariance and the decay time of the errors that last, s.
    pub(crate) fn shared_ties(&self) -> Vec<(&CameraName, &SharedTies, f64)> {
        let ties =
            self.ties.iter().map(|(camera, ties)| (camera, &ties.covariance, ties.lasting_s));
        let mut tied: Vec<_> = ties.filter(|(_, covariance, _)| covariance.amax() > 0.0).collect();
        tied.sort_by(|one, other| other.1.norm_squared().total_cmp(&one.1.norm_squared()));
        tied
    }

    /// Adds a bearing of the target, which the track has taken in, to the next draw.
    pub(super) fn gather(&mut self, bearing: &TrackBearing<'_>) {
        if bearing.time.seconds_since(self.course.since) > LONGEST_COURSE_S {
            self.begin_course();
            return;
        }
        let velocity = self.state().velocity();
        let residual = self.course.residual(bearing);
        if let (Some(residual), Some(ties)) = (residual, self.ties.get_mut(bearing.camera)) {
            ties.drawn = Some(Drawn::with(ties.drawn, &residual, velocity, bearing));
        }
    }

    /// Begins the next draw with what the track knows now.
    pub(crate) fn begin_course(&mut self) {
        self.course = Course::of(self.state(), self.updated_at);
        for ties in self.ties.values_mut() {
            (ties.drawn, ties.beside) = (None, None);
        }
    }

    /// Adds a bearing that passes beside the target to the next draw, for an exposure that has none
    /// of the target; whether it may be the target's, if the camera is turned.
    pub(crate) fn gather_beside(&mut self, bearing: &TrackBearing<'_>, may_be_it: bool) {
        let velocity = self.state().velocity();
        let residual = self.course.residual(bearing);
        if let (Some(residual), Some(ties)) = (residual, self.ties.get_mut(bearing.camera)) {
            ties.beside = Some(Drawn::with(ties.beside, &residual, velocity, bearing));
            ties.may_be_it &= may_be_it;
        }
    }

    /// The cameras' residuals in the middle of the time since the last draw, if the next draw is due; empty
    /// otherwise. If at least as many cameras as see the target have for long had something beside
    /// it in the same place, that is the target, and their poses are worse than stated: these
    /// residuals are then included.
    pub(crate) fn draw(&mut self) -> Draw {
        if self.updated_at.seconds_since(self.course.since) < DRAW_S {
            return Draw::default();
        }
        let middle_s = self.updated_at.seconds_since(self.course.since) / 2.0;
        let speed = self.course.speed_sd.max(speed_sd(self.state()));
        self.course = Course::of(self.state(), self.updated_at);
        let (mut samples, mut beside) = (Vec::new(), Vec::new());
        for (camera, ties) in &mut self.ties {
            let steady = ties.steady_beside();
            let may_be_it = std::mem::replace(&mut ties.may_be_it, true);
            let sample = |drawn: Drawn| drawn.sample(camera, speed, middle_s);
            match ties.drawn.take() {
                Some(drawn) => samples.push(sample(drawn)),
                None => beside.extend(steady.map(|drawn| (sample(drawn), may_be_it))),
            }
        }
        if beside.len() >= samples.len().max(LEAST_BESIDE) {
            samples.extend(beside.drain(..).map(|(sample, _)| sample));
        }
        let beside = beside.into_iter().filter(|(_, may_be_it)| *may_be_it);
        let beside = beside.map(|(sample, _)| sample).collect();
        Draw { age_s: self.age_s(), samples, beside }
    }

    /// Passes on that a camera's pose error variances are `ratio` times what was assumed, and with
    /// them the part of the track's covariance that they cause.
    pub(crate) fn rescale_pose(&mut self, camera: &CameraName, ratio: f64) {
        let rescaling = Rescaling { ratio, scale: ratio.sqrt() };
        if let Some(change) = self.rescale::<OF_POSE>(camera, 0, rescaling) {
            self.imm.add_covariance(&change);
        }
    }

    /// Passes on that a camera has been calibrated anew: the error of its pose is another one, of
    /// which the track contains nothing.
    pub(crate) fn forget_pose(&mut self, camera: &CameraName) {
        self.rescale::<OF_POSE>(camera, 0, Rescaling { ratio: 1.0, scale: 0.0 });
    }

    /// Passes on what has been learnt of a camera's clock: it is `ahead` (in its standard
    /// deviations so far) of what was subtracted from its times, and its variance is `ratio` times
    /// what it was. The track's mean moves by its tie to the clock times `ahead`.
    ///
    /// A smaller variance (`ratio` below 1) comes from knowledge of the very error that the track
    /// contains, and shrinks the track's covariance. A larger one is a new error, which the track
    /// does not contain: only the ties shrink.
    pub(crate) fn set_clock(
        &mut self,
        camera: &CameraName,
        ClockChange { ahead, ratio }: ClockChange,
    ) {
        let Some(ties) = self.ties.get(camera) else {
            return;
        };
        // x += a X: X is the covariance with an error of unit variance, found to be a.
        let moved = ties.covariance.column(OF_CLOCK) * ahead;
        self.imm.shift(&moved);
        self.shift_learnt(camera, OF_CLOCK, ahead);
        self.shift_past(camera, OF_CLOCK, ahead);
        // X <- sqrt(q) X and P <- P + (q - 1) X X' for q < 1; X <- X / sqrt(q) alone for q > 1.
        let scale = ratio.min(ratio.recip()).sqrt();
        let rescaling = Rescaling { ratio: ratio.min(1.0), scale };
        if let Some(change) = self.rescale::<1>(camera, OF_CLOCK, rescaling) {
            self.imm.add_covariance(&change);
        }
    }

    /// Passes on that a camera's mount has turned it: the errors that last until the next turn are
    /// now other ones.
    pub(crate) fn turn_camera(&mut self, camera: &CameraName) {
        self.renew(camera);
        let learns = self.learns(camera);
        if let Some(ties) = self.ties.get_mut(camera) {
            ties.recent = RecentBearings::default();
            // What was outside its view may be in it now.
            ties.visibility = Visibility::new(ties.visibility.last_exposure());
            if !learns {
                ties.covariance.fixed_columns_mut::<2>(LASTING).fill(0.0);
                ties.learnt.fixed_columns_mut::<2>(LASTING).fill(0.0);
            }
        }
    }

    /// What a bearing and the camera's bearings before it show of its noise, in units of the
    /// reported one; `None` if the camera has no ties yet.
    pub(super) fn third_differences(
        &mut self,
        camera: &CameraName,
        line: &SightLine,
    ) -> Option<ThirdDifferences> {
        let (now, state) = (self.updated_at, self.imm.combined());
        let (place, velocity) = (state.position(), state.velocity());
        let expected = |time: Timestamp| {
            Unit::try_new(place + velocity * time.seconds_since(now) - line.origin, 1e-6)
        };
        let longest_s = self.holding_s * CLOSE_BEARINGS;
        let recent = &mut self.ties.get_mut(camera)?.recent;
        Some(recent.see(now, line, longest_s, expected))
    }

    /// Updates what is known of all cameras' errors after a bearing has updated the models, by the
    /// mean over the models; returns the bearing's mean squared Mahalanobis distance.
    pub(super) fn carry(
        &mut self,
        &TrackBearing { camera, time, uncertainty, .. }: &TrackBearing<'_>,
        results: &[Option<Updated>],
    ) -> f64 {
        let lasting = uncertainty.lasting;
        // Weighted with the probabilities after the update; a model whose numbers failed has none.
        let models = results.iter().zip(self.imm.probabilities().iter().copied());
        let models = models.filter_map(|(result, probability)| {
            Some(ModelUpdate { after: result.as_ref()?, probability })
        });
        let nis = models.clone().map(|model| model.after.nis * model.probability).sum();
        let update = CrossUpdate::over(models);
        self.note(camera, self.updated_at);
        // First all is predicted, then updated; the past states first, as they need the ties before
        // the update.
        self.predict_past(time);
        self.predict_ties(time.seconds_since(self.updated_at));
        self.begin_to_learn(camera, lasting, time);
        self.update_past(camera, &update);
        self.learn(camera, &update);
        if let Some(ties) = self.ties.get_mut(camera) {
            ties.lasting_s = lasting.time_s;
        }
        self.keep_ties_possible();
        nis
    }

    /// Creates the ties to a camera's errors, if there are none.
    pub(super) fn note(&mut self, camera: &CameraName, time: Timestamp) {
        if !self.ties.contains_key(camera) {
            let learnt = self.untied();
            self.ties.insert(camera.clone(), Ties { learnt, ..Ties::new(time) });
        }
    }

    /// Widens each model whose covariance is smaller than the ties allow: the ties are updated with
    /// the mean over the models, and a single model that is surer than that is not believed.
    pub(super) fn keep_ties_possible(&mut self) {
        // P - X C^-1 X' is the covariance that is left once the errors are known: it cannot be
        // negative.
        let shared = self.shared_part();
        if shared.amax() > 0.0 {
            self.imm.raise_to(&shared);
        }
    }
}
