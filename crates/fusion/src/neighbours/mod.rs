//! A site that is too large for one fusion centre has several, each for an area. Cameras that see
//! into two areas are used by both centres, so a target that flies from one area into the other
//! has for a while a track in each. This module makes them one target for everybody else: both
//! tracks have the number of the elder, and one of the two centres says (publishes) it.
//!
//! - *Whether two tracks are one target* is a test of hypotheses ([`likeness`]): for a second their
//!   places are where one target's would be, clearly likelier than by chance, and no other track of
//!   either centre explains that as well.
//! - *Which number* is a comparison of what both centres have said, so that both come to the same
//!   result: the number of the track that began earlier. The younger track takes it. Where the two
//!   part again, the track that took a number gives it back.
//! - *Which centre says it* is the one that knows where the target is; where both do, the one that
//!   has said it so far ([`Voice`]).
//!
//! Each centre has its own time: how long ago something was said counts by the time of its centre.
//!
//! There is no border on a map, no message but the tracks themselves, and nobody who decides: a
//! centre that falls silent leaves its targets to those beside it.

mod known;
mod likeness;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use crossfix_message::{
    CueFrame, Timestamp, Track, TrackEvent, TrackEventKind, TrackFrame, TrackState, renumbered,
};

use crate::{FusionConfig, Output};
use known::{Grip, KEPT_EVERY_S, Ours, Theirs, Voice, event, state_of};
use likeness::{Likenesses, NeighbourTrackId, TrackPair};

/// A track of which nothing has been received for this long is no longer said, s: each is said at
/// least every half second. With half of it a message that is lost ends the track; with twice as
/// much a target whose centre has died is gone for twice as long.
const RECEIVED_FOR_S: f64 = 1.0;
/// Tracks are compared this often, s: they move little between, and each costs a pass over all.
/// With half of it the comparisons cost twice as much and tell no more.
const COMPARED_EVERY_S: f64 = 0.1;
/// How long a new track that may be a neighbour's is not said, s: twice what it takes to find out.
/// Its place is said all the while, by the neighbour. With half of it a track that is found out a
/// little late is said twice, and its second number has to be taken back.
const HELD_BACK_S: f64 = 2.0;
/// Most tracks of neighbours that are kept in mind. Memory is bounded; beyond it a target that
/// flies in has a second number here.
const MAX_TRACKS: usize = 10_000;

/// Place of one fusion centre among those of its site.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Share {
    /// Its index among them by name, from 0: it numbers its tracks by every `of`-th number.
    pub index: usize,
    /// How many there are.
    pub of: usize,
}

impl Share {
    /// The number of this centre's `count`-th track, from 1; `own` is a number of the same run.
    fn number(self, own: Own, count: u64) -> Number {
        Number(renumbered(own.0, (count - 1) * self.of as u64 + self.index as u64 + 1))
    }
}

/// The number that the fusion here has given a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Own(u64);

/// The number under which a track is said, here or by a neighbour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Number(u64);

/// The neighbouring fusion centres as one centre hears them, and what it says itself because of
/// that.
///
/// ```
/// use crossfix_fusion::{FusionConfig, Neighbours, Output, Share};
/// use crossfix_message::{Track, TrackFrame, TrackState};
/// let config = FusionConfig::default();
/// // The second of two centres by name: its tracks are 2, 4, 6.
/// let mut west = Neighbours::new(Share { index: 1, of: 2 }, &config);
/// let seen = Track { id: 1, state: TrackState::Confirmed.into(), ..Default::default() };
/// let frame = TrackFrame { tracks: vec![seen], ..Default::default() };
/// let said = west.forward(vec![Output::Tracks(frame)]);
/// let [Output::Tracks(frame)] = &said[..] else { return Err("nobody else says it".into()) };
/// assert_eq!(frame.tracks[0].id, 2);
/// // What the first one says is received as it comes.
/// west.receive(0, &TrackFrame::default());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug)]
pub struct Neighbours {
    share: Share,
    /// Density of a target's unknown acceleration between the times of two states, m^2/s^3.
    density: f64,
    /// How long after a track's end something may still be said of it, s.
    smoothing_s: f64,
    /// The time of the data here; `None` before there are any.
    now: Option<Timestamp>,
    /// The newest time that each neighbour has said.
    newest: BTreeMap<usize, Timestamp>,
    theirs: BTreeMap<NeighbourTrackId, Theirs>,
    ours: BTreeMap<Own, Ours>,
    likenesses: Likenesses,
    numbered: u64,
    sequence: u64,
}

