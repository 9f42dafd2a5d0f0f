//! Conversion of the fusion centre's results to messages.

use crossfix_filter::KinematicState;
use crossfix_message::{CameraResidual, Payload, Timestamp, TrackEvent, TrackState};

use crate::motion::MotionSetup;
use crate::spatial::Quantity;
use crate::track::{FusedTrack, TrackStatus};
use crate::tracker::TrackChange;

/// The message of an event of a track.
pub(crate) fn event(change: TrackChange, time: Timestamp) -> TrackEvent {
    TrackEvent {
        time_ns: time.nanos(),
        kind: change.kind.into(),
        track_id: change.track.0,
        other_id: change.other.map_or(0, |id| id.0),
        ..Default::default()
    }
    .stamped()
}

/// The message of a track, with its state predicted to `time`.
pub(crate) fn track(
    track: &FusedTrack,
    time: Timestamp,
    motion: &MotionSetup,
) -> crossfix_message::Track {
    let now = track.predicted(time, motion);
    let state = match track.status {
        TrackStatus::Tentative => TrackState::Tentative,
        TrackStatus::Confirmed => TrackState::Confirmed,
        TrackStatus::Coasting => TrackState::Coasting,
        TrackStatus::OneCamera => TrackState::OneCamera,
        TrackStatus::Lost => TrackState::Lost,
    };
    let residuals = track.residuals.iter().map(|(camera, residual)| CameraResidual {
        camera: camera.as_str().to_owned(),
        time_ns: residual.time.nanos(),
        angle_rad: residual.angle,
        nis: residual.nis,
    });
    let mut told = crossfix_message::Track {
        id: track.id.0,
        state: state.into(),
        residuals: residuals.collect(),
        solver: track.solver.into(),
        rank: track.observability.rank as u32,
        condition_number: track.observability.condition_number,
        updated_ns: track.updated_at.nanos(),
        born_ns: track.born.nanos(),
        weak_position_axis: weak_axis(track, Quantity::Position),
        weak_velocity_axis: weak_axis(track, Quantity::Velocity),
        ..Default::default()
    };
    set_state(&mut told, &now);
    told
}

/// The axis of a quantity that cannot be observed, if the track's worst determined one is of it.
fn weak_axis(track: &FusedTrack, quantity: Quantity) -> Option<crossfix_message::Vector3> {
    let axis = track.observability.weak_axis.filter(|axis| axis.quantity == quantity)?;
    Some(axis.direction.into_inner().into())
}

/// Sets a message's position, velocity and covariance.
pub(crate) fn set_state(told: &mut crossfix_message::Track, state: &KinematicState) {
    told.position = Some(state.position().into());
    told.velocity = Some(state.velocity().into());
    // Symmetric, so column-major is row-major.
    told.covariance = state.covariance.as_slice().to_vec();
}
