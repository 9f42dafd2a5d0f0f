use std::collections::BTreeMap;

use crossfix_message::Timestamp;
use serde::Serialize;

/// Latency from a bearing to the tracks that followed from it, as the recorder saw both arrive.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Latency {
    /// Median, milliseconds.
    pub p50_ms: f64,
    /// 99th percentile, milliseconds.
    pub p99_ms: f64,
}

/// Pairs bearing frames with the track frames that name them.
#[derive(Clone, Debug, Default)]
pub struct LatencyRecorder {
    bearings: BTreeMap<(String, u64), Timestamp>,
    tracks: Vec<((String, u64), Timestamp)>,
}

impl LatencyRecorder {
    /// A bearing frame arrived.
    pub fn bearing(&mut self, camera: &str, sequence: u64, arrival: Timestamp) {
        self.bearings.insert((camera.to_owned(), sequence), arrival);
    }

    /// A track frame arrived that followed from a camera's frame. The order in which both arrive
    /// does not matter.
    pub fn tracks(&mut self, camera: &str, sequence: u64, arrival: Timestamp) {
        self.tracks.push(((camera.to_owned(), sequence), arrival));
    }

    /// The latency, if any pair has been seen.
    pub fn latency(&self) -> Option<Latency> {
        let pairs = self
            .tracks
            .iter()
            .filter_map(|(key, arrival)| Some(arrival.seconds_since(*self.bearings.get(key)?) * 1e3));
        let mut milliseconds: Vec<f64> = pairs.collect();
        milliseconds.sort_by(f64::total_cmp);
        let last = milliseconds.len().checked_sub(1)?;
        let quantile = |q: f64| milliseconds[(q * last as f64).round() as usize];
        Some(Latency { p50_ms: quantile(0.5), p99_ms: quantile(0.99) })
    }
}
