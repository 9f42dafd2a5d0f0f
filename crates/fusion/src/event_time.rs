//! Event time with a bounded wait: frames are taken in as they arrive and released in the order of
//! their capture times, so that the order of arrival changes nothing.

mod queue;
mod stream;

use std::collections::{BTreeMap, BTreeSet};

use crossfix_message::{CameraName, Timestamp};

use crate::{EventTime, Exposure, Rejection, RejectionReason};
use stream::FrameStream;

pub(crate) use queue::ReorderQueue;

/// Most exposures that are remembered of those that were released: memory is bounded. With half of
/// it the same at the default lateness, within which 64 cameras of 60 Hz send 1920; beyond it what
/// comes twice passes for late.
const MAX_RELEASED_KEYS: usize = 20_000;

/// A camera that has been silent for this many times the lateness is not waited for. With half of
/// it, a second by default, cameras that send less than one frame per second are not.
const PATIENCES: f64 = 4.0;

/// Of the time that one camera's clock alone says has gone by, this share is believed. With all of
/// it a clock that races makes all others look silent between two of their frames; with half of it
/// the last camera of a site is not followed for ten seconds.
const ALONE: f64 = 0.4;

/// How an exposure arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ExposureArrival {
    /// After all others of its camera.
    InOrder,
    /// After a newer one of its camera, but still in time.
    OutOfOrder,
}

/// A camera that should be heard: its stream once it has been, and whether it has come to its end.
#[derive(Clone, Copy, Debug, Default)]
struct CameraArrivals {
    stream: Option<FrameStream>,
    ended: bool,
}

/// The buffer that puts exposures into order.
///
/// The agreed time is that of the second newest of the live cameras, and no more than half of
/// them may be beyond what the others have reached. So a minority of wrong clocks cannot drag the
/// others into the past. Exposures are released up to the time of the slowest camera that is still
/// heard, or up to `lateness_s` behind the agreed time, whichever is later.
///
/// Frames that are refused count for the agreed time too: where most cameras jump, time has jumped.
/// If most of them have been behind what was released for a while, the release was the mistake, and
/// the order starts again from their time.
///
/// A camera is live until time has gone on by [`PATIENCES`] times the lateness since it was heard.
/// There is no other clock here than the cameras': time goes on as the second quickest of them
/// does, without jumps, and by a share of what the quickest alone is ahead ([`ALONE`]). What a
/// camera says all at once of a time that the others have been through, because its host stood
/// still or its link was cut, is no progress.
///
/// A camera that has been further behind than the lateness, for [`PATIENCES`] times as long, is not
/// waited for: its frames come too late all the same.
///
/// After a camera's newest frame nothing older is expected of it, so that nobody waits for an order
/// that transports keep anyway. A camera that has lost a frame by that is taken, for a while, to be
/// as far behind its newest frame as that one was.
///
/// Whether a frame is late is decided not by that but by what has been worked on: an exposure that
/// can still be taken in order is taken.
#[derive(Debug)]
pub(crate) struct EventBuffer {
    config: EventTime,
    /// The waiting exposures, each with whether its time has been compared with another camera's.
    waiting: ReorderQueue<bool>,
    /// What was released within the last `lateness_s`, to tell what comes twice from what comes
    /// late.
    released_keys: BTreeSet<(Timestamp, CameraName)>,
    sources: BTreeMap<CameraName, CameraArrivals>,
    /// How far time has gone on, s.
    run_s: f64,
    /// The time that the live cameras agree on, and how many they were, when a frame last came.
    agreed: Option<CommonTime>,
    /// [`Self::run_s`] since which most live cameras have been behind what was released.
    behind_since_s: Option<f64>,
    /// Exposures that were waiting when the order started again.
    dropped: Vec<Rejection>,
    /// Where the order started again, until somebody asks.
    rewound_to: Option<Timestamp>,
    /// The oldest time heard.
    first: Option<Timestamp>,
    /// The newest time that was released.
    released: Timestamp,
    /// The newest time, with the clock's offset taken off, that has been worked on.
    processed: Timestamp,
}

/// Common time of the live cameras, and how many there are.
#[derive(Clone, Copy, Debug)]
struct CommonTime {
    time: Timestamp,
    live: usize,
}

