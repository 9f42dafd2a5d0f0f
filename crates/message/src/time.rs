use std::fmt;

use serde::{Deserialize, Serialize};

/// An instant: nanoseconds since the Unix epoch, UTC.
///
/// Data without absolute time starts at the epoch. Differences are in seconds, as the mathematics
/// wants them.
///
/// ```
/// use crossfix_message::Timestamp;
/// let start = Timestamp::from_nanos(1_500_000_000);
/// assert_eq!(start.seconds(), 1.5);
/// assert_eq!(Timestamp::from_seconds(2.0).seconds_since(start), 0.5);
/// ```
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
#[serde(transparent)]
pub struct Timestamp(i64);

impl Timestamp {
    /// The earliest instant that can be represented.
    pub const MIN: Self = Self(i64::MIN);
    /// The latest instant that can be represented.
    pub const MAX: Self = Self(i64::MAX);
    /// The Unix epoch.
    pub const EPOCH: Self = Self(0);

    /// From nanoseconds since the Unix epoch.
    pub const fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// From seconds since the Unix epoch, to the nearest nanosecond.
    ///
    /// Saturates at the ends of the range (the years 1677 and 2262); a NaN is the epoch.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// Nanoseconds since the Unix epoch.
    pub const fn nanos(self) -> i64 {
        self.0
    }

    /// Seconds since the Unix epoch.
    pub fn seconds(self) -> f64 {
        self.0 as f64 / 1e9
    }

    /// Seconds from `earlier` to this instant; negative if `earlier` is in fact later.
    pub fn seconds_since(self, earlier: Self) -> f64 {
        match self.0.checked_sub(earlier.0) {
            Some(nanos) => nanos as f64 / 1e9,
            None => (i128::from(self.0) - i128::from(earlier.0)) as f64 / 1e9,
        }
    }

    /// This instant moved by `seconds`, which may be negative; saturates.
    #[must_use]
    pub fn plus_seconds(self, seconds: f64) -> Self {
        Self(self.0.saturating_add((seconds * 1e9).round() as i64))
    }
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.6} s", self.seconds())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_keep_nanoseconds_in_the_present_century() {
        let now = Timestamp::from_nanos(1_790_000_000_123_456_789);
        let later = Timestamp::from_nanos(1_790_000_000_123_456_790);
        assert_eq!(later.seconds_since(now), 1e-9);
    }

    #[test]
    fn the_ends_of_the_range_do_not_overflow() {
        let first = Timestamp::MIN;
        let last = Timestamp::MAX;
        assert!(last.seconds_since(first) > 1.8e10);
        assert_eq!(first.plus_seconds(-1.0), first);
        assert_eq!(last.plus_seconds(1e300), last);
    }
}
