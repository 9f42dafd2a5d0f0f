//! Multi-hypothesis initiation: possible targets are followed in every way that the bearings allow,
//! until one explanation of the bearings is by far the best.

mod confirmation;
mod pruning;

use std::collections::{BTreeMap, BTreeSet};

use confirmation::numbers_of_lines;
use crossfix_message::{CameraName, Solver, Timestamp};

use super::first_lines::{FirstLine, FirstLines};
use super::one_target::{Mobility, OneTargetTest};
use super::rooted_lines::RootedLines;
use super::seeds::{Seed, SeedFinder};
use super::selection::PeriodLine;
use super::{MAX_LINES, NewTrack};
use crate::cameras::{Cameras, KnownCamera, Rooted};
use crate::comparison::{Candidate, Comparison, ComparisonRules};
use crate::evidence::BEYOND_DOUBT;
use crate::motion::MotionSetup;
use crate::spatial::{Fix, LineId, Observability, VelocityKnowledge};
use crate::track::{FusedTrack, StartLine, TrackExpectation, TrackId};
use crate::tracker::UsedSighting;
use crate::uncertainty::CameraUncertainty;
use crate::visibility::log_missed;
use crate::{Exposure, FusionConfig};

/// Bounds on time and memory, however much clutter there is; the best are kept.
struct HypothesisBounds {
    /// Bearings of one exposure with which one hypothesis is continued. With one alone, a bearing
    /// of something else that fits better takes the target's place.
    branches: usize,
    /// Hypotheses of one tree. One exposure makes at most four of each: this holds three exposures
    /// in full, half of it two.
    of_tree: usize,
    /// Hypotheses with the same lines in the newest period. With half of it the right past may be
    /// given up before later periods tell it apart.
    duplicates: usize,
    /// Hypotheses at a time. With half of it, in such clutter, the youngest targets go first.
    hypotheses: usize,
}

/// The numbers in use; what half of each does is said at its field.
const BOUNDS: HypothesisBounds =
    HypothesisBounds { branches: 3, of_tree: 100, duplicates: 20, hypotheses: 6_000 };

/// A hypothesis with a smaller log-likelihood ratio than this is clutter. A seed of two cameras may
/// begin below zero: with half of it the first misses end a new target there.
const LEAST_SCORE: f64 = -12.0;

/// What a camera has said of a hypothesis.
#[derive(Clone, Copy, Debug, Default)]
struct Said {
    /// Whether its newest line is of something that stands in its view.
    rooted: Rooted,
    /// Log-likelihood ratio of its lines and misses against clutter, given the lines of the other
    /// cameras; that of the seed as a whole counts for each of its cameras.
    evidence: f64,
}

/// One hypothesis: that these bearings are one target's.
#[derive(Clone, Debug)]
struct Hypothesis {
    /// The number of its tree: all hypotheses that grew from the same seed.
    tree: u64,
    /// Boxed, as hypotheses are sorted often.
    track: Box<FusedTrack>,
    /// Its lines of the last periods, in order of time.
    lines: Vec<PeriodLine>,
    /// What each of its cameras has said.
    said: BTreeMap<CameraName, Said>,
    /// Number of periods that gave it a line.
    periods: usize,
    born: Timestamp,
    /// The test against its lines being of several targets, one per camera.
    one_target: OneTargetTest,
}

/// Multi-scan initiation: hypotheses branch with every bearing in their gate and compete by
/// log-likelihood ratio; the best set of hypotheses without common bearings is taken to be what is
/// there.
#[derive(Debug)]
pub(super) struct Hypotheses {
    finder: SeedFinder,
    rules: ComparisonRules,
    confirm_score: f64,
    /// Number of periods for which a hypothesis keeps its lines.
    span: u64,
    /// Number of periods that must have given it a line before it is confirmed.
    needed: usize,
    /// How long two cameras alone must agree, s.
    pair_s: f64,
    /// Speed of targets, m/s, standard deviation per axis.
    speed: f64,
    shared_lines: usize,
    rooted_lines: RootedLines,
    hypotheses: Vec<Hypothesis>,
    /// Lines that have been used by a track which only one camera supports.
    provisional: BTreeMap<LineId, TrackId>,
    /// Numbers of periods and of trees so far.
    period: u64,
    trees: u64,
    /// Time of each camera's last exposure.
    exposed: BTreeMap<CameraName, Timestamp>,
}

impl Hypothesis {
    /// The cameras that have given it a line in the last periods.
    fn cameras(&self) -> BTreeSet<&CameraName> {
        self.lines.iter().map(|line| &line.id.camera).collect()
    }

    /// Whether a camera's newest line is of something that stands in its view.
    fn rooted(&self, camera: &CameraName) -> Rooted {
        self.said.get(camera).map_or_else(Rooted::default, |said| said.rooted)
    }

