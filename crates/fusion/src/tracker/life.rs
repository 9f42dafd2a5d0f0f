//! The life cycle of tracks: start, confirmation, coasting, merging, loss.

use crossfix_message::{Timestamp, TrackEventKind, track_id};
use nalgebra::Point3;

use super::{TrackChange, Tracker, mahalanobis_squared, same_target};
use crate::cameras::{Cameras, KnownCamera};
use crate::evidence::ONE_IN_A_HUNDRED;
use crate::initiation::NewTrack;
use crate::motion::MotionSetup;
use crate::track::{FusedTrack, TrackId, TrackStatus};

/// Size of the smallest target that is found, px: tracks closer together than this for every camera
/// are one target. With half of it the two ends of a target make two tracks; with twice as much,
/// targets in formation become one.
const SMALLEST_TARGET_PX: f64 = 7.0;
/// A new track is compared with the older ones at this interval, s, ...
const COMPARED_EVERY_S: f64 = 1.0;
/// ... this many times: by then its position is well known, and two targets that fly side by side
/// have been seen apart. With half as many, two ends of a target whose tracks settle late stay two;
/// with half of the interval, targets that only cross are joined.
const COMPARISONS: u32 = 5;
/// Gate for finding a track again that one camera alone was following (squared Mahalanobis
/// distance, P = 0.999 999). With half of it one in 650 gets a new number.
const FOUND_AGAIN_GATE: f64 = 30.7;

impl Tracker {
    /// Sets the status of all tracks: confirms, lets coast, and ends.
    pub(super) fn review(&mut self, now: Timestamp) -> Vec<TrackChange> {
        let mut changes = Vec::new();
        for track in self.tracks.values_mut() {
            let silent_s = now.seconds_since(track.updated_at);
            let unseen = silent_s > self.config.coasting_after_s;
            let hopeless = silent_s > self.config.lost_after_s
                || (unseen
                    && position_sd(track, now, &self.motion) > self.config.max_position_sd_m);
            match track.status {
                TrackStatus::Lost => {}
                _ if hopeless || track.score < ONE_IN_A_HUNDRED => {
                    track.status = TrackStatus::Lost;
                    changes.push(TrackChange::new(TrackEventKind::Lost, track.id));
                }
                TrackStatus::Tentative if track.score >= self.config.confirm_score => {
                    track.status = TrackStatus::Confirmed;
                    changes.push(TrackChange::new(TrackEventKind::Confirmed, track.id));
                }
                TrackStatus::Confirmed | TrackStatus::Coasting | TrackStatus::OneCamera => {
                    track.status = if track.is_a_direction(now, &self.motion) {
                        TrackStatus::OneCamera
                    } else if unseen {
                        TrackStatus::Coasting
                    } else {
                        TrackStatus::Confirmed
                    };
                }
                TrackStatus::Tentative => {}
            }
        }
        changes
    }

    /// Merges a coasting track into a live one at the same position: they were the same target, and
    /// the live one goes on.
    pub(super) fn merge(&mut self, now: Timestamp) -> Vec<TrackChange> {
        let coasting = self.tracks.values().filter(|t| t.status == TrackStatus::Coasting);
        let live: Vec<&FusedTrack> =
            self.tracks.values().filter(|t| t.status == TrackStatus::Confirmed).collect();
        let merged: Vec<(TrackId, TrackId)> = coasting
            .filter_map(|old| {
                let old_state = old.predicted(now, &self.motion);
                let same = live
                    .iter()
                    .find(|new| same_target(&old_state, &new.predicted(now, &self.motion)))?;
                Some((old.id, same.id))
            })
            .collect();
        merged
            .into_iter()
            .map(|(old, live)| {
                if let Some(track) = self.tracks.get_mut(&old) {
                    track.status = TrackStatus::Lost;
                }
                TrackChange { kind: TrackEventKind::Merged, track: old, other: Some(live) }
            })
            .collect()
    }

    /// Compares each young track a few times with the older ones: a detector that reports the two
    /// ends of a target makes two tracks.
    pub(super) fn prove(&mut self, now: Timestamp, cameras: &Cameras) -> Vec<TrackChange> {
        let due = self.tracks.values().filter(|track| is_comparison_due(track, now));
        let due: Vec<TrackId> = due.map(|track| track.id).collect();
        let mut changes = Vec::new();
        for id in due {
            let older = self.tracks.range(..id).map(|(_, old)| old);
            let mut older = older.filter(|old| old.status == TrackStatus::Confirmed);
            let new = self.tracks.get(&id);
            let same =
                new.and_then(|new| older.find(|old| stays_one_image(old, new, now, cameras)));
            let same = same.map(|old| old.id);
            if let Some(track) = self.tracks.get_mut(&id) {
                track.comparisons += 1;
                if let Some(old) = same {
                    track.status = TrackStatus::Lost;
                    changes.push(TrackChange {
                        kind: TrackEventKind::Merged,
                        track: id,
                        other: Some(old),
                    });
                }
            }
            if let Some(old) = same.and_then(|old| self.tracks.get_mut(&old)) {
                old.has_ends = true;
            }
        }
        changes
    }

