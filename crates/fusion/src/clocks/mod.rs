//! Estimates the cameras' clocks from the tracks: where several cameras see a moving target, it
//! lies off each sight line by its velocity times the offset of that camera's clock.
//!
//! The bearings of a few tracks are gathered for some seconds ([`window`]), stamped by the cameras'
//! own clocks. The target's trajectory ([`curve`]) and all clocks are fitted to them at once
//! ([`adjustment`]), and the result updates the belief about the clocks ([`belief`]). A recursive
//! filter was used here before: an offset of 200 ms times a velocity not yet known is no linear
//! problem, and in straight passes at 30 m/s it was sure of a wrong answer in three of eight.

mod adjustment;
mod batch_means;
mod belief;
mod common_time;
mod curve;
mod window;
mod window_update;

use std::collections::{BTreeMap, BTreeSet};

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, ClockSource, Timestamp};
use nalgebra::Matrix6;

use self::belief::Belief;
use self::window::{ClockRole, StampedLine, TrackWindow};
use self::window_update::{WindowUpdate, window_update};
use crate::config::Clocks;
use crate::ingress::Exposure;
use crate::track::{FusedTrack, TrackId};
use crate::tracker::Tracker;
use crate::uncertainty::CameraUncertainty;

/// Number of targets whose bearings are gathered at the same time. With one, a site of 24 cameras
/// takes three times as long to know its clocks: a window holds eight.
const MAX_WINDOWS: usize = 3;
/// Least speed of such a target, m/s: a slower one says next to nothing about clocks. With half of
/// it a target whose place is known to 0.1 m tells a clock to 0.1 s, and keeps a window from a
/// faster one.
const LEAST_SPEED: f64 = 2.0;
/// How long the bearings of a target are gathered before the result is kept, s. With half of it
/// there are two batches of residuals (`batch_means`), in which even a factor of 3.8 passes for
/// chance.
const WINDOW_S: f64 = 8.0;
/// A clock counts as well known when its relative deviation is below this, s: the time in which a
/// target of 20 m/s flies 4 cm. With half of it the windows are evaluated every second for longer,
/// to gain 2 cm.
const SURE_S: f64 = 0.002;
/// How often the open windows are evaluated while a clock is worse known than [`SURE_S`], s. With
/// half of it twice as many adjustments, of milliseconds each, show a new clock half a second
/// sooner.
const UNSURE_CHECK_S: f64 = 1.0;
/// How often they are evaluated when all clocks are well known, s: one may jump. With half of it
/// that shows two seconds sooner, at twice the cost.
const SURE_CHECK_S: f64 = 4.0;
/// Least time between two adjustments, s: many exposures may come at once. With half of it twice as
/// many adjustments may hold up the exposures of one moment.
const PAUSE_S: f64 = 0.02;
/// A clock counts as worse than before when its camera reports a deviation this many times larger.
/// With half of it one whose report wavers by a half is forgotten once, by chance.
const WORSE: f64 = 3.0;
/// After this many windows in a row that fit only if everything learnt was wrong, it is taken to
/// have been wrong. With one, a single window in which two targets were mixed up undoes all that
/// was learnt.
const MAX_REFUSED: u32 = 2;

/// Estimate of a camera's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockEstimate {
    /// How far the clock is ahead, s: subtracted from its capture times.
    pub offset_s: f64,
    /// Standard deviation of the offset from true time, s. An error that all clocks have in common
    /// cannot be observed: it stays as large as the clocks' reported deviations leave it.
    pub sd_s: f64,
    /// Standard deviation of the offset from the common time of all the site's clocks, s.
    pub relative_sd_s: f64,
    /// Drift: how fast the clock gains, s/s.
    pub drift: f64,
    /// Standard deviation of the drift, s/s.
    pub drift_sd: f64,
}

/// What a camera reports of its clock, and whether that clock is suspected of a jump.
#[derive(Clone, Copy, Debug)]
struct Reported {
    /// Standard deviation that the camera reports, s: the belief starts from it.
    sd_s: f64,
    /// Time source of the clock, as the camera reports it.
    source: ClockSource,
    /// Whether the clock may have jumped.
    suspected: bool,
    /// Whether the open windows determine the clock all the same, so that it need not be widened.
    cleared: bool,
}

impl Reported {
    fn new(sd_s: f64, source: ClockSource) -> Self {
        Self { sd_s, source, suspected: false, cleared: false }
    }
}

