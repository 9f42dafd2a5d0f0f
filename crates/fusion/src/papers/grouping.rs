//! Klochko's temporal processing: fixes of successive periods are grouped by their residual from
//! the group's extrapolation, with an accumulated indicator, and the best groups without common
//! sight lines are handed over (Klochko 2020, temporal processing of both algorithms).
//!
//! The number of targets, the paper's `m^` (step 5 of the alternative algorithm, step 4 of the
//! proposed one), is the number of groups selected by this rule: of the groups with enough fixes,
//! in the order of their indicators, each that shares at most `shared_lines` sight lines with all
//! those selected before it together. With no sharing allowed it cannot exceed the number of lines
//! of any camera.

use std::collections::BTreeSet;

use nalgebra::{Point3, Vector3};

use crate::spatial::{Fix, LineId, TimedLine, VelocityKnowledge};

/// Most groups kept from one period to the next, the best ones: clutter cannot fill the memory.
/// With half of it a young group of a target is pushed out by half as many groups of clutter.
const MAX_GROUPS: usize = 5_000;
/// Most fixes of one period that are grouped, the first ones: with [`MAX_GROUPS`] it bounds the
/// time. With half of it a target whose fix is the 251st is not found.
const MAX_FIXES: usize = 500;

/// A fix with the sight lines that it was made of.
#[derive(Clone, Debug, PartialEq)]
pub struct PeriodFix {
    /// The fix.
    pub fix: Fix,
    /// Its lines, one per camera.
    pub lines: Vec<(LineId, TimedLine)>,
}

/// Fixes that may be of one target, at most one per period.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// In order of time.
    pub fixes: Vec<PeriodFix>,
    /// The accumulated indicator `J_k`: the sum of the residuals.
    pub indicator: f64,
    first_period: u64,
}

/// Gate for a fix that continues a group.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TemporalGate {
    /// The papers': a distance in metres, which is also what is summed in the indicator.
    Distance(f64),
    /// A threshold on the squared Mahalanobis distance, with the covariances of group and fix and
    /// white acceleration of a spectral density (m^2/s^3).
    Covariance {
        /// The threshold, three degrees of freedom.
        threshold: f64,
        /// Power spectral density of the acceleration.
        density: f64,
    },
}

/// How fixes are grouped.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroupingRules {
    /// Most periods that a group may span, `N`.
    pub periods: usize,
    /// Number of fixes from which a group is good enough.
    pub fixes: usize,
    /// Gate for a fix that continues a group.
    pub gate: TemporalGate,
    /// Largest speed of a target, m/s: limits the second fix where the first has no velocity.
    pub max_speed: f64,
    /// Most sight lines that a selected group may share with those selected before it: the paper's
    /// "small number of crossings", for targets that a camera saw as one.
    pub shared_lines: usize,
}

/// The groups that are open, from period to period.
#[derive(Clone, Debug)]
pub struct Grouping {
    rules: GroupingRules,
    groups: Vec<Group>,
    period: u64,
    targets: usize,
}

impl Group {
    fn last(&self) -> &PeriodFix {
        // A group is made with a fix and only grows.
        &self.fixes[self.fixes.len() - 1]
    }

    /// The group's position at the time of its last fix, and its velocity: those of the fix itself
    /// where it has a velocity (Klochko 2020, proposed algorithm, step 3), or of the line through
    /// all vectors of the group (alternative algorithm, steps 1 and 4). `None` for a single fix
    /// without a velocity.
    fn trajectory(&self) -> Option<(Point3<f64>, Vector3<f64>)> {
        let state = &self.last().fix.state;
        match self.last().fix.velocity {
            VelocityKnowledge::Solved => Some((state.position(), state.velocity())),
            VelocityKnowledge::Unknown => self.fitted_line(),
        }
    }

    /// Least-squares line of the positions over time, at the time of the last.
    fn fitted_line(&self) -> Option<(Point3<f64>, Vector3<f64>)> {
        let newest = self.last().fix.time;
        let times: Vec<f64> = self.fixes.iter().map(|f| f.fix.time.seconds_since(newest)).collect();
        let count = times.len() as f64;
        let mean_time = times.iter().sum::<f64>() / count;
        let positions = || self.fixes.iter().map(|f| f.fix.state.position().coords);
        let mean = positions().sum::<Vector3<f64>>() / count;
        let spread: f64 = times.iter().map(|t| (t - mean_time).powi(2)).sum();
        (spread > 0.0).then(|| {
            // v = sum of (t - mean) p / sum of (t - mean)^2.
            let weighted = positions().zip(&times).map(|(position, t)| position * (t - mean_time));
            let velocity = weighted.sum::<Vector3<f64>>() / spread;
            // p(0) = mean p - v mean t, with times counted from the last fix.
            (Point3::from(mean - velocity * mean_time), velocity)
        })
    }

