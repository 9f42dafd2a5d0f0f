use std::collections::BTreeMap;

use crossfix_message::Timestamp;

/// Frames of a camera that are remembered: half a minute of 30 per second, and tracks follow within
/// one.
const FRAMES_A_CAMERA: usize = 1000;

/// When each camera's frames arrived, until the tracks come that follow from them.
#[derive(Debug, Default)]
pub(crate) struct Arrivals(BTreeMap<String, BTreeMap<u64, Timestamp>>);

impl Arrivals {
    /// A camera's frame arrived.
    pub(crate) fn note(&mut self, camera: &str, sequence: u64, arrival: Timestamp) {
        let frames = self.0.entry(camera.to_owned()).or_default();
        // A camera that was started again counts from the start: its old frames are another run's.
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

    /// When a frame arrived; asked once.
    pub(crate) fn take(&mut self, camera: &str, sequence: u64) -> Option<Timestamp> {
        self.0.get_mut(camera)?.remove(&sequence)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_another_run_are_forgotten_and_memory_is_bounded() {
        let mut arrivals = Arrivals::default();
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
