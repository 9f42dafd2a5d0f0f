//! Handover: targets that cameras see one after another, and never two at a time.
//!
//! What one camera alone follows is a direction that turns. When the camera loses sight of the
//! target, another may have begun to see it: the new camera's line crosses the direction that the
//! old camera would see by now at one position, and position and turning rate give a velocity
//! across the old line. How the new line turns, and where the next camera sees the target, tells
//! whether it is the same one. Each such explanation is a "reading".
//!
//! "Strangers" are other targets that a camera may see.

mod reading;
mod seen;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use crossfix_filter::KinematicState;
use crossfix_message::{CameraName, Timestamp};

use self::reading::{Reading, ReadingContext, Rules, TOGETHER_S};
use self::seen::{SeenDirection, pose_variance};
use super::{NewTrack, lines_with_pose};
use crate::cameras::{KnownCamera, Rooted};
use crate::comparison::Comparison;
use crate::cueing::CueTarget;
use crate::evidence::BEYOND_DOUBT;
use crate::motion::MotionSetup;
use crate::spatial::{LineId, TimedLine};
use crate::track::{FusedTrack, TrackStatus};
use crate::tracker::{UsedSighting, same_target};
use crate::{Exposure, FusionConfig};

/// A reading with a smaller log-likelihood ratio than this is given up. With half of it more true
/// readings end with their first line, and none is tried again.
const GIVEN_UP: f64 = -5.0;
/// A target that one camera alone sees is hardly nearer than this, m: the geometric mean with the
/// largest range is taken for its range. With half of it that range is 0.7 times as long, which is
/// little beside its uncertainty.
const NEAREST_M: f64 = 30.0;
/// Bounds on time.
struct HandoverBounds {
    /// Directions that are followed in one camera. With half of it a target goes unfollowed where
    /// its camera sees ten other targets at a time.
    seen: usize,
    /// Lost directions that are tried in one exposure. With half of it, where more are lost at a
    /// time, the earlier ones are tried an exposure later.
    lost: usize,
    /// Readings of one direction at a time. With half of it the true one is not begun where two
    /// other objects have come before it.
    readings: usize,
    /// Lines of other cameras that are tried with one direction. With half of it a direction that
    /// was lost among many objects is not tried with those that come last.
    tried: usize,
}

/// The numbers in use; what half of each does is said at its field.
const BOUNDS: HandoverBounds = HandoverBounds { seen: 20, lost: 20, readings: 4, tried: 50 };

/// The directions that each camera follows alone, and their readings.
#[derive(Debug)]
pub(super) struct Handover {
    rules: Rules,
    seen: BTreeMap<CameraName, Vec<SeenDirection>>,
    /// Number of directions followed so far.
    count: u64,
}

/// A line (by its index) that continues a direction which the camera follows, with that direction's
/// number and the time of its first line.
#[derive(Clone, Copy, Debug)]
struct ContinuedLine {
    index: usize,
    number: u64,
    first: Timestamp,
}

impl Handover {
    pub(super) fn new(config: &FusionConfig) -> Self {
        Self { rules: Rules::new(config), seen: BTreeMap::new(), count: 0 }
    }

    /// Forgets what a camera has followed.
    pub(super) fn forget_camera(&mut self, camera: &CameraName) {
        self.seen.remove(camera);
    }

    /// The sure targets that one camera alone sees, with predictions for cueing: their range is
    /// unknown.
    pub(super) fn known(&self, now: Timestamp) -> Vec<CueTarget> {
        // Geometric mean: the middle of ln r.
        let range = (NEAREST_M * self.rules.comparison.max_range_m).sqrt();
        let Rules { tracking, speed, .. } = &self.rules;
        let all =
            self.seen.iter().flat_map(|(camera, seen)| seen.iter().map(move |one| (camera, one)));
        let sure = all.filter(|(_, one)| one.is_sure(tracking) && !one.is_lost(now, tracking));
        sure.filter_map(|(camera, one)| one.cue_target(camera, now, range, *speed)).collect()
    }

