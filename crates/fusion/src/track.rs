//! One target's track: a filter of position and velocity that single bearings of single cameras
//! update, and what it knows of the cameras' errors.
//!
//! Errors of pose and clock shift all bearings of a camera alike, so they do not average out. They
//! are not part of the state, but their covariance with it is kept (`track/ties.rs`, Schmidt); the
//! errors that last for about a second are estimated with the state (`track/learnt.rs`).
//!
//! Coordinates follow from how many cameras see the target now: Cartesian for two and more, range
//! coordinates about the camera that alone sees it (`range_chart.rs`), as there the range that no
//! bearing holds is one axis.

mod draw;
mod expectation;
mod information;
mod innovation;
mod learnt;
mod past;
mod ties;

use std::collections::{BTreeMap, VecDeque};
use std::fmt;

use crossfix_filter::{Imm, KinematicState};
use crossfix_geometry::{BearingModel, SightLine};
use crossfix_message::{CameraName, Cued, Solver, Timestamp, TrackNumber};
use nalgebra::{Matrix2, Matrix2x6, Matrix6, Point3};

use crate::cameras::ThirdDifferences;
use crate::cueing::CueTarget;
use crate::motion::{
    ManoeuvreDetector, MotionSetup, REINITIALISED_POSITION_SD, REINITIALISED_VELOCITY_SD,
};
use crate::spatial::{Fix, Observability, TimedLine};
use crate::uncertainty::CameraUncertainty;
use crate::update::{Measured, Updated, VAGUE_LOG_RANGE_SD, bearing_update};
use crate::visibility::Visibility;

use draw::Course;
pub(crate) use draw::Draw;
pub(crate) use expectation::TrackExpectation;
use learnt::Learnt;
use past::PastState;
use ties::Ties;

/// A target that just two cameras see counts as placed if its position is known to this share of
/// the range (root of the summed variances of the axes): nearly parallel lines of two different
/// targets cross too. With half of it the lines of two cameras must cross at twice the angle, and
/// targets that are far away are found later.
const MAX_PAIR_SHARE: f64 = 0.03;

/// Identity of a 3D track, unique across restarts: see [`crossfix_message::track_id`]. Displayed as
/// the track's number within its run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TrackId(pub u64);

impl fmt::Display for TrackId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        TrackNumber(self.0).fmt(f)
    }
}

/// The stage of life that a track is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackStatus {
    /// May still be clutter.
    Tentative,
    /// Taken for a target.
    Confirmed,
    /// A target that no camera has seen lately.
    Coasting,
    /// A target that only one camera follows: its direction is known, its range is not.
    OneCamera,
    /// Ended.
    Lost,
}

/// Residual of a bearing against the track's prediction, before the update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasurementResidual {
    /// Capture time of the bearing.
    pub time: Timestamp,
    /// Angle between bearing and prediction, rad.
    pub angle: f64,
    /// Normalised innovation squared, two degrees of freedom.
    pub nis: f64,
}

/// What an update with a bearing has shown beside the new state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Taken {
    /// Whether a manoeuvre detector has fired.
    pub(crate) manoeuvre: bool,
    /// What the camera's last bearings show of their noise.
    pub(crate) third_differences: Option<ThirdDifferences>,
}

/// A bearing as a track takes it in.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrackBearing<'a> {
    pub(crate) camera: &'a CameraName,
    pub(crate) time: Timestamp,
    pub(crate) line: &'a SightLine,
    /// What is uncertain of all bearings of the camera.
    pub(crate) uncertainty: &'a CameraUncertainty,
}

