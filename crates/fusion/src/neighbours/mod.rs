//! A site that is too large for one fusion centre has several, each of an area. Cameras that see into
//! two areas are heard by both, so a target that flies from the one into the other has for a while a
//! track in each. What is here makes it one target for everybody else: both tracks have the number
//! of the elder, and one of the two centres says it.
//!
//! - *Whether two tracks are one target* is a test of hypotheses ([`likeness`]): their places agree
//!   within what both say of their errors for a second, and no other pair explains either as well.
//! - *Which number* is a comparison of what both centres have said, so that both come to the same end:
//!   that of the track that began earlier. The younger one takes it.
//! - *Which centre says it* is the one that knows where the target is; where both do, the one that
//!   has said it so far ([`Voice`]).
//!
//! There is no border on a map, no message but the tracks themselves, and nobody who decides: a
//! centre that falls silent leaves its targets to those beside it.

mod likeness;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use crossfix_filter::KinematicState;
use crossfix_message::{
    CueFrame, Payload, Timestamp, Track, TrackEvent, TrackEventKind, TrackFrame, TrackState,
    renumbered,
};
use nalgebra::{Matrix6, Vector6};

use crate::{FusionConfig, Output};
use likeness::{Likenesses, Pair};

/// A track of which nothing has been heard for so long is not said any more, s: each is said at least
/// every half second. With half of it a message that is lost ends it; with twice as much a target
/// whose centre has died is gone for twice as long.
const HEARD_FOR_S: f64 = 1.0;
/// Tracks are compared this often, s: they move little between, and each costs a pass over all.
const COMPARED_EVERY_S: f64 = 0.1;
/// So long a new track that may be a neighbour's is not said, s: twice what it takes to find out. Its
/// place is said all the while, by the neighbour.
const HELD_BACK_S: f64 = 2.0;
/// Who knows a target's place so many times better says it. Below 1.5 two centres that see it alike
/// would take turns.
const MUCH_BETTER: f64 = 2.0;
/// Tracks of neighbours that are kept in mind.
const MOST_TRACKS: usize = 10_000;

/// Which of a site's fusion centres one is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    /// Its place among them by name, from 0: it numbers its tracks by every `of`-th number.
    pub index: usize,
    /// How many there are.
    pub of: usize,
}

/// The fusion centres of the areas beside one, as it hears them, and what it says itself for that.
#[derive(Clone, Debug)]
pub struct Neighbours {
    share: Share,
    /// What of a target's acceleration nobody knows, m^2/s^3: between the times of two states.
    density: f64,
    /// How long after a track's end something may still be said of it, s.
    smoothing_s: f64,
    /// By number.
    theirs: BTreeMap<u64, Theirs>,
    /// By the number that the fusion here has given.
    ours: BTreeMap<u64, Ours>,
    likenesses: Likenesses,
    numbered: u64,
    sequence: u64,
}

/// A track as a neighbour said it last.
#[derive(Clone, Debug)]
struct Theirs {
    /// Whose.
    index: usize,
    time: Timestamp,
    state: KinematicState,
    grip: Grip,
    born: Timestamp,
}

/// A track of the fusion here.
#[derive(Clone, Debug)]
struct Ours {
    /// Under which it is said.
    number: u64,
    /// When it began, or the one whose number it has.
    born: Timestamp,
    voice: Voice,
    begun: Timestamp,
    compared: Option<Timestamp>,
    ended: Option<Timestamp>,
    /// What has happened to it and is said when it is said itself.
    untold: Vec<TrackEvent>,
}

/// Whether a track is said here.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Voice {
    /// Not yet.
    Unsaid,
    /// Since a time.
    Speaking(Timestamp),
    /// A neighbour says it.
    Silent,
}

/// How well a target is held: the lower, the better.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
struct Grip {
    /// 0: its place is known; 1: a direction; 2: it is not seen; 3: it is hardly there.
    rank: u8,
    worst_sd_m: f64,
}

impl Grip {
    fn of(track: &Track, state: &KinematicState) -> Self {
        let rank = match track.state() {
            TrackState::Confirmed => 0,
            TrackState::OneCamera => 1,
            TrackState::Coasting => 2,
            TrackState::Tentative | TrackState::Lost | TrackState::Unspecified => 3,
        };
        Self { rank, worst_sd_m: state.worst_position_sd() }
    }

    fn is_better_than(&self, other: &Self) -> bool {
        self.rank < other.rank
            || self.rank == other.rank && self.worst_sd_m * MUCH_BETTER < other.worst_sd_m
    }
}

/// The state of a track of the wire; `None` where it is none.
fn state_of(track: &Track) -> Option<KinematicState> {
    let (position, velocity) = (track.position.as_ref()?, track.velocity.as_ref()?);
    let covariance: &[f64; 36] = track.covariance.as_slice().try_into().ok()?;
    let mean = [position.x, position.y, position.z, velocity.x, velocity.y, velocity.z];
    let state = KinematicState {
        mean: Vector6::from(mean),
        covariance: Matrix6::from_column_slice(covariance),
    };
    state.is_finite().then_some(state)
}

