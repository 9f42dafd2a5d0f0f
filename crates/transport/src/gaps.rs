use std::collections::BTreeMap;

/// Counts what is missing between the sequence numbers of each source.
///
/// ```
/// use crossfix_transport::GapCounter;
/// let mut gaps = GapCounter::default();
/// assert_eq!(gaps.see("north", 0), 0);
/// assert_eq!(gaps.see("north", 3), 2);
/// // A source that starts again counts from the start.
/// assert_eq!(gaps.see("north", 0), 0);
/// assert_eq!(gaps.missing(), 2);
/// ```
#[derive(Clone, Debug, Default)]
pub struct GapCounter {
    last: BTreeMap<String, u64>,
    missing: u64,
}

impl GapCounter {
    /// A message of a source came; returns how many are missing before it.
    pub fn see(&mut self, source: &str, sequence: u64) -> u64 {
        let previous = self.last.insert(source.to_owned(), sequence);
        let gap = match previous {
            Some(last) if sequence > last => sequence - last - 1,
            _ => 0,
        };
        self.missing = self.missing.saturating_add(gap);
        gap
    }

    /// All that was missing so far.
    pub fn missing(&self) -> u64 {
        self.missing
    }
}
