use std::collections::{BTreeMap, VecDeque};

use crossfix_message::{CameraName, Timestamp};

use crate::Exposure;

/// A camera whose newest exposure is older than this many frame intervals of another is silent.
const SILENT_INTERVALS: f64 = 5.0;
/// A period is closed where the exposures lie within this factor of as close as they ever do.
const SPREAD_FACTOR: f64 = 1.2;

/// Gathers exposures into observation periods: one exposure of each camera that is heard, closed
/// where these lie closest together, which for cameras that scan in turn is at the end of a scan.
#[derive(Debug)]
pub(crate) struct Periods {
    shortest_s: f64,
    cameras: usize,
    /// The newest exposure of each camera that no period has used.
    unused: BTreeMap<CameraName, Exposure>,
    heard: BTreeMap<CameraName, Timestamp>,
    /// How far apart the cameras' newest exposures lay, s, at each of the last exposures.
    spreads: VecDeque<f64>,
    closed: Option<Timestamp>,
    /// Whether a camera has been heard twice: by then the others have been heard once.
    repeated: bool,
}

impl Periods {
    /// Periods of at least `shortest_s` seconds and this many cameras.
    pub(crate) fn new(shortest_s: f64, cameras: usize) -> Self {
        Self {
            shortest_s,
            cameras,
            unused: BTreeMap::new(),
            heard: BTreeMap::new(),
            spreads: VecDeque::new(),
            closed: None,
            repeated: false,
        }
    }

    /// Takes an exposure in, and returns the period if it ends with it; `known` is the number of
    /// cameras that may be heard.
    pub(crate) fn add(&mut self, exposure: Exposure, known: usize) -> Option<BTreeMap<CameraName, Exposure>> {
        let now = exposure.time;
        let before = self.heard.len();
        let previous = self.heard.insert(exposure.camera.clone(), now);
        self.unused.insert(exposure.camera.clone(), exposure);
        if let Some(interval) = previous.map(|time| now.seconds_since(time)) {
            self.heard.retain(|_, time| now.seconds_since(*time) <= SILENT_INTERVALS * interval);
        }
        self.repeated |= previous.is_some();
        if self.heard.len() != before {
            // Other cameras lie otherwise.
            self.spreads.clear();
        }
        let spread_of = |oldest: Option<Timestamp>| oldest.map_or(0.0, |time| now.seconds_since(time));
        if self.heard.len() < self.cameras || !(self.repeated || self.heard.len() >= known) {
            return None;
        }
        self.spreads.push_back(spread_of(self.heard.values().min().copied()));
        while self.spreads.len() > 2 * self.heard.len() {
            self.spreads.pop_front();
        }
        let closest = self.spreads.iter().copied().fold(f64::INFINITY, f64::min);
        let (unused, heard) = (&mut self.unused, &self.heard);
        unused.retain(|camera, _| heard.contains_key(camera));
        let complete = unused.len() == heard.len();
        let spread = spread_of(unused.values().map(|exposure| exposure.time).min());
        let long_enough = self.closed.is_none_or(|closed| now.seconds_since(closed) >= self.shortest_s);
        if !(complete && long_enough && spread <= closest * SPREAD_FACTOR) {
            return None;
        }
        self.closed = Some(now);
        Some(std::mem::take(&mut self.unused))
    }
}
