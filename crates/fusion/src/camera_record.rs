//! What is learnt of a camera from its own bearings.

use crate::noise::WhiteNoise;
use crate::rooted::View;
use crate::{Exposure, FusionConfig};

/// A clock whose variance (logarithm) and offset (in its deviations) change by less than this changes no track.
const NOTICED_CLOCK: f64 = 0.1;
/// A clock whose deviation is less than this is right, s: times are counted in nanoseconds, and what is known of a
/// clock must not be divided by next to nothing.
const RIGHT_CLOCK_S: f64 = 1e-9;

/// What is learnt of a camera from its own bearings.
#[derive(Clone, Debug)]
pub(crate) struct CameraRecord {
    pub(crate) noise: WhiteNoise,
    view: View,
    /// The deviation and the offset of its clock that the tracks know of, s.
    time_sd_s: f64,
    offset_s: f64,
}

impl CameraRecord {
    pub(crate) fn new(config: &FusionConfig, exposure: &Exposure) -> Self {
        let view = View::new(config.tracking.coasting_after_s);
        let (time_sd_s, offset_s) = (exposure.uncertainty.time_sd_s, exposure.correction_s);
        Self { noise: WhiteNoise::default(), view, time_sd_s, offset_s }
    }

    /// Forgets when it has seen what.
    pub(crate) fn look_anew(&mut self, config: &FusionConfig) {
        self.view = View::new(config.tracking.coasting_after_s);
    }

    /// By how much, in its deviations so far, the clock is found to be ahead of what was known, and how its
    /// variance has changed; `None` if that is little.
    pub(crate) fn clock_change(&mut self, exposure: &Exposure) -> Option<(f64, f64)> {
        let (sd_s, offset_s) = (exposure.uncertainty.time_sd_s, exposure.correction_s);
        let ratio = (sd_s / self.time_sd_s).powi(2);
        let ahead = (offset_s - self.offset_s) / self.time_sd_s;
        let known = self.time_sd_s > RIGHT_CLOCK_S && sd_s > RIGHT_CLOCK_S;
        if known && ratio.ln().abs() < NOTICED_CLOCK && ahead.abs() < NOTICED_CLOCK {
            return None;
        }
        (self.time_sd_s, self.offset_s) = (sd_s, offset_s);
        known.then_some((ahead, ratio))
    }

    /// Puts into an exposure what is known of its camera, and takes what it shows in.
    pub(crate) fn tell(&mut self, exposure: &mut Exposure) {
        exposure.uncertainty.factor = self.noise.factor();
        let lines = exposure.sightings.iter().map(|sighting| &sighting.line);
        let rooted = self.view.see(exposure.time, lines);
        for (sighting, rooted) in exposure.sightings.iter_mut().zip(rooted) {
            sighting.rooted = rooted;
        }
    }
}