    /// Handles an exposure, given which of its lines (by index) belong to tracks; returns the
    /// tracks that are confirmed by it.
    pub(super) fn see(
        &mut self,
        exposure: &Exposure,
        used: &[UsedSighting],
        known: &KnownCamera,
        motion: &MotionSetup,
    ) -> Vec<NewTrack> {
        let mut is_owned = vec![false; exposure.sightings.len()];
        used.iter().for_each(|used| is_owned[used.index] = true);
        let comparison = Comparison { exposure, known, motion, rules: self.rules.comparison };
        let context = ReadingContext { comparison, is_owned: &is_owned };
        self.forget(exposure.time);
        let begun = self.follow(&context);
        self.advance(&context);
        self.cross(&context, &begun);
        self.settle(&context)
    }

    /// Forgets directions that have been silent for as long as a track would be kept, and at once
    /// those that were lost before they were sure.
    fn forget(&mut self, now: Timestamp) {
        let lost_after_s = self.rules.tracking.lost_after_s;
        for seen in self.seen.values_mut() {
            for one in seen.iter_mut() {
                one.readings.retain(|reading| {
                    now.seconds_since(reading.track.updated_at) <= lost_after_s
                        && reading.ratio() > GIVEN_UP
                });
            }
            seen.retain(|one| one.is_worth_keeping(now, &self.rules));
        }
    }

    /// Continues the directions that the exposure's camera follows; returns the lines that continue
    /// them.
    fn follow(&mut self, context: &ReadingContext<'_>) -> Vec<ContinuedLine> {
        let ReadingContext { comparison: Comparison { exposure, known, .. }, is_owned } = *context;
        let factor = exposure.uncertainty.factor;
        let clutter = self.rules.clutter_per_sr(known).ln();
        let with_pose: Vec<TimedLine> = lines_with_pose(exposure).map(|(_, line)| line).collect();
        let seen = self.seen.entry(exposure.camera.clone()).or_default();
        let mut taken = vec![false; with_pose.len()];
        let (gate, mut begun, mut explained) =
            (self.rules.comparison.gate, Vec::new(), BTreeSet::new());
        let is_known = |i: usize| is_owned[i] || exposure.sightings[i].rooted == Rooted::Yes;
        // The best known directions choose first; a lost one takes only a line that is clearly no
        // other target's.
        let mut order: Vec<usize> = (0..seen.len()).collect();
        order.sort_by(|&a, &b| {
            seen[a].at(exposure.time).variance.total_cmp(&seen[b].at(exposure.time).variance)
        });
        for place in order {
            let one = &mut seen[place];
            let sight = one.at(exposure.time);
            let is_lost = one.is_lost(exposure.time, &self.rules.tracking);
            let near =
                exposure.sightings.iter().enumerate().take(taken.len()).filter(|(i, _)| !taken[*i]);
            let fits = near.filter_map(|(i, sighting)| {
                Some((sight.density(&sighting.line, factor, gate)?, i))
            });
            let fits = fits
                .filter(|(fit, i)| !is_lost || (!is_known(*i) && *fit > clutter + BEYOND_DOUBT));
            let best = fits.max_by(|a, b| a.0.total_cmp(&b.0));
            let Some((log_density, index)) = best else {
                one.missed += 1.0;
                continue;
            };
            taken[index] = true;
            if is_known(index) {
                explained.insert(place);
                continue;
            }
            one.score = (one.score + log_density - exposure.clutter_per_sr.ln())
                .min(2.0 * self.rules.tracking.confirm_score);
            one.sight = sight;
            one.sight.update(&exposure.sightings[index].line);
            one.gaps += std::mem::take(&mut one.missed);
            one.lines += 1.0;
            one.pose_variance = pose_variance(&with_pose[index], exposure, index);
            one.line = with_pose[index].clone();
            one.image_track = exposure.sightings[index].image_track;
            begun.push(ContinuedLine { index, number: one.number, first: one.first });
        }
        let mut place = 0..;
        // What a track or something rooted explains is no direction of its own any more.
        seen.retain(|_| !place.next().is_some_and(|place| explained.contains(&place)));
        for (index, line) in with_pose.into_iter().enumerate() {
            if !taken[index] && !is_known(index) && seen.len() < BOUNDS.seen {
                self.count += 1;
                seen.push(SeenDirection::first(self.count, line, exposure, index));
            }
        }
        begun
    }

    /// Continues the readings that the exposure's lines may belong to.
    fn advance(&mut self, context: &ReadingContext<'_>) {
        for one in self.seen.values_mut().flatten() {
            one.readings.retain_mut(|reading| reading.advance(context, &self.rules));
        }
    }

