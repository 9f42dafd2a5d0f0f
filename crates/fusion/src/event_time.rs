//! Event time with a bounded wait: frames go in as they arrive and come out in the order of their
//! capture times, so that the order of arrival changes nothing.

use std::collections::{BTreeMap, BTreeSet};

use crossfix_message::{CameraName, Timestamp};

use crate::ingress::Load;
use crate::{EventTime, Exposure, RejectionReason};

/// More exposures than this are not remembered of those that came out: memory is bounded.
const MAX_TAKEN: usize = 20_000;

/// A camera that has been silent for so many times the lateness is not waited for.
const PATIENCES: f64 = 4.0;

/// For so many times the lateness a camera is waited for as one whose frames overtake each other.
const DISORDER_LASTS: f64 = 20.0;

/// So many frames of a camera one after the other far behind its newest say that its clock was ahead,
/// even where they come too late.
const MOST_FAR_BEHIND: u32 = 3;

type Order = (Timestamp, CameraName);

/// An exposure that waits, and whether its time has been compared with another camera's.
#[derive(Debug)]
struct Held {
    exposure: Exposure,
    compared: bool,
}

/// How an exposure arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arrival {
    /// After all others of its camera.
    InOrder,
    /// After a newer one of its camera, in time all the same.
    OutOfOrder,
}

/// How one camera's frames come.
#[derive(Clone, Copy, Debug)]
struct Stream {
    newest: Timestamp,
    /// From the last but one to the newest, s, as far as that is no jump.
    step_s: f64,
    /// [`EventBuffer::run_s`] when it was heard last.
    heard_s: f64,
    /// Frames far behind the newest, one after the other.
    far_behind: u32,
    /// How far behind the newest others came, at most, s, and the newest when one did last; from a
    /// frame on that came too late for it.
    disorder: Option<(f64, Timestamp)>,
}

impl Stream {
    fn beginning(newest: Timestamp) -> Self {
        Self { newest, step_s: 0.0, heard_s: 0.0, far_behind: 0, disorder: None }
    }

    /// Takes note of a frame that came `late_s` too late.
    fn hear(&mut self, time: Timestamp, late_s: Option<f64>, lateness_s: f64) {
        let behind_s = self.newest.seconds_since(time);
        let known_s = self.disorder_s(lateness_s);
        let far_behind = if behind_s > lateness_s { self.far_behind + 1 } else { 0 };
        self.far_behind = far_behind;
        if behind_s <= 0.0 {
            self.newest = time;
            self.step_s = (-behind_s).min(PATIENCES * lateness_s);
        } else if behind_s <= lateness_s {
            if late_s.is_some() || known_s > 0.0 {
                self.disorder = Some((behind_s.max(known_s), self.newest));
            }
        } else if far_behind >= MOST_FAR_BEHIND || late_s.is_none_or(|late_s| late_s <= lateness_s) {
            // No network reorders so far: the clock was ahead, and now it is not.
            *self = Self::beginning(time);
        }
    }

    /// How far behind the newest another frame may still come, s: 0 for a camera that keeps the order.
    fn disorder_s(&self, lateness_s: f64) -> f64 {
        let lasts_s = DISORDER_LASTS * lateness_s;
        let lately = |(_, then): &(f64, Timestamp)| self.newest.seconds_since(*then) <= lasts_s;
        self.disorder.filter(lately).map_or(0.0, |(behind_s, _)| behind_s)
    }
}

