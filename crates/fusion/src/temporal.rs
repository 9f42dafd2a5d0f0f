//! Temporal processing: fixes of successive periods are grouped by the
//! residual from the group's extrapolation, with an accumulated indicator, and
//! the best groups without common sight lines are handed over (002, temporal
//! processing of both algorithms).

use std::collections::BTreeSet;

use crossfix_message::CameraName;
use nalgebra::{Point3, Vector3};

use crate::spatial::{Fix, TimedLine, VelocityKnowledge};

/// Groups kept from one period to the next: the best ones, so that clutter cannot fill the memory.
const MAX_GROUPS: usize = 5_000;

/// A sight line's name: camera, sequence number of the frame, place in the frame.
pub type LineId = (CameraName, u64, usize);

/// A fix with the sight lines that it was made of.
#[derive(Clone, Debug, PartialEq)]
pub struct PeriodFix {
    /// The fix.
    pub fix: Fix,
    /// Its lines, one a camera.
    pub lines: Vec<(LineId, TimedLine)>,
}

/// Fixes that may be one target's, one a period at most.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// In order of time.
    pub fixes: Vec<PeriodFix>,
    /// The accumulated indicator `J_k`: the sum of the residuals.
    pub indicator: f64,
    first_period: u64,
}

/// What may continue a group.
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
    /// Periods that a group may span, `N`.
    pub periods: usize,
    /// Fixes that make a group good enough.
    pub fixes: usize,
    /// What may continue a group.
    pub gate: TemporalGate,
    /// The fastest target, m/s: limits the second fix where the first has no velocity.
    pub max_speed: f64,
    /// How many lines two selected groups may share.
    pub shared_lines: usize,
}

/// The groups that are open, from period to period.
#[derive(Clone, Debug)]
pub struct Grouping {
    rules: GroupingRules,
    groups: Vec<Group>,
    period: u64,
}

impl Group {
    fn last(&self) -> &PeriodFix {
        // A group is made with a fix and only grows.
        &self.fixes[self.fixes.len() - 1]
    }

    /// The velocity to extrapolate with: the fix's own, or the line through the group's fixes.
    fn velocity(&self) -> Option<Vector3<f64>> {
        match self.last().fix.velocity {
            VelocityKnowledge::Solved => Some(self.last().fix.state.velocity()),
            VelocityKnowledge::Unknown => self.fitted_velocity(),
        }
    }

    /// Slope of the positions over time by least squares, over all vectors of the group.
    fn fitted_velocity(&self) -> Option<Vector3<f64>> {
        let reference = self.last().fix.time;
        let times: Vec<f64> = self.fixes.iter().map(|f| f.fix.time.seconds_since(reference)).collect();
        let mean_time = times.iter().sum::<f64>() / times.len() as f64;
        let spread: f64 = times.iter().map(|t| (t - mean_time).powi(2)).sum();
        (spread > 0.0).then(|| {
            let weighted =
                self.fixes.iter().zip(&times).map(|(f, t)| f.fix.state.position().coords * (t - mean_time));
            weighted.sum::<Vector3<f64>>() / spread
        })
    }

    fn lines(&self) -> BTreeSet<&LineId> {
        self.fixes.iter().flat_map(|fix| &fix.lines).map(|(id, _)| id).collect()
    }

    fn shares(&self, taken: &BTreeSet<LineId>) -> usize {
        self.lines().into_iter().filter(|id| taken.contains(id)).count()
    }
}

impl Grouping {
    /// No group yet.
    pub fn new(rules: GroupingRules) -> Self {
        Self { rules, groups: Vec::new(), period: 0 }
    }

    /// Takes in all fixes of one period and returns the groups that are good enough, best first;
    /// what shares a line with them is forgotten.
    pub fn advance(&mut self, fixes: &[PeriodFix]) -> Vec<Group> {
        self.period += 1;
        let oldest = self.period.saturating_sub(self.rules.periods as u64 - 1);
        self.groups.retain(|group| group.first_period >= oldest);

        let mut grown = Vec::new();
        for group in &self.groups {
            for fix in fixes {
                if let Some(residual) = self.residual(group, fix) {
                    let mut longer = group.clone();
                    longer.fixes.push(fix.clone());
                    longer.indicator += residual;
                    grown.push(longer);
                }
            }
        }
        grown.extend(fixes.iter().map(|fix| Group {
            fixes: vec![fix.clone()],
            indicator: 0.0,
            first_period: self.period,
        }));
        // A group without a fix in this period stays open for the next.
        self.groups.append(&mut grown);
        self.groups
            .sort_by(|a, b| b.fixes.len().cmp(&a.fixes.len()).then(a.indicator.total_cmp(&b.indicator)));
        self.groups.truncate(MAX_GROUPS);
        self.select()
    }

    /// The residual of a fix from a group's extrapolation, if it passes the gate.
    fn residual(&self, group: &Group, fix: &PeriodFix) -> Option<f64> {
        let last = &group.last().fix;
        let dt = fix.fix.time.seconds_since(last.time);
        if dt <= 0.0 {
            return None;
        }
        let Some(velocity) = group.velocity() else {
            // 002, alternative algorithm, step 1: any pair of the first two periods starts a group.
            let distance = (fix.fix.state.position() - last.state.position()).norm();
            return (distance <= self.rules.max_speed * dt).then_some(0.0);
        };
        let predicted: Point3<f64> = last.state.position() + velocity * dt;
        let difference = fix.fix.state.position() - predicted;
        match self.rules.gate {
            TemporalGate::Distance(beta) => {
                let distance = difference.norm();
                (distance <= beta).then_some(distance)
            }
            TemporalGate::Covariance { threshold, density } => {
                let spread = last.state.predicted(dt, density).position_covariance()
                    + fix.fix.state.position_covariance();
                let squared = difference.dot(&spread.cholesky()?.solve(&difference));
                (squared <= threshold).then_some(squared)
            }
        }
    }

    /// The groups with the least indicators that share no lines (002, step 5 and step 4).
    fn select(&mut self) -> Vec<Group> {
        let mut good: Vec<&Group> =
            self.groups.iter().filter(|group| group.fixes.len() >= self.rules.fixes).collect();
        good.sort_by(|a, b| a.indicator.total_cmp(&b.indicator).then_with(|| a.lines().cmp(&b.lines())));
        let mut taken: BTreeSet<LineId> = BTreeSet::new();
        let mut selected = Vec::new();
        for group in good {
            if group.shares(&taken) <= self.rules.shared_lines {
                taken.extend(group.lines().into_iter().cloned());
                selected.push(group.clone());
            }
        }
        self.groups.retain(|group| group.shares(&taken) == 0);
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
            ((camera.parse().unwrap(), period, line), timed)
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
                observability: Observability { rank: 6, unknowns: 6, condition_number: 1.0 },
            },
            lines: vec![line_of("a"), line_of("b")],
        }
    }

    fn grouping(gate: TemporalGate) -> Grouping {
        Grouping::new(GroupingRules { periods: 5, fixes: 3, gate, max_speed: 60.0, shared_lines: 0 })
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
        assert!(grouping.clone().advance(&[fix(2, 20.0, 0, VelocityKnowledge::Unknown)]).is_empty());
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
}
