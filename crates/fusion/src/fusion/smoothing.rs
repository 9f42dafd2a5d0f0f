//! Track frames that wait for smoothing by later bearings.

use std::collections::VecDeque;

use crossfix_message::{Timestamp, TrackFrame};

use crate::messages;
use crate::track::{FusedTrack, TrackId};
use crate::tracker::Tracker;

/// The waiting track frames, in the order of their times.
#[derive(Debug)]
pub(super) struct Smoothing {
    lag_s: f64,
    waiting: VecDeque<TrackFrame>,
}

impl Smoothing {
    pub(super) fn new(lag_s: f64) -> Self {
        Self { lag_s, waiting: VecDeque::new() }
    }

    pub(super) fn is_wanted(&self) -> bool {
        self.lag_s > 0.0
    }

    /// Adds a frame.
    pub(super) fn wait(&mut self, frame: TrackFrame) {
        self.waiting.push_back(frame);
    }

    /// Writes the smoothed states of a track that ends into the waiting frames.
    pub(super) fn settle(&mut self, track: &FusedTrack) {
        self.waiting
            .iter_mut()
            .for_each(|frame| fill(frame, |id| Some(track).filter(|t| t.id == id)));
    }

    /// Removes the frames that have waited long enough, and returns them with the smoothed states.
    pub(super) fn due(&mut self, now: Timestamp, tracker: &mut Tracker) -> Vec<TrackFrame> {
        let times = self.waiting.iter().map(|frame| Timestamp::from_nanos(frame.time_ns));
        let count = times.take_while(|time| now.seconds_since(*time) >= self.lag_s).count();
        self.release(count, tracker)
    }

    /// Removes all waiting frames, and returns them with the smoothed states.
    pub(super) fn all(&mut self, tracker: &mut Tracker) -> Vec<TrackFrame> {
        self.release(self.waiting.len(), tracker)
    }

    fn release(&mut self, count: usize, tracker: &mut Tracker) -> Vec<TrackFrame> {
        let mut frames: Vec<TrackFrame> = self.waiting.drain(..count).collect();
        for frame in &mut frames {
            fill(frame, |id| tracker.track(id));
        }
        if let Some(last) = frames.last() {
            tracker.forget_until(Timestamp::from_nanos(last.time_ns));
        }
        frames
    }
}

/// Writes the stored states of tracks into a frame.
fn fill<'a>(frame: &mut TrackFrame, track: impl Fn(TrackId) -> Option<&'a FusedTrack>) {
    let time = Timestamp::from_nanos(frame.time_ns);
    for told in &mut frame.tracks {
        if let Some(state) = track(TrackId(told.id)).and_then(|track| track.remembered(time)) {
            messages::set_state(told, state);
        }
    }
}
