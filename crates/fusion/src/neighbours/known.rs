//! What is known of a neighbour's track, and of one here.

use std::collections::VecDeque;

use crossfix_filter::KinematicState;
use crossfix_message::{Payload, Timestamp, Track, TrackEvent, TrackEventKind, TrackState};
use nalgebra::{Matrix6, Vector6};

use super::Number;

/// A centre whose standard deviation of a target's place is this many times smaller says the
/// target. Below 1.5 two centres that see it alike would take turns.
const MUCH_BETTER: f64 = 2.0;

/// How far back states are kept, s: two centres may be as far apart in the time of the data. With
/// half of it those that wait for a slow camera do not know their neighbours' targets.
const KEPT_S: f64 = 2.0;
/// Interval of the states that are kept, s: a target's manoeuvre between two of them does not
/// matter. With half of it the same, in twice the memory.
pub(super) const KEPT_EVERY_S: f64 = 0.2;

/// Where a track was lately.
#[derive(Clone, Debug, Default)]
pub(super) struct PastPlaces {
    newest: Option<(Timestamp, KinematicState)>,
    /// Some of the states that were the newest before, the oldest first.
    kept: VecDeque<(Timestamp, KinematicState)>,
}

impl PastPlaces {
    pub(super) fn add(&mut self, time: Timestamp, state: &KinematicState) {
        self.newest = Some((time, state.clone()));
        match self.kept.back().map(|(last, _)| time.seconds_since(*last)) {
            Some(since_s) if (0.0..KEPT_EVERY_S).contains(&since_s) => return,
            // Time has gone back: what was kept is of times that are still to come.
            Some(since_s) if since_s < 0.0 => self.kept.clear(),
            _ => {}
        }
        self.kept.push_back((time, state.clone()));
        while self.kept.front().is_some_and(|(first, _)| time.seconds_since(*first) > KEPT_S) {
            self.kept.pop_front();
        }
    }

    /// Where the track was at a time, predicted from the last state before it with an unknown
    /// acceleration of this density, m^2/s^3. `None` for a track without a past.
    pub(super) fn at(&self, time: Timestamp, density: f64) -> Option<KinematicState> {
        let newest = self.newest.iter().filter(|(at, _)| *at <= time);
        let before = newest.chain(self.kept.iter().rev().filter(|(at, _)| *at <= time)).next();
        let (at, state) = before.or(self.kept.front())?;
        Some(state.predicted(time.seconds_since(*at), density))
    }
}

/// A track as a neighbour last said it.
#[derive(Clone, Debug)]
pub(super) struct Theirs {
    pub(super) time: Timestamp,
    /// The time here when it was received.
    pub(super) received: Option<Timestamp>,
    pub(super) past: PastPlaces,
    pub(super) grip: Grip,
    pub(super) born: Timestamp,
}

/// A track of the fusion here.
#[derive(Clone, Debug)]
pub(super) struct Ours {
    /// The number under which it is said, and when the track of that number began.
    pub(super) number: Number,
    pub(super) born: Timestamp,
    /// Its number and its beginning before it took another's.
    pub(super) first: (Number, Timestamp),
    pub(super) voice: Voice,
    pub(super) past: PastPlaces,
    pub(super) compared: Option<Timestamp>,
    pub(super) ended: Option<Timestamp>,
    /// What has happened to it and is to be said when the track itself is said.
    pub(super) untold: Vec<TrackEvent>,
}

impl Ours {
    pub(super) fn new(number: Number, now: Timestamp) -> Self {
        Self {
            number,
            born: now,
            first: (number, now),
            voice: Voice::Unsaid,
            past: PastPlaces::default(),
            compared: None,
            ended: None,
            untold: Vec::new(),
        }
    }

    pub(super) fn is_said(&self) -> bool {
        matches!(self.voice, Voice::Speaking(_))
    }

    pub(super) fn has_others_number(&self) -> bool {
        self.number != self.first.0
    }
}

/// Whether a track is said here.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Voice {
    /// Not yet, under this number.
    Unsaid,
    /// It is, since this time.
    Speaking(Timestamp),
    /// It is not: a neighbour says it.
    Silent,
}

/// How well a centre knows where a target is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Grip {
    /// 0: its place is known; 1: a direction; 2: it is not seen; 3: it is hardly there.
    rank: u8,
    worst_sd_m: f64,
}

impl Grip {
    pub(super) fn of(track: &Track, state: &KinematicState) -> Self {
        let rank = match track.state() {
            TrackState::Confirmed => 0,
            TrackState::OneCamera => 1,
            TrackState::Coasting => 2,
            TrackState::Tentative | TrackState::Lost | TrackState::Unspecified => 3,
        };
        Self { rank, worst_sd_m: state.worst_position_sd() }
    }

    pub(super) fn is_better_than(&self, other: &Self) -> bool {
        self.rank < other.rank
            || self.rank == other.rank && self.worst_sd_m * MUCH_BETTER < other.worst_sd_m
    }
}

/// The state of a track from the wire; `None` if it is not valid.
pub(super) fn state_of(track: &Track) -> Option<KinematicState> {
    let (position, velocity) = (track.position.as_ref()?, track.velocity.as_ref()?);
    let covariance: &[f64; 36] = track.covariance.as_slice().try_into().ok()?;
    let mean = [position.x, position.y, position.z, velocity.x, velocity.y, velocity.z];
    let state = KinematicState {
        mean: Vector6::from(mean),
        covariance: Matrix6::from_column_slice(covariance),
    };
    state.is_finite().then_some(state)
}

/// Something that happens to a number here.
pub(super) fn event(kind: TrackEventKind, now: Timestamp, [track, other]: [u64; 2]) -> TrackEvent {
    TrackEvent {
        time_ns: now.nanos(),
        kind: kind.into(),
        track_id: track,
        other_id: other,
        ..Default::default()
    }
    .stamped()
}