impl EventBuffer {
    pub(crate) fn new(config: EventTime) -> Self {
        Self {
            config,
            waiting: ReorderQueue::default(),
            released_keys: BTreeSet::new(),
            sources: BTreeMap::new(),
            run_s: 0.0,
            agreed: None,
            behind_since_s: None,
            dropped: Vec::new(),
            rewound_to: None,
            first: None,
            released: Timestamp::MIN,
            processed: Timestamp::MIN,
        }
    }

    /// Announces a camera that should be heard soon: in the beginning it is waited for like the
    /// others.
    pub(crate) fn expect(&mut self, camera: &CameraName) {
        self.sources.entry(camera.clone()).or_default();
    }

    /// Takes an exposure in; nothing is released before [`Self::release`] says so.
    pub(crate) fn insert(
        &mut self,
        exposure: Exposure,
    ) -> Result<ExposureArrival, RejectionReason> {
        let (time, max_ahead_s) = (exposure.time, self.config.max_ahead_s);
        if let Some(source) = self.sources.get_mut(&exposure.camera) {
            source.ended = false;
        }
        let is_released = self.released_keys.contains(&(time, exposure.camera.clone()));
        if is_released || self.waiting.holds(&exposure, time) {
            return Err(RejectionReason::Duplicate);
        }
        let arrival = self.observe(&exposure);
        let compared = self.agreed.is_some_and(|agreed| agreed.live > 1);
        if let Some(agreed) = self.agreed
            && let Some(stream) = self.stream_mut(&exposure.camera)
        {
            // A camera that goes on by itself, step by step, is not from the future.
            let by_s = time.seconds_since(agreed.time.max(stream.trusted));
            if by_s > max_ahead_s {
                return Err(RejectionReason::Future { by_s });
            }
            if compared || time.seconds_since(stream.trusted) <= max_ahead_s {
                stream.trusted = stream.trusted.max(time);
            }
        }
        if let Some(by_s) = self.late_s(&exposure) {
            return Err(RejectionReason::Late { by_s });
        }
        self.waiting.insert(exposure, time, compared);
        Ok(arrival)
    }

    fn stream_mut(&mut self, camera: &CameraName) -> Option<&mut FrameStream> {
        self.sources.get_mut(camera)?.stream.as_mut()
    }

    /// The streams of all cameras that have been heard, each with whether it has come to its end.
    fn streams(&self) -> impl Iterator<Item = (&FrameStream, bool)> {
        self.sources.values().filter_map(|source| Some((source.stream.as_ref()?, source.ended)))
    }

    /// The streams that have not come to their end.
    fn going_on(&self) -> impl Iterator<Item = &FrameStream> {
        self.streams().filter(|(_, ended)| !ended).map(|(stream, _)| stream)
    }

    /// Notes an exposure's time, whatever becomes of the exposure.
    fn observe(&mut self, exposure: &Exposure) -> ExposureArrival {
        let (time, lateness_s) = (exposure.time, self.config.lateness_s);
        let late_s = self.late_s(exposure);
        let source = self.sources.entry(exposure.camera.clone()).or_default();
        let stream = source.stream.get_or_insert(FrameStream::beginning(time));
        let arrival = if time < stream.newest {
            ExposureArrival::OutOfOrder
        } else {
            ExposureArrival::InOrder
        };
        // A clock that races makes nobody else look silent, nor does one that catches up on lost
        // time.
        let reached = self.agreed.map(|agreed| agreed.time.plus_seconds(-lateness_s));
        let keeps_up = reached.is_none_or(|reached| time > reached);
        let step_s = time.seconds_since(stream.newest).clamp(0.0, lateness_s);
        stream.gone_s += stream.progress(keeps_up, step_s);
        stream.observe(time, late_s, lateness_s);
        self.go_on();
        let run_s = self.run_s;
        if let Some(stream) = self.stream_mut(&exposure.camera) {
            stream.heard_s = run_s;
        }
        self.first = Some(self.first.map_or(time, |first| first.min(time)));
        self.estimate_now();
        self.note_who_is_behind();
        arrival
    }

