//! The cameras' clocks, from the tracks themselves: a moving target seen by several cameras lies
//! off their sight lines by its velocity times their clocks' offsets.

use std::collections::BTreeMap;

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Vector3};

use crate::config::Clocks;
use crate::track::{Track, TrackId};
use crate::tracker::Tracker;

/// Targets followed at a time: one is enough, a second bridges its loss.
const MAX_TARGETS: usize = 2;
/// A target slower than this says next to nothing of clocks, m/s.
const LEAST_SPEED: f64 = 2.0;
/// Position, velocity and acceleration.
const TARGET_STATES: usize = 9;
/// How vaguely a target is taken over from its track, so that no bearing counts twice: m, m/s, m/s^2.
const TAKEN_OVER_SD: [f64; 3] = [10.0, 5.0, 3.0];
/// Random walk of an offset (s^2/s) and of a drift (1/s): an ordinary quartz.
const OFFSET_WALK: f64 = 1e-12;
const DRIFT_WALK: f64 = 1e-16;
/// Innovations beyond this squared distance (two degrees of freedom) are somebody else's.
const GATE: f64 = 25.0;
/// When so many more bearings than fit have been somebody else's, the filter has lost its way.
const MAX_STRANGERS: u32 = 20;
/// Offsets beyond this are no offsets any more, s.
const MAX_OFFSET_S: f64 = 2.0;

/// What is known of a camera's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockEstimate {
    /// How far the clock is ahead, s: taken off its capture times.
    pub offset_s: f64,
    /// Standard deviation of the offset against true time, s. What all clocks may have in common
    /// nobody can see: it stays as large as the clocks' reported deviations leave it.
    pub sd_s: f64,
    /// Standard deviation of the offset against what all clocks of the site say together, s.
    pub relative_sd_s: f64,
    /// How fast the clock gains, s/s.
    pub drift: f64,
    /// Standard deviation of the drift, s/s.
    pub drift_sd: f64,
}

/// A camera's clock: where the filter has it, and what was reported of it.
#[derive(Clone, Copy, Debug)]
struct Clock {
    /// The place of its offset against the reference; its drift is the next. The reference, the
    /// first camera heard, has no place.
    place: Option<usize>,
    /// Variance of its offset against true time before anything is seen, s^2.
    prior: f64,
    /// The same of its drift.
    drift_prior: f64,
}

/// Offset and drift of every clock against the first, and the state of a few targets, in one Kalman
/// filter, so that what a bearing says of one is not taken for the other.
///
/// What all clocks have in common is left out: no bearing tells it, and a linearised filter would
/// yet learn something of it that is not true. It follows from the reported deviations alone.
#[derive(Clone, Debug)]
pub(crate) struct ClockFilter {
    config: Clocks,
    cameras: BTreeMap<CameraName, Clock>,
    /// Targets with the place of their first component.
    targets: Vec<TrackId>,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    time: Option<Timestamp>,
    needed: bool,
    /// How many more bearings than fit were somebody else's of late.
    strangers: u32,
}

impl ClockFilter {
    pub(crate) fn new(config: Clocks) -> Self {
        Self {
            config,
            cameras: BTreeMap::new(),
            targets: Vec::new(),
            mean: DVector::zeros(0),
            covariance: DMatrix::zeros(0, 0),
            time: None,
            needed: false,
            strangers: 0,
        }
    }

    /// Whether any clock is uncertain enough to be estimated.
    pub(crate) fn is_needed(&self) -> bool {
        self.needed
    }

    /// Makes a camera's clock known by the deviation it reports; later reports change nothing.
    pub(crate) fn see(&mut self, camera: &CameraName, reported_sd_s: f64) {
        if !self.config.estimate || self.cameras.contains_key(camera) {
            return;
        }
        let uncertain = reported_sd_s >= self.config.least_sd_s && !self.config.trusted.contains(camera);
        self.needed |= uncertain;
        let (prior, drift_prior) =
            if uncertain { (reported_sd_s.powi(2), self.config.drift_sd.powi(2)) } else { (0.0, 0.0) };
        let reference = self.cameras.values().find(|clock| clock.place.is_none()).copied();
        // Clocks come first, so targets move up.
        let place = reference.map(|reference| {
            let place = self.clock_states();
            self.insert(place, &[prior + reference.prior, drift_prior + reference.drift_prior]);
            // The reference's own error is in every offset against it.
            for other in (0..place).step_by(2) {
                self.covariance[(place, other)] = reference.prior;
                self.covariance[(other, place)] = reference.prior;
                self.covariance[(place + 1, other + 1)] = reference.drift_prior;
                self.covariance[(other + 1, place + 1)] = reference.drift_prior;
            }
            place
        });
        self.cameras.insert(camera.clone(), Clock { place, prior, drift_prior });
    }