    fn lines(&self) -> BTreeSet<&LineId> {
        self.fixes.iter().flat_map(|fix| &fix.lines).map(|(id, _)| id).collect()
    }

    fn shares(&self, taken: &BTreeSet<LineId>) -> usize {
        self.lines().into_iter().filter(|id| taken.contains(id)).count()
    }
}

/// A group as it would be, before it is made: where all fixes are alike there are millions.
#[derive(Clone, Copy, Debug)]
struct CandidateGroup {
    fixes: usize,
    indicator: f64,
    from: GroupOrigin,
}

/// What a group of a period is made of, by indices; of equally good ones the earlier is better.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum GroupOrigin {
    /// A group of the periods before, as it was.
    Old { group: usize },
    /// Such a group with one fix more.
    Longer { group: usize, fix: usize },
    /// One fix alone.
    New { fix: usize },
}

/// Keeps the best candidates, those with the most fixes first, then those with the least
/// indicators.
fn keep_best(candidates: &mut Vec<CandidateGroup>) {
    candidates.sort_by(|a, b| {
        b.fixes.cmp(&a.fixes).then(a.indicator.total_cmp(&b.indicator)).then(a.from.cmp(&b.from))
    });
    candidates.truncate(MAX_GROUPS);
}

impl Grouping {
    /// No group yet.
    pub fn new(rules: GroupingRules) -> Self {
        Self { rules, groups: Vec::new(), period: 0, targets: 0 }
    }

    /// The estimate `m^` of the number of targets: how many groups the newest period selected.
    pub fn target_count(&self) -> usize {
        self.targets
    }

    /// Takes in all fixes of one period and returns the groups that are good enough, best first;
    /// groups that share too many lines with them are forgotten.
    pub fn advance(&mut self, fixes: &[PeriodFix]) -> Vec<Group> {
        self.period += 1;
        let oldest = self.period.saturating_sub(self.rules.periods as u64 - 1);
        self.groups.retain(|group| group.first_period >= oldest);

        let fixes = &fixes[..fixes.len().min(MAX_FIXES)];
        self.grow(fixes);
        self.select()
    }

    /// Continues every group with each fix that passes the gate, and without any; every fix begins
    /// a group.
    fn grow(&mut self, fixes: &[PeriodFix]) {
        let mut candidates = Vec::new();
        for (index, group) in self.groups.iter().enumerate() {
            // A group without a fix in this period stays open for the next.
            candidates.push(CandidateGroup {
                fixes: group.fixes.len(),
                indicator: group.indicator,
                from: GroupOrigin::Old { group: index },
            });
            for (place, fix) in fixes.iter().enumerate() {
                if let Some(residual) = self.residual(group, fix) {
                    candidates.push(CandidateGroup {
                        fixes: group.fixes.len() + 1,
                        indicator: group.indicator + residual,
                        from: GroupOrigin::Longer { group: index, fix: place },
                    });
                }
            }
            // Pruned from time to time: the list stays bounded while it is made.
            if candidates.len() > 4 * MAX_GROUPS {
                keep_best(&mut candidates);
            }
        }
        let new = (0..fixes.len()).map(|fix| GroupOrigin::New { fix });
        candidates.extend(new.map(|from| CandidateGroup { fixes: 1, indicator: 0.0, from }));
        keep_best(&mut candidates);
        self.groups = candidates.into_iter().map(|candidate| self.made(candidate, fixes)).collect();
    }

    /// The group of a candidate.
    fn made(&self, candidate: CandidateGroup, fixes: &[PeriodFix]) -> Group {
        match candidate.from {
            GroupOrigin::Old { group } => self.groups[group].clone(),
            GroupOrigin::Longer { group, fix } => {
                let mut longer = self.groups[group].clone();
                longer.fixes.push(fixes[fix].clone());
                longer.indicator = candidate.indicator;
                longer
            }
            GroupOrigin::New { fix } => {
                Group { fixes: vec![fixes[fix].clone()], indicator: 0.0, first_period: self.period }
            }
        }
    }

