//! New tracks: bearings that belong to no track are gathered into observation
//! periods, solved for fixes, and the fixes are grouped.

use std::collections::{BTreeMap, VecDeque};

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Solver, Timestamp};
use nalgebra::{Matrix2x6, Vector2};
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::config::Tracking;
use crate::spatial::{
    Fix, MapSolution, RangeSolution, TimedLine, VAGUE_VELOCITY_SD, VelocityKnowledge, map, pair, stacked,
    triple,
};
use crate::temporal::{Group, Grouping, GroupingRules, LineId, PeriodFix, TemporalGate};
use crate::{Exposure, Initiation, Sighting, SpatialSolver};

/// A target is not faster than this many standard deviations of the velocity prior.
const SPEED_SIGMAS: f64 = 4.0;
/// A camera whose newest exposure is older than this many frame intervals of another is silent.
const SILENT_INTERVALS: f64 = 5.0;
/// A period is closed where the exposures lie within this factor of as close as they ever do.
const SPREAD_FACTOR: f64 = 1.2;

/// The squared distance that a true value of `dof` dimensions stays within with probability `p`.
fn chi_square(p: f64, dof: usize) -> f64 {
    // A positive number of degrees of freedom is all that the distribution asks for.
    ChiSquared::new(dof as f64).map_or(f64::INFINITY, |distribution| distribution.inverse_cdf(p))
}

/// Finds new targets among the bearings that no track claims.
#[derive(Debug)]
pub(crate) struct Initiator {
    config: Initiation,
    grouping: Grouping,
    /// The newest exposure of each camera that no period has used.
    unused: BTreeMap<CameraName, Exposure>,
    heard: BTreeMap<CameraName, Timestamp>,
    /// How far apart the cameras' newest exposures lay, s, at each of the last exposures.
    spreads: VecDeque<f64>,
    closed: Option<Timestamp>,
    pair_gate: f64,
}

impl Initiator {
    pub(crate) fn new(config: Initiation, tracking: &Tracking) -> Self {
        let gate = match config.temporal_gate_m {
            Some(beta) => TemporalGate::Distance(beta),
            None => TemporalGate::Covariance {
                threshold: chi_square(config.spatial_gate_probability, 3),
                density: tracking.acceleration_density,
            },
        };
        let rules = GroupingRules {
            periods: config.periods,
            fixes: config.fixes,
            gate,
            max_speed: SPEED_SIGMAS * config.velocity_prior_sd_mps,
            shared_lines: config.shared_lines,
        };
        let pair_gate = chi_square(config.spatial_gate_probability, 2);
        Self {
            config,
            grouping: Grouping::new(rules),
            unused: BTreeMap::new(),
            heard: BTreeMap::new(),
            spreads: VecDeque::new(),
            closed: None,
            pair_gate,
        }
    }

    /// Takes in what an exposure has left over and returns the groups that are new targets.
    ///
    /// A period holds one exposure of each camera that is heard. It is closed where these lie
    /// closest together, which for cameras that scan in turn is at the end of a scan.
    pub(crate) fn add(&mut self, exposure: Exposure) -> Vec<Group> {
        let now = exposure.time;
        let previous = self.heard.insert(exposure.camera.clone(), now);
        self.unused.insert(exposure.camera.clone(), exposure);
        if let Some(interval) = previous.map(|time| now.seconds_since(time)) {
            self.heard.retain(|_, time| now.seconds_since(*time) <= SILENT_INTERVALS * interval);
        }
        let needed = if self.config.solver == SpatialSolver::Pair { 2 } else { 3 };
        let spread_of = |oldest: Option<Timestamp>| oldest.map_or(0.0, |time| now.seconds_since(time));
        if self.heard.len() < needed {
            return Vec::new();
        }
        self.spreads.push_back(spread_of(self.heard.values().min().copied()));
        while self.spreads.len() > 2 * self.heard.len() {
            self.spreads.pop_front();
        }
        let closest = self.spreads.iter().copied().fold(f64::INFINITY, f64::min);
        let (unused, heard) = (&mut self.unused, &self.heard);
        unused.retain(|camera, _| heard.contains_key(camera));
        let complete = unused.len() == heard.len();
        let spread = spread_of(unused.values().map(|exposure| exposure.time).min());
        let long_enough = self.closed.is_none_or(|closed| now.seconds_since(closed) >= self.config.period_s);
        if !(complete && long_enough && spread <= closest * SPREAD_FACTOR) {
            return Vec::new();
        }
        self.closed = Some(now);
        let period = std::mem::take(&mut self.unused);
        let exposures: Vec<&Exposure> = period.values().collect();
        let fixes = self.fixes(&exposures);
        self.grouping.advance(&fixes)
    }