    /// Time goes on as the cameras do.
    fn go_on(&mut self) {
        let (mut first_s, mut second_s) = (0.0_f64, 0.0_f64);
        for (stream, _) in self.streams() {
            // The two largest in one pass: what is pushed from the first place is in the second.
            second_s = second_s.max(stream.gone_s.min(first_s));
            first_s = first_s.max(stream.gone_s);
        }
        // Where there is only one camera, nobody else can look silent.
        let share = if self.streams().count() > 1 { ALONE } else { 1.0 };
        // run = g2 + ALONE (g1 - g2), and never back.
        self.run_s = self.run_s.max(second_s + share * (first_s - second_s));
    }

    /// Notes the cameras that are further behind than anybody waits.
    fn note_who_is_behind(&mut self) {
        let Some(CommonTime { time, .. }) = self.agreed else { return };
        let (patience, run_s) = (time.plus_seconds(-self.config.lateness_s), self.run_s);
        for stream in self.sources.values_mut().filter_map(|source| source.stream.as_mut()) {
            let since_s = stream.behind_since_s.unwrap_or(run_s);
            stream.behind_since_s = (stream.newest <= patience).then_some(since_s);
        }
    }

    /// The time that the live cameras agree on; `None` before any was heard.
    pub(crate) fn agreed_time(&self) -> Option<Timestamp> {
        self.agreed.map(|agreed| agreed.time)
    }

    /// Computes the agreed time from the live cameras.
    fn estimate_now(&mut self) {
        let patience_s = PATIENCES * self.config.lateness_s;
        let is_live = |stream: &&FrameStream| self.run_s - stream.heard_s <= patience_s;
        let live: Vec<&FrameStream> = self.going_on().filter(is_live).collect();
        let newest = newest_first(live.iter().map(|stream| stream.newest));
        // The time that a camera has reached: its next frame is not due before.
        let reached = newest_first(live.iter().map(|s| s.newest.plus_seconds(s.step_s)));
        let half = live.len() / 2;
        let time = match (newest.as_slice(), reached.get(half)) {
            // The second newest, but no later than what half of the cameras have reached.
            ([_, second, ..], Some(reached)) => Some(*second.min(reached)),
            ([alone], _) => Some(*alone),
            _ => None,
        };
        let is_behind = |time: &Timestamp| self.released.seconds_since(*time) > patience_s;
        let behind = newest.iter().filter(|time| is_behind(time)).count();
        self.agreed = time.map(|time| CommonTime { time, live: live.len() });
        if behind <= half {
            self.behind_since_s = None;
            return;
        }
        let since_s = *self.behind_since_s.get_or_insert(self.run_s);
        if let Some(time) = time.filter(|_| self.run_s - since_s > patience_s) {
            self.rewind(time);
        }
    }

    /// Starts the order again from a time before what was released.
    fn rewind(&mut self, time: Timestamp) {
        while let Some((exposure, _)) = self.waiting.pop() {
            let by_s = exposure.time.seconds_since(time);
            self.dropped.push(exposure.refused(RejectionReason::Future { by_s }));
        }
        self.released_keys.clear();
        let streams = self.sources.values_mut().filter_map(|source| source.stream.as_mut());
        streams.for_each(|stream| stream.trusted = Timestamp::MIN);
        self.behind_since_s = None;
        (self.released, self.processed) = (Timestamp::MIN, Timestamp::MIN);
        self.rewound_to = Some(time);
    }

    /// Forgets all times, as the clocks of all cameras have stepped. Nothing is kept waiting.
    pub(crate) fn reset(&mut self) {
        let mut sources = std::mem::take(&mut self.sources);
        sources.retain(|_, source| source.ended || source.stream.is_some());
        sources.values_mut().for_each(|source| source.stream = None);
        *self = Self { sources, ..Self::new(self.config.clone()) };
    }

    /// The time at which the order started again with the last frame, if it did: what has been made
    /// of later times is to be forgotten.
    pub(crate) fn take_rewind(&mut self) -> Option<Timestamp> {
        self.rewound_to.take()
    }

    /// By how much an exposure comes too late, s: what follows it has been worked on. What was
    /// released may still wait until other clocks are sure (by its time less the clock's offset).
    fn late_s(&self, exposure: &Exposure) -> Option<f64> {
        let corrected = exposure.time.plus_seconds(-exposure.correction_s);
        let is_late = exposure.time < self.released && corrected < self.processed;
        is_late.then(|| self.released.seconds_since(exposure.time))
    }