    fn newest(&self, period: u64) -> Vec<&LineId> {
        self.lines.iter().filter(|line| line.period == period).map(|line| &line.id).collect()
    }
}

impl Hypotheses {
    pub(super) fn new(config: &FusionConfig) -> Self {
        Self {
            finder: SeedFinder::of_likely(config, LEAST_SCORE),
            rules: ComparisonRules::new(config),
            confirm_score: config.tracking.confirm_score,
            span: config.initiation.periods as u64,
            needed: config.initiation.fixes,
            pair_s: config.initiation.pair_s,
            speed: config.initiation.velocity_prior_sd_mps,
            shared_lines: config.initiation.shared_lines,
            rooted_lines: RootedLines::default(),
            hypotheses: Vec::new(),
            provisional: BTreeMap::new(),
            period: 0,
            trees: 0,
            exposed: BTreeMap::new(),
        }
    }

    /// Notes which lines of an exposure a track that only one camera supports has used.
    pub(super) fn note_provisional(&mut self, exposure: &Exposure, used: &[UsedSighting]) {
        for &UsedSighting { index, track } in used {
            self.provisional.insert(LineId::new(exposure, index), track);
        }
    }

    /// Handles one period (exposures in order of time) and returns the tracks that are confirmed by
    /// it.
    pub(super) fn advance(
        &mut self,
        exposures: &[&Exposure],
        cameras: &Cameras,
        motion: &MotionSetup,
    ) -> Vec<NewTrack> {
        self.period += 1;
        for exposure in exposures {
            if let Some(known) = cameras.known(&exposure.camera) {
                self.extend(exposure, known, motion);
            }
        }
        let span = self.span;
        for hypothesis in &mut self.hypotheses {
            let period = self.period;
            hypothesis.lines.retain(|line| line.period + span > period);
            if hypothesis.lines.last().is_some_and(|line| line.period == period) {
                hypothesis.periods += 1;
            }
        }
        // What one camera alone sees may be anywhere: it must start again when another camera sees
        // it too.
        self.hypotheses.retain(|h| {
            h.cameras().len() >= 2 && h.one_target.log_ratio().is_none_or(|r| r > LEAST_SCORE)
        });
        let held = self.held();
        // In the first period nothing can have been followed before.
        let is_first = self.period == 1;
        self.rooted_lines.see(exposures);
        let is_held = |id: &LineId| is_first || held.contains(id);
        let seeds = self.finder.find(exposures, cameras, Some(&self.rooted_lines), is_held);
        self.begin(seeds, exposures, motion);
        self.prune();
        let now = exposures.last().map(|exposure| exposure.time);
        let lines = numbers_of_lines(exposures);
        now.map_or_else(Vec::new, |now| self.confirm(now, &lines, motion))
    }

    /// The lines of this period that continue hypotheses of three cameras, as far as these are
    /// likelier to be one target than one of each camera.
    fn held(&self) -> BTreeSet<LineId> {
        let is_one = |h: &&Hypothesis| h.one_target.log_ratio().is_none_or(|ratio| ratio > 0.0);
        let likely = self.hypotheses.iter().filter(is_one);
        let of_three = likely.filter(|h| h.cameras().len() >= 3);
        of_three.flat_map(|h| h.newest(self.period)).cloned().collect()
    }

    /// Continues every hypothesis with each bearing in its gate, and without any.
    fn extend(&mut self, exposure: &Exposure, known: &KnownCamera, motion: &MotionSetup) {
        let before = self.exposed.insert(exposure.camera.clone(), exposure.time);
        let interval_s = before.map_or(f64::INFINITY, |before| exposure.time.seconds_since(before));
        let comparison = Comparison { exposure, known, motion, rules: self.rules };
        let mut next = Vec::with_capacity(self.hypotheses.len());
        for hypothesis in std::mem::take(&mut self.hypotheses) {
            self.extend_one(hypothesis, &comparison, interval_s, &mut next);
        }
        self.hypotheses = next;
        self.prune_trees();
    }