impl Share {
    /// The identity of this one's so-many-th track; `own` is one of the same run.
    fn number(self, own: u64, count: u64) -> u64 {
        renumbered(own, (count - 1) * self.of as u64 + self.index as u64 + 1)
    }
}

impl Ours {
    fn new(number: u64, now: Timestamp) -> Self {
        Self {
            number,
            born: now,
            voice: Voice::Unsaid,
            begun: now,
            compared: None,
            ended: None,
            untold: Vec::new(),
        }
    }
}

impl Theirs {
    fn is_heard(&self, now: Timestamp) -> bool {
        now.seconds_since(self.time).abs() < HEARD_FOR_S
    }
}

impl Neighbours {
    /// Of a fusion centre that has some share in its site's targets.
    pub fn new(share: Share, config: &FusionConfig) -> Self {
        let densities = config.tracking.models.iter().map(|model| model.acceleration_density);
        Self {
            share,
            density: densities.fold(0.0, f64::max),
            smoothing_s: config.tracking.smoothing_s,
            theirs: BTreeMap::new(),
            ours: BTreeMap::new(),
            likenesses: Likenesses::default(),
            numbered: 0,
            sequence: 0,
        }
    }

    /// Takes in what the neighbour at a place among all centres says of its tracks.
    pub fn hear(&mut self, index: usize, frame: &TrackFrame) {
        let time = Timestamp::from_nanos(frame.time_ns);
        self.theirs.retain(|_, track| track.is_heard(time));
        for track in &frame.tracks {
            let state = state_of(track).filter(|_| track.state() != TrackState::Lost);
            match state {
                // Before it is sure, it may be nothing.
                _ if track.state() == TrackState::Tentative => {}
                Some(state) if self.theirs.len() < MOST_TRACKS => {
                    let (grip, born) =
                        (Grip::of(track, &state), Timestamp::from_nanos(track.born_ns));
                    self.theirs.insert(track.id, Theirs { index, time, state, grip, born });
                }
                _ => drop(self.theirs.remove(&track.id)),
            }
        }
    }

    /// What the fusion here says, as it is said beside its neighbours.
    pub fn pass(&mut self, outputs: Vec<Output>) -> Vec<Output> {
        let mut said = Vec::with_capacity(outputs.len());
        for output in outputs {
            match output {
                Output::Tracks(frame) => self.pass_tracks(frame, &mut said),
                Output::Smoothed(frame) => said.extend(self.pass_smoothed(frame)),
                Output::Event(event) => said.extend(self.pass_event(event)),
                Output::Cues(cues) => said.push(Output::Cues(self.pass_cues(cues))),
                Output::Rejected(_) | Output::Camera(..) => said.push(output),
            }
        }
        said
    }

    fn pass_tracks(&mut self, mut frame: TrackFrame, said: &mut Vec<Output>) {
        let now = Timestamp::from_nanos(frame.time_ns);
        let mut kept = Vec::new();
        for mut track in frame.tracks {
            let own = track.id;
            self.compare(&track, now);
            said.extend(self.settle_number(own, now).map(Output::Event));
            self.settle_voice(own, &track, now);
            let Some(ours) = self.ours.get_mut(&own) else { continue };
            if track.state() == TrackState::Lost {
                ours.ended = Some(now);
            }
            if matches!(ours.voice, Voice::Speaking(_)) {
                said.extend(
                    ours.untold
                        .drain(..)
                        .map(|event| Output::Event(TrackEvent { track_id: ours.number, ..event })),
                );
                (track.id, track.born_ns) = (ours.number, ours.born.nanos());
                kept.push(track);
            }
        }
        self.forget(now);
        if !kept.is_empty() {
            kept.sort_by_key(|track| track.id);
            (frame.tracks, frame.sequence) = (kept, self.sequence);
            self.sequence += 1;
            said.push(Output::Tracks(frame));
        }
    }

    /// A track of the fusion here; one of which it speaks for the first time gets a number.
    fn ours(&mut self, own: u64, now: Timestamp) -> &mut Ours {
        let Self { share, numbered, .. } = self;
        self.ours.entry(own).or_insert_with(|| {
            *numbered += 1;
            Ours::new(share.number(own, *numbered), now)
        })
    }

    /// Holds a track against those of the neighbours.
    fn compare(&mut self, track: &Track, now: Timestamp) {
        let own = track.id;
        let ours = self.ours(own, now);
        if ours.compared.is_some_and(|at| now.seconds_since(at) < COMPARED_EVERY_S) {
            return;
        }
        ours.compared = Some(now);
        let said_as = ours.number;
        let Some(state) = state_of(track) else { return };
        let heard = self.theirs.iter().filter(|(_, theirs)| theirs.is_heard(now));
        for (number, theirs) in heard {
            let there = theirs.state.predicted(now.seconds_since(theirs.time), self.density);
            let pair = Pair { own, number: *number };
            self.likenesses.see(pair, *number == said_as, [&state, &there], now);
        }
    }