    /// Starts readings: combines what other cameras have lost sight of with what this camera has
    /// begun to see since.
    fn cross(&mut self, context: &ReadingContext<'_>, begun: &[ContinuedLine]) {
        let ReadingContext { comparison: Comparison { exposure, .. }, is_owned } = *context;
        let now = exposure.time;
        let others = self.seen.iter_mut().filter(|(camera, _)| **camera != exposure.camera);
        let lost = others.flat_map(|(camera, seen)| seen.iter_mut().map(move |one| (camera, one)));
        let mut lost: Vec<(&CameraName, &mut SeenDirection)> = lost
            .filter(|(_, one)| {
                let silent_s = now.seconds_since(one.sight.time);
                one.is_sure(&self.rules.tracking)
                    && one.is_lost(now, &self.rules.tracking)
                    && (self.rules.pair_s..=self.rules.tracking.lost_after_s).contains(&silent_s)
            })
            .collect();
        lost.sort_by_key(|(_, one)| Reverse(one.sight.time));
        for (camera, one) in lost.into_iter().take(BOUNDS.lost) {
            let since =
                begun.iter().filter(|other| one.sight.time.seconds_since(other.first) < TOGETHER_S);
            for &ContinuedLine { index, number, .. } in since.filter(|other| !is_owned[other.index])
            {
                let name = LineId::new(exposure, index);
                let is_read = one.readings.iter().any(|reading| reading.newest == name);
                let is_full =
                    one.readings.len() >= BOUNDS.readings || one.tried.len() >= BOUNDS.tried;
                if is_read || is_full || !one.tried.insert(number) {
                    continue;
                }
                let reading = one.read_in(camera, index, context, &self.rules);
                one.readings.extend(reading.filter(|reading| reading.ratio() > GIVEN_UP));
            }
        }
    }

    /// Confirms the readings that this exposure has put beyond doubt: one target is likelier than
    /// each camera seeing another target, and than any other reading of the same lines, unless that
    /// gives the same target.
    fn settle(&mut self, context: &ReadingContext<'_>) -> Vec<NewTrack> {
        let Comparison { exposure, motion, .. } = context.comparison;
        let state = |reading: &Reading| reading.track.predicted(exposure.time, motion);
        let all: Vec<&Reading> =
            self.seen.values().flatten().flat_map(|one| &one.readings).collect();
        let mut sure: Vec<&Reading> = all
            .iter()
            .copied()
            .filter(|one| {
                one.is_of(exposure) && one.ratio() >= BEYOND_DOUBT && one.track.is_placed()
            })
            .filter(|one| rivals(one, &all).all(|other| same_target(&state(one), &state(other))))
            .collect();
        sure.sort_by(|one, other| other.ratio().total_cmp(&one.ratio()));
        let mut found: Vec<FusedTrack> = Vec::new();
        for reading in sure {
            if !is_among(&found, &state(reading)) {
                let mut track = FusedTrack::clone(&reading.track);
                track.status = TrackStatus::Confirmed;
                track.score = self.rules.tracking.confirm_score;
                track.born = track.updated_at;
                track.observe();
                track.begin_course();
                found.push(track);
            }
        }
        let settled = all.iter().filter(|reading| is_among(&found, &state(reading)));
        let settled: BTreeSet<u64> = settled.map(|reading| reading.of.1).collect();
        for seen in self.seen.values_mut() {
            seen.retain(|one| !settled.contains(&one.number));
        }
        let start = |track| NewTrack { track, cameras: 2, provisional_owners: BTreeSet::new() };
        found.into_iter().map(start).collect()
    }
}

/// The readings that are nearly as likely as one, or likelier, and share its newest line or the
/// direction that was followed first; itself among them.
fn rivals<'a>(one: &'a Reading, all: &'a [&'a Reading]) -> impl Iterator<Item = &'a Reading> + 'a {
    let near = all.iter().copied().filter(|other| other.ratio() > one.ratio() - BEYOND_DOUBT);
    near.filter(|other| other.newest == one.newest || other.of == one.of)
}

/// Whether one of these tracks is of the target of this state.
fn is_among(found: &[FusedTrack], state: &KinematicState) -> bool {
    found.iter().any(|track| same_target(track.state(), state))
}
