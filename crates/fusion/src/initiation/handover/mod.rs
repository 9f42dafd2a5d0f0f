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

use crossfix_message::{CameraName, Cued, Timestamp};

use self::reading::{Reading, ReadingContext, Rules, TOGETHER_S};
use self::seen::{SeenDirection, TURNING_DENSITY, pose_variance};
use super::one_target::OneTargetTest;
use super::{Start, lines_with_pose};
use crate::cameras::{KnownCamera, Rooted};
use crate::cueing::CueTarget;
use crate::motion::MotionSetup;
use crate::spatial::TimedLine;
use crate::track::{Track, TrackStatus};
use crate::tracker::{UsedSighting, same_target};
use crate::{Exposure, FusionConfig};

/// A reading is confirmed if one target is likelier by this log-likelihood ratio than each camera
/// seeing another target, and than any other reading of the same lines: a chance of 1 in 3000. With
/// half of it (1 in 50) other targets are taken for it.
const MARGIN: f64 = 8.0;
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
        let range = (NEAREST_M * self.rules.max_range_m).sqrt();
        let sure = self.seen.iter().flat_map(|(camera, seen)| {
            let open = |one: &&SeenDirection| {
                one.is_sure(&self.rules.tracking) && !one.is_lost(now, &self.rules.tracking)
            };
            seen.iter().filter(open).map(move |one| (camera, one))
        });
        let known = sure.filter_map(|(camera, one)| {
            let state = one.state_at(range, self.rules.speed)?;
            let of =
                Cued { track_id: 0, camera: camera.to_string(), image_track_id: one.image_track };
            let seen_from = Some(one.line.line.origin);
            Some(CueTarget::new(of, now, seen_from, |time| {
                let ahead_s = time.seconds_since(one.sight.time);
                state.predicted(ahead_s, TURNING_DENSITY * range.powi(2))
            }))
        });
        known.collect()
    }

    /// Handles an exposure, given which of its lines (by index) belong to tracks; returns the
    /// tracks that are confirmed by it.
    pub(super) fn see(
        &mut self,
        exposure: &Exposure,
        used: &[UsedSighting],
        known: &KnownCamera,
        motion: &MotionSetup,
    ) -> Vec<Start> {
        let mut is_owned = vec![false; exposure.sightings.len()];
        used.iter().for_each(|used| is_owned[used.index] = true);
        let context = ReadingContext { exposure, known, motion, is_owned: &is_owned };
        self.forget(exposure.time);
        let begun = self.follow(&context);
        self.advance(&context);
        self.cross(&context, &begun);
        self.settle(&context)
    }

    /// Forgets directions that have been silent for as long as a track would be kept, and at once
    /// those that were lost before they were sure.
    fn forget(&mut self, now: Timestamp) {
        let (tracking, pair_s) = (&self.rules.tracking, self.rules.pair_s);
        let lost_after_s = tracking.lost_after_s;
        for seen in self.seen.values_mut() {
            for one in seen.iter_mut() {
                one.readings.retain(|reading| {
                    now.seconds_since(reading.track.updated) <= lost_after_s
                        && reading.ratio() > GIVEN_UP
                });
            }
            seen.retain(|one| {
                let silent_s = now.seconds_since(one.sight.time);
                if one.is_sure(tracking) {
                    silent_s <= lost_after_s || !one.readings.is_empty()
                } else {
                    silent_s <= pair_s || !one.is_lost(now, tracking)
                }
            });
        }
    }

    /// Continues the directions that the exposure's camera follows; returns the lines that continue
    /// them.
    fn follow(&mut self, context: &ReadingContext<'_>) -> Vec<ContinuedLine> {
        let ReadingContext { exposure, known, is_owned, .. } = *context;
        let factor = exposure.uncertainty.factor;
        let clutter = self.rules.clutter_per_sr(known).ln();
        let with_pose: Vec<TimedLine> = lines_with_pose(exposure).map(|(_, line)| line).collect();
        let seen = self.seen.entry(exposure.camera.clone()).or_default();
        let mut taken = vec![false; with_pose.len()];
        let (gate, mut begun, mut explained) = (self.rules.gate, Vec::new(), BTreeSet::new());
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
            let fits =
                fits.filter(|(fit, i)| !is_lost || (!is_known(*i) && *fit > clutter + MARGIN));
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
        let ReadingContext { exposure, known, motion, is_owned } = *context;
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
                let name = (exposure.camera.clone(), exposure.sequence, index);
                let is_read = one.readings.iter().any(|reading| reading.newest == name);
                let is_full =
                    one.readings.len() >= BOUNDS.readings || one.tried.len() >= BOUNDS.tried;
                if is_read || is_full || !one.tried.insert(number) {
                    continue;
                }
                let line = &exposure.sightings[index].line;
                let reading =
                    one.placed(camera, line, now, &self.rules, motion).and_then(|track| {
                        // Price of the velocity that the reading implies: v^2 / (2 sd^2), of a
                        // prior about zero.
                        let unlikely = track.state().velocity().norm_squared()
                            / (2.0 * self.rules.speed.powi(2));
                        let expected = context.expectation(&track)?;
                        let fit = expected.fit(line, self.rules.gate)?;
                        // Against one other target in the view: the line is there, so it is not
                        // weighed by P_D.
                        let ratio = fit.log_ratio(1.0, self.rules.clutter_per_sr(known)) - unlikely;
                        let one_target = OneTargetTest::of_one(camera, one.sight.clone());
                        let mut reading = Reading {
                            of: (camera.clone(), one.number),
                            track: Box::new(track),
                            one_target,
                            newest: name,
                        };
                        reading.take(context, index, &expected, ratio, &self.rules)?;
                        (reading.ratio() > GIVEN_UP).then_some(reading)
                    });
                one.readings.extend(reading);
            }
        }
    }

    /// Confirms the readings that this exposure has made sure. Other readings of the same lines are
    /// rivals, unless they give the same target.
    fn settle(&mut self, context: &ReadingContext<'_>) -> Vec<Start> {
        let ReadingContext { exposure, motion, .. } = *context;
        let state = |reading: &Reading| reading.track.predicted(exposure.time, motion);
        let all: Vec<&Reading> =
            self.seen.values().flatten().flat_map(|one| &one.readings).collect();
        let mut sure: Vec<&Reading> = all
            .iter()
            .copied()
            .filter(|one| one.is_of(exposure) && one.ratio() >= MARGIN && one.track.is_placed())
            .filter(|one| {
                // Rivals share the newest line or the direction that was followed first.
                let mut rivals = all.iter().filter(|other| {
                    other.ratio() > one.ratio() - MARGIN
                        && (other.newest == one.newest || other.of == one.of)
                });
                rivals.all(|other| same_target(&state(one), &state(other)))
            })
            .collect();
        sure.sort_by(|one, other| other.ratio().total_cmp(&one.ratio()));
        let mut found: Vec<Track> = Vec::new();
        for reading in sure {
            if found.iter().all(|track| !same_target(track.state(), &state(reading))) {
                let mut track = Track::clone(&reading.track);
                track.status = TrackStatus::Confirmed;
                track.score = self.rules.tracking.confirm_score;
                track.born = track.updated;
                track.observe();
                found.push(track);
            }
        }
        let is_found = |reading: &Reading| {
            found.iter().any(|track| same_target(track.state(), &state(reading)))
        };
        let settled: BTreeSet<u64> =
            all.iter().filter(|reading| is_found(reading)).map(|reading| reading.of.1).collect();
        for seen in self.seen.values_mut() {
            seen.retain(|one| !settled.contains(&one.number));
        }
        let start = |track| Start { track, cameras: 2, claimed_by: BTreeSet::new() };
        found.into_iter().map(start).collect()
    }
}
