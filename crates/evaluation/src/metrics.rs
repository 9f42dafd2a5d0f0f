use std::collections::{BTreeMap, BTreeSet};

use crossfix_filter::KinematicState;
use crossfix_message::{Timestamp, TrackState};
use nalgebra::{Point3, Vector3, Vector6};
use pathfinding::prelude::{Matrix, kuhn_munkres_min};
use serde::Serialize;

use crate::stretches::{Delays, Stretches, quantile};

/// Costs are quantised to integers for the assignment, in millionths of the squared cut-off.
/// Distances below a thousandth of the cut-off count as equal; with half of it, below 1.4
/// thousandths.
const COST_SCALE: f64 = 1e6;
/// Beyond this distance from every target an answer is too far off for most uses, m. The names of
/// the reported share and of its count state it, so another value would make them false.
const FAR_OFF_M: f64 = 1.0;
/// An answer farther off than this many of its own standard deviations was overconfident. If one
/// axis has all of the error, one consistent answer in 16 000 is beyond it; with half of it, one in
/// 22 would be.
const SIGMAS: f64 = 4.0;

/// Where a target really is.
#[derive(Clone, Debug, PartialEq)]
pub struct TrueTarget {
    /// Its number.
    pub id: u64,
    /// Metres, world.
    pub position: Point3<f64>,
    /// Metres per second, world.
    pub velocity: Vector3<f64>,
}

impl TrueTarget {
    /// Whether all numbers are finite.
    pub fn is_finite(&self) -> bool {
        self.position.coords.iter().chain(self.velocity.iter()).all(|number| number.is_finite())
    }
}

/// A track's estimate of a target at an instant.
#[derive(Clone, Debug, PartialEq)]
pub struct Estimate {
    /// The track's number.
    pub id: u64,
    /// The track's state as its message stated it.
    pub status: TrackState,
    /// Number of cameras that had given it a bearing within the second before.
    pub cameras: usize,
    /// Its position and velocity with their covariance.
    pub state: KinematicState,
    /// Standard deviation of the time that the estimate is of, s: 0 if the track does not state it.
    pub time_sd_s: f64,
}

impl Estimate {
    /// Root of the sum of the position's variances, m.
    pub fn position_sd_m(&self) -> f64 {
        self.state.position_covariance().trace().max(0.0).sqrt()
    }
}

/// Normalised estimation error squared: squared errors relative to the covariance that the tracks
/// stated. For consistent tracks the mean is the number of degrees of freedom; a single instant
/// with great confidence and a great error spoils the mean, which the median does not show.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Nees {
    /// Mean over the instants.
    pub mean: Option<f64>,
    /// Median over the instants: for consistent tracks 5.35 with six degrees of freedom, 2.37 with
    /// three.
    pub median: Option<f64>,
}

impl Nees {
    fn of(values: &[f64]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let mean = (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        Self { mean, median: quantile(&sorted, 0.5) }
    }
}

/// Figures of one target.
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
    /// NEES of position and velocity; 6 if the tracks are consistent.
    pub nees: Nees,
    /// NEES of the position alone; 3 if consistent.
    pub position_nees: Nees,
    /// NEES of the velocity alone; 3 if consistent.
    pub velocity_nees: Nees,
    /// How often the track paired with it changed.
    pub id_switches: u64,
}

/// Figures of a run.
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
    /// NEES of position and velocity of the pairs; 6 if the tracks are consistent.
    pub nees: Nees,
    /// NEES of the position alone; 3 if consistent.
    pub position_nees: Nees,
    /// NEES of the velocity alone; 3 if consistent.
    pub velocity_nees: Nees,
    /// Number of answers: one per track and instant.
    pub answers: u64,
    /// Answers farther than the cut-off from every target.
    pub false_answers: u64,
    /// Share of the answers that lay more than 1 m from the nearest target, however far.
    pub share_off_by_1_m: Option<f64>,
    /// Share of the answers that lay farther from the nearest target than four times their own
    /// stated deviation (the root of the sum of the position's variances).
    pub share_beyond_4_sd: Option<f64>,
    /// How long the targets waited for an answer.
    pub delays: Delays,
    /// Share of target instants with a track.
    pub completeness: f64,
    /// Mean number of tracks without a target.
    pub false_tracks_per_instant: f64,
    /// Number of tracks that were never paired with a target.
    pub false_tracks: u64,
    /// How often the track paired with a target changed.
    pub id_switches: u64,
    /// Mean OSPA distance (order 2), m.
    pub ospa_m: f64,
    /// Mean GOSPA distance (order 2, alpha 2), m.
    pub gospa_m: f64,
    /// Per target, ordered by id.
    pub targets: Vec<TargetReport>,
}

#[derive(Clone, Debug, Default)]
struct ErrorSums {
    position: f64,
    velocity: f64,
    /// NEES of both together, of the position and of the velocity, one entry per pair.
    nees: [Vec<f64>; 3],
    pairs: u64,
}

