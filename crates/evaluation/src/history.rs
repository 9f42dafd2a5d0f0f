use std::collections::BTreeMap;

use crossfix_filter::KinematicState;
use crossfix_message::{Timestamp, Track, TrackFrame, TrackState};
use nalgebra::{Matrix6, Vector6};

use crate::Estimate;

/// What a run's `TrackFrame`s said when: the causal answer to "where was each track at time t".
#[derive(Clone, Debug, Default)]
pub struct TrackHistory {
    frames: BTreeMap<Timestamp, Vec<Estimate>>,
}

/// A track's state, if the message holds one that makes sense.
fn state(track: &Track) -> Option<KinematicState> {
    let (p, v) = (track.position?, track.velocity?);
    let mean = Vector6::new(p.x, p.y, p.z, v.x, v.y, v.z);
    let covariance: [f64; 36] = track.covariance.as_slice().try_into().ok()?;
    let covariance = Matrix6::from_row_slice(&covariance);
    let finite = mean.iter().chain(covariance.iter()).all(|value| value.is_finite());
    finite.then_some(KinematicState { mean, covariance })
}

impl TrackHistory {
    /// Takes a frame in, in any order; tentative and lost tracks are left out.
    pub fn add(&mut self, frame: &TrackFrame) {
        let sure = |track: &&Track| matches!(track.state(), TrackState::Confirmed | TrackState::Coasting);
        let estimates = frame
            .tracks
            .iter()
            .filter(sure)
            .filter_map(|track| Some(Estimate { id: track.id, state: state(track)? }));
        self.frames.insert(Timestamp::from_nanos(frame.time_ns), estimates.collect());
    }

    /// The confirmed tracks at `time`: of the last frame at or before it, extrapolated with their
    /// velocities. Their covariances grow with the velocity's alone.
    pub fn at(&self, time: Timestamp) -> Vec<Estimate> {
        let Some((&frame_time, estimates)) = self.frames.range(..=time).next_back() else {
            return Vec::new();
        };
        let dt = time.seconds_since(frame_time);
        let moved = |e: &Estimate| Estimate { id: e.id, state: e.state.predicted(dt, 0.0) };
        estimates.iter().map(moved).collect()
    }

    /// Every frame's time with its confirmed tracks, in order of time.
    pub fn frames(&self) -> impl Iterator<Item = (Timestamp, &[Estimate])> {
        self.frames.iter().map(|(&time, estimates)| (time, estimates.as_slice()))
    }
}