/// One pass over the open windows, one window per exposure: an adjustment takes milliseconds.
#[derive(Clone, Debug, Default)]
struct Round {
    /// Index of the next window.
    next: usize,
    /// The belief updated by the windows before it.
    belief: Option<Belief>,
    /// Cameras whose clocks these windows determine.
    cleared: BTreeSet<CameraName>,
}

/// Estimates the clocks of all cameras.
#[derive(Clone, Debug)]
pub(crate) struct ClockEstimator {
    config: Clocks,
    /// The belief from closed windows.
    belief: Belief,
    /// The same, updated by what the open windows say so far.
    provisional: Option<Belief>,
    windows: Vec<TrackWindow>,
    /// Largest relative deviation of a clock when the last window was closed, s.
    worst_sd_s: f64,
    /// What each camera reports of its clock.
    reported: BTreeMap<CameraName, Reported>,
    now: Timestamp,
    next_check: Timestamp,
    /// When the next window may be adjusted.
    next_adjustment: Timestamp,
    /// The pass over the open windows that is under way.
    round: Option<Round>,
    needed: bool,
    /// Windows in a row that contradicted everything learnt before.
    refused: u32,
    /// How many times what is known of the clocks may have changed.
    changes: u64,
}

impl ClockEstimator {
    pub(crate) fn new(config: Clocks) -> Self {
        Self {
            config,
            belief: Belief::default(),
            provisional: None,
            windows: Vec::new(),
            worst_sd_s: 0.0,
            reported: BTreeMap::new(),
            now: Timestamp::MIN,
            next_check: Timestamp::MIN,
            next_adjustment: Timestamp::MIN,
            round: None,
            needed: false,
            refused: 0,
            changes: 0,
        }
    }

    /// How many times what is known of the clocks may have changed: times that were corrected by an
    /// earlier estimate are to be corrected again.
    pub(crate) fn changes(&self) -> u64 {
        self.changes
    }

    /// Whether any clock is uncertain enough to be estimated.
    pub(crate) fn is_needed(&self) -> bool {
        self.needed
    }

    /// Makes a camera's clock and pose known, with the deviations it reports. Of later reports only
    /// two kinds count: one that makes the clock much worse than it was, as when its time source is
    /// lost, and one of another clock, as from a network camera that says only now what its own
    /// clock shows.
    pub(crate) fn see(&mut self, camera: &CameraName, reported: &CameraUncertainty) {
        let reported_sd_s = reported.time_sd_s;
        if !self.config.estimate {
            return;
        }
        // sd of a random walk of density w after the length t of a window: sqrt(w t).
        let walks = (reported.clock_walk * WINDOW_S).sqrt();
        let uncertain = reported_sd_s.max(walks) >= self.config.least_sd_s
            && !self.config.trusted.contains(camera);
        let deviations = if uncertain { [reported_sd_s, self.config.drift_sd] } else { [0.0, 0.0] };
        let Some(before) = self.reported.get_mut(camera) else {
            self.needed |= uncertain;
            self.reported
                .insert(camera.clone(), Reported::new(reported_sd_s, reported.clock_source));
            let pose = reported.pose.map(|pose| *pose.covariance());
            let walk = if uncertain { reported.clock_walk } else { 0.0 };
            self.belief.add(camera, deviations, walk, pose);
            self.forget_provisional();
            return;
        };
        let is_another = reported.clock_source != before.source;
        if is_another || uncertain && reported_sd_s >= WORSE * before.sd_s {
            self.needed |= uncertain;
            (before.sd_s, before.source) = (reported_sd_s, reported.clock_source);
            if is_another {
                self.belief.replace(camera, deviations);
            } else {
                self.belief.worsen(camera, deviations);
            }
            self.forget_provisional();
            self.suspect(camera);
        }
    }

    /// Standard deviation of an exposure's time relative to the other cameras', s, from the
    /// estimate of its clock and from its camera's report: a clock that is not estimated is as good
    /// as reported.
    pub(crate) fn time_sd_s(
        &self,
        camera: &CameraName,
        known: &ClockEstimate,
        reported_sd_s: f64,
    ) -> f64 {
        if self.uses_reported_sd(camera) {
            known.relative_sd_s.max(reported_sd_s)
        } else {
            known.relative_sd_s
        }
    }

    /// Whether a clock is not estimated because its camera reports that it is good.
    fn uses_reported_sd(&self, camera: &CameraName) -> bool {
        !self.belief.is_uncertain(camera) && !self.config.trusted.contains(camera)
    }