impl Neighbours {
    /// For a fusion centre that has this share in its site's targets.
    pub fn new(share: Share, config: &FusionConfig) -> Self {
        let densities = config.tracking.models.iter().map(|model| model.acceleration_density);
        Self {
            share,
            density: densities.fold(0.0, f64::max),
            smoothing_s: config.tracking.smoothing_s,
            now: None,
            newest: BTreeMap::new(),
            theirs: BTreeMap::new(),
            ours: BTreeMap::new(),
            likenesses: Likenesses::default(),
            numbered: 0,
            sequence: 0,
        }
    }

    /// Takes in what a neighbour, by its index among all centres, says of its tracks.
    pub fn receive(&mut self, index: usize, frame: &TrackFrame) {
        let (time, received) = (Timestamp::from_nanos(frame.time_ns), self.now);
        self.newest.insert(index, time);
        let is_said = |track: &Theirs| time.seconds_since(track.time).abs() < RECEIVED_FOR_S;
        self.theirs.retain(|said, track| said.neighbour != index || is_said(track));
        for track in &frame.tracks {
            let said = NeighbourTrackId { neighbour: index, number: Number(track.id) };
            // Before a track is sure it may be nothing.
            let is_sure = !matches!(track.state(), TrackState::Lost | TrackState::Tentative);
            let Some(state) = state_of(track).filter(|_| is_sure) else {
                self.theirs.remove(&said);
                continue;
            };
            if self.theirs.len() < MAX_TRACKS || self.theirs.contains_key(&said) {
                let grip = Grip::of(track, &state);
                // A neighbour that does not say when a track began has not said it before.
                let began = (track.born_ns != 0).then(|| Timestamp::from_nanos(track.born_ns));
                let born = began.unwrap_or(time);
                let known = self.theirs.remove(&said).map(|known| known.past);
                let mut past = known.unwrap_or_default();
                past.add(time, &state);
                self.theirs.insert(said, Theirs { time, received, past, grip, born });
            }
        }
    }

    /// Whether a neighbour says a track now: by the neighbour's own time it has done so lately, and
    /// by the time here it has not fallen silent.
    fn is_said(&self, said: NeighbourTrackId, theirs: &Theirs) -> bool {
        let newest = self.newest.get(&said.neighbour).copied().unwrap_or(theirs.time);
        let silent_s = match (self.now, theirs.received) {
            (Some(now), Some(received)) => now.seconds_since(received),
            _ => 0.0,
        };
        newest.seconds_since(theirs.time) < RECEIVED_FOR_S
            && (0.0..RECEIVED_FOR_S).contains(&silent_s)
    }

    /// Turns what the fusion here says into what is said beside its neighbours.
    pub fn forward(&mut self, outputs: Vec<Output>) -> Vec<Output> {
        let mut said = Vec::with_capacity(outputs.len());
        for output in outputs {
            match output {
                Output::Tracks(frame) => self.forward_tracks(frame, &mut said),
                Output::Smoothed(frame) => said.extend(self.forward_smoothed(frame)),
                Output::Event(event) => said.extend(self.forward_event(event)),
                Output::Cues(cues) => said.push(Output::Cues(self.forward_cues(cues))),
                Output::Rejected(_) | Output::Camera(..) => said.push(output),
            }
        }
        said
    }

