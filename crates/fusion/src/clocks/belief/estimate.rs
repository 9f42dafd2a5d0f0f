//! What the belief says of one clock.

use std::collections::BTreeMap;

use crossfix_message::{CameraName, Timestamp};

use super::{Belief, ClockEntry, MAX_OFFSET_S};
use crate::clocks::ClockEstimate;
use crate::clocks::common_time::StatedClock;

/// Offset (s) or drift (s/s) of a clock relative to the common time of all clocks.
#[derive(Clone, Copy, Debug)]
struct AbsoluteClock {
    mean: f64,
    variance: f64,
    /// Variance of the common time itself.
    common: f64,
}

impl Belief {
    /// The estimate of a camera's clock at a time.
    pub(in crate::clocks) fn estimate(
        &self,
        camera: &CameraName,
        time: Timestamp,
    ) -> Option<ClockEstimate> {
        let clock = self.cameras.get(camera)?;
        let ahead = self.ahead(time);
        let [offset, drift] = [0, 1].map(|component| self.absolute(clock, component, ahead));
        let reported = StatedClock { offset: offset.mean, variance: clock.prior };
        Some(ClockEstimate {
            offset_s: offset.mean.clamp(-MAX_OFFSET_S, MAX_OFFSET_S),
            // No clock is worse known than its report says, as far as the report is believed.
            sd_s: (offset.variance + offset.common).min(reported.believed(offset.mean)).sqrt(),
            relative_sd_s: offset.variance.sqrt(),
            drift: drift.mean,
            drift_sd: (drift.variance + drift.common).min(clock.drift_prior).sqrt(),
        })
    }

    /// The largest offset of all clocks, s, at least 0: no camera's corrected time lies farther
    /// before its reported one.
    pub(in crate::clocks) fn largest_offset(&self, time: Timestamp) -> f64 {
        let ahead = self.ahead(time);
        let offset = |clock: &ClockEntry| self.relative(clock, 0, ahead);
        // Relative to the common time an offset is x_k - sum share x + common_offset, as in
        // `absolute`.
        let common = self.shares().map(|(clock, share)| share * offset(clock)).sum::<f64>()
            - (self.common_offset[0] + self.common_offset[1] * ahead);
        self.cameras
            .values()
            .map(|clock| offset(clock) - common)
            .fold(0.0, f64::max)
            .min(MAX_OFFSET_S)
    }

    /// A clock's offset (component 0) or drift (1) relative to the common time of all clocks.
    fn absolute(&self, clock: &ClockEntry, component: usize, ahead: f64) -> AbsoluteClock {
        let common = match component {
            0 => self.common.variance,
            _ => self.shares().map(|(clock, share)| share.powi(2) * clock.drift_prior).sum(),
        };
        let row = self.absolute_row(clock, component, ahead);
        let common_offset = if component == 0 {
            self.common_offset[0] + self.common_offset[1] * ahead
        } else {
            self.common_offset[1]
        };
        let mean =
            row.iter().map(|(&i, weight)| weight * self.mean[i]).sum::<f64>() + common_offset;
        AbsoluteClock { mean, variance: self.variance_of(&row).max(0.0), common }
    }

    /// Variance h P h' of a row vector h over the state.
    fn variance_of(&self, row: &BTreeMap<usize, f64>) -> f64 {
        let of_row = |i: usize| row.iter().map(|(&k, b)| b * self.covariance[(i, k)]).sum::<f64>();
        row.iter().map(|(&i, a)| a * of_row(i)).sum()
    }

    /// Row vector h of x_clock - sum_k share_k x_k over the state, where the offset `ahead` seconds
    /// later is offset + ahead * drift.
    fn absolute_row(
        &self,
        clock: &ClockEntry,
        component: usize,
        ahead: f64,
    ) -> BTreeMap<usize, f64> {
        let mut row: BTreeMap<usize, f64> = BTreeMap::new();
        let others = self.shares().map(|(other, share)| (other, -share));
        for (one, weight) in std::iter::once((clock, 1.0)).chain(others) {
            let Some(index) = one.index.filter(|_| weight != 0.0) else { continue };
            *row.entry(index + component).or_default() += weight;
            if component == 0 {
                *row.entry(index + 1).or_default() += weight * ahead;
            }
        }
        row
    }
}
