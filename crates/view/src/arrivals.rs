use std::collections::BTreeMap;

use crossfix_message::Timestamp;

/// Frames per camera whose arrival is remembered: half a minute at 30 per second; the tracks follow
/// within that time. With half of it tracks that follow after more than 16 s at that rate have no
/// latency.
const FRAMES_A_CAMERA: usize = 1000;

/// Arrival times of each camera's frames, kept until the tracks that follow from them come.
#[derive(Debug, Default)]
pub(crate) struct FrameArrivals(BTreeMap<String, BTreeMap<u64, Timestamp>>);

impl FrameArrivals {
    /// Notes the arrival of a camera's frame.
    pub(crate) fn note(&mut self, camera: &str, sequence: u64, arrival: Timestamp) {
        let frames = self.0.entry(camera.to_owned()).or_default();
        // A restarted camera numbers from 0 again: its old frames belong to another run.
        if frames.last_key_value().is_some_and(|(&last, _)| {
            sequence < last.saturating_sub(FRAMES_A_CAMERA as u64 / 2) || sequence == 0
        }) {
            frames.clear();
        }
        frames.insert(sequence, arrival);
        if frames.len() > FRAMES_A_CAMERA {
            frames.pop_first();
        }
    }

    /// The arrival of a frame; it is removed, so it can be asked for once.
    pub(crate) fn take(&mut self, camera: &str, sequence: u64) -> Option<Timestamp> {
        self.0.get_mut(camera)?.remove(&sequence)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_another_run_are_forgotten_and_memory_is_bounded() {
        let mut arrivals = FrameArrivals::default();
        for sequence in 0..5000 {
            arrivals.note("a", sequence, Timestamp::from_nanos(sequence as i64));
        }
        assert_eq!(arrivals.0["a"].len(), FRAMES_A_CAMERA);
        assert_eq!(arrivals.take("a", 4999), Some(Timestamp::from_nanos(4999)));
        assert_eq!(arrivals.take("a", 4999), None);
        arrivals.note("a", 0, Timestamp::from_seconds(9.0));
        assert_eq!(arrivals.take("a", 4998), None);
        assert_eq!(arrivals.take("a", 0), Some(Timestamp::from_seconds(9.0)));
    }
}