/// A 3D track of one target, updated by single bearings of single cameras.
#[derive(Clone, Debug, PartialEq)]
pub struct FusedTrack {
    /// Its number.
    pub id: TrackId,
    /// Its stage of life.
    pub status: TrackStatus,
    /// Capture time of the newest bearing used: the time of [`Self::state`].
    pub updated_at: Timestamp,
    /// Log-likelihood ratio of target against clutter.
    pub score: f64,
    /// Residual of each camera's newest bearing.
    pub residuals: BTreeMap<CameraName, MeasurementResidual>,
    /// The solver that made the newest update.
    pub solver: Solver,
    /// Which directions of position and velocity the recent bearings determine; computed again
    /// about once a second.
    pub observability: Observability,
    /// When [`Self::observability`] was computed last.
    observed: Timestamp,
    /// Whether two cameras have seen it lately: see [`Self::is_triangulated`].
    triangulated: bool,
    /// Whether two cameras see it now, so that its range is observed and its motion along every
    /// axis: this decides about coordinates. A triangulated track is not always ranged.
    ranged: bool,
    /// When the track began.
    pub(crate) born: Timestamp,
    /// Whether a detector has been found to report two ends of this target as two objects.
    pub(crate) has_ends: bool,
    /// How often it has been compared with the older tracks.
    pub(crate) comparisons: u32,
    /// Position of the camera that gave the newest bearing.
    follower: Option<Point3<f64>>,
    /// What the cameras' bearings are compared with since the last [`Self::draw`].
    course: Course,
    /// When its state was last published, and with which status.
    pub(crate) published: Option<(Timestamp, TrackStatus)>,
    imm: Imm,
    /// Cross-covariance of the track with the shared errors of each camera that has seen it.
    ties: BTreeMap<CameraName, Ties>,
    /// The lasting errors of cameras that it estimates, and their estimates.
    learnt: Learnt,
    /// Earlier states that later bearings still smooth, where that is asked for; the oldest first.
    past: VecDeque<PastState>,
    /// Fisher information of the recent bearings on position and velocity.
    information: Matrix6<f64>,
    detector: Option<ManoeuvreDetector>,
    /// How long after its bearing a camera counts as one that holds (supports) the track, s.
    holding_s: f64,
}

/// A line of the fix that a track starts from.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StartLine<'a> {
    pub(crate) camera: &'a CameraName,
    /// Its covariance already includes the uncertainty of the camera.
    pub(crate) line: &'a TimedLine,
    pub(crate) uncertainty: CameraUncertainty,
}

