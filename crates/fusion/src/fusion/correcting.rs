//! Times corrected by what is known of the cameras' clocks, and the order that follows from them.

use crossfix_message::Timestamp;

use super::{Fusion, Output};
use crate::ingress::{Exposure, RejectionReason};

/// What a camera said of an exposure's time.
#[derive(Clone, Copy, Debug)]
pub(super) struct SaidTime {
    time: Timestamp,
    /// Standard deviation, s.
    sd_s: f64,
}

impl Fusion {
    /// Subtracts the clock's estimated offset from an exposure's time. The corrected times may come
    /// in another order, so an exposure waits until no camera's clock can be far enough ahead for
    /// an earlier exposure still to come.
    pub(super) fn correct(&mut self, exposure: Exposure, outputs: &mut Vec<Output>) {
        self.clocks.see(&exposure.camera, &exposure.uncertainty);
        if self.clock(&exposure.camera).is_none() {
            return self.process(&exposure, outputs);
        }
        let said = SaidTime { time: exposure.time, sd_s: exposure.uncertainty.time_sd_s };
        self.wait(exposure, said, outputs);
        // No exposure to come can be corrected to before this: times come in order, less the
        // largest offset.
        let settled = |fusion: &Self| said.time.plus_seconds(-fusion.clocks.largest_offset());
        while let Some(next) = self.next_corrected(Some(settled(self)), outputs) {
            self.process(&next, outputs);
        }
    }

    /// The next exposure by corrected times, if nothing can come before it any more; without a
    /// `settled` time, whatever may still come.
    ///
    /// All that waits has been corrected by the same estimates. Were two estimates of a clock in
    /// use by turns, the tracks would take each change for news of their errors.
    pub(super) fn next_corrected(
        &mut self,
        settled: Option<Timestamp>,
        outputs: &mut Vec<Output>,
    ) -> Option<Exposure> {
        if self.corrected_by != self.clocks.changes() {
            self.corrected_by = self.clocks.changes();
            let waiting = std::mem::take(&mut self.corrected);
            for (exposure, said) in waiting.drained() {
                self.wait(exposure, said, outputs);
            }
        }
        let next = match settled {
            Some(settled) => self.corrected.pop_settled(Some(settled)),
            None => self.corrected.pop(),
        };
        next.map(|(exposure, _)| exposure)
    }

    /// Corrects the time of an exposure by what is known of the clocks now, and keeps the exposure
    /// until nothing can come before it.
    fn wait(&mut self, mut exposure: Exposure, said: SaidTime, outputs: &mut Vec<Output>) {
        if let Some(clock) = self.clock(&exposure.camera) {
            exposure.correction_s = clock.offset_s;
            exposure.time = said.time.plus_seconds(-clock.offset_s);
            let sd_s = self.clocks.time_sd_s(&exposure.camera, &clock, said.sd_s);
            exposure.uncertainty.time_sd_s = sd_s;
        }
        if let Some(by_s) = self.buffer.behind_processed_s(exposure.time) {
            return self.refuse(exposure.refused(RejectionReason::Late { by_s }), outputs);
        }
        if self.corrected.holds(&exposure, said.time) {
            return self.refuse(exposure.refused(RejectionReason::Duplicate), outputs);
        }
        self.corrected.insert(exposure, said.time, said);
    }
}