/// The buffer that puts exposures into order.
///
/// The time up to which exposures are released follows the reference: the second newest of the live
/// cameras, and no more than half of them must be beyond what the others have reached. So a minority
/// of wrong clocks cannot drag the others into the past. It is the time of the slowest camera that is
/// still heard, or `lateness_s` behind the reference, whichever is later.
///
/// Frames that are refused count for the reference too: where most cameras jump, time has jumped. If
/// most of them have been behind what was released for a while, that was the mistake, and the order is
/// taken up anew from their time.
///
/// A camera is live until the cameras heard since have gone on, on average, by [`PATIENCES`] times the
/// lateness by their own clocks, jumps left out: there is no other clock here.
///
/// A camera's newest frame is its word that nothing older comes, so that nobody waits for an order
/// that transports keep anyway. A camera whose word has cost a frame is taken, for a while, to be as
/// far behind its newest frame as that one was.
///
/// What is late is not measured by that word but by what has been worked on: an exposure that can
/// still be taken in order is taken.
#[derive(Debug)]
pub(crate) struct EventBuffer {
    config: EventTime,
    held: BTreeMap<Order, Held>,
    load: Load,
    /// What came out within the last `lateness_s`, to tell what comes twice from what comes late.
    taken: BTreeSet<Order>,
    streams: BTreeMap<CameraName, Stream>,
    /// The newest time of each camera that agreed with another camera's.
    trusted: BTreeMap<CameraName, Timestamp>,
    ended: BTreeSet<CameraName>,
    /// How far all cameras together have gone on, each by its own clock and without jumps, s.
    run_s: f64,
    /// The time that the live cameras agree on, and how many they were, when a frame last came.
    reference: Option<Reference>,
    /// [`Self::run_s`] since when most live cameras have been behind what was released.
    behind_since_s: Option<f64>,
    /// What was held when the order was taken up anew.
    dropped: Vec<(Exposure, RejectionReason)>,
    /// Where the order was taken up anew, until somebody asks.
    restarted: Option<Timestamp>,
    /// Cameras that should be heard soon.
    expected: BTreeSet<CameraName>,
    /// The oldest time heard.
    first: Option<Timestamp>,
    /// The newest time that came out.
    released: Timestamp,
    /// The newest time, less the clock's offset, that has been worked on.
    passed: Timestamp,
}

/// What the live cameras say the time is.
#[derive(Clone, Copy, Debug)]
struct Reference {
    time: Timestamp,
    live: usize,
}

impl EventBuffer {
    pub(crate) fn new(config: EventTime) -> Self {
        Self {
            config,
            held: BTreeMap::new(),
            load: Load::default(),
            taken: BTreeSet::new(),
            streams: BTreeMap::new(),
            trusted: BTreeMap::new(),
            ended: BTreeSet::new(),
            run_s: 0.0,
            reference: None,
            behind_since_s: None,
            dropped: Vec::new(),
            restarted: None,
            expected: BTreeSet::new(),
            first: None,
            released: Timestamp::MIN,
            passed: Timestamp::MIN,
        }
    }

    /// Says that a camera should be heard soon: in the beginning it is waited for as for the others.
    pub(crate) fn expect(&mut self, camera: &CameraName) {
        self.expected.insert(camera.clone());
    }

    /// Takes an exposure in; nothing comes out before [`Self::release`] says so.
    pub(crate) fn insert(&mut self, exposure: Exposure) -> Result<Arrival, RejectionReason> {
        let time = exposure.time;
        self.ended.remove(&exposure.camera);
        let order = (time, exposure.camera.clone());
        if self.held.contains_key(&order) || self.taken.contains(&order) {
            return Err(RejectionReason::Duplicate);
        }
        let arrival = self.hear(&exposure);
        let compared = self.reference.is_some_and(|reference| reference.live > 1);
        if let Some(reference) = self.reference {
            // A camera that goes on by itself, step by step, is not from the future.
            let trusted = self.trusted.get(&exposure.camera).copied().unwrap_or(Timestamp::MIN);
            let by_s = time.seconds_since(reference.time.max(trusted));
            if by_s > self.config.max_ahead_s {
                return Err(RejectionReason::Future { by_s });
            }
            if compared || time.seconds_since(trusted) <= self.config.max_ahead_s {
                self.trusted.insert(exposure.camera.clone(), trusted.max(time));
            }
        }
        if let Some(by_s) = self.late_s(&exposure) {
            return Err(RejectionReason::Late { by_s });
        }
        self.load.add(&exposure);
        self.held.insert(order, Held { exposure, compared });
        Ok(arrival)
    }