    /// Every fix that the exposures of one period can make.
    fn fixes(&self, exposures: &[&Exposure]) -> Vec<PeriodFix> {
        match self.config.solver {
            SpatialSolver::Pair => self.pair_fixes(exposures),
            SpatialSolver::Triple => self.triple_fixes(exposures),
            SpatialSolver::Stacked => {
                let sets = self.combinations(exposures);
                sets.into_iter().filter_map(|lines| self.stacked_fix(lines)).collect()
            }
            SpatialSolver::Map => {
                let sets = self.combinations(exposures);
                sets.into_iter().filter_map(|lines| self.map_fix(lines)).collect()
            }
        }
    }

    /// 002, alternative algorithm: all pairs of the first two cameras with `J <= beta`.
    fn pair_fixes(&self, exposures: &[&Exposure]) -> Vec<PeriodFix> {
        let [first, second, ..] = exposures else {
            return Vec::new();
        };
        let mut fixes = Vec::new();
        for one in lines_of(first) {
            for two in lines_of(second) {
                let Some(solution) = pair(&one.1, &two.1, nalgebra::Vector3::zeros()) else {
                    continue;
                };
                let ranges = [solution.first_range, solution.second_range];
                if solution.indicator > self.config.pair_gate_m2 || !self.in_range(&ranges) {
                    continue;
                }
                let lines = vec![one.clone(), two];
                if let Some(mut fix) =
                    self.fix_at(&lines, one.1.time, Solver::Pair, VelocityKnowledge::Unknown)
                {
                    fix.state.mean.fixed_rows_mut::<3>(0).copy_from(&solution.position.coords);
                    fix.state.mean.fixed_rows_mut::<3>(3).fill(0.0);
                    fixes.push(PeriodFix { fix, lines });
                }
            }
        }
        fixes
    }

    /// 002, proposed algorithm: all triples of the first three cameras.
    fn triple_fixes(&self, exposures: &[&Exposure]) -> Vec<PeriodFix> {
        let [first, second, third, ..] = exposures else {
            return Vec::new();
        };
        let mut fixes = Vec::new();
        for one in lines_of(first) {
            for two in lines_of(second) {
                for three in lines_of(third) {
                    let lines = vec![one.clone(), two.clone(), three];
                    let timed = [&lines[0].1, &lines[1].1, &lines[2].1];
                    if let Some(solution) = triple(timed, self.config.velocity_prior_sd_mps) {
                        fixes.extend(self.range_fix(lines, &solution, Solver::Triple));
                    }
                }
            }
        }
        fixes
    }

    fn stacked_fix(&self, lines: Vec<(LineId, TimedLine)>) -> Option<PeriodFix> {
        let timed: Vec<TimedLine> = lines.iter().map(|(_, line)| line.clone()).collect();
        let solution = stacked(&timed, self.config.velocity_prior_sd_mps)?;
        self.range_fix(lines, &solution, Solver::Stacked)
    }

