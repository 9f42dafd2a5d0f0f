//! Texts that several formats use.

use crossfix_message::{Timestamp, TrackState};
use time::OffsetDateTime;

/// An instant as in RFC 3339, in UTC, to the millisecond: `2026-11-26T12:34:56.789Z`.
pub(crate) fn utc(time: Timestamp) -> String {
    let whole_ms = i128::from(time.nanos()).div_euclid(1_000_000) * 1_000_000;
    let at =
        OffsetDateTime::from_unix_timestamp_nanos(whole_ms).unwrap_or(OffsetDateTime::UNIX_EPOCH);
    format!(
        "{:04}-{:02}-{:02}T{:02}:{:02}:{:02}.{:03}Z",
        at.year(),
        u8::from(at.month()),
        at.day(),
        at.hour(),
        at.minute(),
        at.second(),
        at.millisecond()
    )
}

/// A track's state in words.
pub(crate) fn state(state: TrackState) -> &'static str {
    match state {
        TrackState::Unspecified | TrackState::Tentative => "tentative",
        TrackState::Confirmed => "confirmed",
        TrackState::Coasting => "coasting",
        TrackState::OneCamera => "one camera",
        TrackState::Lost => "lost",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_instant_is_written_as_the_standard_has_it() {
        let at = |nanos| utc(Timestamp::from_nanos(nanos));
        assert_eq!(at(1_795_696_496_789_999_999), "2026-11-26T12:34:56.789Z");
        assert_eq!(at(-1), "1969-12-31T23:59:59.999Z");
        assert_eq!(utc(Timestamp::MIN).len(), utc(Timestamp::MAX).len());
    }
}
