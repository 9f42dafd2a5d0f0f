//! The life of tracks: association of an exposure's bearings, confirmation,
//! coasting, loss and merging.

use std::collections::BTreeMap;

use crossfix_filter::{Gate, KinematicState};
use crossfix_message::{CameraName, Timestamp, TrackEventKind, track_id};
use nalgebra::Point3;

use crate::assignment::{Candidate, assign};
use crate::ingress::KnownCamera;
use crate::initiation::Start;
use crate::motion::Motion;
use crate::pose_scale::Sample;
use crate::prediction::Fit;
use crate::reacquisition::{FOUND_AGAIN_MARGIN, Look, Reacquisition};
use crate::standing::{Fitting, Fittings};
use crate::track::{Track, TrackId, TrackStatus};
use crate::watch::Watch;
use crate::{Exposure, Sighting, Tracking};

/// A track whose score falls below this is dropped: a chance of 1 in 100 against clutter.
const DROP_SCORE: f64 = -4.6;
/// Two positions that differ by less than this (squared Mahalanobis, three degrees of freedom,
/// P = 0.99) are one target if one of the tracks is coasting.
const MERGE_GATE: f64 = 11.34;
/// A bearing is not compared with tracks beyond this many times the range of the cameras.
const REACH: f64 = 1.5;
/// Every track's state goes out at least this often, s.
const PUBLISHED_EVERY_S: f64 = 0.5;
/// A score beyond this counts no more: a track that has long been good can still be doubted.
const MAX_SCORE: f64 = 40.0;
/// A camera that is turned by no more than this shows a target beside where the others have it, rad.
const BESIDE_RAD: f64 = 0.1;
/// The smallest target that is found, px: what lies closer together for every camera is one. With half of it the two
/// ends of a target make two tracks, with twice as much targets in formation are one.
const SMALLEST_TARGET_PX: f64 = 7.0;

/// A new track is compared with the older ones this often, s, ...
const COMPARED_EVERY_S: f64 = 1.0;
/// ... and so many times: its place is well known by then, and two targets that fly side by side have been seen
/// apart.
const COMPARISONS: u32 = 5;
/// A track that one camera alone was following is found again within this distance (squared
/// Mahalanobis, P = 0.999 999).
const FOUND_AGAIN_GATE: f64 = 30.7;

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
    motion: Motion,
    gate: Gate,
    /// Beyond this range no camera is expected to see a target, m.
    max_range_m: f64,
    tracks: BTreeMap<TrackId, Track>,
    /// When the first exposure of the run was.
    began: Option<Timestamp>,
    /// Of the next track in this run.
    next_number: u64,
    watches: BTreeMap<CameraName, Watch>,
    reacquisition: Reacquisition,
    /// Where each camera stands, and how small a target it shows (rad).
    eyes: BTreeMap<CameraName, (Point3<f64>, f64)>,
}

/// What is noted while an exposure's bearings are given to the tracks.
#[derive(Debug, Default)]
struct Noted {
    happenings: Vec<Happening>,
    fittings: Fittings,
    third_differences: Vec<f64>,
}

/// What an exposure has done.
#[derive(Debug)]
pub(crate) struct Step {
    /// The sightings that belong to no track, or to one that cannot hold its place alone.
    pub(crate) free: Vec<Sighting>,
    /// Which of them (by index) such a track has used.
    pub(crate) claims: Vec<(usize, TrackId)>,
    /// Which sighting (by index) each track has taken in.
    pub(crate) used: Vec<(usize, TrackId)>,
    /// How the exposure fits the sure targets that other cameras see.
    pub(crate) fittings: Fittings,
    /// Squared third differences of the camera's bearings of tracks, by the noise that it reports.
    pub(crate) third_differences: Vec<f64>,
    pub(crate) happenings: Vec<Happening>,
}

