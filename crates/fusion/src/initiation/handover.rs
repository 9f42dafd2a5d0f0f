//! Targets that cameras see one after another, and never two at a time.
//!
//! What one camera alone follows is a direction that turns. When it loses sight of it, another may
//! have begun to see it: the new camera's line crosses the direction that the old one would have by
//! now in one place, and place and turning give a velocity across the old line. How the new line
//! turns, and where the next camera sees it, tells whether that was so.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

use crossfix_filter::{Gate, KinematicState};
use crossfix_geometry::{BearingModel, SightLine, passing_ranges};
use crossfix_message::{CameraName, Cued, Solver, Timestamp};
use nalgebra::{Matrix3, Vector3, Vector6};

use super::one_target::OneTargetTest;
use super::sight::Sight;
use super::{MAX_LINES, Start, lines_with_pose};
use crate::cameras::KnownCamera;
use crate::cameras::Rooted;
use crate::cameras::view_sr;
use crate::cueing::Known;
use crate::motion::Motion;
use crate::spatial::{Fix, LineId, Observability, TimedLine, VelocityKnowledge};
use crate::track::{Expectation, Track, TrackId, TrackStatus};
use crate::tracker::{log_likelihood_ratio, same_target};
use crate::uncertainty::CameraUncertainty;
use crate::{Exposure, FusionConfig, Tracking};

/// How fast a direction may turn, rad/s (standard deviation): 45 m/s at 150 m. With half of it what
/// flies past a camera is lost again and again; twice as much takes strangers for it.
const TURNING_SD: f64 = 0.3;
/// White acceleration of a direction, rad^2/s^3: 7 m^2/s^3 at 150 m, which is lively. With half of
/// it what turns hard is lost, with twice as much two directions are too soon alike.
const TURNING_DENSITY: f64 = 3e-4;
/// Deviation of the logarithm of a range of which nothing is known: as dense at its middle as if
/// all ranges over a factor of 150 were equally likely.
const UNKNOWN_LOG_RANGE_SD: f64 = 2.0;
/// A camera has lost sight of what it followed if it would so seldom (logarithm) have missed it so
/// often by chance: once in 100 times, which are two exposures where it reports nine of ten.
const LOST: f64 = -4.6;
/// Two cameras that have seen something together for longer than this, s, and have not made a
/// target of it, see different things.
const TOGETHER_S: f64 = 1.0;
/// That it is one target must be so many times (logarithm) likelier than that each camera sees
/// another, and than any other reading of the same lines: a chance of 1 in 3000.
const MARGIN: f64 = 8.0;
/// A reading less likely than this (logarithm) is given up.
const GIVEN_UP: f64 = -5.0;
/// What one camera alone sees is hardly nearer than this, m: with the largest range it gives the
/// middle of those that are possible.
const NEAREST_M: f64 = 30.0;
/// Directions followed in one camera, lost ones tried in one exposure, readings of one, and others
/// tried with one: time is bounded.
const MAX_SEEN: usize = 20;
const MAX_LOST: usize = 20;
const MAX_READINGS: usize = 4;
const MAX_TRIED: usize = 50;

/// What one camera alone follows, as of its last line.
#[derive(Clone, Debug)]
struct Seen {
    /// Two that begin with one exposure are told apart by it.
    number: u64,
    /// The number that the camera gives it.
    image_track: u64,
    sight: Sight,
    first: Timestamp,
    /// Its last line with what is uncertain of the camera's pose, what that is (variance, rad^2),
    /// ...
    line: TimedLine,
    pose_variance: f64,
    /// ... and of the camera.
    uncertainty: CameraUncertainty,
    /// Log-likelihood ratio of being a target, whatever its place, against being clutter.
    score: f64,
    /// Its lines so far, ...
    lines: f64,
    /// ... the exposures between them without one, ...
    gaps: f64,
    /// ... and those since the last.
    missed: f64,
    /// The ways in which other cameras may have seen it since, ...
    readings: Vec<Reading>,
    /// ... and what has been tried: what is refuted once is not tried again.
    tried: BTreeSet<u64>,
}

/// What one camera has followed and others may have seen since, as one target.
#[derive(Clone, Debug)]
struct Reading {
    /// The camera that saw it first, and the number of what it saw.
    of: (CameraName, u64),
    track: Box<Track>,
    one_target: OneTargetTest,
    newest: LineId,
}

