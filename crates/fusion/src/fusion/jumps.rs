//! What becomes of all that is known where the site's time jumps.

use crossfix_message::{BearingFrame, Timestamp};

use super::{Fusion, Output};
use crate::Counters;
use crate::clocks::ClockEstimator;
use crate::ingress::{self, RejectionReason};
use crate::initiation::Initiator;
use crate::site_time::{Apart, moved};
use crate::unmet::Unmet;

/// All clocks have stepped forward, and the cameras have not stood still, where that is so much
/// likelier by the targets' bearings (logarithm): a host that sleeps is the commoner.
const STEP_MARGIN: f64 = 8.0;
/// A longer step forward is not told from a host that slept, s: where a target is after that nobody
/// knows.
const LONGEST_FORWARD_S: f64 = 2.0;

impl Fusion {
    /// Handles everything that waits.
    pub(super) fn finish(&mut self, outputs: &mut Vec<Output>) {
        while let Some(next) = self.buffer.pop() {
            self.handle(next, outputs);
        }
        while let Some((exposure, ())) = self.corrected.pop() {
            self.process(&exposure, outputs);
        }
    }

    /// Takes the order of time up anew from a time long passed: what was made of a time that never
    /// was is forgotten.
    pub(super) fn restart(&mut self, time: Timestamp, outputs: &mut Vec<Output>) {
        self.counters.count("event_time_restarts");
        while let Some((exposure, ())) = self.corrected.pop() {
            let by_s = exposure.time.seconds_since(time);
            self.refuse(exposure.refused(RejectionReason::Future { by_s }), outputs);
        }
        self.smooth_all(outputs);
        let changes = self.tracker.restart(time);
        self.cameras.forget_strangers();
        self.emit_events(changes, time, outputs);
        self.initiator = Initiator::new(&self.config);
        self.unmet = Unmet::new(&self.config.initiation);
        self.clocks = ClockEstimator::new(self.config.clocks.clone());
    }

    /// Takes frames in that have waited until it was clear whether all clocks have stepped, s.
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

    /// Takes frames in that have waited until it was clear that some clocks have stepped for
    /// themselves: by how much exactly, tracks have to show.
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

    /// Whether all clocks have stepped by so much, s. Time that has gone back has. Where it has
    /// gone forward all cameras may have stood still, as those of a host that slept; they have not,
    /// if their bearings show the targets where they would be without it, and not where they would
    /// be with it.
    fn has_stepped(&self, frames: &[BearingFrame], step_s: f64) -> bool {
        let fit = |ahead_s: f64| -> f64 {
            let of_frame = |frame: &BearingFrame| {
                let frame = moved(frame, -ahead_s);
                let name = frame.camera.parse().ok()?;
                let known = self.cameras.at(&name, Timestamp::from_nanos(frame.capture_time_ns))?;
                let read = ingress::read(
                    &frame,
                    &name,
                    known,
                    &self.config.bearings,
                    &mut Counters::default(),
                );
                Some(self.tracker.fit(&read.ok()?.0, known))
            };
            frames.iter().filter_map(of_frame).sum()
        };
        step_s < 0.0 || (step_s < LONGEST_FORWARD_S && fit(step_s) > fit(0.0) + STEP_MARGIN)
    }

    /// All clocks have stepped at once: the tracks go on by the new time.
    fn step_time(&mut self, step_s: f64, outputs: &mut Vec<Output>) {
        self.counters.count("site_time_steps");
        self.finish(outputs);
        self.smooth_all(outputs);
        self.buffer.begin_anew();
        self.tracker.step_time(step_s);
        self.clocks.step_time(step_s);
        self.cameras.forget_strangers();
        self.cameras.look_anew();
        self.initiator = Initiator::new(&self.config);
        self.unmet = Unmet::new(&self.config.initiation);
    }
}