    /// Notes that an exposure of this time, less the clock's offset, is being worked on.
    pub(crate) fn mark_processed(&mut self, corrected: Timestamp) {
        self.processed = self.processed.max(corrected);
    }

    /// By how much a time, less the clock's offset, lies before what has been worked on, s; `None`
    /// unless that is more than the lateness.
    pub(crate) fn behind_processed_s(&self, corrected: Timestamp) -> Option<f64> {
        Some(self.processed.seconds_since(corrected)).filter(|by_s| *by_s > self.config.lateness_s)
    }

    /// Marks a camera as come to its end: nobody waits for it any more.
    pub(crate) fn end(&mut self, camera: &CameraName) {
        self.sources.entry(camera.clone()).or_default().ended = true;
    }

    /// The next exposure that nothing can overtake any more.
    pub(crate) fn release(&mut self) -> Option<Result<Exposure, Rejection>> {
        if let Some(dropped) = self.dropped.pop() {
            return Some(Err(dropped));
        }
        let (exposure, is_compared) = self.waiting.pop_settled(self.watermark())?;
        Some(self.take(exposure, is_compared))
    }

    /// The next exposure, whatever may still come.
    pub(crate) fn pop(&mut self) -> Option<Result<Exposure, Rejection>> {
        if let Some(dropped) = self.dropped.pop() {
            return Some(Err(dropped));
        }
        let (exposure, is_compared) = self.waiting.pop()?;
        Some(self.take(exposure, is_compared))
    }

    /// Takes an exposure out for good; `is_compared` is whether its time has been compared with
    /// that of other cameras.
    fn take(&mut self, exposure: Exposure, is_compared: bool) -> Result<Exposure, Rejection> {
        // A frame taken in before a second camera was heard may turn out to be from the future.
        if !is_compared && let Some(agreed) = self.agreed {
            let ahead = exposure.time.seconds_since(agreed.time);
            if ahead > self.config.max_ahead_s {
                return Err(exposure.refused(RejectionReason::Future { by_s: ahead }));
            }
        }
        self.released = self.released.max(exposure.time);
        self.remember(exposure.time, exposure.camera.clone());
        Ok(exposure)
    }

    fn remember(&mut self, time: Timestamp, camera: CameraName) {
        self.released_keys.insert((time, camera));
        let oldest = self.released.plus_seconds(-self.config.lateness_s);
        while self.released_keys.len() > MAX_RELEASED_KEYS
            || self.released_keys.first().is_some_and(|(time, _)| *time < oldest)
        {
            self.released_keys.pop_first();
        }
    }

    /// The time before which nothing comes any more.
    fn watermark(&self) -> Option<Timestamp> {
        let heard = self.streams().count();
        if heard > 1 && self.going_on().next().is_none() {
            return Some(Timestamp::MAX);
        }
        let lateness_s = self.config.lateness_s;
        let CommonTime { time: agreed, live } = self.agreed?;
        let patience = agreed.plus_seconds(-lateness_s);
        let forgotten = agreed.plus_seconds(-PATIENCES * lateness_s);
        let is_expected = |source: &CameraArrivals| source.stream.is_none() && !source.ended;
        let waits_for_new = self.first.is_some_and(|first| first > forgotten)
            && self.sources.values().any(is_expected);
        // A camera alone is not followed at once: the others may come back, or be heard at last.
        let is_alone = live == 1 && (heard == 1 || self.going_on().count() > 1);
        if waits_for_new || is_alone {
            return Some(patience);
        }
        let bearable_s = PATIENCES * lateness_s;
        let lately = self
            .going_on()
            .filter(|stream| stream.keeps_up(self.run_s, bearable_s) && stream.newest > forgotten);
        let slowest = lately.map(|s| s.newest.plus_seconds(-s.disorder_s(lateness_s))).min();
        // Of the cameras that have ended, nothing more comes; of the others, nothing before
        // `slowest`.
        // The later of the two: a slow camera holds the others up by the lateness at most.
        Some(slowest.map_or(patience, |slowest| slowest.max(patience)))
    }
}

/// Times in order, the newest first.
fn newest_first(times: impl Iterator<Item = Timestamp>) -> Vec<Timestamp> {
    let mut times: Vec<Timestamp> = times.collect();
    times.sort_by(|one, other| other.cmp(one));
    times
}

#[cfg(test)]
mod tests;
