use std::collections::{BTreeMap, BTreeSet};

use crossfix_filter::KinematicState;
use crossfix_message::{Timestamp, Track, TrackFrame, TrackState};
use nalgebra::{Matrix6, Vector6};

use crate::Estimate;

/// What a run's `TrackFrame`s said when: the causal answer to "where was each track at time t".
///
/// A frame holds the tracks that an exposure has changed; the others go on as they were said last.
#[derive(Clone, Debug, Default)]
pub struct TrackHistory {
    /// What was said of each track: its state, or that it is not (or no longer) sure.
    tracks: BTreeMap<u64, BTreeMap<Timestamp, Option<KinematicState>>>,
    times: BTreeSet<Timestamp>,
}

/// A track's state, if the message holds one that makes sense.
fn state(track: &Track) -> Option<KinematicState> {
    let (p, v) = (track.position?, track.velocity?);
    let mean = Vector6::new(p.x, p.y, p.z, v.x, v.y, v.z);
    let covariance: [f64; 36] = track.covariance.as_slice().try_into().ok()?;
    let state = KinematicState { mean, covariance: Matrix6::from_row_slice(&covariance) };
    state.is_finite().then_some(state)
}

impl TrackHistory {
    /// Takes a frame in, in any order; tentative and lost tracks are none.
    pub fn add(&mut self, frame: &TrackFrame) {
        let time = Timestamp::from_nanos(frame.time_ns);
        self.times.insert(time);
        for track in &frame.tracks {
            let sure = matches!(track.state(), TrackState::Confirmed | TrackState::Coasting);
            let said = if sure { state(track) } else { None };
            self.tracks.entry(track.id).or_default().insert(time, said);
        }
    }

    /// The confirmed tracks at `time`, ordered by id: as last said at or before it, extrapolated with
    /// their velocities. Their covariances grow with the velocity's alone.
    pub fn at(&self, time: Timestamp) -> Vec<Estimate> {
        let said = self.tracks.iter().filter_map(|(&id, said)| {
            let (&then, state) = said.range(..=time).next_back()?;
            let state = state.as_ref()?.predicted(time.seconds_since(then), 0.0);
            Some(Estimate { id, state })
        });
        said.collect()
    }

    /// Every frame's time with the confirmed tracks at it, in order of time.
    pub fn frames(&self) -> impl Iterator<Item = (Timestamp, Vec<Estimate>)> + '_ {
        self.times.iter().map(|&time| (time, self.at(time)))
    }
}