/// The newest exposure, and what else its lines are compared by.
#[derive(Clone, Copy)]
struct Look<'a> {
    exposure: &'a Exposure,
    known: &'a KnownCamera,
    motion: &'a Motion,
    /// Whether a track knows the line, by index.
    is_owned: &'a [bool],
}

impl Look<'_> {
    /// What is uncertain of the exposure's camera: what a clock shifts is not known before the
    /// velocity is.
    fn uncertainty(&self) -> CameraUncertainty {
        CameraUncertainty { clock_is_noise: true, ..self.exposure.uncertainty }
    }

    /// What the camera should see of a track.
    fn expectation(&self, track: &Track) -> Option<Expectation> {
        let seen_from = (&self.exposure.camera, self.known.camera.pose().position());
        track.expectation(self.exposure.time, seen_from, &self.uncertainty(), self.motion)
    }
}

/// What the cameras follow one by one, and how it goes together.
#[derive(Debug)]
pub(super) struct Handover {
    tracking: Tracking,
    gate: Gate,
    /// How fast targets are, m/s, standard deviation per axis.
    speed: f64,
    pair_s: f64,
    max_range_m: f64,
    seen: BTreeMap<CameraName, Vec<Seen>>,
    /// How many directions have been followed.
    count: u64,
}

/// A line that a camera has begun to follow, by its index, with what it follows there.
#[derive(Clone, Copy, Debug)]
struct Begun {
    index: usize,
    number: u64,
    first: Timestamp,
}

impl Seen {
    fn first(number: u64, line: TimedLine, exposure: &Exposure, index: usize) -> Self {
        let time = exposure.time;
        Self {
            number,
            image_track: exposure.sightings[index].image_track,
            sight: Sight::first(&exposure.sightings[index].line, time, TURNING_SD),
            first: time,
            pose_variance: pose_variance(&line, exposure, index),
            line,
            uncertainty: CameraUncertainty { clock_is_noise: true, ..exposure.uncertainty },
            score: 0.0,
            lines: 1.0,
            gaps: 0.0,
            missed: 0.0,
            readings: Vec::new(),
            tried: BTreeSet::new(),
        }
    }

    /// Whether the camera no longer sees it, and has not only missed it a few times; or is silent
    /// itself.
    fn is_lost(&self, now: Timestamp, tracking: &Tracking) -> bool {
        let share = (self.lines / (self.lines + self.gaps)).min(tracking.detection_probability);
        let is_silent = now.seconds_since(self.sight.time) > tracking.coasting_after_s;
        is_silent || self.missed * (1.0 - share).ln() <= LOST
    }

    /// Whether it is sure to be something, and not the camera's false alarms.
    fn is_sure(&self, tracking: &Tracking) -> bool {
        self.score >= tracking.confirm_score
    }

    /// Where it is expected at a time.
    fn at(&self, time: Timestamp) -> Sight {
        let mut sight = self.sight.clone();
        sight.predict(time, TURNING_DENSITY);
        sight
    }

    /// A track of it, in the place where its direction at a time crosses another line; the target
    /// may be as fast as `speed` (m/s, standard deviation) along the direction.
    fn placed(
        &self,
        camera: &CameraName,
        (line, time): (&SightLine, Timestamp),
        (speed, max_range_m): (f64, f64),
        motion: &Motion,
    ) -> Option<Track> {
        let Self { sight, line: last, uncertainty, .. } = self;
        let by_now = self.at(time).direction;
        let [range, there] =
            passing_ranges((last.line.origin, &by_now), (line.origin, &line.direction));
        if ![range, there].iter().all(|range| (f64::MIN_POSITIVE..=max_range_m).contains(range)) {
            return None;
        }
        let state = self.state_at(range, speed)?;
        let observability = Observability::unexamined(6);
        let (velocity, solver) = (VelocityKnowledge::Solved, Solver::Map);
        let fix = Fix { time: sight.time, state, velocity, solver, observability };
        Some(Track::start_alone(&fix, (camera, last, *uncertainty), motion))
    }