    /// Components of the state that are clocks'.
    fn clock_states(&self) -> usize {
        2 * self.cameras.values().filter(|clock| clock.place.is_some()).count()
    }

    /// Offset and drift of a clock against the reference.
    fn relative(&self, clock: &Clock) -> (f64, f64) {
        clock.place.map_or((0.0, 0.0), |place| (self.mean[place], self.mean[place + 1]))
    }

    /// How much each clock says of true time, by the variances reported of them, and the variance of
    /// what all say together. A clock that is right by definition says all.
    fn weights(&self, prior: fn(&Clock) -> f64) -> (Vec<(Clock, f64)>, f64) {
        let clocks: Vec<Clock> = self.cameras.values().copied().collect();
        let exact = clocks.iter().filter(|clock| prior(clock) <= 0.0).count();
        let weight = |clock: &Clock| match exact {
            0 => prior(clock).recip(),
            _ => f64::from(u8::from(prior(clock) <= 0.0)),
        };
        let total: f64 = clocks.iter().map(weight).sum();
        let variance = if exact == 0 { total.recip() } else { 0.0 };
        (clocks.into_iter().map(|clock| (clock, weight(&clock) / total)).collect(), variance)
    }

    /// Offset of the reference against true time: what makes all clocks together most nearly right.
    fn reference_offset(&self) -> f64 {
        let (weights, _) = self.weights(|clock| clock.prior);
        -weights.iter().map(|(clock, weight)| weight * self.relative(clock).0).sum::<f64>()
    }

    /// A clock's component (0 offset, 1 drift) against what all clocks say together, with its
    /// variance and the variance of that common time.
    fn absolute(&self, clock: &Clock, component: usize, prior: fn(&Clock) -> f64) -> (f64, f64, f64) {
        let (weights, common) = self.weights(prior);
        let mut row = DVector::<f64>::zeros(self.mean.len());
        if let Some(place) = clock.place {
            row[place + component] += 1.0;
        }
        for (other, weight) in &weights {
            if let Some(place) = other.place {
                row[place + component] -= weight;
            }
        }
        (row.dot(&self.mean), row.dot(&(&self.covariance * &row)).max(0.0), common)
    }

    /// The estimate of a camera's clock.
    pub(crate) fn estimate(&self, camera: &CameraName) -> Option<ClockEstimate> {
        let clock = self.cameras.get(camera)?;
        let (offset, own, common) = self.absolute(clock, 0, |clock| clock.prior);
        let (drift, own_drift, common_drift) = self.absolute(clock, 1, |clock| clock.drift_prior);
        Some(ClockEstimate {
            offset_s: offset.clamp(-MAX_OFFSET_S, MAX_OFFSET_S),
            // No clock is worse known than what was reported of it.
            sd_s: (own + common).min(clock.prior).sqrt(),
            relative_sd_s: own.sqrt(),
            drift,
            drift_sd: (own_drift + common_drift).min(clock.drift_prior).sqrt(),
        })
    }

    /// The largest offset of all clocks, s, at least 0: no camera's corrected time lies farther
    /// behind its reported one.
    pub(crate) fn largest_offset(&self) -> f64 {
        let common = self.reference_offset();
        let offsets = self.cameras.values().map(|clock| common + self.relative(clock).0);
        offsets.fold(0.0, f64::max).min(MAX_OFFSET_S)
    }

