//! The tracks of the site: association of an exposure's bearings, confirmation, coasting, loss and
//! merging.

pub(crate) mod association;
mod life;

use std::collections::BTreeMap;

use crossfix_filter::KinematicState;
use crossfix_message::{CameraName, Timestamp, TrackEventKind};

use crate::cameras::{
    Cameras, ClockChange, Fitting, Fittings, KnownCamera, Rooted, ThirdDifferences,
};
use crate::comparison::{Candidate, Comparison, ComparisonRules};
use crate::cueing::CueTarget;
use crate::motion::MotionSetup;
use crate::reacquisition::{OwnedExposure, Reacquisition};
use crate::track::{Draw, FusedTrack, TrackId, TrackStatus};

use association::fitting;

use crate::{Exposure, FusionConfig, Sighting, Tracking};

/// Gate for merging: two positions closer than this (squared Mahalanobis distance, three degrees of
/// freedom, P = 0.99) are one target if one of the tracks is coasting. With half of it one such
/// track in eight goes on beside the live one until it is lost.
const MERGE_GATE: f64 = 11.34;
/// Every track's state is published at least this often, s. With half of it a track that coasts
/// makes twice as many messages; with twice as much, neighbouring centres take it for ended.
const PUBLISHED_EVERY_S: f64 = 0.5;

/// Something that happened to a track.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TrackChange {
    pub(crate) kind: TrackEventKind,
    pub(crate) track: TrackId,
    pub(crate) other: Option<TrackId>,
}

impl TrackChange {
    fn new(kind: TrackEventKind, track: TrackId) -> Self {
        Self { kind, track, other: None }
    }
}

/// All tracks of the site.
#[derive(Debug)]
pub(crate) struct Tracker {
    config: Tracking,
    motion: MotionSetup,
    rules: ComparisonRules,
    tracks: BTreeMap<TrackId, FusedTrack>,
    /// Time of the first exposure of the run.
    began: Option<Timestamp>,
    /// Number of the next track in this run.
    next_number: u64,
    reacquisition: Reacquisition,
}

/// What is gathered while an exposure's bearings are assigned to the tracks.
#[derive(Debug, Default)]
struct Noted {
    changes: Vec<TrackChange>,
    fittings: Fittings,
    third_differences: Vec<ThirdDifferences>,
    /// Tracks that none of its bearings was assigned to.
    unseen: Vec<TrackId>,
}

/// A sighting that a track has used.
#[derive(Clone, Copy, Debug)]
pub(crate) struct UsedSighting {
    /// Its index: among the exposure's sightings where tracks have used it, among the free ones
    /// where weakly supported ones have used it.
    pub(crate) index: usize,
    pub(crate) track: TrackId,
}

/// Result of an exposure.
#[derive(Debug)]
pub(crate) struct TrackerStep {
    /// The sightings that belong to no track, or to a track that only one camera supports.
    pub(crate) free: Vec<Sighting>,
    /// Those of them that such a weakly supported track has used, by their indices among the free.
    pub(crate) provisional: Vec<UsedSighting>,
    /// Which sighting updated which track.
    pub(crate) used: Vec<UsedSighting>,
    /// How the exposure fits the confirmed targets that other cameras see.
    pub(crate) fittings: Fittings,
    /// What the camera's bearings of tracks show of their noise.
    pub(crate) third_differences: Vec<ThirdDifferences>,
    /// Number of its sightings that no track has taken.
    pub(crate) unassigned: usize,
    /// Whether the exposure shows any of the targets that two other cameras see in this one's view;
    /// `None` if there are none.
    pub(crate) company: Option<Fitting>,
    pub(crate) changes: Vec<TrackChange>,
}

impl Tracker {
    pub(crate) fn new(config: &FusionConfig, motion: MotionSetup) -> Self {
        Self {
            config: config.tracking.clone(),
            motion,
            rules: ComparisonRules::new(config),
            tracks: BTreeMap::new(),
            began: None,
            next_number: 1,
            reacquisition: Reacquisition::default(),
        }
    }

    /// Sets the start of the run: the time of the first exposure handled, from which the tracks'
    /// identities count.
    pub(crate) fn begin(&mut self, time: Timestamp) {
        self.began.get_or_insert(time);
    }

    /// All tracks, ordered by id; those lost in this step are included one last time, as lost.
    pub(crate) fn tracks(&self) -> impl Iterator<Item = &FusedTrack> {
        self.tracks.values()
    }

    /// The tracks whose state should be published now, ordered by id: those just updated, those
    /// whose status has changed, and every track at least each half second.
    pub(crate) fn due(&mut self, now: Timestamp) -> Vec<TrackId> {
        let mut due = Vec::new();
        for track in self.tracks.values_mut() {
            let silent = track.published.is_none_or(|(time, status)| {
                status != track.status || now.seconds_since(time) >= PUBLISHED_EVERY_S
            });
            if silent || track.updated_at == now {
                track.published = Some((now, track.status));
                track.observe_again();
                due.push(track.id);
            }
        }
        due
    }