impl FusedTrack {
    /// A tentative track at a fix of these lines.
    pub(crate) fn start<'a>(
        fix: &Fix,
        lines: impl IntoIterator<Item = StartLine<'a>>,
        motion: &MotionSetup,
    ) -> Self {
        let mut track = Self {
            id: TrackId(0),
            status: TrackStatus::Tentative,
            updated_at: fix.time,
            score: 0.0,
            residuals: BTreeMap::new(),
            solver: fix.solver,
            observability: fix.observability,
            observed: fix.time,
            triangulated: true,
            ranged: true,
            born: fix.time,
            has_ends: false,
            comparisons: 0,
            follower: None,
            course: Course::of(&fix.state, fix.time),
            published: None,
            imm: Imm::new(fix.state.clone(), motion.models(true)),
            ties: BTreeMap::new(),
            learnt: Learnt::default(),
            past: VecDeque::new(),
            information: Matrix6::zeros(),
            detector: motion.detector(),
            holding_s: motion.holding_s,
        };
        for StartLine { camera, line, uncertainty } in lines {
            track.note_start(fix, camera, line, &uncertainty);
        }
        // Not every solver includes in the fix's covariance all that poses and clocks can have done
        // to the fix.
        track.keep_ties_possible();
        track
    }

    /// A tentative track of a target that one camera alone has followed: see [`Self::start`].
    pub(crate) fn start_alone(
        fix: &Fix,
        camera: &CameraName,
        line: &TimedLine,
        uncertainty: CameraUncertainty,
        motion: &MotionSetup,
    ) -> Self {
        let mut track = Self::start(fix, [StartLine { camera, line, uncertainty }], motion);
        // One camera alone: nothing holds the range, and what moves along the sight line is not
        // seen.
        (track.triangulated, track.ranged, track.follower) = (false, false, Some(line.line.origin));
        // A wrong pose does not change how fast the direction turns: the velocity is not tied to
        // it.
        track.ties.values_mut().for_each(Ties::forget_velocity);
        track
    }

    /// Takes over one line of the fix that the track starts with: its residual, its
    /// cross-covariance with the camera's errors, and its information.
    fn note_start(
        &mut self,
        fix: &Fix,
        camera: &CameraName,
        TimedLine { line, time, time_sd_s, origin_sd_m }: &TimedLine,
        uncertainty: &CameraUncertainty,
    ) -> Option<()> {
        let dt = time.seconds_since(fix.time);
        let here = fix.state.predicted(dt, 0.0);
        let model = BearingModel::new(line.origin, here.position())?;
        let residual = model.residual(line)?;
        let shifts = uncertainty.shifts(&model, here.velocity());
        // `moved`: variance by which an uncertain time and origin displace the line, m^2.
        let moved = (here.velocity().norm() * time_sd_s).powi(2) + origin_sd_m.powi(2);
        let noise = model.covariance_of(line) + Matrix2::identity() * (moved / model.range.powi(2));
        // NIS = |L^-1 z|^2 with R = L L': a sum of squares cannot become negative, however nearly
        // singular the noise is.
        let factor = noise.cholesky()?;
        let nis = factor.l().solve_lower_triangular(&residual)?.norm_squared();
        let inverse = factor.inverse();
        self.residuals.insert(
            camera.clone(),
            MeasurementResidual { time: *time, angle: residual.norm(), nis },
        );
        // The line is taken dt after the fix: H = H_p [I, dt I].
        let mut by = Matrix2x6::zeros();
        by.fixed_view_mut::<2, 3>(0, 0).copy_from(&model.by_position());
        by.fixed_view_mut::<2, 3>(0, 3).copy_from(&(model.by_position() * dt));
        // An error J s of the line (s: the camera's shared errors) moves the least-squares
        // solution; the cross-covariance with s is X = -P H' R^-1 J.
        let covariance = -(fix.state.covariance * by.transpose() * inverse * shifts);
        self.ties.insert(camera.clone(), Ties::begun(*time, covariance, uncertainty.lasting));
        self.information += by.transpose() * inverse * by;
        Some(())
    }

    /// Position and velocity at [`Self::updated_at`].
    pub fn state(&self) -> &KinematicState {
        self.imm.combined()
    }

    /// Root of the summed variances of the position, m: at least the standard deviation along any
    /// axis.
    pub(crate) fn position_sd(&self) -> f64 {
        self.state().covariance.diagonal().fixed_rows::<3>(0).sum().sqrt()
    }

    /// Whether the bearings' own noise leaves the place well determined; the part of the covariance
    /// that poses and clocks shift the whole track by is left out.
    pub(crate) fn is_placed(&self) -> bool {
        // The position's part of the sum of X X' over the cameras.
        let shared: f64 =
            self.ties.values().map(|t| t.covariance.fixed_rows::<3>(0).norm_squared()).sum();
        // tr P - |X_p|^2: what is left if poses and clocks were exact.
        let sd = (self.position_sd().powi(2) - shared).max(0.0).sqrt();
        sd <= MAX_PAIR_SHARE * self.range()
    }

    /// Range from the camera that gave the newest bearing, m.
    fn range(&self) -> f64 {
        let place = self.state().position();
        self.follower.map_or(f64::INFINITY, |follower| (place - follower).norm())
    }

    /// Position and velocity expected at another time.
    pub(crate) fn predicted(&self, time: Timestamp, motion: &MotionSetup) -> KinematicState {
        self.imm.predicted(time.seconds_since(self.updated_at), motion.models(self.ranged))
    }

    /// Where the target is expected at another time: the mean alone.
    pub(crate) fn position_at(&self, time: Timestamp) -> Point3<f64> {
        let state = self.imm.combined();
        state.position() + state.velocity() * time.seconds_since(self.updated_at)
    }

    /// The track's state now and for the seconds ahead, for cueing.
    pub(crate) fn known(&self, now: Timestamp, motion: &MotionSetup) -> CueTarget {
        let of = Cued { track_id: self.id.0, ..Default::default() };
        let seen_from = self.alone();
        CueTarget::new(of, now, seen_from, |time| self.predicted(time, motion))
    }

    /// The probability of each motion model.
    pub fn model_probabilities(&self) -> &[f64] {
        self.imm.probabilities()
    }

    /// How many other cameras than this one have lately seen the target.
    pub(crate) fn others_than(&self, camera: &CameraName) -> usize {
        let lately = |ties: &Ties| ties.has_seen_lately(self.updated_at, self.holding_s);
        self.ties.iter().filter(|(name, ties)| lately(ties) && *name != camera).count()
    }

    /// Whether a camera has given it a bearing or should have: only then is anything known of how
    /// that camera sees the target.
    pub(crate) fn is_tied_to(&self, camera: &CameraName) -> bool {
        self.ties.contains_key(camera)
    }

    /// Whether no two cameras saw the target at its newest bearing, and this one did not: any line
    /// of it that crosses the sight line of the other would pass for the target.
    pub(crate) fn is_lost_sight_of_by(&self, camera: &CameraName) -> bool {
        let sees = |ties: &Ties| ties.sees(self.updated_at, self.holding_s);
        !self.ranged && !self.ties.get(camera).is_some_and(sees)
    }

    /// Whether two cameras saw the target at its newest bearing, and so its range.
    pub(crate) fn is_ranged(&self) -> bool {
        self.ranged
    }

    /// Whether the track is only a direction: one camera alone sees the target, and the range is
    /// unknown.
    pub(crate) fn is_a_direction(&self, time: Timestamp, motion: &MotionSetup) -> bool {
        let vague =
            |origin| log_range_sd(&self.predicted(time, motion), origin) > VAGUE_LOG_RANGE_SD;
        self.alone().is_some_and(vague)
    }

    /// Position of the camera that alone sees the target now: the range from there is not observed.
    fn alone(&self) -> Option<Point3<f64>> {
        self.follower.filter(|_| !self.ranged)
    }

    /// Probability that the target is visible to a camera at a time, given what that camera has
    /// seen so far.
    pub(crate) fn visible_to(&self, camera: &CameraName, time: Timestamp) -> f64 {
        let visibility = |ties: &Ties| ties.visibility.at(time, self.holding_s);
        self.ties.get(camera).map_or(Visibility::UNKNOWN, visibility)
    }

    /// Whether another camera has seen the target since this one last looked for it. If nobody has,
    /// whatever hides the target hides it from all cameras, and further misses are no new evidence.
    pub(crate) fn is_seen_since_exposure_of(&self, camera: &CameraName) -> bool {
        self.ties.get(camera).is_none_or(|ties| self.updated_at > ties.visibility.last_exposure())
    }

    /// Notes whether a camera that should see the target has reported it.
    pub(crate) fn note_visibility(
        &mut self,
        camera: &CameraName,
        time: Timestamp,
        seen: bool,
        detection: f64,
    ) {
        self.note(camera, time);
        let holding_s = self.holding_s;
        if let Some(ties) = self.ties.get_mut(camera) {
            ties.visibility.update(time, seen, detection, holding_s);
        }
    }

    /// Notes that the target was outside a camera's view, where that has had it in its view before.
    pub(crate) fn note_out_of_view(&mut self, camera: &CameraName, time: Timestamp) {
        if let Some(ties) = self.ties.get_mut(camera) {
            ties.visibility.hide(time);
        }
    }

    /// Adds evidence (a log-likelihood ratio) for or against the track to its score, which is
    /// capped at `most`.
    pub(crate) fn add_evidence(&mut self, change: f64, most: f64) {
        self.score = (self.score + change).min(most);
    }

    /// Updates the track with a bearing, and tells whether the target has begun to manoeuvre.
    /// `None` if the numbers fail: then the bearing is not used, though a detector may have widened
    /// the covariance.
    pub(crate) fn measurement_update(
        &mut self,
        bearing: TrackBearing<'_>,
        motion: &MotionSetup,
    ) -> Option<Taken> {
        let TrackBearing { camera, time, line, uncertainty } = bearing;
        let interval = time.seconds_since(self.updated_at);
        let innovation = self.innovation(time, line)?;
        let manoeuvre = self.sees_manoeuvre(&innovation, &bearing, motion);
        if manoeuvre {
            self.imm.reinitialise(REINITIALISED_POSITION_SD, REINITIALISED_VELOCITY_SD);
            self.settle_past();
            self.keep_ties_possible();
        }
        // Where one camera alone sees the target, the iterated update works in range coordinates
        // about it.
        let seen_from = self.alone();
        let known = self.errors_of(camera, interval);
        // A lasting error may have been drawn again since (a label that jumps): take the likelier
        // case.
        let renewed = self.renewed(&innovation, &bearing, &known, motion);
        let errors = renewed.unwrap_or(known);
        let measured = Measured { line, camera: uncertainty, errors: &errors };
        let mut results: Vec<Option<Updated>> = Vec::with_capacity(crossfix_filter::MAX_MODELS);
        self.imm.update(interval, motion.models(self.ranged), |state| {
            let result = bearing_update(state, seen_from, &measured);
            let likely = result.as_ref().map(|after| (after.state.clone(), after.log_likelihood));
            results.push(result);
            likely
        })?;
        if renewed.is_some() {
            self.renew(camera);
        }
        // The errors outside the state are carried once, with the mean of all models' updates.
        let nis = self.carry(&bearing, &results);
        self.gather_information(&bearing);
        self.updated_at = time;
        self.follower = Some(line.origin);
        self.solver = Solver::Kalman;
        self.ties.get_mut(camera).into_iter().for_each(|ties| ties.see(time));
        let residual = MeasurementResidual { time, angle: innovation.residual.norm(), nis };
        if let Some(newest) = self.residuals.get_mut(camera) {
            *newest = residual;
        } else {
            self.residuals.insert(camera.clone(), residual);
        }
        let lately = |ties: &&Ties| ties.has_seen_lately(time, self.holding_s);
        self.triangulated = self.ties.values().filter(lately).count() >= 2;
        let sees = |ties: &&Ties| ties.sees(time, self.holding_s);
        self.ranged = self.ties.values().filter(sees).count() >= 2;
        self.gather(&bearing);
        let third_differences = self.third_differences(camera, line);
        Some(Taken { manoeuvre, third_differences })
    }

    /// Whether two cameras have lately supported the track, within 1.5 s or so. With only one since
    /// then the range has been unobserved for long, and the track may have drifted along its sight
    /// line.
    pub fn is_triangulated(&self) -> bool {
        self.triangulated
    }

    /// Moves all times of the track: all clocks have stepped by `step_s` seconds.
    pub(crate) fn step_time(&mut self, step_s: f64) {
        let residuals = self.residuals.values_mut().map(|residual| &mut residual.time);
        let own =
            [&mut self.updated_at, &mut self.observed, &mut self.born, &mut self.course.since];
        for time in own.into_iter().chain(residuals) {
            *time = time.plus_seconds(step_s);
        }
        self.published = None;
        self.ties.values_mut().for_each(|ties| ties.step_time(step_s));
    }

    /// Time from its beginning to its latest bearing, s.
    pub(crate) fn age_s(&self) -> f64 {
        self.updated_at.seconds_since(self.born)
    }

    /// Whether it has been confirmed and is not lost.
    pub fn is_confirmed(&self) -> bool {
        matches!(
            self.status,
            TrackStatus::Confirmed | TrackStatus::Coasting | TrackStatus::OneCamera
        )
    }
}

/// Standard deviation of the logarithm of a state's range from a place: sd(r) / r.
fn log_range_sd(state: &KinematicState, origin: Point3<f64>) -> f64 {
    let away = state.position() - origin;
    (away.dot(&(state.position_covariance() * away))).max(0.0).sqrt() / away.norm_squared()
}

#[cfg(test)]
mod tests;
