//! Jumps of the site's time, and what becomes of the state then.

use crossfix_message::{BearingFrame, Timestamp};

use super::{Fusion, Output};
use crate::Counters;
use crate::clocks::ClockEstimator;
use crate::evidence::BEYOND_DOUBT;
use crate::ingress::{self, RejectionReason};
use crate::initiation::Initiator;
use crate::site_time::{Apart, moved};
use crate::unmet::Unmet;

/// A longer step forward cannot be told from a host that slept, s: after that nobody knows where a
/// target is. With half of it a step of a second and a half moves all tracks on by so much, away
/// from their targets.
const LONGEST_FORWARD_S: f64 = 2.0;

impl Fusion {
    /// Handles everything that waits.
    pub(super) fn finish(&mut self, outputs: &mut Vec<Output>) {
        while let Some(next) = self.buffer.pop() {
            self.handle(next, outputs);
        }
        while let Some(exposure) = self.next_corrected(None, outputs) {
            self.process(&exposure, outputs);
        }
    }

    /// Starts the order of time again at a time long passed: whatever came of times that never were
    /// is dropped.
    pub(super) fn rewind(&mut self, time: Timestamp, outputs: &mut Vec<Output>) {
        self.counters.count("event_time_restarts");
        while let Some((exposure, _)) = self.corrected.pop() {
            let by_s = exposure.time.seconds_since(time);
            self.refuse(exposure.refused(RejectionReason::Future { by_s }), outputs);
        }
        self.smooth_all(outputs);
        let changes = self.tracker.rewind(time);
        self.emit_events(changes, time, outputs);
        self.begin_anew();
        self.clocks = ClockEstimator::new(self.config.clocks.clone());
    }

    /// Handles frames that have waited until it was clear whether all clocks have stepped, by
    /// `step_s` seconds.
    pub(super) fn take_after(
        &mut self,
        frames: &[BearingFrame],
        step_s: f64,
        outputs: &mut Vec<Output>,
    ) {
        if self.has_stepped(frames, step_s) {
            self.step_time(step_s, outputs);
        }
        frames.iter().for_each(|frame| self.take(frame, outputs));
    }

    /// Handles frames that have waited until it was clear that some clocks have stepped by
    /// themselves: by how much exactly, the tracks have to show.
    pub(super) fn take_apart(
        &mut self,
        frames: &[BearingFrame],
        apart: &Apart,
        outputs: &mut Vec<Output>,
    ) {
        for camera in &apart.cameras {
            self.counters.count("clock_steps");
            self.clocks.suspect(camera);
        }
        if let Some(step_s) = apart.site_s {
            self.step_time(step_s, outputs);
        }
        frames.iter().for_each(|frame| self.take(frame, outputs));
    }

    /// Whether all clocks have stepped by `step_s` seconds. A step back is always one. At a step
    /// forward all cameras may instead have stood still, like those of a host that slept; they have
    /// not if the bearings fit the tracks at the times without the step, and not at the times with
    /// it, beyond doubt: a host that slept is the commoner cause.
    fn has_stepped(&self, frames: &[BearingFrame], step_s: f64) -> bool {
        step_s < 0.0
            || (step_s < LONGEST_FORWARD_S
                && self.fit_of(frames, step_s) > self.fit_of(frames, 0.0) + BEYOND_DOUBT)
    }

    /// How well frames fit the tracks with `ahead_s` taken off their times: the sum of the
    /// log-likelihood ratios.
    fn fit_of(&self, frames: &[BearingFrame], ahead_s: f64) -> f64 {
        frames.iter().filter_map(|frame| self.fit_of_frame(&moved(frame, -ahead_s))).sum()
    }

    /// How well a frame fits the tracks, with its time and noise as reported: both times are
    /// compared by the same. `None` if it would be refused.
    fn fit_of_frame(&self, frame: &BearingFrame) -> Option<f64> {
        let name = frame.camera.parse().ok()?;
        let known = self.cameras.at(&name, Timestamp::from_nanos(frame.capture_time_ns))?;
        let read =
            ingress::read(frame, &name, known, &self.config.bearings, &mut Counters::default());
        Some(self.tracker.fit(&read.ok()?.0, known))
    }

    /// Applies a step of all clocks: the tracks continue on the new time.
    fn step_time(&mut self, step_s: f64, outputs: &mut Vec<Output>) {
        self.counters.count("site_time_steps");
        self.finish(outputs);
        self.smooth_all(outputs);
        self.buffer.reset();
        self.tracker.step_time(step_s);
        self.clocks.step_time(step_s);
        self.begin_anew();
    }

    /// Forgets what has been gathered of other things than tracks: it is of another time.
    fn begin_anew(&mut self) {
        self.cameras.forget_views();
        self.initiator = Initiator::new(&self.config);
        self.unmet = Unmet::new(&self.config.initiation);
    }
}