    /// Takes in a camera's new calibration: its bearings so far say nothing of the new pose.
    pub(crate) fn calibrate(&mut self, camera: &CameraName, pose: Option<Matrix6<f64>>) {
        if self.belief.knows(camera) {
            self.belief.calibrate(camera, pose);
            self.forget_provisional();
            self.windows.clear();
        }
    }

    /// Discards the result of the open windows so far: a camera is new, or no longer as it was.
    fn forget_provisional(&mut self) {
        self.changes += 1;
        self.provisional = None;
        self.round = None;
    }

    fn newest(&self) -> &Belief {
        self.provisional.as_ref().unwrap_or(&self.belief)
    }

    /// The estimate of a camera's clock.
    pub(crate) fn estimate(&self, camera: &CameraName) -> Option<ClockEstimate> {
        let estimate = self.newest().estimate(camera, self.now)?;
        let uses_reported = self.uses_reported_sd(camera);
        let widens =
            |reported: &&Reported| uses_reported || (reported.suspected && !reported.cleared);
        let reported = self.reported.get(camera).filter(widens);
        let widened = |sd: f64| reported.map_or(sd, |reported| reported.sd_s.max(sd));
        let (sd_s, relative_sd_s) = (widened(estimate.sd_s), widened(estimate.relative_sd_s));
        Some(ClockEstimate { sd_s, relative_sd_s, ..estimate })
    }

    /// The largest offset of all clocks, s, at least 0: no camera's corrected time lies farther
    /// before its reported one.
    pub(crate) fn largest_offset(&self) -> f64 {
        self.newest().largest_offset(self.now)
    }

    /// Moves on to a time: closes a window that is full or whose track two cameras no longer see,
    /// or now and then evaluates an open one. One window at a time, as an exposure waits for it.
    pub(crate) fn advance(&mut self, time: Timestamp, tracker: &Tracker) {
        self.now = self.now.max(time);
        if self.now < self.next_adjustment {
            return;
        }
        let followed = |id: TrackId| {
            tracker.track(id).is_some_and(|t| t.is_confirmed() && t.is_triangulated())
        };
        let now = self.now;
        let full = |window: &TrackWindow| now.seconds_since(window.start) >= WINDOW_S;
        if let Some(index) = self.windows.iter().position(|w| full(w) || !followed(w.track)) {
            let window = self.windows.remove(index);
            self.close(&window);
            self.changes += 1;
            self.worst_sd_s = self.worst_sd();
            self.round = Some(Round::default());
            self.next_adjustment = now.plus_seconds(PAUSE_S);
            return;
        }
        if self.round.is_none() && self.now >= self.next_check {
            self.round = Some(Round::default());
        }
        if let Some(round) = self.round.take() {
            self.evaluate_next(round);
            self.next_adjustment = now.plus_seconds(PAUSE_S);
        }
    }

    /// Handles a step of all clocks by `step_s`, s: what was learnt stays, the open windows belong
    /// to another time.
    pub(crate) fn step_time(&mut self, step_s: f64) {
        self.belief.step_time(step_s);
        self.forget_provisional();
        self.windows.clear();
        for time in [&mut self.now, &mut self.next_check, &mut self.next_adjustment] {
            *time = time.plus_seconds(step_s);
        }
    }

    /// Takes in a bearing of a track, stamped by the camera's own clock.
    pub(crate) fn update(&mut self, track: &FusedTrack, exposure: &Exposure, line: &SightLine) {
        // Undo the correction: windows use the camera's own time.
        let time = exposure.time.plus_seconds(exposure.correction_s);
        let camera = &exposure.camera;
        let known = self.windows.iter().position(|window| window.track == track.id);
        let Some(index) = known.or_else(|| self.open_window(track, time)) else {
            return;
        };
        let is_new = !self.windows[index].cameras.contains(camera);
        let role = if is_new && self.is_to_be_estimated(camera, index) {
            ClockRole::Estimated
        } else {
            ClockRole::Anchor
        };
        let window = &mut self.windows[index];
        let CameraUncertainty { declared_lasting, factor, .. } = exposure.uncertainty;
        let line = StampedLine { time, line: *line, lasting: declared_lasting, white: factor };
        window.add(camera, role, line, track.position_at(exposure.time).coords);
    }