    /// The fix of a solution for ranges and velocity, if it is possible.
    fn range_fix(
        &self,
        lines: Vec<(LineId, TimedLine)>,
        solution: &RangeSolution,
        solver: Solver,
    ) -> Option<PeriodFix> {
        let max_speed = SPEED_SIGMAS * self.config.velocity_prior_sd_mps;
        if !self.in_range(&solution.ranges) || solution.velocity.norm() > max_speed {
            return None;
        }
        let solver = if solution.observability.is_full() { solver } else { Solver::PseudoInverse };
        let mut fix = self.fix_at(&lines, lines.first()?.1.time, solver, VelocityKnowledge::Solved)?;
        fix.state.mean.fixed_rows_mut::<3>(0).copy_from(&solution.position.coords);
        fix.state.mean.fixed_rows_mut::<3>(3).copy_from(&solution.velocity);
        fix.observability = solution.observability;
        Some(PeriodFix { fix, lines })
    }

    /// A fix with the covariance that the lines' noise and the velocity prior give at `time`.
    fn fix_at(
        &self,
        lines: &[(LineId, TimedLine)],
        time: Timestamp,
        solver: Solver,
        velocity: VelocityKnowledge,
    ) -> Option<Fix> {
        let MapSolution { state, observability, .. } = self.solve(lines, time)?;
        Some(Fix { time, state, velocity, solver, observability })
    }

    fn solve(&self, lines: &[(LineId, TimedLine)], time: Timestamp) -> Option<MapSolution> {
        let timed: Vec<TimedLine> = lines.iter().map(|(_, line)| line.clone()).collect();
        map(&timed, time, self.config.velocity_prior_sd_mps)
    }

    fn map_fix(&self, lines: Vec<(LineId, TimedLine)>) -> Option<PeriodFix> {
        let time = lines.iter().map(|(_, line)| line.time).max()?;
        let solution = self.solve(&lines, time)?;
        let position = solution.state.position();
        let ranges: Vec<f64> = lines.iter().map(|(_, l)| (position - l.line.origin).norm()).collect();
        let gate = chi_square(self.config.spatial_gate_probability, 2 * lines.len() - 3);
        if solution.chi_square > gate || !self.in_range(&ranges) {
            return None;
        }
        let MapSolution { state, observability, .. } = solution;
        let fix =
            Fix { time, state, velocity: VelocityKnowledge::Solved, solver: Solver::Map, observability };
        Some(PeriodFix { fix, lines })
    }

    fn in_range(&self, ranges: &[f64]) -> bool {
        ranges.iter().all(|range| (0.0..self.config.max_range_m).contains(range))
    }

    /// Sets of lines of three and more cameras that may meet: every pair of lines that pass each
    /// other closely enough, with every line of a later camera in its gate, and then the best line
    /// of each camera after that.
    fn combinations(&self, exposures: &[&Exposure]) -> Vec<Vec<(LineId, TimedLine)>> {
        let cameras: Vec<Vec<(LineId, TimedLine)>> =
            exposures.iter().map(|e| lines_of(e).collect()).collect();
        let mut sets = Vec::new();
        for (a, first_camera) in cameras.iter().enumerate() {
            for (b, second_camera) in cameras.iter().enumerate().skip(a + 1) {
                for first in first_camera {
                    for second in second_camera {
                        if let Some(seed) = self.seed(first, second) {
                            self.extend_seed(
                                &[first.clone(), second.clone()],
                                &seed,
                                &cameras[b + 1..],
                                &mut sets,
                            );
                        }
                    }
                }
            }
        }
        sets
    }

    /// The solution of two lines, if they pass each other as closely as one target's may.
    fn seed(
        &self,
        (_, first): &(LineId, TimedLine),
        (_, second): &(LineId, TimedLine),
    ) -> Option<MapSolution> {
        let solution = pair(first, second, nalgebra::Vector3::zeros())?;
        let ranges = [solution.first_range, solution.second_range];
        let noise = first.line.standard_deviation() * ranges[0].abs()
            + second.line.standard_deviation() * ranges[1].abs();
        let motion = self.config.velocity_prior_sd_mps * second.time.seconds_since(first.time).abs();
        let near_enough = solution.indicator.sqrt() <= SPEED_SIGMAS * (noise + motion);
        let slack = self.config.max_range_m;
        if !near_enough || !ranges.iter().all(|range| (0.0..slack).contains(range)) {
            return None;
        }
        map(&[first.clone(), second.clone()], second.time, self.config.velocity_prior_sd_mps)
    }

