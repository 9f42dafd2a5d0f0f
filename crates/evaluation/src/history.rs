use std::collections::{BTreeMap, BTreeSet};

use crossfix_filter::KinematicState;
use crossfix_message::{Timestamp, Track, TrackFrame, TrackState};
use nalgebra::{Matrix6, Vector6};

use crate::Estimate;

/// A camera takes part in a track if it has given it a bearing within this time before the answer,
/// s. With half of it a camera with two frames per second would drop out whenever it misses one.
const LATELY_S: f64 = 1.0;

/// A statement holds for so long, s. Every track is stated at least each half second as long as
/// there are data; later than this the data have ended, and nobody says where the target is. With
/// half of it a site whose frames come seven seconds apart has no answer in two of them.
const HOLDS_S: f64 = 10.0;

/// Record of a run's `TrackFrame`s: the causal answer to "where was each track at time t".
///
/// A frame has the tracks that an exposure has changed; the others continue as last stated.
#[derive(Clone, Debug, Default)]
pub struct TrackHistory {
    /// Statements on each track, by time.
    tracks: BTreeMap<u64, BTreeMap<Timestamp, ReportedTrack>>,
    times: BTreeSet<Timestamp>,
}

#[derive(Clone, Debug)]
struct ReportedTrack {
    status: TrackState,
    /// When each camera gave its newest bearing.
    bearings: Vec<Timestamp>,
    state: Option<KinematicState>,
    time_sd_s: f64,
}

/// A track's state, if the message has one that is finite.
fn state(track: &Track) -> Option<KinematicState> {
    let (p, v) = (track.position?, track.velocity?);
    let mean = Vector6::new(p.x, p.y, p.z, v.x, v.y, v.z);
    let covariance: [f64; 36] = track.covariance.as_slice().try_into().ok()?;
    let state = KinematicState { mean, covariance: Matrix6::from_row_slice(&covariance) };
    state.is_finite().then_some(state)
}

impl TrackHistory {
    /// Adds a frame, in any order.
    pub fn add(&mut self, frame: &TrackFrame) {
        let time = Timestamp::from_nanos(frame.time_ns);
        self.times.insert(time);
        for track in &frame.tracks {
            let bearings =
                track.residuals.iter().map(|r| Timestamp::from_nanos(r.time_ns)).collect();
            let (status, state) = (track.state(), state(track));
            let said = ReportedTrack { status, bearings, state, time_sd_s: frame.time_sd_s };
            self.tracks.entry(track.id).or_default().insert(time, said);
        }
    }

    /// The confirmed tracks at `time`, ordered by id: as last stated at or before it, extrapolated
    /// with their velocities. Their covariances grow only by the velocity's covariance, without
    /// process noise.
    pub fn at(&self, time: Timestamp) -> Vec<Estimate> {
        let mut estimates = self.all_at(time);
        estimates
            .retain(|said| matches!(said.status, TrackState::Confirmed | TrackState::Coasting));
        estimates
    }

    /// Time of the first and of the last statement; `None` without any.
    pub fn span(&self) -> Option<[Timestamp; 2]> {
        Some([*self.times.first()?, *self.times.last()?])
    }

    /// The same with tentative tracks, and those that a single camera follows: a direction whose
    /// range is a guess.
    pub fn all_at(&self, time: Timestamp) -> Vec<Estimate> {
        let said = self.tracks.iter().filter_map(|(&id, said)| {
            let (&then, said) = said.range(..=time).next_back()?;
            if time.seconds_since(then) > HOLDS_S {
                return None;
            }
            let state = said.state.as_ref()?.predicted(time.seconds_since(then), 0.0);
            let lately = |bearing: &&Timestamp| time.seconds_since(**bearing) <= LATELY_S;
            let cameras = said.bearings.iter().filter(lately).count();
            Some(Estimate { id, status: said.status, cameras, state, time_sd_s: said.time_sd_s })
        });
        said.filter(|said| said.status != TrackState::Lost).collect()
    }

    /// The times of all frames, in order.
    pub fn times(&self) -> impl Iterator<Item = Timestamp> + '_ {
        self.times.iter().copied()
    }
}