    /// Moves on to a time; targets that are gone or that too few cameras see are let go.
    pub(crate) fn advance(&mut self, time: Timestamp, tracker: &Tracker) {
        let held = |id: TrackId| tracker.track(id).is_some_and(|t| t.is_confirmed() && t.is_held());
        let gone: Vec<TrackId> = self.targets.iter().copied().filter(|&id| !held(id)).collect();
        for id in gone {
            self.let_go(id);
        }
        let dt = self.time.map_or(0.0, |before| time.seconds_since(before));
        self.time = Some(time);
        let clocks = self.clock_states();
        for k in (0..clocks).step_by(2) {
            self.carry(k, k + 1, dt);
            if self.covariance[(k, k)] > 0.0 {
                self.covariance[(k, k)] += OFFSET_WALK * dt.abs();
                self.covariance[(k + 1, k + 1)] += DRIFT_WALK * dt.abs();
            }
        }
        for index in 0..self.targets.len() {
            self.carry_target(clocks + TARGET_STATES * index, dt);
        }
    }

    /// Moves a target on: constant acceleration driven by white jerk, which follows a turn closely
    /// enough that its curve is not taken for the clocks'.
    fn carry_target(&mut self, first: usize, dt: f64) {
        let noise = self.config.jerk_density * dt.abs();
        for p in first..first + 3 {
            let (v, a) = (p + 3, p + 6);
            self.carry(p, a, dt * dt / 2.0);
            self.carry(p, v, dt);
            self.carry(v, a, dt);
            let added = [
                (p, p, dt.powi(4) / 20.0),
                (p, v, dt.powi(3) / 8.0),
                (p, a, dt.powi(2) / 6.0),
                (v, v, dt.powi(2) / 3.0),
                (v, a, dt / 2.0),
                (a, a, 1.0),
            ];
            for (i, k, share) in added {
                self.covariance[(i, k)] += noise * share;
                if i != k {
                    self.covariance[(k, i)] += noise * share;
                }
            }
        }
    }

    /// Takes a bearing of a track in, taken at a time that was corrected by `applied_s`.
    pub(crate) fn update(&mut self, track: &Track, camera: &CameraName, line: &SightLine, applied_s: f64) {
        let Some(clock) = self.cameras.get(camera).copied() else {
            return;
        };
        let common = self.reference_offset();
        let Some(first) = self.place_of(track) else {
            return;
        };
        let position: Vector3<f64> = self.mean.fixed_rows::<3>(first).into_owned();
        let velocity: Vector3<f64> = self.mean.fixed_rows::<3>(first + 3).into_owned();
        let Some(offset) = line.tangent_offset(position.into()) else {
            return;
        };
        let range = (position - line.origin.coords).norm();
        let across = line.basis.transpose() / range;
        let drift = across * velocity;
        // A clock ahead by o shows the target where it was o ago; `applied_s` of it is taken off.
        let n = self.mean.len();
        let mut jacobian = DMatrix::zeros(2, n);
        jacobian.fixed_view_mut::<2, 3>(0, first).copy_from(&across);
        if let Some(place) = clock.place {
            jacobian.fixed_view_mut::<2, 1>(0, place).copy_from(&-drift);
        }
        let innovation = -(offset + drift * (applied_s - common - self.relative(&clock).0));
        let tied = &self.covariance * jacobian.transpose();
        let spread: Matrix2<f64> = (&jacobian * &tied).fixed_view::<2, 2>(0, 0) + line.covariance;
        let spread = spread + self.second_order(clock.place, first, &across);
        let Some(inverse) = spread.try_inverse() else {
            return;
        };
        if innovation.dot(&(inverse * innovation)) > GATE {
            self.strangers += 1;
            if self.strangers > MAX_STRANGERS {
                self.begin_anew();
            }
            return;
        }
        self.strangers = self.strangers.saturating_sub(2);
        let gain = &tied * inverse;
        let (mean, covariance) =
            (&self.mean + &gain * innovation, &self.covariance - &gain * tied.transpose());
        if mean.iter().chain(covariance.iter()).all(|value| value.is_finite()) {
            self.mean = mean;
            self.covariance = (&covariance + covariance.transpose()) / 2.0;
        }
    }

