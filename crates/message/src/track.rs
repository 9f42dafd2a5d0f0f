use std::fmt;

use crate::{Timestamp, TrackEvent, TrackEventKind};

/// Number of track identities reserved for one run of the fusion centre. A run that makes more
/// tracks continues into the identities of a run that began a second later; they stay unique as
/// long as no run began then. With half of it that begins at 524 288 tracks; with eight times as
/// many, identities exceed 2^53, which JSON readers take without loss.
const TRACKS_A_RUN: u64 = 1 << 20;

/// The identity of the `number`-th track (counted from 1) of a run of the fusion centre that began
/// at a data time.
///
/// It follows from the data alone, so that the same bearings give the same tracks live and
/// replayed. A restarted fusion centre begins at a later time and so gives other identities. Less
/// than 2^53, which JSON readers take without loss.
pub fn track_id(run_began: Timestamp, number: u64) -> u64 {
    // Data without absolute time begins at the epoch: its tracks are 1, 2, 3.
    let seconds = u64::try_from(run_began.nanos()).unwrap_or(0) / 1_000_000_000;
    seconds * TRACKS_A_RUN + number
}

/// The identity of track `number` in the same run as track `id`.
pub fn renumbered(id: u64, number: u64) -> u64 {
    id - id % TRACKS_A_RUN + number
}

/// A track identity, displayed as the track's number in its run, which is what people call it.
///
/// ```
/// use crossfix_message::{Timestamp, TrackNumber, track_id};
/// let id = track_id(Timestamp::from_seconds(1.79e9), 12);
/// assert_eq!(TrackNumber(id).to_string(), "12");
/// assert_ne!(id, track_id(Timestamp::from_seconds(1.79e9 + 60.0), 12));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrackNumber(pub u64);

impl TrackNumber {
    /// The number of the track in its run, from 1.
    pub fn in_run(self) -> u64 {
        self.0 % TRACKS_A_RUN
    }
}

impl fmt::Display for TrackNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.in_run())
    }
}

/// What happened to which track, for people.
///
/// ```
/// use crossfix_message::{TrackEvent, TrackEventKind};
/// let kind = TrackEventKind::Merged.into();
/// let event = TrackEvent { kind, track_id: 3, other_id: 1, ..Default::default() };
/// assert_eq!(event.to_string(), "track 3 merged into 1");
/// ```
impl fmt::Display for TrackEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let happened = match self.kind() {
            TrackEventKind::Unspecified => "changed",
            TrackEventKind::Born => "born",
            TrackEventKind::Confirmed => "confirmed",
            TrackEventKind::Lost => "lost",
            TrackEventKind::Merged => "merged",
            TrackEventKind::Manoeuvre => "began to manoeuvre",
        };
        write!(f, "track {} {happened}", TrackNumber(self.track_id))?;
        match self.other_id {
            0 => Ok(()),
            other => write!(f, " into {}", TrackNumber(other)),
        }
    }
}