    fn forward_tracks(&mut self, mut frame: TrackFrame, said: &mut Vec<Output>) {
        let now = Timestamp::from_nanos(frame.time_ns);
        if self.now.is_none() {
            // What was received before there was a time here counts as received now.
            self.theirs.values_mut().for_each(|theirs| theirs.received = Some(now));
        }
        self.now = Some(now);
        let mut kept = Vec::new();
        for mut track in frame.tracks {
            let own = Own(track.id);
            let merged =
                if self.compare(&track, now) { self.settle_number(own, now) } else { None };
            if let Some(before) = merged {
                let number = self.ours(own, now).number;
                let ids = [before.0, number.0];
                said.push(Output::Event(event(TrackEventKind::Merged, now, ids)));
                let mut ended = Track { id: before.0, ..track.clone() };
                ended.set_state(TrackState::Lost);
                kept.push(ended);
            }
            self.settle_voice(&track, now);
            let ours = self.ours(own, now);
            if track.state() == TrackState::Lost {
                ours.ended = Some(now);
            }
            if ours.is_said() {
                let number = ours.number.0;
                (track.id, track.born_ns) = (number, ours.born.nanos());
                said.extend(
                    ours.untold
                        .drain(..)
                        .map(|event| Output::Event(TrackEvent { track_id: number, ..event })),
                );
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

    /// A track of the fusion here; one that is spoken of for the first time gets a number.
    fn ours(&mut self, own: Own, now: Timestamp) -> &mut Ours {
        let Self { share, numbered, .. } = self;
        self.ours.entry(own).or_insert_with(|| {
            *numbered += 1;
            Ours::new(share.number(own, *numbered), now)
        })
    }

    /// Compares a track with those of the neighbours if it is time to; returns whether it has.
    fn compare(&mut self, track: &Track, now: Timestamp) -> bool {
        let own = Own(track.id);
        let ours = self.ours(own, now);
        let since = |at: Timestamp| now.seconds_since(at);
        if ours.compared.is_some_and(|at| (0.0..COMPARED_EVERY_S).contains(&since(at))) {
            return false;
        }
        let before = ours.compared.replace(now);
        let Some(state) = state_of(track) else { return true };
        ours.past.add(now, &state);
        let (number, past) = (ours.number, ours.past.clone());
        for (said, theirs) in &self.theirs {
            if !self.is_said(*said, theirs) {
                continue;
            }
            // Where the two times are apart, at the earlier one: there neither state is predicted
            // far.
            let is_behind = since(theirs.time) > KEPT_EVERY_S;
            // And only once: what was compared there already tells nothing new.
            if is_behind && theirs.received < before {
                continue;
            }
            let earlier = if is_behind { past.at(theirs.time, self.density) } else { None };
            let here = earlier.as_ref().unwrap_or(&state);
            let when = if is_behind { theirs.time } else { now };
            if let Some(there) = theirs.past.at(when, self.density) {
                let pair = TrackPair { own, theirs: *said };
                self.likenesses.see(pair, said.number == number, [here, &there], now);
            }
        }
        true
    }

    /// The neighbours' tracks of a number that are said now.
    fn of_number(&self, number: Number) -> impl Iterator<Item = (NeighbourTrackId, &Theirs)> {
        let of_neighbour = move |index: &usize| {
            let said = NeighbourTrackId { neighbour: *index, number };
            let (said, theirs) = self.theirs.get_key_value(&said)?;
            self.is_said(*said, theirs).then_some((*said, theirs))
        };
        self.newest.keys().filter_map(of_neighbour)
    }

    /// Takes the number of the eldest track of the same target, or gives back a number that is
    /// another target's after all. Returns the number before, if a reader knows it.
    fn settle_number(&mut self, own: Own, now: Timestamp) -> Option<Number> {
        let ours = self.ours.get(&own)?;
        let has_parted =
            |(said, _): (NeighbourTrackId, &Theirs)| self.likenesses.have_parted(own, said);
        if ours.has_others_number() && self.of_number(ours.number).any(has_parted) {
            let ours = self.ours.get_mut(&own)?;
            ((ours.number, ours.born), ours.voice) = (ours.first, Voice::Unsaid);
            ours.untold = [TrackEventKind::Born, TrackEventKind::Confirmed]
                .map(|kind| event(kind, now, [0; 2]))
                .into();
            return None;
        }
        let (before, born, was_said) = (ours.number, ours.born, ours.is_said());
        let is_free = |number: Number| {
            let has_it = |(other, ours): (&Own, &Ours)| {
                *other != own && ours.number == number && ours.ended.is_none()
            };
            !self.ours.iter().any(has_it)
        };
        let same = self.likenesses.same_as(own, now);
        let elder = same
            .filter_map(|said| Some((self.theirs.get(&said)?.born, said.number)))
            // The eldest, and of two of one age the smaller number: both centres find the same.
            .min()
            .filter(|elder| *elder < (born, before) && is_free(elder.1))?;
        let ours = self.ours.get_mut(&own)?;
        ((ours.born, ours.number), ours.voice) = (elder, Voice::Unsaid);
        ours.untold.clear();
        (was_said && elder.1 != before).then_some(before)
    }

    /// Decides which centre says a track.
    fn settle_voice(&mut self, track: &Track, now: Timestamp) {
        // Whoever has said it so far says its end.
        if track.state() != TrackState::Lost
            && let Some(voice) = self.voice_of(track, now)
            && let Some(ours) = self.ours.get_mut(&Own(track.id))
        {
            ours.voice = voice;
        }
    }

    fn voice_of(&self, track: &Track, now: Timestamp) -> Option<Voice> {
        let own = Own(track.id);
        let ours = self.ours.get(&own)?;
        // A neighbour that says this number of something elsewhere says nothing of this track.
        let of_number = self.of_number(ours.number);
        let mut theirs =
            of_number.filter(|(said, _)| self.likenesses.may_be_one(own, *said)).peekable();
        if theirs.peek().is_none() {
            return Some(match ours.voice {
                Voice::Unsaid if self.is_held_back(own, track, now) => Voice::Unsaid,
                Voice::Unsaid | Voice::Silent => Voice::Speaking(now),
                Voice::Speaking(_) => ours.voice,
            });
        }
        let grip = Grip::of(track, &state_of(track)?);
        let is_outdone = theirs.any(|(said, theirs)| match ours.voice {
            Voice::Speaking(since) => {
                // What the neighbour said before this centre began is why this one began. Where
                // both began at once, one goes on.
                let is_new = theirs.received.is_some_and(|received| received > since);
                // A tie is decided by the centres' order, which both know alike.
                let yields =
                    said.neighbour < self.share.index && !grip.is_better_than(&theirs.grip);
                is_new && (theirs.grip.is_better_than(&grip) || yields)
            }
            Voice::Silent | Voice::Unsaid => !grip.is_better_than(&theirs.grip),
        });
        Some(match ours.voice {
            _ if is_outdone => Voice::Silent,
            Voice::Speaking(_) => ours.voice,
            Voice::Silent | Voice::Unsaid => Voice::Speaking(now),
        })
    }

    /// Whether a track that has not been said has to wait: it may be a neighbour's, or is not seen.
    fn is_held_back(&self, own: Own, track: &Track, now: Timestamp) -> bool {
        let is_new = self
            .ours
            .get(&own)
            .is_some_and(|ours| (0.0..HELD_BACK_S).contains(&now.seconds_since(ours.first.1)));
        is_new && self.likenesses.may_be_theirs(own, now) || track.state() == TrackState::Coasting
    }

    fn forward_smoothed(&self, mut frame: TrackFrame) -> Option<Output> {
        frame.tracks.retain_mut(|track| {
            let ours = self.ours.get(&Own(track.id)).filter(|ours| ours.is_said());
            if let Some(ours) = ours {
                (track.id, track.born_ns) = (ours.number.0, ours.born.nanos());
            }
            ours.is_some()
        });
        frame.tracks.sort_by_key(|track| track.id);
        (!frame.tracks.is_empty()).then_some(Output::Smoothed(frame))
    }

    /// What happens to a track is said by the centre that says the track.
    fn forward_event(&mut self, event: TrackEvent) -> Option<Output> {
        let (own, now) = (Own(event.track_id), Timestamp::from_nanos(event.time_ns));
        let kind = event.kind();
        let number = self.ours(own, now).number;
        let ends = matches!(kind, TrackEventKind::Lost | TrackEventKind::Merged);
        let goes_on =
            ends && self.of_number(number).any(|(said, _)| self.likenesses.may_be_one(own, said));
        let ours = self.ours(own, now);
        if goes_on {
            ours.voice = Voice::Silent;
        }
        let is_said = ours.is_said();
        if !is_said && ours.voice == Voice::Unsaid && !ends && kind != TrackEventKind::Manoeuvre {
            ours.untold.push(event);
        }
        if ends {
            ours.ended = Some(now);
        }
        if !is_said {
            return None;
        }
        let other = (event.other_id != 0).then(|| self.ours(Own(event.other_id), now));
        let other_id = other.map_or(0, |other| {
            // A reader who knows this track has to find the other.
            if other.voice == Voice::Unsaid {
                other.voice = Voice::Speaking(now);
            }
            other.number.0
        });
        Some(Output::Event(TrackEvent { track_id: number.0, other_id, ..event }))
    }

    fn forward_cues(&self, mut frame: CueFrame) -> CueFrame {
        for of in frame.cues.iter_mut().filter_map(|cue| cue.of.as_mut()) {
            if let Some(ours) = self.ours.get(&Own(of.track_id)) {
                of.track_id = ours.number.0;
            }
        }
        frame
    }

    /// Forgets what has ended.
    fn forget(&mut self, now: Timestamp) {
        let kept_s = RECEIVED_FOR_S + self.smoothing_s;
        let is_kept = |ended: Timestamp| (0.0..kept_s).contains(&now.seconds_since(ended));
        self.ours.retain(|_, ours| ours.ended.is_none_or(is_kept));
        self.likenesses.forget(now);
    }
}
