use std::collections::BTreeMap;

use crossfix_message::Timestamp;
use serde::Serialize;

/// Latency from a bearing to the tracks that followed from it, by the times at which the recorder
/// received both.
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
    /// Arrivals by camera and frame number; several for one number if the camera was restarted and
    /// counts from the start again.
    bearings: BTreeMap<(String, u64), Vec<Timestamp>>,
    tracks: Vec<((String, u64), Timestamp)>,
}

impl LatencyRecorder {
    /// Adds the arrival of a bearing frame.
    pub fn bearing(&mut self, camera: &str, sequence: u64, arrival: Timestamp) {
        self.bearings.entry((camera.to_owned(), sequence)).or_default().push(arrival);
    }

    /// Adds the arrival of a track frame that followed from a camera's frame. The order in which
    /// both arrive does not matter.
    pub fn tracks(&mut self, camera: &str, sequence: u64, arrival: Timestamp) {
        self.tracks.push(((camera.to_owned(), sequence), arrival));
    }

    /// The latency, if there is any pair, and half of the tracks come after what they followed
    /// from: nothing comes before its cause, so the times of an import are not those of an arrival.
    pub fn latency(&self) -> Option<Latency> {
        let pairs = self.tracks.iter().filter_map(|(key, arrival)| {
            Some(arrival.seconds_since(self.cause(key, *arrival)?) * 1e3)
        });
        let mut milliseconds: Vec<f64> = pairs.collect();
        milliseconds.sort_by(f64::total_cmp);
        let last = milliseconds.len().checked_sub(1)?;
        let quantile = |q: f64| milliseconds[(q * last as f64).round() as usize];
        let latency = Latency { p50_ms: quantile(0.5), p99_ms: quantile(0.99) };
        (latency.p50_ms >= 0.0).then_some(latency)
    }

    /// Arrival of the frame that caused tracks which arrived at a time: the last arrival before
    /// that time, or the first where the tracks overtook the frame.
    fn cause(&self, key: &(String, u64), tracks: Timestamp) -> Option<Timestamp> {
        let arrivals = self.bearings.get(key)?;
        arrivals
            .iter()
            .rev()
            .find(|arrival| **arrival <= tracks)
            .or_else(|| arrivals.first())
            .copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tracks_that_come_before_what_they_followed_from_have_no_latency() {
        for (late_s, is_known) in [(0.02, true), (-0.004, false)] {
            let mut recorder = LatencyRecorder::default();
            for sequence in 0..10 {
                let arrival = Timestamp::from_seconds(0.1 * sequence as f64);
                recorder.bearing("a", sequence, arrival);
                recorder.tracks("a", sequence, arrival.plus_seconds(late_s));
            }
            assert_eq!(recorder.latency().is_some(), is_known, "{late_s} s");
        }
    }

    #[test]
    fn a_camera_that_was_started_again_has_no_latency_of_minutes() {
        let mut recorder = LatencyRecorder::default();
        for run_s in [0.0, 600.0] {
            for sequence in 0..10 {
                let arrival = Timestamp::from_seconds(run_s + 0.1 * sequence as f64);
                recorder.bearing("a", sequence, arrival);
                recorder.tracks("a", sequence, arrival.plus_seconds(0.02));
            }
        }
        let latency = recorder.latency().unwrap();
        assert!(
            (latency.p50_ms - 20.0).abs() < 0.01 && (latency.p99_ms - 20.0).abs() < 0.01,
            "{latency:?}"
        );
    }
}