    /// Where it is and how it moves if its range is about `range` (m), which is not known, as of its
    /// last line; the target may be as fast as `speed` (m/s, standard deviation) along the
    /// direction.
    fn state_at(&self, range: f64, speed: f64) -> Option<KinematicState> {
        let Self { sight, line: last, .. } = self;
        let along = sight.direction.into_inner();
        let velocity = (sight.rate - along * along.dot(&sight.rate)) * range;
        let model = BearingModel::new(last.line.origin, last.line.origin + along * range)?;
        let [across, along_squared] =
            [model.basis * model.basis.transpose(), along * along.transpose()];
        // A range that is off by a share has the place off along the direction, and the velocity by
        // the same share.
        let scale = stacked(along * range, velocity) * UNKNOWN_LOG_RANGE_SD;
        let direction_variance = sight.variance + self.pose_variance;
        let (tie, turning) = (sight.tie, sight.rate_variance);
        let mut covariance = scale * scale.transpose();
        let mut add = |row: usize, column: usize, block: Matrix3<f64>| {
            let mut view = covariance.fixed_view_mut::<3, 3>(row, column);
            view += block;
        };
        add(0, 0, across * (direction_variance * range.powi(2)));
        add(0, 3, across * (tie * range.powi(2)));
        add(3, 0, across * (tie * range.powi(2)));
        add(3, 3, across * (turning * range.powi(2)) + along_squared * speed.powi(2));
        let mean = stacked(last.line.origin.coords + along * range, velocity);
        Some(KinematicState { mean, covariance })
    }
}

/// What the pose adds to a line's variance along each tangent, rad^2.
fn pose_variance(with_pose: &TimedLine, exposure: &Exposure, index: usize) -> f64 {
    let own = exposure.sightings[index].line.covariance * exposure.uncertainty.factor;
    (with_pose.line.covariance - own).trace().max(0.0) / 2.0
}

fn stacked(place: Vector3<f64>, velocity: Vector3<f64>) -> Vector6<f64> {
    let mut both = Vector6::zeros();
    both.fixed_rows_mut::<3>(0).copy_from(&place);
    both.fixed_rows_mut::<3>(3).copy_from(&velocity);
    both
}

impl Reading {
    /// Takes the exposure's best line in; returns whether it is still open what this is: not if a
    /// track has the line.
    fn advance(&mut self, look: &Look<'_>, rules: &Handover) -> bool {
        let Look { exposure, known, is_owned, .. } = *look;
        let Some(expected) = look.expectation(&self.track) else {
            return true;
        };
        let lines = exposure.sightings.iter().enumerate().take(MAX_LINES);
        let fits = lines.filter_map(|(i, sighting)| {
            Some((expected.fit(&sighting.line, rules.gate)?.log_density, i))
        });
        let best = fits.max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((log_density, index)) = best.filter(|(_, index)| !is_owned[*index]) {
            self.take(
                look,
                index,
                &expected,
                log_density - rules.strangers_per_sr(known).ln(),
                rules,
            );
        }
        best.is_none_or(|(_, index)| !is_owned[index])
    }

    /// Takes a line in; `None` if the numbers fail.
    fn take(
        &mut self,
        look: &Look<'_>,
        index: usize,
        expected: &Expectation,
        first_ratio: f64,
        rules: &Handover,
    ) -> Option<()> {
        let Look { exposure, motion, .. } = *look;
        let Exposure { camera, time, uncertainty, sightings, .. } = exposure;
        let line = &sightings[index].line;
        let density = motion.density(self.track.model_probabilities());
        self.track.measurement_update(camera, line, (*time, &look.uncertainty()), motion)?;
        self.track.look(camera, *time, true, rules.tracking.detection_probability, motion);
        let timed = (line, *time, uncertainty.time_sd_s);
        // That two cameras which see something at once agree says nothing of what the first one has
        // seen before.
        let is_joint = self.track.residuals.iter().any(|(name, residual)| {
            *name != self.of.0 && name != camera && time.seconds_since(residual.time) < TOGETHER_S
        });
        let first_ratio = if is_joint { 0.0 } else { first_ratio };
        match expected {
            Expectation::Near(prediction) => {
                self.one_target.see(camera, timed, prediction, (density, rules.speed), first_ratio);
            }
            Expectation::Along { .. } if self.one_target.knows(camera) => {}
            Expectation::Along { .. } => {
                let range = (self.track.state().position() - line.origin).norm();
                self.one_target.see_first(camera, (line, *time), rules.speed / range, first_ratio);
            }
        }
        self.newest = (camera.clone(), exposure.sequence, index);
        Some(())
    }

    fn ratio(&self) -> f64 {
        self.one_target.log_ratio().unwrap_or(f64::NEG_INFINITY)
    }
}

