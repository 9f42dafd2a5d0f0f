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
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn exposure(camera: &str, time_s: f64) -> Exposure {
        Exposure {
            camera: camera.parse().unwrap(),
            sequence: 0,
            time: Timestamp::from_seconds(time_s),
            uncertainty: crate::uncertainty::CameraUncertainty::of_time(0.0),
            correction_s: 0.0,
            sightings: vec![],
        }
    }

    fn drain(buffer: &mut EventBuffer) -> Vec<f64> {
        let mut times = Vec::new();
        while let Some(next) = buffer.release() {
            let Ok(exposure) = next else { continue };
            buffer.pass(exposure.time);
            times.push(exposure.time.seconds());
        }
        times
    }

    #[test]
    fn a_frame_waits_for_the_slowest_camera() {
        let mut buffer = EventBuffer::new(EventTime::default());
        buffer.insert(exposure("a", 1.0)).unwrap();
        buffer.insert(exposure("b", 1.1)).unwrap();
        buffer.insert(exposure("a", 1.2)).unwrap();
        assert_eq!(drain(&mut buffer), [1.0, 1.1]);
        buffer.insert(exposure("b", 1.3)).unwrap();
        assert_eq!(drain(&mut buffer), [1.2]);
    }

    #[test]
    fn frames_out_of_order_are_told_and_put_into_order() {
        let mut buffer = EventBuffer::new(EventTime::default());
        assert_eq!(buffer.insert(exposure("a", 1.1)), Ok(Arrival::InOrder));
        assert_eq!(buffer.insert(exposure("a", 1.0)), Ok(Arrival::OutOfOrder));
        assert_eq!(buffer.insert(exposure("a", 1.1)), Err(RejectionReason::Duplicate));
        buffer.insert(exposure("b", 2.0)).unwrap();
        buffer.insert(exposure("a", 2.0)).unwrap();
        assert_eq!(drain(&mut buffer), [1.0, 1.1, 2.0, 2.0]);
    }

    #[test]
    fn what_is_overtaken_is_taken_until_something_later_is_worked_on() {
        let mut buffer = EventBuffer::new(EventTime::default());
        for (camera, time_s) in [("a", 1.0), ("a", 1.2), ("b", 1.25)] {
            buffer.insert(exposure(camera, time_s)).unwrap();
        }
        // Two come out, and the second waits for the clocks.
        buffer.release().unwrap().unwrap();
        buffer.pass(Timestamp::from_seconds(1.0));
        assert_eq!(buffer.release().unwrap().unwrap().time, Timestamp::from_seconds(1.2));
        assert_eq!(buffer.insert(exposure("a", 1.1)), Ok(Arrival::OutOfOrder));
        assert_eq!(buffer.release().unwrap().unwrap().time, Timestamp::from_seconds(1.1));
        buffer.pass(Timestamp::from_seconds(1.2));
        let late = buffer.insert(exposure("a", 1.15)).unwrap_err();
        assert!(matches!(late, RejectionReason::Late { by_s } if (by_s - 0.05).abs() < 1e-9), "{late:?}");
    }

    #[test]
    fn what_comes_at_the_time_of_the_last_is_taken_and_what_comes_twice_is_told_from_what_is_late() {
        let mut buffer = EventBuffer::new(EventTime::default());
        for (camera, time_s) in [("a", 1.0), ("c", 1.0), ("a", 1.1), ("c", 1.1), ("c", 1.2)] {
            buffer.insert(exposure(camera, time_s)).unwrap();
        }
        assert_eq!(drain(&mut buffer), [1.0, 1.0, 1.1, 1.1]);
        assert_eq!(buffer.insert(exposure("b", 1.1)), Ok(Arrival::InOrder));
        assert_eq!(drain(&mut buffer), [1.1]);
        for (camera, time_s) in [("a", 1.0), ("b", 1.1), ("c", 1.1), ("c", 1.2)] {
            assert_eq!(buffer.insert(exposure(camera, time_s)), Err(RejectionReason::Duplicate));
        }
        assert!(matches!(buffer.insert(exposure("b", 1.0)), Err(RejectionReason::Late { .. })));
    }

    /// Frames of `b`, and of `a` in pairs whose second comes first; returns how many are refused.
    fn swapped(buffer: &mut EventBuffer, tenths: std::ops::Range<u32>) -> usize {
        let mut refused = 0;
        for k in tenths {
            let t = 0.1 * f64::from(k);
            let of_a = if k % 2 == 0 { t + 0.1 } else { t - 0.1 };
            refused += usize::from(buffer.insert(exposure("a", of_a)).is_err());
            buffer.insert(exposure("b", t + 0.15)).unwrap();
            drain(buffer);
        }
        refused
    }

    #[test]
    fn a_camera_whose_frames_overtake_each_other_is_waited_for_from_then_on() {
        let mut buffer = EventBuffer::new(EventTime::default());
        assert_eq!(swapped(&mut buffer, 0..100), 1);
        // For a while nobody relies on its order, then everybody does again.
        let mut waits = Vec::new();
        for k in 100..400 {
            let t = 0.1 * f64::from(k);
            buffer.insert(exposure("a", t + 0.1)).unwrap();
            buffer.insert(exposure("b", t + 0.15)).unwrap();
            let newest = drain(&mut buffer).last().copied();
            waits.push(newest.is_none_or(|newest| newest < t + 0.09));
        }
        let (first, last) = waits.split_at(90);
        assert!(first.iter().all(|wait| *wait) && last[20..].iter().all(|wait| !wait), "{waits:?}");
    }

    #[test]
    fn a_clock_that_was_ahead_is_waited_for_when_it_is_right_again() {
        for (ahead_s, refused) in [(5.0, vec![21, 22]), (3600.0, vec![20, 21, 22])] {
            let mut buffer = EventBuffer::new(EventTime::default());
            buffer.expect(&"c".parse().unwrap());
            let mut errors = Vec::new();
            for k in 0..60 {
                let t = 0.1 * f64::from(k);
                buffer.insert(exposure("a", t)).unwrap();
                buffer.insert(exposure("b", t)).unwrap();
                // `c` comes 0.3 s after the others.
                let wrong = if k == 20 { ahead_s } else { 0.0 };
                if k >= 3 && buffer.insert(exposure("c", t - 0.3 + wrong)).is_err() {
                    errors.push(k);
                }
                drain(&mut buffer);
            }
            // When it was ahead nobody waited for it: the others were worked on up to 2.0 s.
            assert_eq!(errors, refused);
        }
    }

    #[test]
    fn a_silent_camera_holds_nobody_up_for_longer_than_the_lateness() {
        let mut buffer = EventBuffer::new(EventTime::default());
        buffer.insert(exposure("c", 0.0)).unwrap();
        for i in 1..20 {
            buffer.insert(exposure("a", f64::from(i) * 0.1)).unwrap();
            buffer.insert(exposure("b", f64::from(i) * 0.1 + 0.01)).unwrap();
        }
        let released = drain(&mut buffer);
        assert!(*released.last().unwrap() > 1.3, "{released:?}");
        assert!(matches!(buffer.insert(exposure("c", 0.5)), Err(RejectionReason::Late { .. })));
    }

    #[test]
    fn a_camera_that_should_be_heard_is_waited_for_in_the_beginning_and_not_for_ever() {
        let mut buffer = EventBuffer::new(EventTime::default());
        for camera in ["a", "b", "c"] {
            buffer.expect(&camera.parse().unwrap());
        }
        buffer.insert(exposure("a", 0.0)).unwrap();
        buffer.insert(exposure("b", 0.0)).unwrap();
        assert_eq!(drain(&mut buffer), []);
        buffer.insert(exposure("c", 0.0)).unwrap();
        assert_eq!(drain(&mut buffer), [0.0, 0.0, 0.0]);
        for i in 1..40 {
            buffer.insert(exposure("a", f64::from(i) * 0.1)).unwrap();
            buffer.insert(exposure("b", f64::from(i) * 0.1)).unwrap();
        }
        // `c` is silent: after two seconds only the two others count.
        assert!(drain(&mut buffer).last().is_some_and(|&time| time > 3.85));
    }

    #[test]
    fn one_camera_from_the_future_is_refused_and_drags_nobody() {
        let mut buffer = EventBuffer::new(EventTime::default());
        // It comes first, when there is nothing to compare it with.
        buffer.insert(exposure("liar", 1e6)).unwrap();
        for i in 0..10 {
            buffer.insert(exposure("a", f64::from(i))).unwrap();
            buffer.insert(exposure("b", f64::from(i) + 0.01)).unwrap();
        }
        // Ten of `a` and nine of `b`: the tenth of `b` waits for `a`.
        assert_eq!(drain(&mut buffer).len(), 19);
        assert!(matches!(buffer.insert(exposure("liar", 1e6 + 1.0)), Err(RejectionReason::Future { .. })));
    }

    #[test]
    fn after_a_common_pause_two_cameras_bring_the_time_back() {
        let mut buffer = EventBuffer::new(EventTime::default());
        buffer.insert(exposure("a", 0.0)).unwrap();
        buffer.insert(exposure("b", 0.0)).unwrap();
        assert!(buffer.insert(exposure("a", 60.0)).is_err());
        buffer.insert(exposure("b", 60.01)).unwrap();
        buffer.insert(exposure("a", 60.02)).unwrap();
        assert!(drain(&mut buffer).contains(&60.01));
    }

    /// Ten frames a second of `cameras`, as `change` makes them (`None`: none); how many are refused.
    fn run(
        buffer: &mut EventBuffer,
        cameras: usize,
        seconds: std::ops::Range<u32>,
        change: impl Fn(usize, f64) -> Option<f64>,
    ) -> usize {
        let mut refused = 0;
        for k in seconds.start * 10..seconds.end * 10 {
            for camera in 0..cameras {
                let t = 0.1 * f64::from(k) + 0.1 * camera as f64 / cameras as f64;
                let Some(time_s) = change(camera, t) else { continue };
                let name = format!("c{camera:02}");
                refused += usize::from(buffer.insert(exposure(&name, time_s)).is_err());
                while let Some(next) = buffer.release() {
                    match next {
                        Ok(exposure) => buffer.pass(exposure.time),
                        Err(_) => refused += 1,
                    }
                }
            }
        }
        refused
    }

    fn between(range: std::ops::Range<f64>, t: f64, ahead_s: f64) -> f64 {
        if range.contains(&t) { t + ahead_s } else { t }
    }

    #[test]
    fn a_minority_of_clocks_ahead_costs_its_own_frames_alone() {
        for (ahead_s, until_s, wrong) in [(60.0, 5.3, 6), (3600.0, 6.0, 20), (1.503, 6.0, 0)] {
            let mut buffer = EventBuffer::new(EventTime::default());
            let lie = |camera, t| Some(if camera > 2 { between(5.0..until_s, t, ahead_s) } else { t });
            let refused = run(&mut buffer, 5, 0..40, lie);
            assert!((wrong..=wrong + 2).contains(&refused), "{ahead_s}: {refused}");
        }
    }

    #[test]
    fn a_clock_ahead_is_not_vouched_for_by_one_that_is_dead() {
        let mut buffer = EventBuffer::new(EventTime::default());
        let lie = |camera, t| match camera {
            3 => (t < 5.1).then(|| between(5.0..5.1, t, 3600.0)),
            4 => Some(between(10.0..10.1, t, 3590.0)),
            _ => Some(t),
        };
        assert_eq!(run(&mut buffer, 5, 0..40, lie), 2);
    }

    #[test]
    fn sixteen_cameras_are_not_dragged_by_seven() {
        let mut buffer = EventBuffer::new(EventTime::default());
        let lie = |camera, t| Some(if camera < 7 { between(5.0..6.0, t, 9.003) } else { t });
        assert_eq!(run(&mut buffer, 16, 0..20, lie), 0, "within what may be ahead they wait");
        assert!(drain(&mut buffer).is_empty() && buffer.held.len() <= 16, "{}", buffer.held.len());
    }

    #[test]
    fn the_last_of_three_cameras_is_followed_after_a_while() {
        let mut buffer = EventBuffer::new(EventTime::default());
        let dead = |camera, t| (camera == 0 || t < 5.0).then_some(t);
        assert_eq!(run(&mut buffer, 3, 0..20, dead), 0);
        assert!(buffer.released > Timestamp::from_seconds(19.3), "{:?}", buffer.released);
        // The others come back and are waited for again.
        assert_eq!(run(&mut buffer, 3, 20..25, |_, t| Some(t)), 0);
        assert!(buffer.released > Timestamp::from_seconds(24.8), "{:?}", buffer.released);
    }

    #[test]
    fn a_camera_that_comes_back_with_a_later_clock_drags_nobody() {
        for (ahead_s, all) in [(3.0, 0), (100.0, 150)] {
            let mut buffer = EventBuffer::new(EventTime::default());
            let later = |camera, t| match camera {
                2 if (5.0..10.0).contains(&t) => None,
                2 => Some(between(10.0..f64::INFINITY, t, ahead_s)),
                _ => Some(t),
            };
            let refused = run(&mut buffer, 3, 0..25, later);
            assert!((all..all + 2).contains(&refused), "{ahead_s}: {refused}");
            assert!(buffer.released > Timestamp::from_seconds(24.8), "{:?}", buffer.released);
        }
    }

    #[test]
    fn where_most_clocks_come_back_from_ahead_the_order_is_taken_up_anew() {
        for cameras in [1, 2, 3, 5] {
            let mut buffer = EventBuffer::new(EventTime::default());
            let refused = run(&mut buffer, cameras, 0..40, |_, t| Some(between(5.0..7.0, t, 600.0)));
            assert!(buffer.take_restart().is_some(), "{cameras} cameras");
            // For the 2 s that they must be behind, for which they are waited for, and a few frames.
            assert!(refused < 40 * cameras, "{cameras} cameras: {refused}");
            assert!(buffer.released > Timestamp::from_seconds(39.0), "{:?}", buffer.released);
            assert!(buffer.released < Timestamp::from_seconds(40.1), "{:?}", buffer.released);
        }
    }

    #[test]
    fn what_a_network_held_back_is_late_and_not_a_clock_that_was_ahead() {
        let mut buffer = EventBuffer::new(EventTime::default());
        run(&mut buffer, 3, 0..5, |_, t| Some(t));
        run(&mut buffer, 3, 5..9, |camera, t| (camera == 0).then_some(t));
        // Four seconds of two cameras come at once.
        run(&mut buffer, 3, 5..9, |camera, t| (camera > 0).then_some(t));
        run(&mut buffer, 3, 9..20, |_, t| Some(t));
        assert_eq!(buffer.take_restart(), None);
    }

    fn crowded(camera: &str, time_s: f64, sightings: usize) -> Exposure {
        let line = crossfix_geometry::SightLine {
            origin: nalgebra::Point3::origin(),
            direction: nalgebra::Vector3::x_axis(),
            basis: nalgebra::Matrix3x2::identity(),
            covariance: nalgebra::Matrix2::identity(),
        };
        let sighting = crate::Sighting { image_track: 1, line };
        Exposure { sightings: vec![sighting; sightings], ..exposure(camera, time_s) }
    }

    #[test]
    fn sightings_that_wait_are_counted_and_bounded() {
        let patient = EventTime { lateness_s: 60.0, ..EventTime::default() };
        let mut buffer = EventBuffer::new(patient);
        buffer.insert(exposure("b", 0.0)).unwrap();
        let mut most = 0;
        for k in 1..40 {
            buffer.insert(crowded("a", 0.1 * f64::from(k), 10_000)).unwrap();
            drain(&mut buffer);
            let held: usize = buffer.held.values().map(|held| held.exposure.sightings.len()).sum();
            most = most.max(held);
        }
        assert_eq!(most, 100_000);
        while buffer.pop().is_some() {}
        assert_eq!(buffer.load, Load::default());
    }

    #[test]
    fn exposures_that_wait_are_counted_and_bounded() {
        let mut buffer = EventBuffer::new(EventTime::default());
        buffer.insert(exposure("b", 0.0)).unwrap();
        for k in 1..10_000 {
            buffer.insert(exposure("a", 1e-6 * f64::from(k))).unwrap();
            drain(&mut buffer);
        }
        assert_eq!(buffer.held.len(), 6_000);
    }

    #[test]
    fn a_camera_alone_is_followed_after_the_lateness() {
        let mut buffer = EventBuffer::new(EventTime::default());
        buffer.expect(&"b".parse().unwrap());
        assert_eq!(run(&mut buffer, 1, 0..60, |_, t| Some(t)), 0);
        assert!((5..7).contains(&buffer.held.len()), "{}", buffer.held.len());
    }

    proptest! {
        #[test]
        fn the_order_of_arrival_changes_nothing(seed in proptest::collection::vec(0..1000u32, 30)) {
            let frames: Vec<Exposure> =
                (0..30).map(|i| exposure(["a", "b", "c"][i % 3], 0.01 * i as f64)).collect();
            let mut shuffled: Vec<(u32, Exposure)> = seed.into_iter().zip(frames).collect();
            shuffled.sort_by_key(|(key, _)| *key);
            let mut buffer = EventBuffer::new(EventTime::default());
            let mut released = Vec::new();
            for (_, frame) in shuffled {
                buffer.insert(frame).unwrap();
            }
            while let Some(Ok(frame)) = buffer.pop() {
                released.push(frame.time);
            }
            prop_assert_eq!(released.len(), 30);
            prop_assert!(released.is_sorted());
        }
    }
}