    /// Stores the present state of these tracks, so that later bearings can smooth it.
    pub(crate) fn remember(&mut self, tracks: &[TrackId], now: Timestamp) {
        for id in tracks {
            if let Some(track) = self.tracks.get_mut(id) {
                track.remember(now, &self.motion);
            }
        }
    }

    /// Drops the stored states up to a time.
    pub(crate) fn forget_until(&mut self, time: Timestamp) {
        self.tracks.values_mut().for_each(|track| track.forget_until(time));
    }

    /// All confirmed targets with their predicted states, for cueing.
    pub(crate) fn known(&self, now: Timestamp) -> Vec<CueTarget> {
        let sure = self.tracks.values().filter(|track| track.is_confirmed());
        sure.map(|track| track.known(now, &self.motion)).collect()
    }

    /// Whether any track is confirmed.
    pub(crate) fn has_sure(&self) -> bool {
        self.tracks.values().any(FusedTrack::is_confirmed)
    }

    /// A track by its number.
    pub(crate) fn track(&self, id: TrackId) -> Option<&FusedTrack> {
        self.tracks.get(&id)
    }

    /// Compares an exposure of an excluded camera with the confirmed tracks that others see,
    /// without updating any: returns what [`TrackerStep::fittings`] and [`TrackerStep::used`] would
    /// be.
    pub(crate) fn compare(
        &self,
        exposure: &Exposure,
        known: &KnownCamera,
    ) -> (Fittings, Vec<UsedSighting>) {
        let comparison = self.comparison(exposure, known);
        let (mut fittings, mut used) = (Fittings::default(), Vec::new());
        for track in self.expected_by_others(comparison) {
            let nearest = comparison.expectation(track).and_then(|expected| {
                let near = comparison.candidates(track, &expected, |_| true);
                let distance = |candidate: &Candidate| candidate.fit.gate_distance;
                near.min_by(|a, b| distance(a).total_cmp(&distance(b)))
            });
            let others = track.others_than(&exposure.camera);
            fittings.add(others, fitting(track, exposure, known, nearest.is_some()));
            let id = track.id;
            used.extend(nearest.map(|nearest| UsedSighting { index: nearest.index, track: id }));
        }
        (fittings, used)
    }