    /// Takes over a new track from the initiation, and numbers it.
    ///
    /// If it has used the bearings of a track that one camera alone was following, and lies where
    /// that track may have gone, it is the same target found again and goes on under the old
    /// number. If it lies elsewhere, the old track was wrong and is ended; but two cameras are not
    /// enough to say so, as their lines cross anywhere.
    pub(crate) fn adopt(&mut self, start: NewTrack, cameras: &Cameras) -> Vec<TrackChange> {
        let NewTrack { mut track, cameras: seen_by, provisional_owners } = start;
        let owners = provisional_owners.iter().filter_map(|id| self.tracks.get(id));
        let alone: Vec<&FusedTrack> =
            owners.filter(|old| old.is_confirmed() && !old.is_triangulated()).collect();
        let same = alone.iter().find(|old| {
            let expected = old.predicted(track.updated_at, &self.motion);
            mahalanobis_squared(&expected, track.state())
                .is_some_and(|distance| distance < FOUND_AGAIN_GATE)
        });
        if let Some(old) = same {
            track.id = old.id;
            // The number goes on, and with it what spoke for the target.
            track.score = track.score.max(old.score);
            (track.has_ends, track.comparisons) = (old.has_ends, old.comparisons);
            if let Some(old) = self.tracks.get_mut(&track.id) {
                track.inherit(old);
            }
            self.tracks.insert(track.id, track);
            return Vec::new();
        }
        if self.tracks.values().any(|old| {
            old.status == TrackStatus::Confirmed
                && old.is_triangulated()
                && is_one_image(old, &track, track.updated_at, cameras)
        }) {
            return Vec::new();
        }
        let wrong: Vec<TrackId> = alone.iter().map(|old| old.id).collect();
        if !wrong.is_empty() && seen_by < 3 {
            return Vec::new();
        }
        let id = TrackId(track_id(self.began.unwrap_or(track.updated_at), self.next_number));
        self.next_number += 1;
        track.id = id;
        let mut changes = vec![TrackChange::new(TrackEventKind::Born, id)];
        for old in wrong {
            if let Some(track) = self.tracks.get_mut(&old) {
                track.status = TrackStatus::Lost;
            }
            changes.push(TrackChange::new(TrackEventKind::Lost, old));
        }
        if track.is_confirmed() {
            changes.push(TrackChange::new(TrackEventKind::Confirmed, id));
        }
        self.tracks.insert(id, track);
        changes
    }
}

/// Whether a young track is to be compared with the older ones once more.
fn is_comparison_due(track: &FusedTrack, now: Timestamp) -> bool {
    let next_s = f64::from(track.comparisons + 1) * COMPARED_EVERY_S;
    track.status == TrackStatus::Confirmed
        && track.comparisons < COMPARISONS
        && now.seconds_since(track.born) >= next_s
}

/// Whether two tracks are one image ([`is_one_image`]) now and a moment later: two targets that
/// only cross part again.
fn stays_one_image(old: &FusedTrack, new: &FusedTrack, now: Timestamp, cameras: &Cameras) -> bool {
    [0.0, COMPARED_EVERY_S].iter().all(|&s| is_one_image(old, new, now.plus_seconds(s), cameras))
}

/// Whether two tracks lie so close together at a time, for every camera that sees the new one, that
/// they are parts of one target: a detector may report its two ends.
fn is_one_image(old: &FusedTrack, new: &FusedTrack, time: Timestamp, cameras: &Cameras) -> bool {
    let places = [old.position_at(time), new.position_at(time)];
    // A target that was split once will be split again, and a track that is just beginning is less
    // certain in position: twice the distance is allowed.
    let times = if old.has_ends { 2.0 } else { 1.0 };
    let mut known = new.residuals.keys().map(|name| cameras.known(name));
    known.all(|known| known.is_some_and(|known| see_as_one(known, places, times)))
}

/// Whether two places are closer together for a camera than this many times the smallest target.
fn see_as_one(known: &KnownCamera, [there, here]: [Point3<f64>; 2], times: f64) -> bool {
    // px / fx is the angle about the optical axis.
    let smallest = SMALLEST_TARGET_PX / known.camera.model().intrinsics().fx;
    let origin = known.camera.pose().position();
    (there - origin).angle(&(here - origin)) < times * smallest
}

/// Root of the summed variances of the predicted position, m: at least the standard deviation along
/// any axis.
fn position_sd(track: &FusedTrack, now: Timestamp, motion: &MotionSetup) -> f64 {
    let state = track.predicted(now, motion);
    state.covariance.diagonal().fixed_rows::<3>(0).sum().sqrt()
}