    /// Continues one hypothesis with each bearing in its gate that is likely enough compared with
    /// the likeliest continuation, and without any if that is. The camera's exposure before was
    /// `interval_s` earlier.
    fn extend_one(
        &self,
        mut hypothesis: Hypothesis,
        comparison: &Comparison<'_>,
        interval_s: f64,
        next: &mut Vec<Hypothesis>,
    ) {
        let is_expected = comparison.expects(&hypothesis.track);
        // If the target is outside the camera's view, a hypothesis without a line costs nothing.
        let miss = if is_expected { comparison.log_missed(&hypothesis.track) } else { 0.0 };
        let prediction = comparison.expectation(&hypothesis.track);
        let is_open = |index: usize| index < MAX_LINES;
        let near = prediction.as_ref().map_or_else(Vec::new, |prediction| {
            comparison.ranked(&hypothesis.track, prediction, is_open)
        });
        // The likeliest continuation, with a bearing or without.
        let best = near.first().map_or(miss, |likeliest| likeliest.ratio.max(miss));
        let likely = |one: &Candidate| one.ratio > miss && one.ratio > best - BEYOND_DOUBT;
        let likely: Vec<_> = near.into_iter().filter(likely).take(BOUNDS.branches).collect();
        let continued = |candidate, hypothesis| {
            self.continued_with(candidate, hypothesis, comparison, prediction.as_ref())
        };
        // Copies are most of what a hypothesis costs: one that does not go on without a bearing
        // becomes its last continuation, and is given up if the numbers fail.
        if miss <= best - BEYOND_DOUBT
            && let Some((last, others)) = likely.split_last()
        {
            next.extend(others.iter().filter_map(|one| continued(*one, hypothesis.clone())));
            next.extend(continued(*last, hypothesis));
            return;
        }
        next.extend(likely.into_iter().filter_map(|one| continued(one, hypothesis.clone())));
        if is_expected {
            // ln(1 - P(visible) P_D); against one target per camera, ln(1 - P_D) alone.
            hypothesis.track.score += miss;
            if let Some(said) = hypothesis.said.get_mut(&comparison.exposure.camera) {
                said.evidence += miss;
            }
            comparison.note(&mut hypothesis.track, false);
            let missed = log_missed(self.rules.detection);
            // Looks within the time for which chance may agree count as one.
            let share = (interval_s / self.pair_s).clamp(0.0, 1.0);
            hypothesis.one_target.miss(&comparison.exposure.camera, missed, share);
        }
        next.push(hypothesis);
    }

    /// A hypothesis continued with a bearing.
    fn continued_with(
        &self,
        Candidate { index, ratio, .. }: Candidate,
        mut hypothesis: Hypothesis,
        comparison: &Comparison<'_>,
        prediction: Option<&TrackExpectation>,
    ) -> Option<Hypothesis> {
        let Comparison { exposure, motion, .. } = *comparison;
        if let Some(TrackExpectation::Near(_)) = prediction {
            let density = motion.density(hypothesis.track.model_probabilities());
            let mobility = Mobility { density, speed: self.speed };
            let bearing = comparison.bearing(index);
            hypothesis.one_target.see(&bearing, &hypothesis.track, mobility, ratio);
        } else {
            hypothesis.one_target.pass_over();
        }
        comparison.take(&mut hypothesis.track, index)?;
        hypothesis.track.score += ratio;
        let id = LineId::new(exposure, index);
        hypothesis.lines.push(PeriodLine { period: self.period, id });
        let said = hypothesis.said.entry(exposure.camera.clone()).or_default();
        said.rooted = exposure.sightings[index].rooted;
        said.evidence += ratio;
        Some(hypothesis)
    }

    /// Starts a hypothesis from every seed.
    fn begin(&mut self, seeds: Vec<Seed>, exposures: &[&Exposure], motion: &MotionSetup) {
        let uncertainty: BTreeMap<&CameraName, CameraUncertainty> =
            exposures.iter().map(|exposure| (&exposure.camera, exposure.uncertainty)).collect();
        for seed in seeds {
            let Some(time) = seed.time() else {
                continue;
            };
            self.trees += 1;
            let (state, velocity) = (seed.solution.state, VelocityKnowledge::Solved);
            // Eigenvalues cost more than all the rest: they are computed only for those that are
            // confirmed.
            let observability = Observability::unexamined(6);
            let fix = Fix { time, state, velocity, solver: Solver::Map, observability };
            let named = seed.lines.iter().filter_map(|(LineId { camera, .. }, line)| {
                Some(StartLine { camera, line, uncertainty: *uncertainty.get(camera)? })
            });
            let mut track = Box::new(FusedTrack::start(&fix, named, motion));
            track.score = seed.score;
            let place = fix.state.position();
            let first_lines = seed.lines.iter().filter_map(|(id, solved)| {
                Some(FirstLine {
                    camera: id.camera.clone(),
                    line: id.sighting_in(exposures)?.line,
                    uncertainty: *uncertainty.get(&id.camera)?,
                    solved: solved.clone(),
                })
            });
            let first = FirstLines::of_seed(first_lines, place, self.speed, seed.score);
            let one_target = OneTargetTest::begin(first);
            let mut said = BTreeMap::new();
            for (id @ LineId { camera, .. }, _) in &seed.lines {
                let Some(own) = id.sighting_in(exposures) else { continue };
                said.insert(camera.clone(), Said { rooted: own.rooted, evidence: seed.score });
            }
            let period = self.period;
            let lines = seed.lines.into_iter().map(|(id, _)| PeriodLine { period, id });
            self.hypotheses.push(Hypothesis {
                tree: self.trees,
                track,
                lines: lines.collect(),
                said,
                periods: 1,
                born: time,
                one_target,
            });
        }
    }
}
