//! How tracks come, are confirmed, and go.

use crossfix_message::{Timestamp, TrackEventKind, track_id};

use super::{TrackChange, Tracker, mahalanobis_squared, same_target};
use crate::cameras::Cameras;
use crate::initiation::Start;
use crate::motion::Motion;
use crate::track::{Track, TrackId, TrackStatus};

/// The smallest target that is found, px: what lies closer together for every camera is one. With
/// half of it the two ends of a target make two tracks, with twice as much targets in formation are
/// one.
const SMALLEST_TARGET_PX: f64 = 7.0;
/// A track whose score falls below this is dropped: a chance of 1 in 100 against clutter.
const DROP_SCORE: f64 = -4.6;
/// A new track is compared with the older ones this often, s, ...
const COMPARED_EVERY_S: f64 = 1.0;
/// ... and so many times: its place is well known by then, and two targets that fly side by side
/// have been seen apart.
const COMPARISONS: u32 = 5;
/// A track that one camera alone was following is found again within this distance (squared
/// Mahalanobis, P = 0.999 999).
const FOUND_AGAIN_GATE: f64 = 30.7;

impl Tracker {
    /// Confirms, coasts and gives up.
    pub(super) fn review(&mut self, now: Timestamp) -> Vec<TrackChange> {
        let mut changes = Vec::new();
        for track in self.tracks.values_mut() {
            let silent_s = now.seconds_since(track.updated);
            let unseen = silent_s > self.config.coasting_after_s;
            let hopeless = silent_s > self.config.lost_after_s
                || (unseen
                    && position_sd(track, now, &self.motion) > self.config.max_position_sd_m);
            match track.status {
                TrackStatus::Lost => {}
                _ if hopeless || track.score < DROP_SCORE => {
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

    /// A coasting track beside a live one was the same target: the live one goes on.
    pub(super) fn merge(&mut self, now: Timestamp) -> Vec<TrackChange> {
        let coasting = self.tracks.values().filter(|t| t.status == TrackStatus::Coasting);
        let live: Vec<&Track> =
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

    /// Compares each track a few times while it is young with those that were there before it: a
    /// detector that reports the two ends of a target makes two tracks.
    pub(super) fn prove(&mut self, now: Timestamp, cameras: &Cameras) -> Vec<TrackChange> {
        let is_due = |track: &&Track| {
            let next_s = f64::from(track.comparisons + 1) * COMPARED_EVERY_S;
            track.status == TrackStatus::Confirmed
                && track.comparisons < COMPARISONS
                && now.seconds_since(track.born) >= next_s
        };
        let due: Vec<TrackId> = self.tracks.values().filter(is_due).map(|track| track.id).collect();
        let mut changes = Vec::new();
        for id in due {
            let older = self.tracks.range(..id).map(|(_, old)| old);
            let mut older = older.filter(|old| old.status == TrackStatus::Confirmed);
            // Two targets that cross part again.
            let stays = |old: &Track, new: &Track| {
                [0.0, COMPARED_EVERY_S]
                    .iter()
                    .all(|&s| is_one_image(old, new, now.plus_seconds(s), cameras))
            };
            let same = self.tracks.get(&id).and_then(|new| older.find(|old| stays(old, new)));
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

    /// Takes a track over that the initiation has found, and numbers it. Where it has used the
    /// bearings of a track that one camera alone was following and lies where that may have gone,
    /// it is the same target found again: it goes on under the old number. Where it lies elsewhere,
    /// the old one was wrong and is given up; but two cameras are not enough to say so, as their
    /// lines cross anywhere.
    pub(crate) fn adopt(&mut self, start: Start, cameras: &Cameras) -> Vec<TrackChange> {
        let Start { mut track, cameras: seen_by, claimed_by } = start;
        let owners = claimed_by.iter().filter_map(|id| self.tracks.get(id));
        let unheld: Vec<&Track> =
            owners.filter(|old| old.is_confirmed() && !old.is_held()).collect();
        let same = unheld.iter().find(|old| {
            let expected = old.predicted(track.updated, &self.motion);
            mahalanobis_squared(&expected, track.state())
                .is_some_and(|distance| distance < FOUND_AGAIN_GATE)
        });
        if let Some(old) = same {
            track.id = old.id;
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
                && old.is_held()
                && is_one_image(old, &track, track.updated, cameras)
        }) {
            return Vec::new();
        }
        let wrong: Vec<TrackId> = unheld.iter().map(|old| old.id).collect();
        if !wrong.is_empty() && seen_by < 3 {
            return Vec::new();
        }
        let id = TrackId(track_id(self.began.unwrap_or(track.updated), self.next_number));
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

/// Whether two tracks lie so close together at a time for every camera that sees the new one that
/// they are parts of one target: a detector may report its two ends.
fn is_one_image(old: &Track, new: &Track, time: Timestamp, cameras: &Cameras) -> bool {
    let [there, here] = [old.position_at(time), new.position_at(time)];
    // What was split once is split again, and where a track begins it is less sure where.
    let times = if old.has_ends { 2.0 } else { 1.0 };
    new.residuals.keys().all(|name| {
        cameras.known(name).is_some_and(|known| {
            let smallest = SMALLEST_TARGET_PX / known.camera.model().intrinsics().fx;
            let origin = known.camera.pose().position();
            (there - origin).angle(&(here - origin)) < times * smallest
        })
    })
}

/// Root of the sum of the position's variances, m: not less than the standard deviation along any
/// axis.
fn position_sd(track: &Track, now: Timestamp, motion: &Motion) -> f64 {
    let state = track.predicted(now, motion);
    state.covariance.diagonal().fixed_rows::<3>(0).sum().sqrt()
}