/// NEES of three components of a state, from the first of them on.
fn nees_from(state: &KinematicState, first: usize, error: &Vector3<f64>) -> f64 {
    let spread = state.covariance.fixed_view::<3, 3>(first, first).into_owned().cholesky();
    spread.map_or(f64::INFINITY, |c| error.dot(&c.solve(error)))
}

impl ErrorSums {
    fn add(&mut self, truth: &TrueTarget, state: &KinematicState) {
        let position = state.position() - truth.position;
        let velocity = state.velocity() - truth.velocity;
        self.position += position.norm_squared();
        self.velocity += velocity.norm_squared();
        let error = Vector6::from_iterator(position.iter().chain(velocity.iter()).copied());
        // A covariance that cannot be inverted is consistent with no error.
        let both =
            state.covariance.cholesky().map_or(f64::INFINITY, |c| error.dot(&c.solve(&error)));
        let [of_position, of_velocity] =
            [(0, position), (3, velocity)].map(|(first, error)| nees_from(state, first, &error));
        for (list, value) in self.nees.iter_mut().zip([both, of_position, of_velocity]) {
            list.push(value);
        }
        self.pairs += 1;
    }

    fn root_mean(&self, sum: f64) -> Option<f64> {
        (self.pairs > 0).then(|| (sum / self.pairs as f64).sqrt())
    }

    fn nees(&self) -> [Nees; 3] {
        self.nees.each_ref().map(|values| Nees::of(values))
    }
}

#[derive(Clone, Debug, Default)]
struct TargetScore {
    sums: ErrorSums,
    instants: u64,
    last_track: Option<u64>,
    switches: u64,
}

/// Counts of answers by their distance from the nearest target; `with_truth` are those at instants
/// with any target.
#[derive(Clone, Copy, Debug, Default)]
struct Answers {
    all: u64,
    with_truth: u64,
    false_ones: u64,
    off_by_1_m: u64,
    beyond_4_sd: u64,
}

impl Answers {
    fn add(&mut self, truth: &[TrueTarget], estimate: &Estimate, cutoff: f64) {
        self.all += 1;
        let away = |target: &TrueTarget| distance(target, estimate);
        let Some(nearest) = truth.iter().map(away).min_by(f64::total_cmp) else {
            self.false_ones += 1;
            return;
        };
        self.with_truth += 1;
        self.false_ones += u64::from(nearest >= cutoff);
        self.off_by_1_m += u64::from(nearest > FAR_OFF_M);
        self.beyond_4_sd += u64::from(nearest > SIGMAS * estimate.position_sd_m());
    }

    fn share(&self, count: u64) -> Option<f64> {
        (self.with_truth > 0).then(|| count as f64 / self.with_truth as f64)
    }
}

/// Compares tracks with the truth, instant by instant.
#[derive(Clone, Debug)]
pub struct Evaluator {
    cutoff: f64,
    instants: u64,
    targets: BTreeMap<u64, TargetScore>,
    all: ErrorSums,
    false_instants: u64,
    answers: Answers,
    stretches: Stretches,
    tracks: BTreeSet<u64>,
    true_tracks: BTreeSet<u64>,
    ospa: f64,
    gospa: f64,
}

impl Evaluator {
    /// An evaluator in which tracks and targets `cutoff_m` or more apart are not paired; this is
    /// also the c of OSPA and GOSPA.
    pub fn new(cutoff_m: f64) -> Self {
        Self {
            cutoff: cutoff_m,
            instants: 0,
            targets: BTreeMap::new(),
            all: ErrorSums::default(),
            false_instants: 0,
            answers: Answers::default(),
            stretches: Stretches::default(),
            tracks: BTreeSet::new(),
            true_tracks: BTreeSet::new(),
            ospa: 0.0,
            gospa: 0.0,
        }
    }