impl Tracker {
    pub(crate) fn new(config: Tracking, max_range_m: f64, motion: Motion) -> Self {
        let gate = Gate::with_probability(config.gate_probability);
        Self {
            config,
            motion,
            gate,
            max_range_m,
            tracks: BTreeMap::new(),
            began: None,
            next_number: 1,
            watches: BTreeMap::new(),
            reacquisition: Reacquisition::default(),
            eyes: BTreeMap::new(),
        }
    }

    /// Says when the run begins: at the first exposure that it handles. The tracks' identities count from
    /// there.
    pub(crate) fn begin(&mut self, time: Timestamp) {
        self.began.get_or_insert(time);
    }

    /// All tracks, ordered by id; those lost in this step are there once more, as lost.
    pub(crate) fn tracks(&self) -> impl Iterator<Item = &Track> {
        self.tracks.values()
    }

    /// The tracks whose state should go out now, ordered by id: those just updated, those whose status
    /// has changed, and each at least every half second.
    pub(crate) fn due(&mut self, now: Timestamp) -> Vec<TrackId> {
        let mut due = Vec::new();
        for track in self.tracks.values_mut() {
            let silent = track.published.is_none_or(|(time, status)| {
                status != track.status || now.seconds_since(time) >= PUBLISHED_EVERY_S
            });
            if silent || track.updated == now {
                track.published = Some((now, track.status));
                track.observe_again();
                due.push(track.id);
            }
        }
        due
    }

    /// Whether any target is followed for sure.
    pub(crate) fn has_sure(&self) -> bool {
        self.tracks.values().any(Track::is_confirmed)
    }

    /// A track by its number.
    pub(crate) fn track(&self, id: TrackId) -> Option<&Track> {
        self.tracks.get(&id)
    }

