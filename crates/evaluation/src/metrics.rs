use std::collections::{BTreeMap, BTreeSet};

use crossfix_filter::KinematicState;
use nalgebra::{Point3, Vector3, Vector6};
use pathfinding::prelude::{Matrix, kuhn_munkres_min};
use serde::Serialize;

/// Costs are quantised for the assignment: a millionth of the cut-off.
const COST_SCALE: f64 = 1e6;

/// Where a target really is.
#[derive(Clone, Debug, PartialEq)]
pub struct TrueTarget {
    /// Its number.
    pub id: u64,
    /// Metres, world.
    pub position: Point3<f64>,
    /// Metres a second, world.
    pub velocity: Vector3<f64>,
}

/// Where a track says that a target is.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// The track's number.
    pub id: u64,
    /// Its state.
    pub state: KinematicState,
}

/// One target's figures.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TargetReport {
    /// The target.
    pub target: u64,
    /// Whether any track was ever paired with it.
    pub detected: bool,
    /// Share of the instants at which a track was paired with it.
    pub share_tracked: f64,
    /// Root mean squared position error, m.
    pub position_rmse_m: Option<f64>,
    /// Root mean squared velocity error, m/s.
    pub velocity_rmse_mps: Option<f64>,
    /// Mean normalised estimation error squared; 6 is honest.
    pub mean_nees: Option<f64>,
    /// How often another track took it over.
    pub id_switches: u64,
}

/// All figures of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Instants compared.
    pub instants: u64,
    /// The distance beyond which a track is not a target's, m.
    pub cutoff_m: f64,
    /// Root mean squared position error of the pairs, m.
    pub position_rmse_m: Option<f64>,
    /// Root mean squared velocity error of the pairs, m/s.
    pub velocity_rmse_mps: Option<f64>,
    /// Mean normalised estimation error squared; 6 is honest.
    pub mean_nees: Option<f64>,
    /// Share of target instants with a track.
    pub completeness: f64,
    /// Mean number of tracks without a target.
    pub false_tracks_per_instant: f64,
    /// Tracks that were never any target's.
    pub false_tracks: u64,
    /// How often a target was taken over by another track.
    pub id_switches: u64,
    /// Mean OSPA distance (order 2), m.
    pub ospa_m: f64,
    /// Mean GOSPA distance (order 2, alpha 2), m.
    pub gospa_m: f64,
    /// Per target, ordered by id.
    pub targets: Vec<TargetReport>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    position: f64,
    velocity: f64,
    nees: f64,
    pairs: u64,
}

impl Sums {
    fn add(&mut self, truth: &TrueTarget, state: &KinematicState) {
        let position = state.position() - truth.position;
        let velocity = state.velocity() - truth.velocity;
        self.position += position.norm_squared();
        self.velocity += velocity.norm_squared();
        let error = Vector6::from_iterator(position.iter().chain(velocity.iter()).copied());
        // A covariance that cannot be inverted is not honest at any error.
        self.nees += state.covariance.cholesky().map_or(f64::INFINITY, |c| error.dot(&c.solve(&error)));
        self.pairs += 1;
    }

    fn mean(&self, sum: f64) -> Option<f64> {
        (self.pairs > 0).then(|| sum / self.pairs as f64)
    }

    fn root_mean(&self, sum: f64) -> Option<f64> {
        self.mean(sum).map(f64::sqrt)
    }
}

#[derive(Clone, Debug, Default)]
struct Target {
    sums: Sums,
    instants: u64,
    last_track: Option<u64>,
    switches: u64,
}

/// Holds tracks against truth, instant by instant.
#[derive(Clone, Debug)]
pub struct Evaluator {
    cutoff: f64,
    instants: u64,
    targets: BTreeMap<u64, Target>,
    all: Sums,
    false_instants: u64,
    tracks: BTreeSet<u64>,
    true_tracks: BTreeSet<u64>,
    ospa: f64,
    gospa: f64,
}

impl Evaluator {
    /// Pairs farther apart than `cutoff_m` are no pairs; it is also OSPA's and GOSPA's c.
    pub fn new(cutoff_m: f64) -> Self {
        Self {
            cutoff: cutoff_m,
            instants: 0,
            targets: BTreeMap::new(),
            all: Sums::default(),
            false_instants: 0,
            tracks: BTreeSet::new(),
            true_tracks: BTreeSet::new(),
            ospa: 0.0,
            gospa: 0.0,
        }
    }