    /// What the linearisation leaves out: the offset's error times the velocity's, and half the
    /// acceleration times the offset's square; rad^2.
    fn second_order(&self, clock: Option<usize>, first: usize, across: &Matrix2x3<f64>) -> Matrix2<f64> {
        let variance = clock.map_or(0.0, |place| self.covariance[(place, place)].max(0.0));
        let velocity = self.covariance.fixed_view::<3, 3>(first + 3, first + 3).into_owned();
        let acceleration = across * self.mean.fixed_rows::<3>(first + 6);
        across * velocity * across.transpose() * variance
            + acceleration * acceleration.transpose() * (variance * variance / 2.0)
    }

    /// The filter has lost its way: the targets are let go, and nothing more is known of the clocks
    /// than what was reported of them.
    pub(crate) fn begin_anew(&mut self) {
        self.strangers = 0;
        for id in self.targets.clone() {
            self.let_go(id);
        }
        let cameras = std::mem::take(&mut self.cameras);
        let reference = cameras.values().find(|clock| clock.place.is_none()).copied();
        let common = reference.map_or((0.0, 0.0), |clock| (clock.prior, clock.drift_prior));
        self.covariance.fill(0.0);
        self.mean.fill(0.0);
        for (one, clock) in cameras.values().filter_map(|clock| Some((clock.place?, clock))) {
            for other in cameras.values().filter_map(|clock| clock.place) {
                self.covariance[(one, other)] = common.0;
                self.covariance[(one + 1, other + 1)] = common.1;
            }
            self.covariance[(one, one)] += clock.prior;
            self.covariance[(one + 1, one + 1)] += clock.drift_prior;
        }
        self.cameras = cameras;
    }

    /// The place of a track's state; takes it over if it is worth following.
    fn place_of(&mut self, track: &Track) -> Option<usize> {
        let clocks = self.clock_states();
        if let Some(index) = self.targets.iter().position(|&id| id == track.id) {
            return Some(clocks + TARGET_STATES * index);
        }
        let state = track.state();
        let worth = track.is_held() && track.residuals.len() >= 3 && state.velocity().norm() >= LEAST_SPEED;
        if !worth || self.targets.len() >= MAX_TARGETS {
            return None;
        }
        let first = self.mean.len();
        let vague = TAKEN_OVER_SD.map(|sd: f64| sd.powi(2));
        let own = state.covariance.diagonal();
        let variances: [f64; TARGET_STATES] =
            std::array::from_fn(|i| vague[i / 3] + own.get(i).copied().unwrap_or(0.0));
        self.insert(first, &variances);
        self.mean.fixed_rows_mut::<6>(first).copy_from(&state.mean);
        self.targets.push(track.id);
        Some(first)
    }

    fn let_go(&mut self, id: TrackId) {
        if let Some(index) = self.targets.iter().position(|&target| target == id) {
            self.targets.remove(index);
            let first = self.clock_states() + TARGET_STATES * index;
            self.mean =
                std::mem::replace(&mut self.mean, DVector::zeros(0)).remove_rows(first, TARGET_STATES);
            let covariance = std::mem::replace(&mut self.covariance, DMatrix::zeros(0, 0));
            self.covariance =
                covariance.remove_rows(first, TARGET_STATES).remove_columns(first, TARGET_STATES);
        }
    }

    /// Makes room for independent components of mean 0.
    fn insert(&mut self, place: usize, variances: &[f64]) {
        let count = variances.len();
        self.mean = std::mem::replace(&mut self.mean, DVector::zeros(0)).insert_rows(place, count, 0.0);
        let covariance = std::mem::replace(&mut self.covariance, DMatrix::zeros(0, 0));
        self.covariance = covariance.insert_rows(place, count, 0.0).insert_columns(place, count, 0.0);
        for (i, variance) in variances.iter().enumerate() {
            self.covariance[(place + i, place + i)] = *variance;
        }
    }

    /// `x_i += x_rate dt`, with its covariances.
    fn carry(&mut self, i: usize, rate: usize, dt: f64) {
        self.mean[i] += self.mean[rate] * dt;
        for k in 0..self.mean.len() {
            let moved = self.covariance[(rate, k)] * dt;
            self.covariance[(i, k)] += moved;
        }
        for k in 0..self.mean.len() {
            let moved = self.covariance[(k, rate)] * dt;
            self.covariance[(k, i)] += moved;
        }
    }
}
