//! The life of tracks: association of an exposure's bearings, confirmation,
//! coasting, loss and merging.

use std::collections::BTreeMap;

use crossfix_filter::Gate;
use crossfix_geometry::Camera;
use crossfix_message::{Timestamp, TrackEventKind};

use crate::assignment::assign;
use crate::initiation::{starting_point, vague_velocity};
use crate::temporal::Group;
use crate::track::{Track, TrackId, TrackStatus};
use crate::{Exposure, Sighting, Tracking};

/// A tentative track whose score falls below this is dropped: a chance of 1 in 100 against clutter.
const DROP_SCORE: f64 = -4.6;
/// Two positions that differ by less than this (squared Mahalanobis, three degrees of freedom,
/// P = 0.99) are one target if one of the tracks is coasting.
const MERGE_GATE: f64 = 11.34;

/// Something that happened to a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Happening {
    pub(crate) kind: TrackEventKind,
    pub(crate) track: TrackId,
    pub(crate) other: Option<TrackId>,
}

impl Happening {
    fn new(kind: TrackEventKind, track: TrackId) -> Self {
        Self { kind, track, other: None }
    }
}

/// All tracks of the site.
#[derive(Debug)]
pub(crate) struct Tracker {
    config: Tracking,
    gate: Gate,
    tracks: BTreeMap<TrackId, Track>,
    next_id: u64,
}

impl Tracker {
    pub(crate) fn new(config: Tracking) -> Self {
        let gate = Gate::with_probability(config.gate_probability);
        Self { config, gate, tracks: BTreeMap::new(), next_id: 1 }
    }

    /// All tracks, ordered by id; those lost in this step are there once more, as lost.
    pub(crate) fn tracks(&self) -> impl Iterator<Item = &Track> {
        self.tracks.values()
    }

    /// Takes in one exposure: what of it belongs to tracks updates them. Returns the sightings
    /// that are nobody's, and what happened.
    pub(crate) fn step(&mut self, exposure: &Exposure, camera: &Camera) -> (Vec<Sighting>, Vec<Happening>) {
        self.tracks.retain(|_, track| track.status != TrackStatus::Lost);
        for track in self.tracks.values_mut() {
            track.time_update(exposure.time, &self.config);
        }
        let mut free: Vec<Option<&Sighting>> = exposure.sightings.iter().map(Some).collect();
        // A sure track chooses before an unsure one: a ghost must not take a target's bearings.
        for sure in [true, false] {
            self.associate(exposure, camera, &mut free, sure);
        }
        let mut happenings = self.review(exposure.time);
        happenings.extend(self.merge());
        (free.into_iter().flatten().cloned().collect(), happenings)
    }

    fn associate(
        &mut self,
        exposure: &Exposure,
        camera: &Camera,
        free: &mut [Option<&Sighting>],
        sure: bool,
    ) {
        let ids: Vec<TrackId> =
            self.tracks.values().filter(|t| t.is_confirmed() == sure).map(|t| t.id).collect();
        let innovations: Vec<Vec<Option<f64>>> = ids
            .iter()
            .map(|id| {
                let nis = |sighting: &Sighting| {
                    Some(self.tracks.get(id)?.innovation(&sighting.line, exposure.time_sd_s)?.nis)
                };
                free.iter().map(|sighting| sighting.and_then(nis)).collect()
            })
            .collect();
        let pairs = assign(ids.len(), free.len(), self.gate.threshold(), |row, column| {
            innovations[row][column].filter(|nis| self.gate.holds(*nis))
        });
        let partner: BTreeMap<usize, usize> = pairs.into_iter().collect();
        for (row, id) in ids.iter().enumerate() {
            let Some(track) = self.tracks.get_mut(id) else {
                continue;
            };
            let sighting = partner.get(&row).and_then(|&column| free[column].take());
            let update = sighting.and_then(|sighting| {
                track.measurement_update(&exposure.camera, &sighting.line, exposure.time_sd_s, &self.config)
            });
            match update {
                Some(innovation) => track.score += innovation.log_likelihood_ratio(&self.config),
                None if camera.sees(track.state.position()) => {
                    track.score += (1.0 - self.config.detection_probability).ln();
                }
                None => {}
            }
        }
    }

    /// Confirms, coasts and gives up.
    fn review(&mut self, now: Timestamp) -> Vec<Happening> {
        let mut happenings = Vec::new();
        for track in self.tracks.values_mut() {
            let silent_s = now.seconds_since(track.updated);
            let hopeless = silent_s > self.config.lost_after_s
                || track.state.worst_position_sd() > self.config.max_position_sd_m;
            match track.status {
                TrackStatus::Tentative if hopeless || track.score < DROP_SCORE => {
                    track.status = TrackStatus::Lost;
                    happenings.push(Happening::new(TrackEventKind::Lost, track.id));
                }
                TrackStatus::Tentative if track.score >= self.config.confirm_score => {
                    track.status = TrackStatus::Confirmed;
                    happenings.push(Happening::new(TrackEventKind::Confirmed, track.id));
                }
                TrackStatus::Confirmed | TrackStatus::Coasting if hopeless => {
                    track.status = TrackStatus::Lost;
                    happenings.push(Happening::new(TrackEventKind::Lost, track.id));
                }
                TrackStatus::Confirmed | TrackStatus::Coasting => {
                    track.status = if silent_s > self.config.coasting_after_s {
                        TrackStatus::Coasting
                    } else {
                        TrackStatus::Confirmed
                    };
                }
                TrackStatus::Tentative | TrackStatus::Lost => {}
            }
        }
        happenings
    }

    /// A coasting track beside a live one was the same target: the live one goes on.
    fn merge(&mut self) -> Vec<Happening> {
        let coasting = self.tracks.values().filter(|t| t.status == TrackStatus::Coasting);
        let merged: Vec<(TrackId, TrackId)> = coasting
            .filter_map(|old| {
                let live = self
                    .tracks
                    .values()
                    .find(|new| new.status == TrackStatus::Confirmed && same_target(old, new))?;
                Some((old.id, live.id))
            })
            .collect();
        merged
            .into_iter()
            .map(|(old, live)| {
                if let Some(track) = self.tracks.get_mut(&old) {
                    track.status = TrackStatus::Lost;
                }
                Happening { kind: TrackEventKind::Merged, track: old, other: Some(live) }
            })
            .collect()
    }

    /// Starts a tentative track from a group of fixes, at the time `now` of the newest exposure.
    pub(crate) fn start(&mut self, group: &Group, now: Timestamp) -> Option<Happening> {
        let (fix, later) = starting_point(group)?;
        let id = TrackId(self.next_id);
        let state = vague_velocity(fix);
        let mut track = Track::start(id, state, fix.time, fix.solver, fix.observability);
        for ((camera, ..), timed) in later {
            track.time_update(timed.time, &self.config);
            track.measurement_update(camera, &timed.line, 0.0, &self.config)?;
        }
        track.solver = fix.solver;
        track.time_update(now, &self.config);
        self.next_id += 1;
        self.tracks.insert(id, track);
        Some(Happening::new(TrackEventKind::Born, id))
    }
}

fn same_target(one: &Track, other: &Track) -> bool {
    let difference = one.state.position() - other.state.position();
    let spread = one.state.position_covariance() + other.state.position_covariance();
    spread.cholesky().is_some_and(|c| difference.dot(&c.solve(&difference)) < MERGE_GATE)
}
