//! What becomes of all that is known where the site's time jumps.

use crossfix_message::{BearingFrame, Timestamp};

use super::{Fusion, Output};
use crate::Counters;
use crate::clocks::ClockEstimator;
use crate::event_time::EventBuffer;
use crate::ingress::{self, RejectionReason};
use crate::initiation::Initiator;
use crate::site_time::{Step, moved};
use crate::unmet::Unmet;

impl Fusion {
    /// Handles everything that waits.
    pub(super) fn finish(&mut self, outputs: &mut Vec<Output>) {
        while let Some(next) = self.buffer.pop() {
            self.handle(next, outputs);
        }
        while let Some(exposure) = self.next_corrected(Timestamp::from_nanos(i64::MAX)) {
            self.process(&exposure, outputs);
        }
    }

    /// Takes the order of time up anew from a time long passed: what was made of a time that never was
    /// is forgotten.
    pub(super) fn restart(&mut self, time: Timestamp, outputs: &mut Vec<Output>) {
        self.counters.count("event_time_restarts");
        while let Some(exposure) = self.next_corrected(Timestamp::from_nanos(i64::MAX)) {
            let by_s = exposure.time.seconds_since(time);
            self.handle(Err((exposure, RejectionReason::Future { by_s })), outputs);
        }
        let happenings = self.tracker.restart(time);
        self.tell(happenings, time, outputs);
        self.initiator = Initiator::new(&self.config);
        self.unmet = Unmet::new(&self.config.initiation);
        self.clocks = ClockEstimator::new(self.config.clocks.clone());
    }

    /// Takes frames in that have waited until it was clear whether all clocks have stepped.
    pub(super) fn take_after(
        &mut self,
        frames: &[BearingFrame],
        step: Option<&Step>,
        outputs: &mut Vec<Output>,
    ) {
        if let Some(step) = step.filter(|step| self.has_stepped(frames, step.by_s)) {
            self.step_time(step.by_s, outputs);
            self.site_time.confirm(step);
        }
        for frame in frames {
            let behind_s = frame.camera.parse().map_or(0.0, |camera| self.site_time.behind_s(&camera));
            self.take(&moved(frame, behind_s), outputs);
        }
    }

    /// Whether frames that come after a step of the site's time show the targets where they would be if the time
    /// had gone on without it. Time that has gone back has stepped; where it has gone forward the cameras may all
    /// have stood still.
    fn has_stepped(&self, frames: &[BearingFrame], step_s: f64) -> bool {
        let fit = |ahead_s: f64| -> f64 {
            let of_frame = |frame: &BearingFrame| {
                let frame = moved(frame, -ahead_s);
                let name = frame.camera.parse().ok()?;
                let known = self.cameras.at(&name, Timestamp::from_nanos(frame.capture_time_ns))?;
                let read =
                    ingress::read(&frame, &name, known, &self.config.bearings, &mut Counters::default());
                Some(self.tracker.fit(&read.ok()?.0, known))
            };
            frames.iter().filter_map(of_frame).sum()
        };
        step_s < 0.0 || fit(step_s) > fit(0.0)
    }

    /// All clocks have stepped at once: the tracks go on by the new time.
    fn step_time(&mut self, step_s: f64, outputs: &mut Vec<Output>) {
        self.counters.count("site_time_steps");
        self.finish(outputs);
        self.buffer = EventBuffer::new(self.config.event_time.clone());
        self.cameras.now().keys().for_each(|camera| self.buffer.expect(camera));
        self.tracker.step_time(step_s);
        self.clocks.step_time(step_s);
        self.records.clear();
        self.initiator = Initiator::new(&self.config);
        self.unmet = Unmet::new(&self.config.initiation);
    }
}
