use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use crossfix_message::{CameraName, Timestamp};

use crate::Exposure;

/// Bounds on what waits in one queue. There are two queues, so about 30 MB in all.
struct QueueBounds {
    /// Exposures: 64 cameras of 60 Hz send 1920 within the default lateness, three of 30 Hz 5400
    /// within the longest. With half of it the latter are released before their lateness is over.
    exposures: usize,
    /// Sightings of all of them. With half of it 64 cameras of 60 Hz with more than 26 sightings
    /// each, and not 52, are no longer waited for as long as the lateness.
    sightings: usize,
}

/// The numbers in use; what half of each does is said at its field.
const BOUNDS: QueueBounds = QueueBounds { exposures: 6_000, sightings: 100_000 };

/// Key by which exposures are ordered: two of a camera may be corrected to the same time, and the
/// reported times tell them apart.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct QueueKey {
    time: Timestamp,
    camera: CameraName,
    reported: Timestamp,
}

/// Exposures that wait until nothing can come before them, in the order of their times, each with a
/// note; their number is bounded.
///
/// ```text
///                        out, in order
///                              ^
///          insert              |  nothing can come before it, or more wait than may
///   new  ---------->  waiting -+
///    |                         |  the order starts again
///    | the same waits already  v
///    v                      drained
///  refused
/// ```
///
/// The fusion has two: one by the times that the cameras report ([`super::EventBuffer`] says what
/// can still come), and one by those times less the estimated offsets of the clocks (until no clock
/// can be so far ahead).
#[derive(Debug)]
pub(crate) struct ReorderQueue<Note> {
    waiting: BTreeMap<QueueKey, (Exposure, Note)>,
    sightings: usize,
}

impl<Note> Default for ReorderQueue<Note> {
    fn default() -> Self {
        Self { waiting: BTreeMap::new(), sightings: 0 }
    }
}

impl<Note> ReorderQueue<Note> {
    /// Whether an exposure of this camera and these times waits.
    pub(crate) fn holds(&self, exposure: &Exposure, reported: Timestamp) -> bool {
        let place = QueueKey { time: exposure.time, camera: exposure.camera.clone(), reported };
        self.waiting.contains_key(&place)
    }

    /// Takes an exposure in by its time, with the time that its camera reported, unless the same
    /// waits already.
    pub(crate) fn insert(&mut self, exposure: Exposure, reported: Timestamp, note: Note) {
        let place = QueueKey { time: exposure.time, camera: exposure.camera.clone(), reported };
        if let Entry::Vacant(waiting) = self.waiting.entry(place) {
            self.sightings += exposure.sightings.len();
            waiting.insert((exposure, note));
        }
    }

    /// The first exposure, if it is no later than the time before which nothing can come any more,
    /// or if more wait than is allowed.
    pub(crate) fn pop_settled(&mut self, settled: Option<Timestamp>) -> Option<(Exposure, Note)> {
        let (first, _) = self.waiting.first_key_value()?;
        let is_crowded = self.waiting.len() > BOUNDS.exposures || self.sightings > BOUNDS.sightings;
        (is_crowded || settled.is_some_and(|settled| first.time <= settled)).then(|| self.pop())?
    }

    /// The first exposure, whatever may still come.
    pub(crate) fn pop(&mut self) -> Option<(Exposure, Note)> {
        let (_, (exposure, note)) = self.waiting.pop_first()?;
        self.sightings -= exposure.sightings.len();
        Some((exposure, note))
    }

    /// All that wait, in order.
    pub(crate) fn drained(self) -> impl Iterator<Item = (Exposure, Note)> {
        self.waiting.into_values()
    }

    /// Number of exposures that wait, and of their sightings.
    #[cfg(test)]
    pub(super) fn load(&self) -> (usize, usize) {
        (self.waiting.len(), self.sightings)
    }
}