    /// Takes the number of the elder track of the same target, or gives one up that is another's
    /// after all; says what becomes of a track that has been said under another number.
    fn settle_number(&mut self, own: u64, now: Timestamp) -> Option<TrackEvent> {
        let ours = self.ours.get(&own)?;
        let (before, voice) = (ours.number, ours.voice);
        if voice == Voice::Silent && self.likenesses.is_unlike(Pair { own, number: before }) {
            self.numbered += 1;
            let number = self.share.number(own, self.numbered);
            let ours = self.ours.get_mut(&own)?;
            (ours.number, ours.born, ours.voice) = (number, ours.begun, Voice::Unsaid);
            return None;
        }
        let elder = self.likenesses.same_as(own, now)?;
        let theirs = self.theirs.get(&elder)?;
        if elder == before || (theirs.born, elder) >= (ours.born, before) {
            return None;
        }
        let born = theirs.born;
        let ours = self.ours.get_mut(&own)?;
        (ours.number, ours.born, ours.voice) = (elder, born, Voice::Unsaid);
        ours.untold.clear();
        let merged = TrackEvent {
            time_ns: now.nanos(),
            kind: TrackEventKind::Merged.into(),
            track_id: before,
            other_id: elder,
            ..Default::default()
        };
        matches!(voice, Voice::Speaking(_)).then(|| merged.stamped())
    }

    /// Decides who says a track.
    fn settle_voice(&mut self, own: u64, track: &Track, now: Timestamp) {
        let Some(ours) = self.ours.get(&own) else { return };
        let grip = match state_of(track) {
            Some(state) => Grip::of(track, &state),
            None => return,
        };
        let theirs = self.theirs.get(&ours.number).filter(|theirs| theirs.is_heard(now));
        let voice = match (ours.voice, theirs) {
            (Voice::Speaking(since), Some(theirs)) => {
                let outdone = theirs.grip.is_better_than(&grip);
                // Both have begun at once.
                let yields = theirs.time > since
                    && theirs.index < self.share.index
                    && !grip.is_better_than(&theirs.grip);
                if outdone || yields { Voice::Silent } else { ours.voice }
            }
            (Voice::Speaking(_), None) => ours.voice,
            // Nobody has missed what is lost before it was said.
            _ if track.state() == TrackState::Lost => ours.voice,
            (_, Some(theirs)) if !grip.is_better_than(&theirs.grip) => Voice::Silent,
            (Voice::Silent, _) | (Voice::Unsaid, Some(_)) => Voice::Speaking(now),
            (Voice::Unsaid, None) => {
                let may_be_theirs = now.seconds_since(ours.begun) < HELD_BACK_S
                    && self.likenesses.may_be_theirs(own, now);
                let is_seen = track.state() != TrackState::Coasting;
                if may_be_theirs || !is_seen { Voice::Unsaid } else { Voice::Speaking(now) }
            }
        };
        if let Some(ours) = self.ours.get_mut(&own) {
            ours.voice = voice;
        }
    }

    fn pass_smoothed(&self, mut frame: TrackFrame) -> Option<Output> {
        frame.tracks.retain_mut(|track| {
            let ours = self.ours.get(&track.id);
            let ours = ours.filter(|ours| matches!(ours.voice, Voice::Speaking(_)));
            if let Some(ours) = ours {
                (track.id, track.born_ns) = (ours.number, ours.born.nanos());
            }
            ours.is_some()
        });
        frame.tracks.sort_by_key(|track| track.id);
        (!frame.tracks.is_empty()).then_some(Output::Smoothed(frame))
    }

    /// What happens to a track is said by who says the track.
    fn pass_event(&mut self, event: TrackEvent) -> Option<Output> {
        let other_id = self.ours.get(&event.other_id).map_or(0, |ours| ours.number);
        let ours = self.ours(event.track_id, Timestamp::from_nanos(event.time_ns));
        if matches!(ours.voice, Voice::Speaking(_)) {
            let track_id = ours.number;
            return Some(Output::Event(TrackEvent { track_id, other_id, ..event }));
        }
        let begins = matches!(event.kind(), TrackEventKind::Born | TrackEventKind::Confirmed);
        if begins && ours.voice == Voice::Unsaid {
            ours.untold.push(event);
        }
        None
    }

    fn pass_cues(&self, mut frame: CueFrame) -> CueFrame {
        for of in frame.cues.iter_mut().filter_map(|cue| cue.of.as_mut()) {
            if let Some(ours) = self.ours.get(&of.track_id) {
                of.track_id = ours.number;
            }
        }
        frame
    }

    /// Forgets what has ended.
    fn forget(&mut self, now: Timestamp) {
        let kept_s = HEARD_FOR_S + self.smoothing_s;
        let is_over = |ours: &Ours| ours.ended.is_some_and(|at| now.seconds_since(at) > kept_s);
        self.ours.retain(|_, ours| !is_over(ours));
        self.likenesses.forget(now);
    }
}