    /// The residual of a fix from a group's extrapolation, if it passes the gate.
    fn residual(&self, group: &Group, fix: &PeriodFix) -> Option<f64> {
        let last = &group.last().fix;
        let dt = fix.fix.time.seconds_since(last.time);
        if dt <= 0.0 {
            return None;
        }
        let Some((position, velocity)) = group.trajectory() else {
            // Klochko 2020, alternative algorithm, step 1: any pair of the first two periods starts
            // a group.
            let distance = (fix.fix.state.position() - last.state.position()).norm();
            return (distance <= self.rules.max_speed * dt).then_some(0.0);
        };
        let difference = fix.fix.state.position() - (position + velocity * dt);
        match self.rules.gate {
            TemporalGate::Distance(beta) => {
                let distance = difference.norm();
                (distance <= beta).then_some(distance)
            }
            TemporalGate::Covariance { threshold, density } => {
                // Squared Mahalanobis distance, by the covariances of the extrapolation and of the
                // fix.
                let spread = last.state.predicted(dt, density).position_covariance()
                    + fix.fix.state.position_covariance();
                let squared = difference.dot(&spread.cholesky()?.solve(&difference));
                (squared <= threshold).then_some(squared)
            }
        }
    }

    /// Selects the groups of the least indicators that share no lines, or few (Klochko 2020, step 5
    /// of the alternative algorithm and step 4 of the proposed one).
    fn select(&mut self) -> Vec<Group> {
        let good = self.groups.iter().filter(|group| group.fixes.len() >= self.rules.fixes);
        let mut good: Vec<(BTreeSet<&LineId>, &Group)> =
            good.map(|group| (group.lines(), group)).collect();
        good.sort_by(|a, b| a.1.indicator.total_cmp(&b.1.indicator).then_with(|| a.0.cmp(&b.0)));
        let mut taken: BTreeSet<LineId> = BTreeSet::new();
        let mut selected = Vec::new();
        for (lines, group) in good {
            if lines.iter().filter(|id| taken.contains(**id)).count() <= self.rules.shared_lines {
                taken.extend(lines.into_iter().cloned());
                selected.push(group.clone());
            }
        }
        // A group that goes on may share no more lines with the selected ones than a selected one
        // may, and must have others.
        self.groups.retain(|group| {
            let shared = group.shares(&taken);
            shared <= self.rules.shared_lines && (shared == 0 || shared < group.lines().len())
        });
        self.targets = selected.len();
        selected
    }
}

#[cfg(test)]
mod tests {
    use crossfix_filter::KinematicState;
    use crossfix_message::{Solver, Timestamp};
    use nalgebra::{Matrix6, Vector6};

    use super::*;
    use crate::spatial::Observability;

    fn fix(period: u64, x: f64, line: usize, velocity: VelocityKnowledge) -> PeriodFix {
        let line_of = |camera: &str| {
            let timed = crate::spatial::tests_support::line_at(
                Point3::new(0.0, -100.0, 0.0),
                Point3::new(x, 0.0, 0.0),
                period as f64,
            );
            (LineId { camera: camera.parse().unwrap(), sequence: period, index: line }, timed)
        };
        PeriodFix {
            fix: Fix {
                time: Timestamp::from_seconds(period as f64),
                state: KinematicState {
                    mean: Vector6::new(x, 0.0, 0.0, 10.0, 0.0, 0.0),
                    covariance: Matrix6::identity() * 0.01,
                },
                velocity,
                solver: Solver::Triple,
                observability: Observability::full(6, 1.0),
            },
            lines: vec![line_of("a"), line_of("b")],
        }
    }

    fn grouping(gate: TemporalGate) -> Grouping {
        Grouping::new(GroupingRules {
            periods: 5,
            fixes: 3,
            gate,
            max_speed: 60.0,
            shared_lines: 0,
        })
    }

    #[test]
    fn a_target_is_found_and_its_ghost_that_shares_lines_is_not() {
        let mut grouping = grouping(TemporalGate::Distance(4.0));
        let mut found = Vec::new();
        for period in 0..3 {
            let x = 10.0 * period as f64;
            let truth = fix(period, x, 0, VelocityKnowledge::Solved);
            // The ghost uses the same lines and wanders.
            let ghost = fix(period, x + 1.0 + period as f64, 0, VelocityKnowledge::Solved);
            found = grouping.advance(&[ghost, truth]);
        }
        assert_eq!(found.len(), 1);
        assert!(found[0].indicator < 1e-9, "{}", found[0].indicator);
    }

