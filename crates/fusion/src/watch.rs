//! What a camera reports beside the targets that are followed.

use crossfix_message::Timestamp;

use crate::ingress::KnownCamera;

/// How long the strangers of a camera are averaged over, s.
const MEMORY_S: f64 = 3.0;
/// Strangers in an exposure that may always be, however few there were.
const LEAST_STRANGERS: f64 = 0.05;

/// What hides a target from cameras hides it for about so long, s.
const HIDDEN_S: f64 = 0.25;

/// How much of a piece of evidence counts that follows another of the same target after an interval
/// of seconds: exposures close together tell no more than one.
pub(crate) fn independent_share(interval_s: f64) -> f64 {
    (interval_s / HIDDEN_S).clamp(0.0, 1.0)
}

/// A camera's exposures so far.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Watch {
    time: Timestamp,
    /// Bearings in an exposure that belong to no track that is held in its place.
    strangers: f64,
}

impl Watch {
    /// A camera's first exposure.
    pub(crate) fn first(time: Timestamp, strangers: usize) -> Self {
        Self { time, strangers: strangers as f64 }
    }

    /// Its next one.
    pub(crate) fn see(&mut self, time: Timestamp, strangers: usize) {
        let weight = (time.seconds_since(self.time) / MEMORY_S).clamp(0.0, 1.0);
        self.strangers += (strangers as f64 - self.strangers) * weight;
        self.time = time;
    }

    /// How many bearings are nobody's, 1/sr about the optical axis.
    pub(crate) fn strangers_per_sr(&self, known: &KnownCamera) -> f64 {
        let lens = known.camera.model().intrinsics();
        let [width, height] = [lens.size.width, lens.size.height].map(f64::from);
        (self.strangers + LEAST_STRANGERS) * (lens.fx / width) * (lens.fy / height)
    }
}