    /// Takes note of an exposure's time, whatever becomes of it.
    fn hear(&mut self, exposure: &Exposure) -> Arrival {
        let (time, lateness_s) = (exposure.time, self.config.lateness_s);
        let late_s = self.late_s(exposure);
        let stream = self.streams.entry(exposure.camera.clone()).or_insert(Stream::beginning(time));
        let arrival = if time < stream.newest { Arrival::OutOfOrder } else { Arrival::InOrder };
        // A clock that races makes nobody else look silent.
        self.run_s += time.seconds_since(stream.newest).clamp(0.0, lateness_s);
        stream.hear(time, late_s, lateness_s);
        stream.heard_s = self.run_s;
        self.first = Some(self.first.map_or(time, |first| first.min(time)));
        self.refer();
        arrival
    }

    /// Asks the live cameras for the time.
    fn refer(&mut self) {
        let patience_s = PATIENCES * self.config.lateness_s;
        let heard = self.streams.iter().filter(|(camera, _)| !self.ended.contains(*camera));
        let mut heard: Vec<&Stream> = heard.map(|(_, stream)| stream).collect();
        heard.sort_by(|one, other| other.heard_s.total_cmp(&one.heard_s));
        let is_live = |(since, stream): &(usize, &Stream)| {
            self.run_s - stream.heard_s <= patience_s * (*since).max(1) as f64
        };
        let live: Vec<&Stream> = heard.into_iter().enumerate().take_while(is_live).map(|(_, s)| s).collect();
        let newest_first = |mut times: Vec<Timestamp>| {
            times.sort_by(|one, other| other.cmp(one));
            times
        };
        let newest = newest_first(live.iter().map(|stream| stream.newest).collect());
        // What a camera has reached: its next frame is not due before.
        let reached = newest_first(live.iter().map(|s| s.newest.plus_seconds(s.step_s)).collect());
        let half = live.len() / 2;
        let time = match (newest.as_slice(), reached.get(half)) {
            ([_, second, ..], Some(reached)) => Some(*second.min(reached)),
            ([alone], _) => Some(*alone),
            _ => None,
        };
        let is_behind = |time: &Timestamp| self.released.seconds_since(*time) > patience_s;
        let behind = newest.iter().filter(|time| is_behind(time)).count();
        self.reference = time.map(|time| Reference { time, live: live.len() });
        if behind <= half {
            self.behind_since_s = None;
            return;
        }
        let since_s = *self.behind_since_s.get_or_insert(self.run_s);
        if let Some(time) = time.filter(|_| self.run_s - since_s > patience_s * behind as f64) {
            self.restart(time);
        }
    }

    /// Takes the order up anew from a time before what was released.
    fn restart(&mut self, time: Timestamp) {
        for (_, Held { exposure, .. }) in std::mem::take(&mut self.held) {
            let by_s = exposure.time.seconds_since(time);
            self.dropped.push((exposure, RejectionReason::Future { by_s }));
        }
        self.load = Load::default();
        self.taken.clear();
        self.trusted.clear();
        self.behind_since_s = None;
        (self.released, self.passed) = (Timestamp::MIN, Timestamp::MIN);
        self.restarted = Some(time);
    }

    /// Forgets all times: the clocks of all cameras have stepped. Nothing is held.
    pub(crate) fn begin_anew(&mut self) {
        let ended = std::mem::take(&mut self.ended);
        let heard = self.streams.keys().filter(|camera| !ended.contains(*camera)).cloned();
        let expected = heard.collect();
        *self = Self { expected, ended, ..Self::new(self.config.clone()) };
    }

    /// The time at which the order was taken up anew with the last frame, if it was: what has been made of
    /// later times is to be forgotten.
    pub(crate) fn take_restart(&mut self) -> Option<Timestamp> {
        self.restarted.take()
    }

    /// By how much an exposure comes too late, s: what follows it has been worked on. What came out may
    /// still wait for other clocks to be sure (its time is less the clock's offset then).
    fn late_s(&self, exposure: &Exposure) -> Option<f64> {
        let corrected = exposure.time.plus_seconds(-exposure.correction_s);
        let is_late = exposure.time < self.released && corrected < self.passed;
        is_late.then(|| self.released.seconds_since(exposure.time))
    }