impl Handover {
    pub(super) fn new(config: &FusionConfig) -> Self {
        Self {
            gate: Gate::with_probability(config.tracking.gate_probability),
            tracking: config.tracking.clone(),
            speed: config.initiation.velocity_prior_sd_mps,
            pair_s: config.initiation.pair_s,
            max_range_m: config.initiation.max_range_m,
            seen: BTreeMap::new(),
            count: 0,
        }
    }

    /// Forgets what a camera has followed.
    pub(super) fn forget_camera(&mut self, camera: &CameraName) {
        self.seen.remove(camera);
    }

    /// What one camera alone sees for sure, as far as it is known now: its range is anywhere.
    pub(super) fn known(&self, now: Timestamp) -> Vec<Known> {
        let range = (NEAREST_M * self.max_range_m).sqrt();
        let sure = self.seen.iter().flat_map(|(camera, seen)| {
            let open =
                |one: &&Seen| one.is_sure(&self.tracking) && !one.is_lost(now, &self.tracking);
            seen.iter().filter(open).map(move |one| (camera, one))
        });
        let known = sure.filter_map(|(camera, one)| {
            let state = one.state_at(range, self.speed)?;
            let of =
                Cued { track_id: 0, camera: camera.to_string(), image_track_id: one.image_track };
            let seen_from = Some(one.line.line.origin);
            let expected = |time: Timestamp| {
                let ahead_s = time.seconds_since(one.sight.time);
                state.predicted(ahead_s, TURNING_DENSITY * range.powi(2))
            };
            Some(Known::new(of, now, seen_from, expected))
        });
        known.collect()
    }

    /// Takes an exposure in, with which of its lines (by index) a track knows; returns the tracks
    /// that are sure now.
    pub(super) fn see(
        &mut self,
        exposure: &Exposure,
        used: &[(usize, TrackId)],
        known: &KnownCamera,
        motion: &Motion,
    ) -> Vec<Start> {
        let mut is_owned = vec![false; exposure.sightings.len()];
        used.iter().for_each(|(index, _)| is_owned[*index] = true);
        let look = Look { exposure, known, motion, is_owned: &is_owned };
        self.forget(exposure.time);
        let begun = self.follow(&look);
        self.advance(&look);
        self.cross(&look, &begun);
        self.settle(&look)
    }

