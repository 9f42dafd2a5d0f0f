use std::collections::{BTreeMap, VecDeque};

use crossfix_message::{CameraName, Timestamp};

use crate::Exposure;

/// A camera counts as silent if its newest exposure is older than this many frame intervals (the
/// median over the cameras). With half of it a camera that skips two frames counts as silent; with
/// twice as much the others wait twice as long for one that has died.
const SILENT_INTERVALS: f64 = 5.0;
/// A period is closed when the exposures lie within this factor of the smallest spread seen lately.
/// Nearer to 1, frames that jitter keep a period open for another round.
const SPREAD_FACTOR: f64 = 1.2;

/// Weight of the last frame interval in the running mean of a camera's frame interval. With half of
/// it a new frame rate is learnt in ten frames and not in five.
const INTERVAL_RATE: f64 = 0.2;

/// A camera that sends exposures at present.
#[derive(Clone, Copy, Debug)]
struct Heard {
    time: Timestamp,
    /// Its usual frame interval, s.
    interval_s: Option<f64>,
}

/// Gathers exposures into observation periods: one exposure of each camera that is heard, closed
/// when these lie closest together in time; for cameras that scan in turn that is at the end of a
/// scan.
#[derive(Debug)]
pub(crate) struct Periods {
    shortest_s: f64,
    cameras: usize,
    /// The newest exposure of each camera that has not been part of a period.
    unused: BTreeMap<CameraName, Exposure>,
    heard: BTreeMap<CameraName, Heard>,
    /// Time between the oldest and the newest of the cameras' newest exposures, s, at each of the
    /// last exposures.
    spreads: VecDeque<f64>,
    closed: Option<Timestamp>,
    /// Whether a camera has been heard twice: by then the others have been heard once.
    repeated: bool,
}

impl Periods {
    /// Periods of at least `shortest_s` seconds and at least this many cameras.
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

    /// Adds an exposure, and returns the period if it ends with this one; `known` is the number of
    /// cameras that may be heard.
    pub(crate) fn add(
        &mut self,
        exposure: Exposure,
        known: usize,
    ) -> Option<BTreeMap<CameraName, Exposure>> {
        let now = exposure.time;
        let before = self.heard.len();
        let previous = self.note_exposure(&exposure.camera, now);
        self.unused.insert(exposure.camera.clone(), exposure);
        if let Some(interval_s) = self.usual_interval_s().filter(|_| previous) {
            self.heard
                .retain(|_, heard| now.seconds_since(heard.time) <= SILENT_INTERVALS * interval_s);
        }
        self.repeated |= previous;
        if self.heard.len() != before {
            // With other cameras the spread is another one.
            self.spreads.clear();
        }
        let spread_of =
            |oldest: Option<Timestamp>| oldest.map_or(0.0, |time| now.seconds_since(time));
        if self.heard.len() < self.cameras || !(self.repeated || self.heard.len() >= known) {
            return None;
        }
        self.spreads.push_back(spread_of(self.heard.values().map(|heard| heard.time).min()));
        while self.spreads.len() > 2 * self.heard.len() {
            self.spreads.pop_front();
        }
        // The smallest spread of the last two rounds: a period may close where it comes that small
        // again.
        let closest = self.spreads.iter().copied().fold(f64::INFINITY, f64::min);
        let (unused, heard) = (&mut self.unused, &self.heard);
        unused.retain(|camera, _| heard.contains_key(camera));
        let complete = unused.len() == heard.len();
        let spread = spread_of(unused.values().map(|exposure| exposure.time).min());
        let long_enough =
            self.closed.is_none_or(|closed| now.seconds_since(closed) >= self.shortest_s);
        if !(complete && long_enough && spread <= closest * SPREAD_FACTOR) {
            return None;
        }
        self.closed = Some(now);
        Some(std::mem::take(&mut self.unused))
    }

    /// Notes an exposure; returns whether the camera has been heard before.
    fn note_exposure(&mut self, camera: &CameraName, now: Timestamp) -> bool {
        let Some(heard) = self.heard.get_mut(camera) else {
            self.heard.insert(camera.clone(), Heard { time: now, interval_s: None });
            return false;
        };
        // Times corrected for the clock's offset may go back.
        let last_s = now.seconds_since(heard.time).max(0.0);
        let usual_s = heard.interval_s.unwrap_or(last_s);
        heard.interval_s = Some(usual_s + INTERVAL_RATE * (last_s - usual_s));
        heard.time = now;
        true
    }

    /// The median of the cameras' frame intervals, s: one camera with odd times changes little.
    fn usual_interval_s(&self) -> Option<f64> {
        let mut intervals: Vec<f64> =
            self.heard.values().filter_map(|heard| heard.interval_s).collect();
        intervals.sort_unstable_by(f64::total_cmp);
        intervals.get(intervals.len() / 2).copied()
    }
}