    #[test]
    fn without_velocity_two_fixes_give_it_and_the_third_must_agree() {
        let mut grouping = grouping(TemporalGate::Distance(1.0));
        assert!(grouping.advance(&[fix(0, 0.0, 0, VelocityKnowledge::Unknown)]).is_empty());
        assert!(grouping.advance(&[fix(1, 7.0, 0, VelocityKnowledge::Unknown)]).is_empty());
        assert!(
            grouping.clone().advance(&[fix(2, 20.0, 0, VelocityKnowledge::Unknown)]).is_empty()
        );
        assert_eq!(grouping.advance(&[fix(2, 14.5, 0, VelocityKnowledge::Unknown)]).len(), 1);
    }

    #[test]
    fn a_period_without_a_fix_does_not_end_a_group() {
        let mut grouping = grouping(TemporalGate::Covariance { threshold: 16.3, density: 1.0 });
        assert!(grouping.advance(&[fix(0, 0.0, 0, VelocityKnowledge::Solved)]).is_empty());
        assert!(grouping.advance(&[fix(1, 10.0, 0, VelocityKnowledge::Solved)]).is_empty());
        assert!(grouping.advance(&[]).is_empty());
        assert_eq!(grouping.advance(&[fix(3, 30.0, 0, VelocityKnowledge::Solved)]).len(), 1);
    }

    /// Two targets on straight lines whose fixes share the first camera's line, and not the
    /// second's, in `merged_periods`.
    fn two_that_cross(shared_lines: usize, merged_periods: &[u64]) -> Grouping {
        let rules = GroupingRules {
            periods: 5,
            fixes: 5,
            gate: TemporalGate::Distance(4.0),
            max_speed: 60.0,
            shared_lines,
        };
        let mut grouping = Grouping::new(rules);
        for period in 0..5 {
            let x = 10.0 * period as f64;
            let one = fix(period, x, 0, VelocityKnowledge::Solved);
            let mut other = fix(period, x + 20.0, 1, VelocityKnowledge::Solved);
            if merged_periods.contains(&period) {
                other.lines[0] = one.lines[0].clone();
            }
            grouping.advance(&[one, other]);
        }
        grouping
    }

    #[test]
    fn the_number_of_targets_is_that_of_the_groups_selected() {
        assert_eq!(two_that_cross(0, &[]).target_count(), 2);
        assert_eq!(Grouping::new(grouping(TemporalGate::Distance(1.0)).rules).target_count(), 0);
    }

    #[test]
    fn a_small_number_of_crossings_is_allowed_and_a_larger_is_not() {
        assert_eq!(two_that_cross(0, &[2]).target_count(), 1, "seen as one once, none allowed");
        assert_eq!(two_that_cross(1, &[2]).target_count(), 2, "seen as one once, one allowed");
        assert_eq!(two_that_cross(1, &[2, 3]).target_count(), 1, "seen as one twice, one allowed");
        assert_eq!(two_that_cross(2, &[2, 3]).target_count(), 2);
    }

    #[test]
    fn crossings_are_counted_with_all_groups_before_together() {
        let of = |lines: [usize; 2], period: u64, x: f64| {
            let mut made = fix(period, x, 0, VelocityKnowledge::Solved);
            for (line, number) in made.lines.iter_mut().zip(lines) {
                line.0.index = number;
            }
            made
        };
        let rules = GroupingRules {
            shared_lines: 2,
            fixes: 2,
            ..grouping(TemporalGate::Distance(1.0)).rules
        };
        let mut grouping = Grouping::new(rules);
        grouping.advance(&[of([0, 0], 0, 0.0), of([1, 1], 0, 50.0), of([0, 1], 0, 99.0)]);
        // The third is last in order, as it wanders by half a metre. In each period it shares one
        // line with the first and one with the second: two with each, four in all.
        grouping.advance(&[of([0, 0], 1, 10.0), of([1, 1], 1, 60.0), of([0, 1], 1, 109.5)]);
        assert_eq!(grouping.target_count(), 2);
    }

    #[test]
    fn a_group_without_velocity_is_extrapolated_along_the_line_through_all_its_fixes() {
        let fixes = [(0, 0.0), (1, 1.0), (2, 1.4)]
            .map(|(period, x)| fix(period, x, 0, VelocityKnowledge::Unknown));
        let group = Group { fixes: fixes.to_vec(), indicator: 0.0, first_period: 1 };
        let (position, velocity) = group.trajectory().unwrap();
        assert!((velocity.x - 0.7).abs() < 1e-12 && (position.x - 1.5).abs() < 1e-12);
    }
}