    /// Compares one instant.
    pub fn add(&mut self, truth: &[TrueTarget], estimates: &[Estimate]) {
        self.instants += 1;
        self.tracks.extend(estimates.iter().map(|estimate| estimate.id));
        let mut squares = 0.0;
        let pairs = self.pair(truth, estimates);
        for (target, partner) in truth.iter().zip(&pairs) {
            let entry = self.targets.entry(target.id).or_default();
            entry.instants += 1;
            let Some(estimate) = partner.map(|index| &estimates[index]) else {
                continue;
            };
            entry.sums.add(target, &estimate.state);
            self.all.add(target, &estimate.state);
            self.true_tracks.insert(estimate.id);
            if entry.last_track.is_some_and(|last| last != estimate.id) {
                entry.switches += 1;
            }
            entry.last_track = Some(estimate.id);
            squares += (estimate.state.position() - target.position).norm_squared();
        }
        let paired = pairs.iter().flatten().count();
        let (missed, false_ones) = (truth.len() - paired, estimates.len() - paired);
        self.false_instants += false_ones as u64;
        let c2 = self.cutoff.powi(2);
        self.gospa += (squares + c2 / 2.0 * (missed + false_ones) as f64).sqrt();
        let larger = truth.len().max(estimates.len());
        if larger > 0 {
            // Unpaired targets cost the cut-off, be it that there is no track or none near enough.
            let unpaired = (larger - paired) as f64;
            self.ospa += ((squares + c2 * unpaired) / larger as f64).sqrt();
        }
    }

    /// The estimate of each target, least total squared distance first.
    fn pair(&self, truth: &[TrueTarget], estimates: &[Estimate]) -> Vec<Option<usize>> {
        if truth.is_empty() {
            return Vec::new();
        }
        let distance =
            |row: usize, column: usize| (estimates[column].state.position() - truth[row].position).norm();
        let columns = estimates.len() + truth.len();
        let weights = Matrix::from_fn(truth.len(), columns, |(row, column)| {
            let relative = if column < estimates.len() { distance(row, column) / self.cutoff } else { 1.0 };
            (relative.min(1.0).powi(2) * COST_SCALE) as i64
        });
        let (_, column_of) = kuhn_munkres_min(&weights);
        let near = |(row, column): (usize, usize)| {
            (column < estimates.len() && distance(row, column) < self.cutoff).then_some(column)
        };
        column_of.into_iter().enumerate().map(near).collect()
    }

    /// The figures of all instants so far.
    pub fn report(&self) -> Report {
        let target_instants: u64 = self.targets.values().map(|target| target.instants).sum();
        let instants = self.instants.max(1) as f64;
        Report {
            instants: self.instants,
            cutoff_m: self.cutoff,
            position_rmse_m: self.all.root_mean(self.all.position),
            velocity_rmse_mps: self.all.root_mean(self.all.velocity),
            mean_nees: self.all.mean(self.all.nees),
            completeness: if target_instants > 0 {
                self.all.pairs as f64 / target_instants as f64
            } else {
                1.0
            },
            false_tracks_per_instant: self.false_instants as f64 / instants,
            false_tracks: self.tracks.difference(&self.true_tracks).count() as u64,
            id_switches: self.targets.values().map(|target| target.switches).sum(),
            ospa_m: self.ospa / instants,
            gospa_m: self.gospa / instants,
            targets: self.targets.iter().map(|(&id, target)| target_report(id, target)).collect(),
        }
    }
}

fn target_report(id: u64, target: &Target) -> TargetReport {
    let sums = &target.sums;
    TargetReport {
        target: id,
        detected: sums.pairs > 0,
        share_tracked: sums.pairs as f64 / target.instants.max(1) as f64,
        position_rmse_m: sums.root_mean(sums.position),
        velocity_rmse_mps: sums.root_mean(sums.velocity),
        mean_nees: sums.mean(sums.nees),
        id_switches: target.switches,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix6;

    use super::*;

    fn target(id: u64, x: f64) -> TrueTarget {
        TrueTarget { id, position: Point3::new(x, 0.0, 0.0), velocity: Vector3::zeros() }
    }

    fn estimate(id: u64, x: f64) -> Estimate {
        let mean = Vector6::new(x, 0.0, 0.0, 0.0, 0.0, 0.0);
        Estimate { id, state: KinematicState { mean, covariance: Matrix6::identity() } }
    }

    #[test]
    fn known_answers_by_hand() {
        let mut evaluator = Evaluator::new(5.0);
        // One pair 1 m apart, one miss, one false track.
        evaluator.add(&[target(1, 0.0), target(2, 100.0)], &[estimate(7, 1.0), estimate(8, 50.0)]);
        let report = evaluator.report();
        assert_eq!(report.position_rmse_m, Some(1.0));
        assert_eq!(report.mean_nees, Some(1.0));
        assert_eq!(report.completeness, 0.5);
        assert_eq!(report.false_tracks, 1);
        assert_eq!(report.false_tracks_per_instant, 1.0);
        assert!((report.gospa_m - (1.0 + 25.0f64).sqrt()).abs() < 1e-12);
        assert!((report.ospa_m - (26.0f64 / 2.0).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn a_track_that_takes_over_is_a_switch_and_not_a_false_track() {
        let mut evaluator = Evaluator::new(5.0);
        evaluator.add(&[target(1, 0.0)], &[estimate(7, 0.0)]);
        evaluator.add(&[target(1, 0.0)], &[]);
        evaluator.add(&[target(1, 0.0)], &[estimate(9, 0.0)]);
        let report = evaluator.report();
        assert_eq!((report.id_switches, report.false_tracks), (1, 0));
        assert!((report.targets[0].share_tracked - 2.0 / 3.0).abs() < 1e-12);
    }
}