    /// An exposure with what its bearings are compared by.
    fn comparison<'a>(&'a self, exposure: &'a Exposure, known: &'a KnownCamera) -> Comparison<'a> {
        Comparison { exposure, known, motion: &self.motion, rules: self.rules }
    }

    /// The confirmed tracks that an exposure's camera should see, and two others see.
    fn expected_by_others<'a>(
        &'a self,
        comparison: Comparison<'a>,
    ) -> impl Iterator<Item = &'a FusedTrack> {
        self.tracks.values().filter(move |track| {
            track.is_confirmed()
                && track.others_than(&comparison.exposure.camera) >= 2
                && comparison.expects(track)
        })
    }

    /// How targets move.
    pub(crate) fn motion(&self) -> &MotionSetup {
        &self.motion
    }

    /// Goes back to a time: ends the tracks that bearings of later times have updated.
    pub(crate) fn rewind(&mut self, time: Timestamp) -> Vec<TrackChange> {
        let mut changes = Vec::new();
        for track in self.tracks.values_mut() {
            track.published = None;
            if track.updated_at > time && track.status != TrackStatus::Lost {
                track.status = TrackStatus::Lost;
                changes.push(TrackChange::new(TrackEventKind::Lost, track.id));
            }
        }
        changes
    }

    /// Moves all tracks' times: all clocks have stepped by `step_s` seconds.
    pub(crate) fn step_time(&mut self, step_s: f64) {
        self.reacquisition = Reacquisition::default();
        self.tracks.values_mut().for_each(|track| track.step_time(step_s));
    }

    /// How well an exposure fits the confirmed tracks: the sum over the tracks of the best
    /// log-likelihood ratio, of a bearing being this track's against being clutter.
    pub(crate) fn fit(&self, exposure: &Exposure, known: &KnownCamera) -> f64 {
        let comparison = self.comparison(exposure, known);
        let confirmed = self.tracks.values().filter(|track| track.is_confirmed());
        let best = confirmed.filter_map(|track| {
            let expected = comparison.expectation(track)?;
            let near = comparison.candidates(track, &expected, |_| true);
            // ln(N / clutter), P_D left out: it is the same for both times that are compared.
            near.map(|one| one.fit.log_ratio(1.0, self.config.clutter_per_sr))
                .max_by(f64::total_cmp)
        });
        best.sum()
    }

    /// Handles one exposure: bearings that belong to tracks update them.
    pub(crate) fn step(
        &mut self,
        exposure: &Exposure,
        known: &KnownCamera,
        cameras: &Cameras,
    ) -> TrackerStep {
        self.tracks.retain(|_, track| track.status != TrackStatus::Lost);
        let mut owners: Vec<Option<TrackId>> = vec![None; exposure.sightings.len()];
        // If all cameras were silent for long, the tracks are overdue for a review and may be lost
        // already.
        let mut noted = Noted { changes: self.review(exposure.time), ..Noted::default() };
        for ids in self.in_order_of_choice() {
            self.associate(exposure, known, &ids, &mut owners, &mut noted);
        }
        self.note_beside(exposure, known, &owners);
        let Noted { mut changes, fittings, third_differences, unseen } = noted;
        self.reacquire(exposure, known, &mut owners);
        self.note_unseen(exposure, known, &owners, &unseen);
        let used = owners
            .iter()
            .enumerate()
            .filter_map(|(index, owner)| Some(UsedSighting { index, track: (*owner)? }))
            .collect();
        let unassigned = owners.iter().filter(|owner| owner.is_none()).count();
        let company = self.company(exposure, known, &owners);
        let (mut free, mut provisional) = (Vec::new(), Vec::new());
        for (sighting, owner) in exposure.sightings.iter().zip(owners) {
            // Bearings of tracks that one camera alone follows are offered to the initiation as
            // free: if the other cameras see the target elsewhere, it must be found again.
            let weak = owner
                .filter(|id| self.tracks.get(id).is_some_and(|track| !track.is_triangulated()));
            if owner.is_none() || weak.is_some() {
                provisional.extend(weak.map(|track| UsedSighting { index: free.len(), track }));
                free.push(sighting.clone());
            }
        }
        changes.extend(self.review(exposure.time));
        changes.extend(self.merge(exposure.time));
        changes.extend(self.prove(exposure.time, cameras));
        TrackerStep {
            free,
            provisional,
            used,
            fittings,
            third_differences,
            unassigned,
            company,
            changes,
        }
    }

    /// Whether an exposure, whose bearings have these owners, shows any of the targets that two
    /// other cameras see in this one's view, or something that moves and is none of them. Where it
    /// shows nothing that moves, something may hide them.
    fn company(
        &self,
        exposure: &Exposure,
        known: &KnownCamera,
        owners: &[Option<TrackId>],
    ) -> Option<Fitting> {
        self.expected_by_others(self.comparison(exposure, known)).next()?;
        // What was there when the camera began to look, or since its mount turned, may stand there.
        let mut others = exposure.sightings.iter().filter(|seen| seen.rooted == Rooted::No);
        let is_alone = owners.iter().all(Option::is_none) && others.next().is_some();
        Some(if is_alone { Fitting::Beside } else { Fitting::Fits })
    }

    /// What the cameras see of confirmed targets and beside them, by target, for those whose
    /// comparison is due.
    pub(crate) fn draws(&mut self) -> Vec<Draw> {
        let sure = self
            .tracks
            .values_mut()
            .filter(|track| track.is_confirmed() && track.is_triangulated());
        sure.map(FusedTrack::draw).filter(|draw| draw.samples.len() >= 2).collect()
    }

    /// Passes on that a camera's pose error variance was found to be `ratio` times what was
    /// assumed.
    pub(crate) fn rescale_pose(&mut self, camera: &CameraName, ratio: f64) {
        self.tracks.values_mut().for_each(|track| track.rescale_pose(camera, ratio));
    }

    /// Passes on that a camera has been calibrated anew: see [`FusedTrack::forget_pose`].
    pub(crate) fn forget_pose(&mut self, camera: &CameraName) {
        self.tracks.values_mut().for_each(|track| track.forget_pose(camera));
    }

    /// Passes on that a camera's mount has turned it: see [`FusedTrack::turn_camera`].
    pub(crate) fn turn_camera(&mut self, camera: &CameraName) {
        self.tracks.values_mut().for_each(|track| track.turn_camera(camera));
    }

    /// Passes on what has been learnt of a camera's clock: see [`FusedTrack::set_clock`].
    pub(crate) fn set_clock(&mut self, camera: &CameraName, change: ClockChange) {
        self.tracks.values_mut().for_each(|track| track.set_clock(camera, change));
    }

    /// Looks for a second camera's bearings of the tracks that one camera alone follows.
    fn reacquire(
        &mut self,
        exposure: &Exposure,
        known: &KnownCamera,
        owners: &mut [Option<TrackId>],
    ) {
        let comparison = Comparison { exposure, known, motion: &self.motion, rules: self.rules };
        let owned = OwnedExposure { comparison, owners };
        for (track, bearing) in self.reacquisition.advance(&self.tracks, &owned) {
            if let Some(owner) = bearing.and_then(|index| owners.get_mut(index)) {
                *owner = Some(track.id);
            }
            let mut track = track;
            if let Some(old) = self.tracks.get_mut(&track.id) {
                track.inherit(old);
            }
            self.tracks.insert(track.id, track);
        }
    }
}

/// Squared Mahalanobis distance between two states' positions, three degrees of freedom.
fn mahalanobis_squared(one: &KinematicState, other: &KinematicState) -> Option<f64> {
    let difference = one.position() - other.position();
    let spread = one.position_covariance() + other.position_covariance();
    spread.cholesky().map(|c| difference.dot(&c.solve(&difference)))
}

/// Whether two states of the same time may belong to one target.
pub(crate) fn same_target(one: &KinematicState, other: &KinematicState) -> bool {
    mahalanobis_squared(one, other).is_some_and(|distance| distance < MERGE_GATE)
}
