//! Limits warnings that would be repeated endlessly.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// A warning of one kind is logged at once, then at this interval with the number of repeats. With
/// half of it one that lasts costs twice as many lines.
const PERIOD: Duration = Duration::from_secs(60);
/// Most kinds that are distinguished: the names in them come from outside. With half as many all
/// beyond 500 share one line, and hide each other.
const MOST_KINDS: usize = 1000;

/// Logs the first warning of a kind at once, and after that once a minute how many more there were,
/// so that whoever can cause a warning cannot fill a disk with it.
#[derive(Debug, Default)]
pub struct Repeats {
    kinds: BTreeMap<String, RepeatedWarning>,
}

#[derive(Debug)]
struct RepeatedWarning {
    said: Instant,
    /// Number of warnings since, and the text of the first of them.
    more: u64,
    first: String,
}

impl Repeats {
    /// Adds a warning of a kind. Its text is only made when it is logged.
    pub fn warn(&mut self, kind: &str, now: Instant, text: impl FnOnce() -> String) {
        if let Some(line) = self.line(kind, now, text) {
            tracing::warn!("{line}");
        }
    }

    /// As [`Self::warn`], for good news. How often it came again is logged with the warnings'
    /// counts.
    pub fn info(&mut self, kind: &str, now: Instant, text: impl FnOnce() -> String) {
        if let Some(line) = self.line(kind, now, text) {
            tracing::info!("{line}");
        }
    }

    /// Logs the due counts of warnings that have stopped coming.
    pub fn remind(&mut self, now: Instant) {
        for kind in self.kinds.values_mut() {
            if let Some(line) = kind.due(now) {
                tracing::warn!("{line}");
            }
        }
    }

    /// Logs all counts that have not been logged yet, at the end.
    pub fn end(&mut self) {
        self.kinds
            .values_mut()
            .filter_map(RepeatedWarning::rest)
            .for_each(|line| tracing::warn!("{line}"));
    }

    fn line(&mut self, kind: &str, now: Instant, text: impl FnOnce() -> String) -> Option<String> {
        let has_room = self.kinds.len() < MOST_KINDS || self.kinds.contains_key(kind);
        let kind = if has_room { kind } else { "others" };
        if let Some(known) = self.kinds.get_mut(kind) {
            known.more += 1;
            if known.more == 1 {
                known.first = text();
            }
            return known.due(now);
        }
        let line = text();
        self.kinds
            .insert(kind.to_owned(), RepeatedWarning { said: now, more: 0, first: String::new() });
        Some(line)
    }
}

impl RepeatedWarning {
    fn due(&mut self, now: Instant) -> Option<String> {
        if now.saturating_duration_since(self.said) < PERIOD {
            return None;
        }
        let line = self.rest()?;
        self.said = now;
        Some(line)
    }

    /// The line for the warnings of this kind that have not been logged yet.
    fn rest(&mut self) -> Option<String> {
        let more = std::mem::take(&mut self.more);
        (more > 0).then(|| format!("{} ({more} times since this was said last)", self.first))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thousand_warnings_of_a_kind_are_two_lines() {
        let (mut repeats, begun) = (Repeats::default(), Instant::now());
        let lines: Vec<String> = (0..1000)
            .filter_map(|i| repeats.line("gap", begun + PERIOD * i / 999, || format!("gap {i}")))
            .collect();
        assert_eq!(lines, ["gap 0", "gap 1 (999 times since this was said last)"]);
        assert_eq!(repeats.line("other", begun, || "other".to_owned()).as_deref(), Some("other"));
    }

    #[test]
    fn the_last_of_a_flood_is_said_though_nothing_comes_after_it() {
        let (mut repeats, now) = (Repeats::default(), Instant::now());
        repeats.line("gap", now, String::new);
        repeats.line("gap", now, || "gap".to_owned());
        let kind = repeats.kinds.get_mut("gap").unwrap();
        assert_eq!(
            kind.due(now + PERIOD).as_deref(),
            Some("gap (1 times since this was said last)")
        );
        assert_eq!(kind.due(now + 3 * PERIOD), None);
        repeats.line("gap", now + PERIOD, || "another".to_owned());
        let kind = repeats.kinds.get_mut("gap").unwrap();
        assert_eq!(kind.rest().as_deref(), Some("another (1 times since this was said last)"));
        assert_eq!(kind.rest(), None, "at the end, once");
    }

    #[test]
    fn kinds_are_bounded() {
        let (mut repeats, now) = (Repeats::default(), Instant::now());
        let said = (0..5000).filter_map(|i| repeats.line(&i.to_string(), now, String::new)).count();
        assert_eq!(said, MOST_KINDS + 1);
        assert_eq!(
            repeats.line("7", now + PERIOD, || "known".to_owned()).as_deref(),
            Some("known (1 times since this was said last)")
        );
    }
}
