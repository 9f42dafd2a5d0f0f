use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crossfix_message::Key;

use crate::{Origin, RunId};

/// Most runs remembered per key: the one that publishes, and those before it. With half of it three
/// that take turns would each be forgotten before they come again, and never count as rivals.
const RUNS_A_KEY: usize = 4;
/// Most keys that are counted. A site of 1000 cameras has 5000; more is an attack. With half of it
/// such a site just fits.
const MAX_KEYS: usize = 10_000;
/// A larger gap is not counted as a loss: the number makes no sense. This is three hours of 100
/// messages per second. With half of it the loss of an hour and a half at that rate is not counted.
const LARGEST_GAP: u64 = 1_000_000;
/// Two runs that took turns on a key less than this ago still count as rivals. With half of it a
/// warning about two that take turns every six seconds comes and goes.
const RIVALRY: Duration = Duration::from_secs(10);

/// Counts the messages of each key that did not arrive, and notices two publishers on one key.
///
/// ```
/// use std::time::Instant;
/// use crossfix_transport::{Origin, Reception, RunId};
/// let key = "crossfix/field/north/bearings".parse()?;
/// let mut reception = Reception::default();
/// let mut see = |run, sequence| {
///     reception.see(&key, Origin { run: RunId(run), sequence }, Instant::now())
/// };
/// assert_eq!(see(1, 0), 0);
/// assert_eq!(see(1, 3), 2);
/// // A program that was started again counts from the start.
/// assert_eq!(see(2, 0), 0);
/// assert_eq!(reception.missing(), 2);
/// assert!(reception.rivals(Instant::now()).is_empty());
/// # Ok::<(), crossfix_message::KeyError>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Reception {
    keys: BTreeMap<Key, Senders>,
    missing: u64,
}

/// The runs that have published on a key.
#[derive(Clone, Debug, Default)]
struct Senders {
    /// Each run with the sequence number that is expected next; the run heard most recently is the
    /// last.
    runs: Vec<(RunId, u64)>,
    /// When a run last published again after another run had taken over.
    took_turns: Option<Instant>,
}

impl Reception {
    /// Notes a message that came at a time; returns how many are missing before it.
    pub fn see(&mut self, key: &Key, origin: Origin, now: Instant) -> u64 {
        if !self.keys.contains_key(key) && self.keys.len() >= MAX_KEYS {
            return 0;
        }
        let senders = self.keys.entry(key.clone()).or_default();
        let known = senders.runs.iter().position(|(run, _)| *run == origin.run);
        let expected = known.map(|index| senders.runs.remove(index).1);
        // A run that was not the one heard most recently publishes again: two runs take turns.
        if known.is_some_and(|index| index < senders.runs.len()) {
            senders.took_turns = Some(now);
        }
        let next = origin.sequence.saturating_add(1);
        senders.runs.push((origin.run, expected.map_or(next, |expected| expected.max(next))));
        if senders.runs.len() > RUNS_A_KEY {
            senders.runs.remove(0);
        }
        let gap = expected.map_or(0, |expected| origin.sequence.saturating_sub(expected));
        let gap = if gap > LARGEST_GAP { 0 } else { gap };
        self.missing += gap;
        gap
    }

    /// Number of messages missing so far.
    pub fn missing(&self) -> u64 {
        self.missing
    }

    /// The keys on which two runs take turns now, each with the two runs heard most recently.
    pub fn rivals(&self, now: Instant) -> Vec<(&Key, [RunId; 2])> {
        let keys = self.keys.iter();
        keys.filter_map(|(key, senders)| Some((key, senders.rivals(now)?))).collect()
    }
}

impl Senders {
    /// The two runs heard most recently, if runs take turns now.
    fn rivals(&self, now: Instant) -> Option<[RunId; 2]> {
        self.took_turns.filter(|then| now.saturating_duration_since(*then) < RIVALRY)?;
        let [.., (one, _), (other, _)] = self.runs[..] else { return None };
        Some([one, other])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key() -> Key {
        "crossfix/field/north/bearings".parse().unwrap()
    }

    #[test]
    fn two_that_take_turns_on_a_key_are_named_and_a_restart_is_not() {
        let (mut reception, key, now) = (Reception::default(), key(), Instant::now());
        let mut see = |run, sequence| {
            reception.see(&key, Origin { run: RunId(run), sequence }, now);
            reception.rivals(now).len()
        };
        assert_eq!([see(1, 0), see(1, 1), see(2, 0), see(2, 1)], [0; 4], "a restart");
        assert_eq!([see(1, 2), see(2, 2)], [1; 2], "the first is still there");
        assert_eq!(reception.missing(), 0, "each has its own count");
        assert_eq!(reception.rivals(now), [(&key, [RunId(1), RunId(2)])]);
        assert!(reception.rivals(now + 2 * RIVALRY).is_empty(), "one of them has stopped");
    }

    #[test]
    fn one_that_was_overtaken_is_not_counted_twice() {
        let (mut reception, key) = (Reception::default(), key());
        let mut see =
            |sequence| reception.see(&key, Origin { run: RunId(1), sequence }, Instant::now());
        assert_eq!([5, 3, 6].map(&mut see), [0, 0, 0]);
    }

    #[test]
    fn a_number_from_nowhere_is_no_loss() {
        let (mut reception, key) = (Reception::default(), key());
        for sequence in [0, u64::MAX, 5, u64::MAX, 0, 1_000, 0, 1_000] {
            reception.see(&key, Origin { run: RunId(1), sequence }, Instant::now());
        }
        assert_eq!(reception.missing(), 0);
    }
}
