use serde::{Deserialize, Serialize};

/// A camera's own clock: what it shows when the true time is t.
///
/// `own = t + offset + drift t`, with t in seconds from the scene's start.
///
/// ```
/// use crossfix_simulation::SimulatedClock;
/// let clock = SimulatedClock { offset_s: 0.05, drift_ppm: 20.0 };
/// assert!((clock.own(100.0) - 100.052).abs() < 1e-12);
/// assert!((clock.true_time(clock.own(100.0)) - 100.0).abs() < 1e-12);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedClock {
    /// What it shows at the scene's start (true time 0), s.
    pub offset_s: f64,
    /// How much too fast it runs, parts per million.
    pub drift_ppm: f64,
}

impl SimulatedClock {
    /// What the clock shows at a true time.
    pub fn own(&self, true_s: f64) -> f64 {
        true_s + self.offset_s + self.drift_ppm * 1e-6 * true_s
    }

    /// The true time at which the clock shows `own_s`.
    pub fn true_time(&self, own_s: f64) -> f64 {
        (own_s - self.offset_s) / (1.0 + self.drift_ppm * 1e-6)
    }
}