    /// Compares an exposure of a camera that is left out with the sure tracks that others see, and
    /// updates none: what [`Step::fittings`] and [`Step::used`] would be.
    pub(crate) fn compare(
        &self,
        exposure: &Exposure,
        known: &KnownCamera,
    ) -> (Fittings, Vec<(usize, TrackId)>) {
        let seen = self.tracks.values().filter(|track| {
            track.is_confirmed()
                && track.others_than(&exposure.camera, &self.motion) >= 2
                && known.expects(track.position_at(exposure.time), self.max_range_m)
        });
        let origin = known.camera.pose().position();
        let nearest = |track: &Track| {
            let camera = (&exposure.camera, origin);
            let expected = track.expectation(exposure.time, camera, &exposure.uncertainty, &self.motion)?;
            let fits = exposure.sightings.iter().enumerate();
            let fits = fits.filter_map(|(i, s)| Some((expected.fit(&s.line, self.gate)?.gate_distance, i)));
            fits.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, nearest)| nearest)
        };
        let (mut fittings, mut used) = (Fittings::default(), Vec::new());
        for track in seen {
            let nearest = nearest(track);
            let others = track.others_than(&exposure.camera, &self.motion);
            fittings.add(others, fitting(track, exposure, known, nearest.is_some()));
            used.extend(nearest.map(|nearest| (nearest, track.id)));
        }
        (fittings, used)
    }

    /// How targets move.
    pub(crate) fn motion(&self) -> &Motion {
        &self.motion
    }

    /// Goes back to a time: gives up the tracks that bearings of later times have updated, and forgets
    /// what the cameras reported beside them.
    pub(crate) fn restart(&mut self, time: Timestamp) -> Vec<Happening> {
        self.watches.clear();
        let mut happenings = Vec::new();
        for track in self.tracks.values_mut() {
            track.published = None;
            if track.updated > time && track.status != TrackStatus::Lost {
                track.status = TrackStatus::Lost;
                happenings.push(Happening::new(TrackEventKind::Lost, track.id));
            }
        }
        happenings
    }

    /// Takes in one exposure: what of it belongs to tracks updates them.
    pub(crate) fn step(&mut self, exposure: &Exposure, known: &KnownCamera) -> Step {
        self.tracks.retain(|_, track| track.status != TrackStatus::Lost);
        let smallest = SMALLEST_TARGET_PX / known.camera.model().intrinsics().fx;
        self.eyes.insert(exposure.camera.clone(), (known.camera.pose().position(), smallest));
        let mut owners: Vec<Option<TrackId>> = vec![None; exposure.sightings.len()];
        // Where all cameras were silent for long, nothing has told the tracks yet that they are lost.
        let mut noted = Noted { happenings: self.review(exposure.time), ..Noted::default() };
        for ids in self.in_order_of_choice() {
            self.associate(exposure, known, &ids, &mut owners, &mut noted);
        }
        let Noted { mut happenings, fittings, third_differences } = noted;
        self.reacquire(exposure, known, &mut owners);
        let used = owners.iter().enumerate().filter_map(|(i, owner)| Some((i, (*owner)?))).collect();
        let strangers = owners.iter().filter(|owner| owner.is_none()).count();
        let (mut free, mut claims) = (Vec::new(), Vec::new());
        for (sighting, owner) in exposure.sightings.iter().zip(owners) {
            // What one camera alone follows is offered as if it were nobody's: if the others see the
            // target elsewhere, it must be found again.
            let weak = owner.filter(|id| self.tracks.get(id).is_some_and(|track| !track.is_held()));
            if owner.is_none() || weak.is_some() {
                claims.extend(weak.map(|id| (free.len(), id)));
                free.push(sighting.clone());
            }
        }
        let time = exposure.time;
        let watch = self.watches.get_mut(&exposure.camera);
        if let Some(watch) = watch {
            watch.see(time, strangers, self.motion.holding_s);
        } else {
            self.watches.insert(exposure.camera.clone(), Watch::first(time, strangers));
        }
        happenings.extend(self.review(exposure.time));
        happenings.extend(self.merge(exposure.time));
        happenings.extend(self.prove(exposure.time));
        Step { free, claims, used, fittings, third_differences, happenings }
    }

    /// What the cameras have seen of sure targets, by target, where it is time to compare them.
    pub(crate) fn draws(&mut self) -> Vec<Vec<Sample>> {
        let sure = self.tracks.values_mut().filter(|track| track.is_confirmed() && track.is_held());
        sure.map(Track::draw).filter(|samples| samples.len() >= 2).collect()
    }

    /// A camera's pose errors have been found to be larger or smaller (ratio of the variances).
    pub(crate) fn rescale_pose(&mut self, camera: &CameraName, ratio: f64) {
        self.tracks.values_mut().for_each(|track| track.rescale_pose(camera, ratio));
    }

    /// A camera's clock is known otherwise: see [`Track::set_clock`].
    pub(crate) fn set_clock(&mut self, camera: &CameraName, ahead: f64, ratio: f64) {
        self.tracks.values_mut().for_each(|track| track.set_clock(camera, ahead, ratio));
    }

    /// Takes up what a second camera sees of the tracks that one alone follows.
    fn reacquire(&mut self, exposure: &Exposure, known: &KnownCamera, owners: &mut [Option<TrackId>]) {
        let look = Look {
            exposure,
            known,
            motion: &self.motion,
            config: &self.config,
            gate: self.gate,
            max_range_m: self.max_range_m,
            owners,
        };
        for (track, sighting) in self.reacquisition.advance(&self.tracks, &look) {
            if let Some(owner) = sighting.and_then(|index| owners.get_mut(index)) {
                *owner = Some(track.id);
            }
            self.tracks.insert(track.id, track);
        }
    }

    /// Which tracks choose first: those that several cameras hold in their place, then those that one alone
    /// follows, then those that are not sure. A ghost must not take a target's bearings.
    fn in_order_of_choice(&self) -> [Vec<TrackId>; 3] {
        let mut order = [const { Vec::new() }; 3];
        for track in self.tracks.values().filter(|track| track.status != TrackStatus::Lost) {
            let place = if !track.is_confirmed() { 2 } else { usize::from(!track.is_held()) };
            order[place].push(track.id);
        }
        order
    }

    /// Gives bearings that are still open to some tracks, and judges these by it.
    fn associate(
        &mut self,
        exposure: &Exposure,
        known: &KnownCamera,
        ids: &[TrackId],
        owners: &mut [Option<TrackId>],
        noted: &mut Noted,
    ) {
        let candidates = self.candidates(exposure, known, owners, ids);
        let gains: BTreeMap<(usize, usize), f64> =
            candidates.iter().map(|c| ((c.row, c.column), c.gain)).collect();
        let partner: BTreeMap<usize, usize> = assign(&candidates).into_iter().collect();
        for (row, id) in ids.iter().enumerate() {
            let Some(track) = self.tracks.get_mut(id) else {
                continue;
            };
            let sure = track.is_confirmed();
            let column = partner.get(&row).copied();
            let taken = column.and_then(|column| {
                let sighting = &exposure.sightings[column];
                let time = (exposure.time, &exposure.uncertainty);
                let taken = track.measurement_update(&exposure.camera, &sighting.line, time, &self.motion)?;
                owners[column] = Some(*id);
                Some(taken)
            });
            let gain = taken.and(column).and_then(|column| gains.get(&(row, column))).copied();
            let sees = known.expects(track.position_at(exposure.time), self.max_range_m);
            if sure && (taken.is_some() || sees) {
                let others = track.others_than(&exposure.camera, &self.motion);
                noted.fittings.add(others, fitting(track, exposure, known, taken.is_some()));
            }
            noted.third_differences.extend(taken.filter(|_| sure).and_then(|taken| taken.third_difference));
            let silent = exposure.time.seconds_since(track.updated) > self.config.coasting_after_s;
            let detection = self.config.detection_probability;
            let missed = missed(track.visible_to(&exposure.camera, exposure.time, &self.motion), detection);
            let seen_since = !sure || track.is_seen_since_look_of(&exposure.camera);
            let silent = sure && silent;
            let change = match gain {
                // What one camera alone follows may be anything along its sight line.
                Some(_) if sure && !track.is_held() => 0.0,
                Some(gain) => gain + missed,
                // What hides the target from all is no evidence against it: of what nobody sees time decides.
                None if sees && !silent && seen_since => missed,
                None => 0.0,
            };
            track.judge(change, MAX_SCORE);
            // Outside its field of view a camera has missed nothing.
            if gain.is_some() || sees {
                track.look(&exposure.camera, exposure.time, gain.is_some(), detection, &self.motion);
            }
            if taken.is_some_and(|taken| taken.manoeuvre) {
                noted.happenings.push(Happening::new(TrackEventKind::Manoeuvre, *id));
            }
        }
    }

    /// Density of a camera's false bearings, 1/sr: as many as it reports beside the targets.
    pub(crate) fn clutter_per_sr(&self, camera: &CameraName, known: &KnownCamera) -> f64 {
        self.watches.get(camera).map_or(self.config.clutter_per_sr, |watch| watch.strangers_per_sr(known))
    }

    /// What the open bearings in the gates of these tracks are worth to them.
    fn candidates(
        &self,
        exposure: &Exposure,
        known: &KnownCamera,
        owners: &[Option<TrackId>],
        ids: &[TrackId],
    ) -> Vec<Candidate> {
        // What a line must be worth to bring a track back that the camera has lost sight of.
        let stranger = exposure.clutter_per_sr.ln() + FOUND_AGAIN_MARGIN;
        let origin = known.camera.pose().position();
        let mut candidates = Vec::new();
        for (row, track) in ids.iter().enumerate().filter_map(|(row, id)| Some((row, self.tracks.get(id)?))) {
            if (track.position_at(exposure.time) - origin).norm() > REACH * self.max_range_m {
                continue;
            }
            let prediction = track.expectation(
                exposure.time,
                (&exposure.camera, origin),
                &exposure.uncertainty,
                &self.motion,
            );
            let Some(prediction) = prediction else {
                continue;
            };
            let detection = self.config.detection_probability;
            let visible = track.visible_to(&exposure.camera, exposure.time, &self.motion);
            let lost_sight = track.is_lost_sight_of_by(&exposure.camera, &self.motion);
            let open = exposure.sightings.iter().enumerate().filter(|(i, _)| owners[*i].is_none());
            for (column, sighting) in open {
                let fit = prediction.fit(&sighting.line, self.gate);
                if let Some(fit) = fit.filter(|fit| !lost_sight || fit.log_density > stranger) {
                    let gain = log_likelihood_ratio(&fit, visible * detection, exposure.clutter_per_sr)
                        - missed(visible, detection);
                    candidates.push(Candidate { row, column, gain });
                }
            }
        }
        candidates
    }

    /// Confirms, coasts and gives up.
    fn review(&mut self, now: Timestamp) -> Vec<Happening> {
        let mut happenings = Vec::new();
        for track in self.tracks.values_mut() {
            let silent_s = now.seconds_since(track.updated);
            let unseen = silent_s > self.config.coasting_after_s;
            let hopeless = silent_s > self.config.lost_after_s
                || (unseen && position_sd(track, now, &self.motion) > self.config.max_position_sd_m);
            match track.status {
                TrackStatus::Lost => {}
                _ if hopeless || track.score < DROP_SCORE => {
                    track.status = TrackStatus::Lost;
                    happenings.push(Happening::new(TrackEventKind::Lost, track.id));
                }
                TrackStatus::Tentative if track.score >= self.config.confirm_score => {
                    track.status = TrackStatus::Confirmed;
                    happenings.push(Happening::new(TrackEventKind::Confirmed, track.id));
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
        happenings
    }

    /// A coasting track beside a live one was the same target: the live one goes on.
    fn merge(&mut self, now: Timestamp) -> Vec<Happening> {
        let coasting = self.tracks.values().filter(|t| t.status == TrackStatus::Coasting);
        let live: Vec<&Track> = self.tracks.values().filter(|t| t.status == TrackStatus::Confirmed).collect();
        let merged: Vec<(TrackId, TrackId)> = coasting
            .filter_map(|old| {
                let old_state = old.predicted(now, &self.motion);
                let same =
                    live.iter().find(|new| same_target(&old_state, &new.predicted(now, &self.motion)))?;
                Some((old.id, same.id))
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

    /// Compares each track a few times while it is young with those that were there before it: a detector that
    /// reports the two ends of a target makes two tracks.
    fn prove(&mut self, now: Timestamp) -> Vec<Happening> {
        let is_due = |track: &&Track| {
            let next_s = f64::from(track.comparisons + 1) * COMPARED_EVERY_S;
            track.status == TrackStatus::Confirmed
                && track.comparisons < COMPARISONS
                && now.seconds_since(track.born) >= next_s
        };
        let due: Vec<TrackId> = self.tracks.values().filter(is_due).map(|track| track.id).collect();
        let mut happenings = Vec::new();
        for id in due {
            let older = self.tracks.range(..id).map(|(_, old)| old);
            let mut older = older.filter(|old| old.status == TrackStatus::Confirmed);
            let same = self.tracks.get(&id).and_then(|new| older.find(|old| self.is_one_image(old, new)));
            let same = same.map(|old| old.id);
            if let Some(track) = self.tracks.get_mut(&id) {
                track.comparisons += 1;
                if let Some(old) = same {
                    track.status = TrackStatus::Lost;
                    happenings.push(Happening { kind: TrackEventKind::Merged, track: id, other: Some(old) });
                }
            }
            if let Some(old) = same.and_then(|old| self.tracks.get_mut(&old)) {
                old.has_ends = true;
            }
        }
        happenings
    }

    /// Takes a track over that the initiation has found, and numbers it. Where it has used the
    /// bearings of a track that one camera alone was following and lies where that may have gone, it
    /// is the same target found again: it goes on under the old number. Where it lies elsewhere, the
    /// old one was wrong and is given up; but two cameras are not enough to say so, as their lines
    /// cross anywhere.
    pub(crate) fn adopt(&mut self, Start { mut track, cameras, claimed_by }: Start) -> Vec<Happening> {
        let owners = claimed_by.iter().filter_map(|id| self.tracks.get(id));
        let unheld: Vec<&Track> = owners.filter(|old| old.is_confirmed() && !old.is_held()).collect();
        let same = unheld.iter().find(|old| {
            let expected = old.predicted(track.updated, &self.motion);
            mahalanobis_squared(&expected, track.state()).is_some_and(|distance| distance < FOUND_AGAIN_GATE)
        });
        if let Some(old) = same {
            track.id = old.id;
            track.score = track.score.max(old.score);
            self.tracks.insert(track.id, track);
            return Vec::new();
        }
        if self.tracks.values().any(|old| old.is_confirmed() && self.is_one_image(old, &track)) {
            return Vec::new();
        }
        let wrong: Vec<TrackId> = unheld.iter().map(|old| old.id).collect();
        if !wrong.is_empty() && cameras < 3 {
            return Vec::new();
        }
        let id = TrackId(track_id(self.began.unwrap_or(track.updated), self.next_number));
        self.next_number += 1;
        track.id = id;
        let mut happenings = vec![Happening::new(TrackEventKind::Born, id)];
        for old in wrong {
            if let Some(track) = self.tracks.get_mut(&old) {
                track.status = TrackStatus::Lost;
            }
            happenings.push(Happening::new(TrackEventKind::Lost, old));
        }
        if track.is_confirmed() {
            happenings.push(Happening::new(TrackEventKind::Confirmed, id));
        }
        self.tracks.insert(id, track);
        happenings
    }
}

/// How an exposure fits a track that other cameras see; `None` if it says nothing.
fn fitting(track: &Track, exposure: &Exposure, known: &KnownCamera, seen: bool) -> Option<Fitting> {
    let expected = track.position_at(exposure.time) - known.camera.pose().position();
    let is_beside = |sighting: &Sighting| sighting.line.direction.angle(&expected) < BESIDE_RAD;
    if seen {
        Some(Fitting::Fits)
    } else {
        exposure.sightings.iter().any(is_beside).then_some(Fitting::Beside)
    }
}

impl Tracker {
    /// Whether two tracks lie so close together for every camera that sees the new one that they are parts of
    /// one target: a detector may report its two ends.
    fn is_one_image(&self, old: &Track, new: &Track) -> bool {
        let [there, here] = [old.position_at(new.updated), new.position_at(new.updated)];
        // What was split once is split again, and where a track begins it is less sure where.
        let times = if old.has_ends { 2.0 } else { 1.0 };
        let mut eyes = new.residuals.keys().map(|camera| self.eyes.get(camera));
        eyes.all(|eye| {
            eye.is_some_and(|(origin, smallest)| (there - origin).angle(&(here - origin)) < times * smallest)
        })
    }
}

/// Log-likelihood ratio of a bearing being a target's that is seen with a probability against being one of
/// so many false ones, 1/sr.
pub(crate) fn log_likelihood_ratio(fit: &Fit, detection: f64, clutter_per_sr: f64) -> f64 {
    detection.ln() + fit.log_density - clutter_per_sr.ln()
}

/// Log-likelihood ratio of a camera's not reporting a target that is visible to it with a probability.
pub(crate) fn missed(visible: f64, detection: f64) -> f64 {
    (1.0 - visible * detection).ln()
}

/// Root of the sum of the position's variances, m: not less than the standard deviation along any axis.
fn position_sd(track: &Track, now: Timestamp, motion: &Motion) -> f64 {
    let state = track.predicted(now, motion);
    state.covariance.diagonal().fixed_rows::<3>(0).sum().sqrt()
}

/// Squared Mahalanobis distance of two states' positions, three degrees of freedom.
fn mahalanobis_squared(one: &KinematicState, other: &KinematicState) -> Option<f64> {
    let difference = one.position() - other.position();
    let spread = one.position_covariance() + other.position_covariance();
    spread.cholesky().map(|c| difference.dot(&c.solve(&difference)))
}

/// Whether two states of one time may be one target's.
pub(crate) fn same_target(one: &KinematicState, other: &KinematicState) -> bool {
    mahalanobis_squared(one, other).is_some_and(|distance| distance < MERGE_GATE)
}
