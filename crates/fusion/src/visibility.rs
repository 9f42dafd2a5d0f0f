//! Whether a target can be seen at all: what hides it from a camera.

use crossfix_message::Timestamp;

/// Rate at which a visible target is hidden from a camera (by a tree, a house, glare), per time for
/// which a camera's bearing holds (supports) a track: once in twenty seconds. With half of it a
/// camera that is blind for a target costs its track too much.
const HIDDEN: f64 = 0.075;
/// Rate at which a hidden target comes into sight again, per the same time: every two seconds. With
/// half of it a target of which nothing is known is visible with 0.83 and not 0.91, and a miss says
/// less against a ghost.
const APPEARS: f64 = 0.75;

/// Probability that a target is in a camera's view after all where that does not reach: by errors
/// of pose and lens at its border. With half of it the same: it comes into sight by the rate above.
const OUT_OF_VIEW: f64 = 1e-3;

/// Log-likelihood ratio of a missed report, for a target that the camera reports with probability
/// `detection`.
pub(crate) fn log_missed(detection: f64) -> f64 {
    (1.0 - detection).ln()
}

/// Whether a camera can see a target: a Markov chain of two states, visible and hidden. A camera
/// that misses a target ten times running has it behind something; that is one event and not ten.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Visibility {
    visible: f64,
    time: Timestamp,
}

impl Visibility {
    /// Probability that a target of which nothing is known is visible: the chain's stationary one.
    pub(crate) const UNKNOWN: f64 = APPEARS / (APPEARS + HIDDEN);

    pub(crate) fn new(time: Timestamp) -> Self {
        Self { visible: Self::UNKNOWN, time }
    }

    pub(crate) fn seen(time: Timestamp) -> Self {
        Self { visible: 1.0, time }
    }

    /// Time of the camera's last exposure.
    pub(crate) fn last_exposure(&self) -> Timestamp {
        self.time
    }

    /// Probability that the target is visible at a time; `holding_s` is how long a bearing holds a
    /// track.
    pub(crate) fn at(&self, time: Timestamp, holding_s: f64) -> f64 {
        let interval = time.seconds_since(self.time).max(0.0) / holding_s;
        // p(t) = p_inf + (p - p_inf) exp(-(a + b) t), with the two rates a and b.
        let kept = (-(HIDDEN + APPEARS) * interval).exp();
        Self::UNKNOWN + (self.visible - Self::UNKNOWN) * kept
    }

    /// Handles a step of all clocks by `step_s`, s.
    pub(crate) fn step_time(&mut self, step_s: f64) {
        self.time = self.time.plus_seconds(step_s);
    }

    /// Takes in an exposure in whose view the target was not.
    pub(crate) fn hide(&mut self, time: Timestamp) {
        (self.visible, self.time) = (OUT_OF_VIEW, time);
    }

    /// Takes in an exposure that has shown the target or not; `detection` is the probability that
    /// the camera reports a target that is visible.
    pub(crate) fn update(&mut self, time: Timestamp, seen: bool, detection: f64, holding_s: f64) {
        let before = self.at(time, holding_s);
        // Bayes: P(visible | missed) = v (1 - d) / (v (1 - d) + 1 - v).
        let missed = before * (1.0 - detection);
        self.visible = if seen { 1.0 } else { missed / (missed + 1.0 - before) };
        self.time = time;
    }
}
