//! Fixes of one period by the papers' spatial processing.

use crossfix_message::{Solver, Timestamp};

use super::grouping::PeriodFix;
use super::{RangeSolution, pair, stacked, triple};
use crate::cameras::Cameras;
use crate::initiation::{NamedLine, SeedFinder, lines_of};
use crate::spatial::{Fix, MapSolution, TimedLine, VelocityKnowledge, map};
use crate::{Exposure, FusionConfig, Initiation, SpatialSolver};

/// Largest speed of a target, in standard deviations of the velocity prior. By the prior one target
/// in 900 is faster; with half of it one in four would be.
pub(super) const SPEED_SIGMAS: f64 = 4.0;

/// Most bearings of each camera that are tried in every combination of three: time is bounded. It
/// is 64 000 combinations; with half of it 8000, and the bearings from the 21st on are not seen.
const MAX_IN_TRIPLES: usize = 40;
/// Most fixes of one period, the first ones: memory is bounded. With half of it the same: only the
/// first 500 are grouped.
const MAX_FIXES: usize = 2_000;

/// Solves periods for fixes by the solver that the configuration names.
#[derive(Debug)]
pub(super) struct FixFinder {
    config: Initiation,
    seeds: SeedFinder,
}

impl FixFinder {
    pub(super) fn new(config: &FusionConfig) -> Self {
        Self { config: config.initiation.clone(), seeds: SeedFinder::of_all(config, 3) }
    }

    /// Every fix that the exposures of one period can make.
    pub(super) fn fixes(&self, exposures: &[&Exposure], cameras: &Cameras) -> Vec<PeriodFix> {
        match self.config.solver {
            SpatialSolver::Pair => self.pair_fixes(exposures),
            SpatialSolver::Triple => self.triple_fixes(exposures),
            SpatialSolver::Stacked => {
                let sets = self.seeds.find(exposures, cameras, None, |_| true).into_iter();
                sets.filter_map(|seed| self.stacked_fix(seed.lines)).collect()
            }
            SpatialSolver::Map => {
                let sets = self.seeds.find(exposures, cameras, None, |_| true).into_iter();
                sets.filter_map(|seed| {
                    let (observability, state) =
                        (seed.solution.observability(), seed.solution.state.clone());
                    let (time, velocity) = (seed.time()?, VelocityKnowledge::Solved);
                    let fix = Fix { time, state, velocity, solver: Solver::Map, observability };
                    Some(PeriodFix { fix, lines: seed.lines })
                })
                .collect()
            }
        }
    }

    /// Klochko 2020, alternative algorithm: all pairs of the first two cameras with `J <= beta`.
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
                if fixes.len() >= MAX_FIXES {
                    return fixes;
                }
                if let Some(mut fix) =
                    self.fix_at(&lines, one.1.time, Solver::Pair, VelocityKnowledge::Unknown)
                {
                    fix.state.mean.fixed_rows_mut::<3>(0).copy_from(&solution.position.coords);
                    // The paper's position, with the covariance of the weighted solution; the pair
                    // knows no velocity.
                    fix.state.mean.fixed_rows_mut::<3>(3).fill(0.0);
                    fixes.push(PeriodFix { fix, lines });
                }
            }
        }
        fixes
    }

    /// Klochko 2020, proposed algorithm: all triples of the first three cameras.
    fn triple_fixes(&self, exposures: &[&Exposure]) -> Vec<PeriodFix> {
        let [first, second, third, ..] = exposures else {
            return Vec::new();
        };
        let mut fixes = Vec::new();
        for one in lines_of(first).take(MAX_IN_TRIPLES) {
            for two in lines_of(second).take(MAX_IN_TRIPLES) {
                for three in lines_of(third).take(MAX_IN_TRIPLES) {
                    if fixes.len() >= MAX_FIXES {
                        return fixes;
                    }
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

    fn stacked_fix(&self, lines: Vec<NamedLine>) -> Option<PeriodFix> {
        let timed: Vec<TimedLine> = lines.iter().map(|(_, line)| line.clone()).collect();
        let solution = stacked(&timed, self.config.velocity_prior_sd_mps)?;
        self.range_fix(lines, &solution, Solver::Stacked)
    }

    /// The fix of a solution for ranges and velocity; `None` if a range or the speed is impossible.
    fn range_fix(
        &self,
        lines: Vec<NamedLine>,
        solution: &RangeSolution,
        solver: Solver,
    ) -> Option<PeriodFix> {
        let max_speed = SPEED_SIGMAS * self.config.velocity_prior_sd_mps;
        if !self.in_range(&solution.ranges) || solution.velocity.norm() > max_speed {
            return None;
        }
        let solver = if solution.observability.is_full() { solver } else { Solver::PseudoInverse };
        let mut fix =
            self.fix_at(&lines, lines.first()?.1.time, solver, VelocityKnowledge::Solved)?;
        fix.state.mean.fixed_rows_mut::<3>(0).copy_from(&solution.position.coords);
        fix.state.mean.fixed_rows_mut::<3>(3).copy_from(&solution.velocity);
        fix.observability = solution.observability;
        Some(PeriodFix { fix, lines })
    }

    /// A fix with the covariance that the lines' noise and the velocity prior give at `time`.
    fn fix_at(
        &self,
        lines: &[NamedLine],
        time: Timestamp,
        solver: Solver,
        velocity: VelocityKnowledge,
    ) -> Option<Fix> {
        let solution = self.solve(lines, time)?;
        let (observability, state) = (solution.observability(), solution.state);
        Some(Fix { time, state, velocity, solver, observability })
    }

    fn solve(&self, lines: &[NamedLine], time: Timestamp) -> Option<MapSolution> {
        let timed: Vec<TimedLine> = lines.iter().map(|(_, line)| line.clone()).collect();
        map(&timed, time, self.config.velocity_prior_sd_mps)
    }

    fn in_range(&self, ranges: &[f64]) -> bool {
        ranges.iter().all(|range| (0.0..self.config.max_range_m).contains(range))
    }
}