    /// Adds one instant; instants come in order of time.
    pub fn add(&mut self, time: Timestamp, truth: &[TrueTarget], estimates: &[Estimate]) {
        self.instants += 1;
        estimates.iter().for_each(|estimate| self.answers.add(truth, estimate, self.cutoff));
        self.tracks.extend(estimates.iter().map(|estimate| estimate.id));
        let mut squares = 0.0;
        let pairs = self.pair(truth, estimates);
        for (target, partner) in truth.iter().zip(&pairs) {
            let entry = self.targets.entry(target.id).or_default();
            entry.instants += 1;
            self.stretches.add(target.id, time, partner.is_some());
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
        // GOSPA with p = 2 and alpha = 2: each missed target and each false track adds c^2 / 2.
        self.gospa += (squares + c2 / 2.0 * (missed + false_ones) as f64).sqrt();
        let larger = truth.len().max(estimates.len());
        if larger > 0 {
            // OSPA with p = 2: whatever is unpaired adds c^2, whether there is no track or none
            // near enough.
            let unpaired = (larger - paired) as f64;
            self.ospa += ((squares + c2 * unpaired) / larger as f64).sqrt();
        }
    }

    /// The index of each target's estimate: the assignment of least total squared distance.
    fn pair(&self, truth: &[TrueTarget], estimates: &[Estimate]) -> Vec<Option<usize>> {
        if truth.is_empty() {
            return Vec::new();
        }
        let distance = |row: usize, column: usize| distance(&truth[row], &estimates[column]);
        // One extra column per target, at the cut-off's cost, leaves the target unpaired.
        let columns = estimates.len() + truth.len();
        let weights = Matrix::from_fn(truth.len(), columns, |(row, column)| {
            let relative =
                if column < estimates.len() { distance(row, column) / self.cutoff } else { 1.0 };
            (relative.min(1.0).powi(2) * COST_SCALE) as i64
        });
        let (_, column_of) = kuhn_munkres_min(&weights);
        let is_near = |row, column| column < estimates.len() && distance(row, column) < self.cutoff;
        let pairs = column_of.into_iter().enumerate();
        pairs.map(|(row, column)| is_near(row, column).then_some(column)).collect()
    }

    /// Figures of all instants so far.
    pub fn report(&self) -> Report {
        let target_instants: u64 = self.targets.values().map(|target| target.instants).sum();
        let instants = self.instants.max(1) as f64;
        let [nees, position_nees, velocity_nees] = self.all.nees();
        Report {
            instants: self.instants,
            cutoff_m: self.cutoff,
            position_rmse_m: self.all.root_mean(self.all.position),
            velocity_rmse_mps: self.all.root_mean(self.all.velocity),
            nees,
            position_nees,
            velocity_nees,
            answers: self.answers.all,
            false_answers: self.answers.false_ones,
            share_off_by_1_m: self.answers.share(self.answers.off_by_1_m),
            share_beyond_4_sd: self.answers.share(self.answers.beyond_4_sd),
            delays: self.stretches.delays(),
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

/// Distance of an estimate from a target, m.
fn distance(truth: &TrueTarget, estimate: &Estimate) -> f64 {
    (estimate.state.position() - truth.position).norm()
}

fn target_report(id: u64, target: &TargetScore) -> TargetReport {
    let sums = &target.sums;
    let [nees, position_nees, velocity_nees] = sums.nees();
    TargetReport {
        target: id,
        detected: sums.pairs > 0,
        share_tracked: sums.pairs as f64 / target.instants.max(1) as f64,
        position_rmse_m: sums.root_mean(sums.position),
        velocity_rmse_mps: sums.root_mean(sums.velocity),
        nees,
        position_nees,
        velocity_nees,
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
        let state = KinematicState { mean, covariance: Matrix6::identity() };
        Estimate { id, status: TrackState::Confirmed, cameras: 3, state, time_sd_s: 0.0 }
    }

    #[test]
    fn known_answers_by_hand() {
        let mut evaluator = Evaluator::new(5.0);
        // One pair 1 m apart, one miss, one false track.
        let now = Timestamp::EPOCH;
        evaluator.add(
            now,
            &[target(1, 0.0), target(2, 100.0)],
            &[estimate(7, 1.0), estimate(8, 50.0)],
        );
        let report = evaluator.report();
        assert_eq!(report.position_rmse_m, Some(1.0));
        assert_eq!(report.nees, Nees { mean: Some(1.0), median: Some(1.0) });
        assert_eq!((report.position_nees.mean, report.velocity_nees.mean), (Some(1.0), Some(0.0)));
        // Two answers: one a metre off, within its 1.7 m; one 50 m from any target.
        assert_eq!((report.answers, report.false_answers), (2, 1));
        assert_eq!((report.share_off_by_1_m, report.share_beyond_4_sd), (Some(0.5), Some(0.5)));
        assert_eq!(report.completeness, 0.5);
        assert_eq!(report.false_tracks, 1);
        assert_eq!(report.false_tracks_per_instant, 1.0);
        assert!((report.gospa_m - (1.0 + 25.0f64).sqrt()).abs() < 1e-12);
        assert!((report.ospa_m - (26.0f64 / 2.0).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn a_track_that_takes_over_is_a_switch_and_not_a_false_track() {
        let mut evaluator = Evaluator::new(5.0);
        for (seconds, estimates) in
            [(0.0, vec![estimate(7, 0.0)]), (0.5, vec![]), (1.0, vec![estimate(9, 0.0)])]
        {
            evaluator.add(Timestamp::EPOCH.plus_seconds(seconds), &[target(1, 0.0)], &estimates);
        }
        let report = evaluator.report();
        assert_eq!((report.id_switches, report.false_tracks), (1, 0));
        assert!((report.targets[0].share_tracked - 2.0 / 3.0).abs() < 1e-12);
    }
}
