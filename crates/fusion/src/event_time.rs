//! Event time with a bounded wait: frames go in as they arrive and come out in the order of their
//! capture times, so that the order of arrival changes nothing.

use std::collections::{BTreeMap, BTreeSet};

use crossfix_message::{CameraName, Timestamp};

use crate::{EventTime, Exposure, RejectionReason};

/// More exposures than this are not held back, whatever the clocks say: memory is bounded.
const MAX_HELD: usize = 20_000;

/// A camera that has been silent for so many times the lateness is not waited for.
const PATIENCES: f64 = 4.0;

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

/// The buffer that puts exposures into order.
///
/// The time up to which exposures are released follows the *second* newest camera, so that one
/// camera with a wrong clock cannot drag the others into the past: up to the slowest camera that
/// is still heard, or `lateness_s` behind that second newest, whichever is later.
#[derive(Debug)]
pub(crate) struct EventBuffer {
    config: EventTime,
    held: BTreeMap<Order, Held>,
    newest: BTreeMap<CameraName, Timestamp>,
    /// The newest time of each camera that agreed with another camera's.
    trusted: BTreeMap<CameraName, Timestamp>,
    ended: BTreeSet<CameraName>,
    /// Cameras that should be heard soon.
    expected: BTreeSet<CameraName>,
    /// The oldest time heard.
    first: Option<Timestamp>,
    released: Timestamp,
}

impl EventBuffer {
    pub(crate) fn new(config: EventTime) -> Self {
        Self {
            config,
            held: BTreeMap::new(),
            newest: BTreeMap::new(),
            trusted: BTreeMap::new(),
            ended: BTreeSet::new(),
            expected: BTreeSet::new(),
            first: None,
            released: Timestamp::MIN,
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
        let previous = self.newest.get(&exposure.camera).copied().unwrap_or(Timestamp::MIN);
        self.newest.insert(exposure.camera.clone(), previous.max(time));
        self.first = Some(self.first.map_or(time, |first| first.min(time)));
        let reference = self.second_newest();
        if let Some(reference) = reference {
            // A camera that goes on by itself, step by step, is not from the future.
            let trusted = self.trusted.get(&exposure.camera).copied().unwrap_or(Timestamp::MIN);
            let by_s = time.seconds_since(reference.max(trusted));
            if by_s > self.config.max_ahead_s {
                return Err(RejectionReason::Future { by_s });
            }
            self.trusted.insert(exposure.camera.clone(), trusted.max(time));
        }
        if time <= self.released {
            return Err(RejectionReason::Late { by_s: self.released.seconds_since(time) });
        }
        let order = (time, exposure.camera.clone());
        if self.held.contains_key(&order) {
            return Err(RejectionReason::Duplicate);
        }
        self.held.insert(order, Held { exposure, compared: reference.is_some() });
        Ok(if time < previous { Arrival::OutOfOrder } else { Arrival::InOrder })
    }

    /// Marks a camera as come to its end: nobody waits for it any more.
    pub(crate) fn end(&mut self, camera: &CameraName) {
        self.ended.insert(camera.clone());
    }

    /// The next exposure that nothing can overtake any more.
    pub(crate) fn release(&mut self) -> Option<Result<Exposure, (Exposure, RejectionReason)>> {
        let (order, _) = self.held.first_key_value()?;
        if self.held.len() <= MAX_HELD && !self.everyone_ended() && order.0 > self.watermark()? {
            return None;
        }
        self.pop()
    }

    /// The next exposure, whatever may still come.
    pub(crate) fn pop(&mut self) -> Option<Result<Exposure, (Exposure, RejectionReason)>> {
        let (_, Held { exposure, compared }) = self.held.pop_first()?;
        // A frame taken in before a second camera was heard may turn out to be from the future.
        if !compared && let Some(reference) = self.second_newest() {
            let ahead = exposure.time.seconds_since(reference);
            if ahead > self.config.max_ahead_s {
                return Some(Err((exposure, RejectionReason::Future { by_s: ahead })));
            }
        }
        self.released = self.released.max(exposure.time);
        Some(Ok(exposure))
    }

    fn everyone_ended(&self) -> bool {
        self.newest.len() > 1 && self.newest.keys().all(|camera| self.ended.contains(camera))
    }

    fn second_newest(&self) -> Option<Timestamp> {
        let mut times: Vec<Timestamp> = self.newest.values().copied().collect();
        times.sort_unstable_by(|a, b| b.cmp(a));
        times.get(1).copied()
    }

    fn watermark(&self) -> Option<Timestamp> {
        let reference = self.second_newest()?;
        let patience = reference.plus_seconds(-self.config.lateness_s);
        let forgotten = reference.plus_seconds(-PATIENCES * self.config.lateness_s);
        let never_heard = |camera: &CameraName| !self.newest.contains_key(camera);
        let waits_for_new = self.first.is_some_and(|first| first > forgotten)
            && self.expected.iter().any(|camera| never_heard(camera) && !self.ended.contains(camera));
        if waits_for_new {
            return Some(patience);
        }
        let heard = self.newest.iter().filter(|(camera, _)| !self.ended.contains(camera));
        let slowest = heard.map(|(_, &time)| time).filter(|&time| time > forgotten).min();
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
        std::iter::from_fn(|| buffer.release()).filter_map(Result::ok).map(|e| e.time.seconds()).collect()
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