    /// Forgets what no camera has seen for as long as a track would be kept, and what was never
    /// sure at once.
    fn forget(&mut self, now: Timestamp) {
        let (tracking, pair_s) = (&self.tracking, self.pair_s);
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

    /// Goes on with what the exposure's camera follows; returns its lines of that.
    fn follow(&mut self, look: &Look<'_>) -> Vec<Begun> {
        let Look { exposure, known, is_owned, .. } = *look;
        let factor = exposure.uncertainty.factor;
        let strangers = self.strangers_per_sr(known).ln();
        let with_pose: Vec<TimedLine> = lines_with_pose(exposure).map(|(_, line)| line).collect();
        let seen = self.seen.entry(exposure.camera.clone()).or_default();
        let mut taken = vec![false; with_pose.len()];
        let (gate, mut begun, mut explained) = (self.gate, Vec::new(), BTreeSet::new());
        let is_known = |i: usize| is_owned[i] || exposure.sightings[i].rooted == Rooted::Yes;
        // Those that are best known choose first; one that is lost takes nothing that may be a
        // stranger.
        let mut order: Vec<usize> = (0..seen.len()).collect();
        order.sort_by(|&a, &b| {
            seen[a].at(exposure.time).variance.total_cmp(&seen[b].at(exposure.time).variance)
        });
        for place in order {
            let one = &mut seen[place];
            let sight = one.at(exposure.time);
            let is_lost = one.is_lost(exposure.time, &self.tracking);
            let near =
                exposure.sightings.iter().enumerate().take(taken.len()).filter(|(i, _)| !taken[*i]);
            let fits = near.filter_map(|(i, sighting)| {
                Some((sight.density(&sighting.line, factor, gate)?, i))
            });
            let fits =
                fits.filter(|(fit, i)| !is_lost || (!is_known(*i) && *fit > strangers + MARGIN));
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
                .min(2.0 * self.tracking.confirm_score);
            one.sight = sight;
            one.sight.update(&exposure.sightings[index].line);
            one.gaps += std::mem::take(&mut one.missed);
            one.lines += 1.0;
            one.pose_variance = pose_variance(&with_pose[index], exposure, index);
            one.line = with_pose[index].clone();
            one.image_track = exposure.sightings[index].image_track;
            begun.push(Begun { index, number: one.number, first: one.first });
        }
        let mut place = 0..;
        seen.retain(|_| !place.next().is_some_and(|place| explained.contains(&place)));
        for (index, line) in with_pose.into_iter().enumerate() {
            if !taken[index] && !is_known(index) && seen.len() < MAX_SEEN {
                self.count += 1;
                seen.push(Seen::first(self.count, line, exposure, index));
            }
        }
        begun
    }

    /// Goes on with the readings that the exposure's lines may be part of.
    fn advance(&mut self, look: &Look<'_>) {
        let mut all = std::mem::take(&mut self.seen);
        for one in all.values_mut().flatten() {
            one.readings.retain_mut(|reading| reading.advance(look, self));
        }
        self.seen = all;
    }

    /// Tries what other cameras have lost sight of with what this one has begun to see since.
    fn cross(&mut self, look: &Look<'_>, begun: &[Begun]) {
        let Look { exposure, known, motion, is_owned } = *look;
        let now = exposure.time;
        let mut all = std::mem::take(&mut self.seen);
        let others = all.iter_mut().filter(|(camera, _)| **camera != exposure.camera);
        let lost = others.flat_map(|(camera, seen)| seen.iter_mut().map(move |one| (camera, one)));
        let mut lost: Vec<(&CameraName, &mut Seen)> = lost
            .filter(|(_, one)| {
                let silent_s = now.seconds_since(one.sight.time);
                one.is_sure(&self.tracking)
                    && one.is_lost(now, &self.tracking)
                    && (self.pair_s..=self.tracking.lost_after_s).contains(&silent_s)
            })
            .collect();
        lost.sort_by_key(|(_, one)| Reverse(one.sight.time));
        for (camera, one) in lost.into_iter().take(MAX_LOST) {
            let since =
                begun.iter().filter(|other| one.sight.time.seconds_since(other.first) < TOGETHER_S);
            for &Begun { index, number, .. } in since.filter(|other| !is_owned[other.index]) {
                let name = (exposure.camera.clone(), exposure.sequence, index);
                let is_read = one.readings.iter().any(|reading| reading.newest == name);
                let is_full = one.readings.len() >= MAX_READINGS || one.tried.len() >= MAX_TRIED;
                if is_read || is_full || !one.tried.insert(number) {
                    continue;
                }
                let line = &exposure.sightings[index].line;
                let reading = one
                    .placed(camera, (line, now), (self.speed, self.max_range_m), motion)
                    .and_then(|track| {
                        let unlikely =
                            track.state().velocity().norm_squared() / (2.0 * self.speed.powi(2));
                        let expected = look.expectation(&track)?;
                        let fit = expected.fit(line, self.gate)?;
                        let ratio = log_likelihood_ratio(&fit, 1.0, self.strangers_per_sr(known))
                            - unlikely;
                        let one_target = OneTargetTest::of_one(camera, one.sight.clone());
                        let mut reading = Reading {
                            of: (camera.clone(), one.number),
                            track: Box::new(track),
                            one_target,
                            newest: name,
                        };
                        reading.take(look, index, &expected, ratio, self)?;
                        (reading.ratio() > GIVEN_UP).then_some(reading)
                    });
                one.readings.extend(reading);
            }
        }
        self.seen = all;
    }

    /// The readings that an exposure has made sure. Others of the same lines are rivals, unless
    /// they are the same target.
    fn settle(&mut self, look: &Look<'_>) -> Vec<Start> {
        let Look { exposure, motion, .. } = *look;
        let is_new = |reading: &Reading| {
            let (camera, sequence, _) = &reading.newest;
            *camera == exposure.camera && *sequence == exposure.sequence
        };
        let state = |reading: &Reading| reading.track.predicted(exposure.time, motion);
        let all: Vec<&Reading> =
            self.seen.values().flatten().flat_map(|one| &one.readings).collect();
        let mut sure: Vec<&Reading> = all
            .iter()
            .copied()
            .filter(|one| is_new(one) && one.ratio() >= MARGIN && one.track.is_placed())
            .filter(|one| {
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
                track.score = self.tracking.confirm_score;
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

    /// How many other targets a camera sees, 1/sr: one, as nothing else is known.
    fn strangers_per_sr(&self, known: &KnownCamera) -> f64 {
        1.0 / view_sr(known)
    }
}
