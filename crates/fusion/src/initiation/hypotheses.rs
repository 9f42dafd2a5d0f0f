//! Multi-hypothesis initiation: possible targets are followed in every way that the bearings allow,
//! until one explanation of the bearings is by far the best.

mod pruning;

use std::collections::{BTreeMap, BTreeSet};

use crossfix_message::{CameraName, Solver, Timestamp};

use super::first_lines::{FirstLine, FirstLines};
use super::one_target::{Mobility, OneTargetTest};
use super::rooted_lines::RootedLines;
use super::seeds::{Seed, SeedFinder};
use super::selection::{PeriodLine, ScoredLines, Selection};
use super::{MAX_LINES, NewTrack};
use crate::cameras::{Cameras, KnownCamera, Rooted};
use crate::comparison::{Candidate, Comparison, ComparisonRules};
use crate::evidence::{BEYOND_DOUBT, ONE_IN_A_HUNDRED};
use crate::motion::MotionSetup;
use crate::spatial::{Fix, LineId, Observability, VelocityKnowledge};
use crate::track::{FusedTrack, StartLine, TrackExpectation, TrackId, TrackStatus};
use crate::tracker::{UsedSighting, same_target};
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

    /// Whether enough cameras agree on it: three, or two for at least `pair_s` seconds. Lines of
    /// two targets, each seen by another one of two cameras, may cross for a while; and what one
    /// camera gave may be clutter, whatever the other one follows meanwhile: any line that lies
    /// near the plane of the other's makes a target with it.
    fn agrees(&self, pair_s: f64, lines: &BTreeMap<&CameraName, LineCounts>) -> bool {
        let cameras = self.cameras();
        if cameras.len() >= 3 {
            return true;
        }
        let all = |camera: &&CameraName| lines.get(*camera).map_or(1, |counts| counts.all);
        let choices: f64 = cameras.iter().map(|camera| log_number(all(camera))).sum();
        let is_sure = |said: &Said| said.evidence >= BEYOND_DOUBT + choices;
        cameras.into_iter().all(|camera| self.said.get(camera).is_some_and(is_sure))
            && self.track.updated_at.seconds_since(self.born) >= pair_s
            && self.track.is_placed()
    }

    /// The cameras in whose views what it is made of stands, if all of it does but for one line at
    /// most, which may be clutter (of two cameras, but for none).
    fn rooted_cameras(&self) -> Option<Vec<&CameraName>> {
        let cameras = self.cameras();
        let clutter = usize::from(cameras.len() > 2);
        let (rooted, others): (Vec<_>, Vec<_>) =
            cameras.into_iter().partition(|camera| self.rooted(camera) == Rooted::Yes);
        (others.len() <= clutter).then_some(rooted)
    }

    /// Whether what stands in the cameras' views explains it: not if so little stands there that it
    /// crosses nowhere by chance. As long as this is unknown of a line (its camera has only begun
    /// to look), two cameras are not enough.
    fn stands(&self, lines: &RootedLines) -> bool {
        let cameras = self.cameras();
        let is_unknown = cameras.iter().any(|camera| self.rooted(camera) == Rooted::Unknown);
        (is_unknown && cameras.len() == 2)
            || self.rooted_cameras().is_some_and(|rooted| lines.may_cross(rooted.into_iter()))
    }

    /// Least log-likelihood ratio of one target against an object per camera with which it is
    /// confirmed: the logarithm of the number of sets of lines that it may have been chosen from by
    /// chance, the product of the numbers of its cameras' lines. What stands in a view is counted
    /// where the hypothesis has such a line, but not for two cameras, of which one line at least
    /// has come or moved: a target that flies slowly passes for standing before one of them, and
    /// would be found ten seconds later. If none of its lines has been seen to come or to move, and
    /// how many things stand in the views is not known yet, it must be a hundred times likelier.
    fn least_one_target_ratio(&self, lines: &BTreeMap<&CameraName, LineCounts>) -> f64 {
        let cameras = self.cameras();
        let moves = cameras.iter().any(|camera| self.rooted(camera) == Rooted::No);
        let choices = cameras.iter().map(|camera| {
            let may_stand = self.rooted(camera) == Rooted::Yes;
            let count_all = may_stand && (cameras.len() > 2 || !moves);
            let number = |counts: &LineCounts| if count_all { counts.all } else { counts.others };
            log_number(lines.get(camera).map_or(1, number))
        });
        let is_unknown = !moves && self.rooted_cameras().is_none();
        choices.sum::<f64>() - if is_unknown { ONE_IN_A_HUNDRED } else { 0.0 }
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

    /// Confirms hypotheses: those of the best set without common lines that are likely enough and
    /// have no rival. The log-likelihood ratio of one target against a target per camera must reach
    /// the logarithm of the number of sets of lines that may look like one target by chance.
    fn confirm(
        &mut self,
        now: Timestamp,
        lines: &BTreeMap<&CameraName, LineCounts>,
        motion: &MotionSetup,
    ) -> Vec<NewTrack> {
        // Sorted by score: the rest have scores of 0 and less, which are never chosen.
        let likely = self.hypotheses.iter().take_while(|h| h.track.score > 0.0);
        let scored = likely.map(|h| ScoredLines { score: h.track.score, lines: &h.lines });
        let selection = Selection::new(scored, self.shared_lines);
        let state = |i: usize| self.hypotheses[i].track.predicted(now, motion);
        let is_likely = |&i: &usize| {
            let hypothesis = &self.hypotheses[i];
            self.is_likely(hypothesis, lines) && !hypothesis.stands(&self.rooted_lines)
        };
        let likely = selection.chosen().filter(is_likely);
        let has_no_rival = |&i: &usize| {
            let own = state(i);
            selection.margin_of(i, |k| same_target(&own, &state(k))) >= BEYOND_DOUBT
        };
        let sure: Vec<usize> = likely.filter(has_no_rival).collect();
        let lines: BTreeSet<LineId> = sure
            .iter()
            .flat_map(|&i| &self.hypotheses[i].lines)
            .map(|line| line.id.clone())
            .collect();
        let starts = sure.iter().map(|&i| self.start(&self.hypotheses[i])).collect();
        if !lines.is_empty() {
            self.hypotheses.retain(|h| h.lines.iter().all(|line| !lines.contains(&line.id)));
        }
        if !self.provisional.is_empty() {
            let alive: BTreeSet<&LineId> =
                self.hypotheses.iter().flat_map(|h| &h.lines).map(|line| &line.id).collect();
            self.provisional.retain(|id, _| alive.contains(id));
        }
        starts
    }

    /// Whether a hypothesis is likely enough to be confirmed if it has no rival, given the numbers
    /// of the cameras' lines.
    fn is_likely(
        &self,
        hypothesis: &Hypothesis,
        lines: &BTreeMap<&CameraName, LineCounts>,
    ) -> bool {
        let least = hypothesis.least_one_target_ratio(lines);
        let is_one = hypothesis.one_target.log_ratio().is_none_or(|ratio| ratio >= least);
        hypothesis.agrees(self.pair_s, lines)
            && is_one
            && hypothesis.track.score >= self.confirm_score
            && hypothesis.periods >= self.needed
    }

    fn start(&self, hypothesis: &Hypothesis) -> NewTrack {
        let mut track = FusedTrack::clone(&hypothesis.track);
        track.status = TrackStatus::Confirmed;
        track.observe();
        let lines = hypothesis.lines.iter();
        let provisional_owners =
            lines.filter_map(|line| self.provisional.get(&line.id)).copied().collect();
        NewTrack { track, cameras: hypothesis.cameras().len(), provisional_owners }
    }
}

/// Numbers of lines of a camera in an exposure.
#[derive(Clone, Copy, Debug, Default)]
struct LineCounts {
    all: usize,
    /// Those of which it is not known that they are of something that stands in its view.
    others: usize,
}

/// Logarithm of a number of lines, of which there is at least one.
fn log_number(lines: usize) -> f64 {
    (lines.max(1) as f64).ln()
}

/// Numbers of lines of each camera in an exposure, the largest of the period.
fn numbers_of_lines<'a>(exposures: &[&'a Exposure]) -> BTreeMap<&'a CameraName, LineCounts> {
    let mut lines: BTreeMap<&CameraName, LineCounts> = BTreeMap::new();
    for exposure in exposures {
        let others = exposure.sightings.iter().filter(|sighting| sighting.rooted != Rooted::Yes);
        let most = lines.entry(&exposure.camera).or_default();
        most.all = most.all.max(exposure.sightings.len());
        most.others = most.others.max(others.count());
    }
    lines
}
