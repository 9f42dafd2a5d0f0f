//! Whether a target can be seen at all: what hides it from a camera.

use crossfix_message::Timestamp;

/// What hides a target from cameras hides it for about so long, s.
const HIDDEN_S: f64 = 0.25;

/// How much of a piece of evidence counts that follows another of the same target after an interval
/// of seconds: exposures close together tell no more than one.
pub(crate) fn independent_share(interval_s: f64) -> f64 {
    (interval_s / HIDDEN_S).clamp(0.0, 1.0)
}

/// How often a visible target is hidden from a camera (by a tree, a house, glare) within the time
/// for which a camera's bearing holds a track: once in twenty seconds. With half of it a camera
/// that is blind for a target costs its track too much.
const HIDDEN: f64 = 0.075;
/// How often one that is hidden comes into sight again within that time: every two seconds.
const APPEARS: f64 = 0.75;

/// Log-likelihood ratio of a camera's not reporting a target that is visible to it with a probability, and
/// that it reports with another where it is.
pub(crate) fn log_missed(visible: f64, detection: f64) -> f64 {
    (1.0 - visible * detection).ln()
}

/// Whether a camera can see a target: a chain of two states, visible and hidden. A camera that
/// misses a target ten times running has it behind something; that is one event and not ten.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Visibility {
    visible: f64,
    time: Timestamp,
}

impl Visibility {
    /// The probability that a target is visible of which nothing is known.
    pub(crate) const UNKNOWN: f64 = APPEARS / (APPEARS + HIDDEN);

    pub(crate) fn new(time: Timestamp) -> Self {
        Self { visible: Self::UNKNOWN, time }
    }

    pub(crate) fn seen(time: Timestamp) -> Self {
        Self { visible: 1.0, time }
    }

    /// When the camera was exposed last.
    pub(crate) fn last_look(&self) -> Timestamp {
        self.time
    }

    /// The probability that the target is visible at a time; a bearing holds a track for
    /// `holding_s`.
    pub(crate) fn at(&self, time: Timestamp, holding_s: f64) -> f64 {
        let interval = time.seconds_since(self.time).max(0.0) / holding_s;
        let kept = (-(HIDDEN + APPEARS) * interval).exp();
        Self::UNKNOWN + (self.visible - Self::UNKNOWN) * kept
    }

    /// All clocks have stepped by so much, s.
    pub(crate) fn step_time(&mut self, step_s: f64) {
        self.time = self.time.plus_seconds(step_s);
    }

    /// The camera has been exposed and has seen the target or not; `detection` is the probability
    /// that it reports one that is visible.
    pub(crate) fn look(&mut self, time: Timestamp, seen: bool, detection: f64, holding_s: f64) {
        let before = self.at(time, holding_s);
        let missed = before * (1.0 - detection);
        self.visible = if seen { 1.0 } else { missed / (missed + 1.0 - before) };
        self.time = time;
    }
}