    /// Says that an exposure of this time, less the clock's offset, is being worked on.
    pub(crate) fn pass(&mut self, corrected: Timestamp) {
        self.passed = self.passed.max(corrected);
    }

    /// By how much a time, less the clock's offset, lies before what has been worked on, s: more than the
    /// lateness, or `None`.
    pub(crate) fn passed_by_s(&self, corrected: Timestamp) -> Option<f64> {
        Some(self.passed.seconds_since(corrected)).filter(|by_s| *by_s > self.config.lateness_s)
    }

    /// Marks a camera as come to its end: nobody waits for it any more.
    pub(crate) fn end(&mut self, camera: &CameraName) {
        self.ended.insert(camera.clone());
    }

    /// The next exposure that nothing can overtake any more.
    pub(crate) fn release(&mut self) -> Option<Result<Exposure, (Exposure, RejectionReason)>> {
        if let Some(dropped) = self.dropped.pop() {
            return Some(Err(dropped));
        }
        let (order, _) = self.held.first_key_value()?;
        if !self.load.is_too_much() && !self.everyone_ended() && order.0 > self.watermark()? {
            return None;
        }
        self.pop()
    }

    /// The next exposure, whatever may still come.
    pub(crate) fn pop(&mut self) -> Option<Result<Exposure, (Exposure, RejectionReason)>> {
        if let Some(dropped) = self.dropped.pop() {
            return Some(Err(dropped));
        }
        let (order, Held { exposure, compared }) = self.held.pop_first()?;
        self.load.remove(&exposure);
        // A frame taken in before a second camera was heard may turn out to be from the future.
        if !compared && let Some(reference) = self.reference {
            let ahead = exposure.time.seconds_since(reference.time);
            if ahead > self.config.max_ahead_s {
                return Some(Err((exposure, RejectionReason::Future { by_s: ahead })));
            }
        }
        self.released = self.released.max(exposure.time);
        self.remember(order);
        Some(Ok(exposure))
    }

    fn remember(&mut self, order: Order) {
        self.taken.insert(order);
        let oldest = self.released.plus_seconds(-self.config.lateness_s);
        while self.taken.len() > MAX_TAKEN || self.taken.first().is_some_and(|(time, _)| *time < oldest) {
            self.taken.pop_first();
        }
    }

    fn everyone_ended(&self) -> bool {
        self.streams.len() > 1 && self.streams.keys().all(|camera| self.ended.contains(camera))
    }

    fn watermark(&self) -> Option<Timestamp> {
        let lateness_s = self.config.lateness_s;
        let Reference { time: reference, live } = self.reference?;
        let patience = reference.plus_seconds(-lateness_s);
        let forgotten = reference.plus_seconds(-PATIENCES * lateness_s);
        let never_heard = |camera: &CameraName| !self.streams.contains_key(camera);
        let waits_for_new = self.first.is_some_and(|first| first > forgotten)
            && self.expected.iter().any(|camera| never_heard(camera) && !self.ended.contains(camera));
        let going_on = self.streams.keys().filter(|camera| !self.ended.contains(*camera)).count();
        // A camera alone is not followed at once: the others may come back, or be heard at last.
        let is_alone = live == 1 && (going_on > 1 || self.streams.len() == 1);
        if waits_for_new || is_alone {
            return Some(patience);
        }
        let heard = self.streams.iter().filter(|(camera, _)| !self.ended.contains(camera));
        let heard = heard.map(|(_, stream)| stream).filter(|stream| stream.newest > forgotten);
        let slowest = heard.map(|s| s.newest.plus_seconds(-s.disorder_s(lateness_s))).min();
        // Of the cameras that have ended, nothing more comes; of the others, nothing before `slowest`.
        Some(slowest.map_or(patience, |slowest| slowest.max(patience)))
    }
}

#[cfg(test)]
mod tests;
