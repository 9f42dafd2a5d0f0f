//! The cameras' clocks, from the tracks themselves: a moving target seen by several cameras lies
//! off their sight lines by its velocity times their clocks' offsets.

use std::collections::BTreeMap;

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{DMatrix, DVector, Matrix2, Vector3};

use crate::config::Clocks;
use crate::track::{Track, TrackId};
use crate::tracker::Tracker;

/// Targets followed at a time: one is enough, a second bridges its loss.
const MAX_TARGETS: usize = 2;
/// A target slower than this says next to nothing of clocks, m/s.
const LEAST_SPEED: f64 = 2.0;
/// How vaguely a target is taken over from its track, so that no bearing counts twice: m and m/s.
const TAKEN_OVER_SD: f64 = 10.0;
/// Random walk of an offset (s^2/s) and of a drift (1/s): an ordinary quartz.
const OFFSET_WALK: f64 = 1e-12;
const DRIFT_WALK: f64 = 1e-16;
/// Innovations beyond this squared distance (two degrees of freedom) are somebody else's.
const GATE: f64 = 25.0;
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
    /// Standard deviation of the offset against the best clock of the site, s.
    pub relative_sd_s: f64,
    /// How fast the clock gains, s/s.
    pub drift: f64,
    /// Standard deviation of the drift, s/s.
    pub drift_sd: f64,
}

/// Offset and drift of every clock and the state of a few targets in one Kalman filter, so that
/// what a bearing says of one is not taken for the other.
#[derive(Clone, Debug)]
pub(crate) struct ClockFilter {
    config: Clocks,
    /// The place of each camera's offset; its drift is the next.
    cameras: BTreeMap<CameraName, usize>,
    /// Targets with the place of their first component.
    targets: Vec<TrackId>,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    time: Option<Timestamp>,
    needed: bool,
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
        let trusted = self.config.trusted.contains(camera);
        let (sd, drift_sd) = if trusted { (0.0, 0.0) } else { (reported_sd_s, self.config.drift_sd) };
        let uncertain = sd >= self.config.least_sd_s;
        self.needed |= uncertain;
        // Clocks come first, so targets move up.
        let place = 2 * self.cameras.len();
        self.insert(place, &[sd.powi(2), if uncertain { drift_sd.powi(2) } else { 0.0 }]);
        self.cameras.insert(camera.clone(), place);
    }

    /// The estimate of a camera's clock.
    pub(crate) fn estimate(&self, camera: &CameraName) -> Option<ClockEstimate> {
        let &place = self.cameras.get(camera)?;
        let best =
            self.cameras.values().copied().min_by(|&a, &b| {
                self.covariance[(a, a)].total_cmp(&self.covariance[(b, b)]).then(a.cmp(&b))
            })?;
        let variance = |i: usize| self.covariance[(i, i)].max(0.0);
        let against_best = variance(place) + variance(best) - 2.0 * self.covariance[(place, best)];
        Some(ClockEstimate {
            offset_s: self.mean[place].clamp(-MAX_OFFSET_S, MAX_OFFSET_S),
            sd_s: variance(place).sqrt(),
            relative_sd_s: if place == best { 0.0 } else { against_best.max(0.0).sqrt() },
            drift: self.mean[place + 1],
            drift_sd: variance(place + 1).sqrt(),
        })
    }

    /// The largest offset of all clocks, s, at least 0: no camera's corrected time lies farther
    /// behind its reported one.
    pub(crate) fn largest_offset(&self) -> f64 {
        self.cameras.values().map(|&i| self.mean[i].min(MAX_OFFSET_S)).fold(0.0, f64::max)
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
        let clocks = 2 * self.cameras.len();
        for k in (0..clocks).step_by(2) {
            self.carry(k, k + 1, dt);
            if self.covariance[(k, k)] > 0.0 {
                self.covariance[(k, k)] += OFFSET_WALK * dt.abs();
                self.covariance[(k + 1, k + 1)] += DRIFT_WALK * dt.abs();
            }
        }
        for (index, id) in self.targets.clone().into_iter().enumerate() {
            let density = tracker.track(id).map_or(1.0, |t| t.mean_density(tracker.motion()));
            let density = density.max(self.config.least_density);
            let first = clocks + 6 * index;
            for axis in first..first + 3 {
                self.carry(axis, axis + 3, dt);
                let noise = density * dt.abs();
                self.covariance[(axis, axis)] += noise * dt * dt / 3.0;
                self.covariance[(axis, axis + 3)] += noise * dt / 2.0;
                self.covariance[(axis + 3, axis)] += noise * dt / 2.0;
                self.covariance[(axis + 3, axis + 3)] += noise;
            }
        }
    }

    /// Takes a bearing of a track in, taken at a time that was corrected by `applied_s`.
    pub(crate) fn update(&mut self, track: &Track, camera: &CameraName, line: &SightLine, applied_s: f64) {
        let Some(&clock) = self.cameras.get(camera) else {
            return;
        };
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
        jacobian.fixed_view_mut::<2, 1>(0, clock).copy_from(&-drift);
        let innovation = -(offset + drift * (applied_s - self.mean[clock]));
        let tied = &self.covariance * jacobian.transpose();
        let spread: Matrix2<f64> = (&jacobian * &tied).fixed_view::<2, 2>(0, 0) + line.covariance;
        let Some(inverse) = spread.try_inverse() else {
            return;
        };
        if innovation.dot(&(inverse * innovation)) > GATE {
            return;
        }
        let gain = &tied * inverse;
        let (mean, covariance) =
            (&self.mean + &gain * innovation, &self.covariance - &gain * tied.transpose());
        if mean.iter().chain(covariance.iter()).all(|value| value.is_finite()) {
            self.mean = mean;
            self.covariance = (&covariance + covariance.transpose()) / 2.0;
        }
    }

    /// The place of a track's state; takes it over if it is worth following.
    fn place_of(&mut self, track: &Track) -> Option<usize> {
        let clocks = 2 * self.cameras.len();
        if let Some(index) = self.targets.iter().position(|&id| id == track.id) {
            return Some(clocks + 6 * index);
        }
        let state = track.state();
        let worth = track.is_held() && track.residuals.len() >= 3 && state.velocity().norm() >= LEAST_SPEED;
        if !worth || self.targets.len() >= MAX_TARGETS {
            return None;
        }
        let first = self.mean.len();
        let variances: Vec<f64> =
            state.covariance.diagonal().iter().map(|variance| variance + TAKEN_OVER_SD.powi(2)).collect();
        self.insert(first, &variances);
        self.mean.fixed_rows_mut::<6>(first).copy_from(&state.mean);
        self.targets.push(track.id);
        Some(first)
    }

    fn let_go(&mut self, id: TrackId) {
        if let Some(index) = self.targets.iter().position(|&target| target == id) {
            self.targets.remove(index);
            let first = 2 * self.cameras.len() + 6 * index;
            self.mean = std::mem::replace(&mut self.mean, DVector::zeros(0)).remove_rows(first, 6);
            let covariance = std::mem::replace(&mut self.covariance, DMatrix::zeros(0, 0));
            self.covariance = covariance.remove_rows(first, 6).remove_columns(first, 6);
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