    fn extend_seed(
        &self,
        seed_lines: &[(LineId, TimedLine)],
        seed: &MapSolution,
        later: &[Vec<(LineId, TimedLine)>],
        sets: &mut Vec<Vec<(LineId, TimedLine)>>,
    ) {
        let reference = seed_lines[seed_lines.len() - 1].1.time;
        for (c, camera) in later.iter().enumerate() {
            for third in camera {
                if gate_distance(seed, reference, &third.1).is_none_or(|d| d > self.pair_gate) {
                    continue;
                }
                let mut lines = seed_lines.to_vec();
                lines.push(third.clone());
                for further in &later[c + 1..] {
                    let Some(solution) = self.solve(&lines, reference) else {
                        break;
                    };
                    let near = further.iter().filter_map(|line| {
                        let distance = gate_distance(&solution, reference, &line.1)?;
                        (distance <= self.pair_gate).then_some((distance, line))
                    });
                    if let Some((_, line)) = near.min_by(|x, y| x.0.total_cmp(&y.0)) {
                        lines.push(line.clone());
                    }
                }
                sets.push(lines);
            }
        }
    }
}

/// An exposure's sight lines with their names.
fn lines_of(exposure: &Exposure) -> impl Iterator<Item = (LineId, TimedLine)> + '_ {
    exposure.sightings.iter().enumerate().map(|(index, Sighting { line, .. })| {
        let id = (exposure.camera.clone(), exposure.sequence, index);
        (id, TimedLine { line: *line, time: exposure.time })
    })
}

/// Squared Mahalanobis distance of a line from a solution, two degrees of freedom.
fn gate_distance(solution: &MapSolution, reference: Timestamp, line: &TimedLine) -> Option<f64> {
    let dt = line.time.seconds_since(reference);
    let state = solution.state.predicted(dt, 0.0);
    let SightLine { origin, basis, covariance, .. } = line.line;
    let range = (state.position() - origin).norm();
    let offset: Vector2<f64> = line.line.tangent_offset(state.position())?;
    let mut jacobian = Matrix2x6::zeros();
    jacobian.fixed_view_mut::<2, 3>(0, 0).copy_from(&(basis.transpose() / range));
    let spread = jacobian * state.covariance * jacobian.transpose() + covariance;
    Some(offset.dot(&spread.cholesky()?.solve(&offset)))
}

/// The fix that a new track starts from, and the lines of the group's later fixes to take in.
pub(crate) fn starting_point(group: &Group) -> Option<(&Fix, Vec<&(LineId, TimedLine)>)> {
    let (first, later) = group.fixes.split_first()?;
    let mut lines: Vec<&(LineId, TimedLine)> = later.iter().flat_map(|fix| &fix.lines).collect();
    lines.sort_by(|a, b| a.1.time.cmp(&b.1.time).then_with(|| a.0.cmp(&b.0)));
    Some((&first.fix, lines))
}

/// The covariance of a fix without a velocity says so: the prior is replaced by a vague one.
pub(crate) fn vague_velocity(fix: &Fix) -> crossfix_filter::KinematicState {
    let mut state = fix.state.clone();
    if fix.velocity == VelocityKnowledge::Unknown {
        state.covariance.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
        state.covariance.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
        let mut velocity = state.covariance.fixed_view_mut::<3, 3>(3, 3);
        velocity.fill_with_identity();
        velocity.scale_mut(VAGUE_VELOCITY_SD.powi(2) / 9.0);
    }
    state
}