    /// Opens a window for a track that shows the clocks, if there is room for one; returns its
    /// index.
    fn open_window(&mut self, track: &FusedTrack, time: Timestamp) -> Option<usize> {
        let fast = track.state().velocity().norm() >= LEAST_SPEED;
        let worth = fast && track.is_confirmed() && track.is_triangulated();
        (worth && self.windows.len() < MAX_WINDOWS).then(|| {
            self.windows.push(TrackWindow::new(track.id, time));
            self.windows.len() - 1
        })
    }

    /// Deviation of a camera's clock relative to the others, s; 0 for a camera without an estimate.
    fn relative_sd_s(&self, camera: &CameraName) -> f64 {
        self.belief.estimate(camera, self.now).map_or(0.0, |clock| clock.relative_sd_s)
    }

    /// Largest relative deviation of any camera's clock, s.
    fn worst_sd(&self) -> f64 {
        self.reported.keys().map(|camera| self.relative_sd_s(camera)).fold(0.0, f64::max)
    }

    /// Whether a window should learn a camera's clock: it is among the worst known, and the camera
    /// is in no other window.
    fn is_to_be_estimated(&self, camera: &CameraName, index: usize) -> bool {
        let others = || self.windows.iter().enumerate().filter(|(other, _)| *other != index);
        let sd = self.relative_sd_s(camera);
        // The worst half first: a window holds few cameras.
        let is_bad = self.is_suspected(camera) || sd > SURE_S.max(self.worst_sd_s / 2.0);
        is_bad && !others().any(|(_, window)| window.cameras.contains(camera))
    }

    /// Marks a clock that may have jumped, as its camera's bearings do not fit the others'. It
    /// counts as badly known as it was at the start, until a window determines it.
    pub(crate) fn suspect(&mut self, camera: &CameraName) {
        if self.belief.is_uncertain(camera) {
            if let Some(reported) = self.reported.get_mut(camera) {
                self.changes += u64::from(!reported.suspected || reported.cleared);
                (reported.suspected, reported.cleared) = (true, false);
            }
            self.next_check = self.next_check.min(self.now.plus_seconds(UNSURE_CHECK_S));
            // Earlier bearings may have been stamped before the jump.
            self.windows
                .iter_mut()
                .for_each(|window| *window = window.without_early(f64::INFINITY, camera));
            self.round = None;
        }
    }

    /// Keeps the result of a closed window.
    fn close(&mut self, window: &TrackWindow) {
        match window_update(&self.belief, window) {
            WindowUpdate::Accepted(belief) => {
                self.belief = *belief;
                self.refused = 0;
                for camera in window.checked_cameras() {
                    if let Some(reported) = self.reported.get_mut(&camera) {
                        reported.suspected = false;
                    }
                }
            }
            WindowUpdate::Uninformative => {}
            WindowUpdate::Contradicts(belief) => {
                self.refused += 1;
                if self.refused >= MAX_REFUSED {
                    self.refused = 0;
                    self.belief = *belief;
                }
            }
        }
    }

    fn is_suspected(&self, camera: &CameraName) -> bool {
        self.reported.get(camera).is_some_and(|reported| reported.suspected)
    }

    /// Whether the clock of a camera that sees one of the windows' targets is not well known.
    fn is_unsure(&self) -> bool {
        self.windows
            .iter()
            .flat_map(|window| &window.cameras)
            .any(|camera| self.is_unsure_of(camera))
    }

    fn is_unsure_of(&self, camera: &CameraName) -> bool {
        let clock = self.belief.estimate(camera, self.now);
        self.is_suspected(camera) || clock.is_some_and(|clock| clock.relative_sd_s > SURE_S)
    }

    /// Evaluates the next open window; after the last one the provisional belief takes effect.
    fn evaluate_next(&mut self, mut round: Round) {
        if let Some(window) = self.windows.get(round.next) {
            if let WindowUpdate::Accepted(next) =
                window_update(round.belief.as_ref().unwrap_or(&self.belief), window)
            {
                round.belief = Some(*next);
                round.cleared.extend(window.checked_cameras());
            }
            round.next += 1;
        }
        if round.next < self.windows.len() {
            self.round = Some(round);
            return;
        }
        for (camera, reported) in &mut self.reported {
            reported.cleared = round.cleared.contains(camera);
        }
        self.provisional = round.belief;
        self.changes += 1;
        // Soon again while a clock that is in use is not well known.
        let pause = if self.is_unsure() { UNSURE_CHECK_S } else { SURE_CHECK_S };
        self.next_check = self.now.plus_seconds(pause);
    }
}

#[cfg(test)]
mod tests;
