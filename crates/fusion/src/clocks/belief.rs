//! Belief about the clocks: offset and drift of each relative to one of them, the reference; and
//! about the cameras' poses, as a camera that is turned sees a moving target early or late.

mod estimate;

use std::collections::BTreeMap;

use crossfix_message::{CameraName, Timestamp};
use nalgebra::{DMatrix, DVector, Matrix6};

use super::common_time::{Common, LIARS_SD_S, StatedClock, common_time};

/// Random walk of an offset, s^2/s: an ordinary quartz. With half of it the estimates follow a
/// clock a little later.
const OFFSET_WALK: f64 = 1e-12;
/// Random walk of a drift, 1/s, of the same quartz. With half of it the estimates follow one that
/// warms up a little later.
const DRIFT_WALK: f64 = 1e-16;
/// No two clocks agree to better than this, s: it keeps their covariance regular. With half of it
/// the same.
const OFFSET_FLOOR_S: f64 = 1e-6;
/// The same for their drifts, s/s. With half of it the same.
const DRIFT_FLOOR: f64 = 1e-9;
/// The same floor for a pose, rad and m. With half of it the same.
const POSE_FLOOR: f64 = 1e-6;
/// Weight of a window in the mean of the latest ones' inflations. With half of it a minute passes
/// before a change in the bearings' errors shows.
const INFLATION_WEIGHT: f64 = 0.25;
/// Offsets are clamped to this, s: beyond it they are no offsets any more. With half of it a clock
/// that is off by a second and a half stays off by half a second.
pub(super) const MAX_OFFSET_S: f64 = 2.0;

/// An uncertain camera pose: index of its error in the state, and its covariance as reported.
#[derive(Clone, Copy, Debug)]
struct UnsurePose {
    index: usize,
    reported: Matrix6<f64>,
}

/// A camera's clock: index of its offset in the state, and what was reported of it.
#[derive(Clone, Copy, Debug)]
struct ClockEntry {
    /// Index of its offset from the reference; its drift is the next. `None` for the reference
    /// itself, the first camera heard.
    index: Option<usize>,
    /// Its camera's pose, where that is uncertain.
    pose: Option<UnsurePose>,
    /// Variance of its offset from true time before any bearing, s^2; 0 where the camera's
    /// report is used as it is.
    prior: f64,
    /// The same for its drift, (s/s)^2.
    drift_prior: f64,
    /// Random walk of its offset beside [`OFFSET_WALK`], s^2/s.
    walk: f64,
    /// Factor by which the bearings of its camera repeat one another, the mean of the latest
    /// windows; `None` before any.
    inflation: Option<f64>,
}

/// Offsets and drifts of all clocks relative to the first, and the pose errors (world axes:
/// rotation, rad, then position, m), as one normal distribution at an epoch.
///
/// The error that all clocks have in common is left out: no bearing observes it, and a linearised
/// estimate would still learn something of it that is not true. It follows from the reported
/// deviations alone.
#[derive(Clone, Debug, Default)]
pub(super) struct Belief {
    cameras: BTreeMap<CameraName, ClockEntry>,
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    epoch: Option<Timestamp>,
    /// Offset and drift of the clocks' common time from what their reported deviations make of it
    /// now: with it the common time does not step when a clock becomes less certain than it was.
    common_offset: [f64; 2],
    /// The clocks' common time: recomputed whenever the belief about one of them changes, and not
    /// as time goes on, so that nobody's time steps.
    common: Common,
}

impl Belief {
    pub(super) fn knows(&self, camera: &CameraName) -> bool {
        self.cameras.contains_key(camera)
    }

    /// Adds a camera: standard deviations of its clock's offset (s) and drift (s/s), random walk of
    /// the offset beside that (s^2/s), and covariance of its pose.
    pub(super) fn add(
        &mut self,
        camera: &CameraName,
        [offset_sd, drift_sd]: [f64; 2],
        walk: f64,
        pose: Option<Matrix6<f64>>,
    ) {
        let (prior, drift_prior) = (offset_sd.powi(2), drift_sd.powi(2));
        let reference = self.reference();
        let others: Vec<usize> = self.clock_indices().collect();
        let index = reference.map(|_| self.grow(2));
        if let (Some(reference), Some(index)) = (reference, index) {
            // The offset o_k - o_r from the reference r has the variance v_k + v_r, ...
            let own = [prior + OFFSET_FLOOR_S.powi(2), drift_prior + DRIFT_FLOOR.powi(2)];
            for (i, common) in [reference.prior, reference.drift_prior].into_iter().enumerate() {
                // ... of which v_r, the reference's own, is in common with every other offset.
                for &other in &others {
                    self.covariance[(index + i, other + i)] = common;
                    self.covariance[(other + i, index + i)] = common;
                }
                self.covariance[(index + i, index + i)] = common + own[i];
            }
        }
        self.cameras.insert(
            camera.clone(),
            ClockEntry { index, pose: None, prior, drift_prior, walk, inflation: None },
        );
        self.settle();
        self.calibrate(camera, pose);
    }

    /// Gives a camera another pose, of this covariance, and forgets what was learnt of the one
    /// before.
    pub(super) fn calibrate(&mut self, camera: &CameraName, pose: Option<Matrix6<f64>>) {
        let Some(before) = self.cameras.get(camera).map(|known| known.pose) else {
            return;
        };
        let pose = pose.map(|covariance| self.replace_pose(before, covariance));
        if let Some(known) = self.cameras.get_mut(camera) {
            known.pose = pose;
        }
    }

    /// Enters a pose of this covariance in the state, where the one before was if there was one.
    fn replace_pose(&mut self, before: Option<UnsurePose>, covariance: Matrix6<f64>) -> UnsurePose {
        let first = before.map_or_else(|| self.grow(6), |before| before.index);
        self.mean.fixed_rows_mut::<6>(first).fill(0.0);
        self.covariance.fixed_rows_mut::<6>(first).fill(0.0);
        self.covariance.fixed_columns_mut::<6>(first).fill(0.0);
        let regular = covariance + Matrix6::identity() * POSE_FLOOR.powi(2);
        self.covariance.fixed_view_mut::<6, 6>(first, first).copy_from(&regular);
        UnsurePose { index: first, reported: covariance }
    }

    /// Enlarges the state by `by` components; returns the index of the first.
    fn grow(&mut self, by: usize) -> usize {
        let before = self.mean.len();
        self.mean.resize_vertically_mut(before + by, 0.0);
        self.covariance.resize_mut(before + by, before + by, 0.0);
        before
    }

    /// State indices of all offsets.
    fn clock_indices(&self) -> impl Iterator<Item = usize> + '_ {
        self.cameras.values().filter_map(|clock| clock.index)
    }

    fn reference(&self) -> Option<ClockEntry> {
        self.cameras.values().find(|clock| clock.index.is_none()).copied()
    }

    /// State index of a clock's offset; its drift is the next. `None` for the reference.
    pub(super) fn index(&self, camera: &CameraName) -> Option<usize> {
        self.cameras.get(camera)?.index
    }

    /// State index of a camera's pose, of six components; `None` where the pose is exact.
    pub(super) fn pose(&self, camera: &CameraName) -> Option<usize> {
        Some(self.cameras.get(camera)?.pose?.index)
    }

    /// The standard deviation that a camera has reported of its clock, s.
    pub(super) fn reported_sd(&self, camera: &CameraName) -> Option<f64> {
        Some(self.cameras.get(camera)?.prior.sqrt())
    }

    /// Whether a camera's report leaves its clock uncertain.
    pub(super) fn is_uncertain(&self, camera: &CameraName) -> bool {
        self.reported_sd(camera).is_some_and(|sd| sd > 0.0)
    }

    /// The time at which the state holds.
    pub(super) fn epoch(&self) -> Option<Timestamp> {
        self.epoch
    }

    /// Handles a step of all clocks by `step_s`, s: the offsets between them stay.
    pub(super) fn step_time(&mut self, step_s: f64) {
        self.epoch = self.epoch.map(|epoch| epoch.plus_seconds(step_s));
    }

    /// Predicts the state to a time; never back.
    pub(super) fn advance(&mut self, time: Timestamp) {
        let dt = self.epoch.map_or(0.0, |epoch| time.seconds_since(epoch));
        if self.epoch.is_some() && dt <= 0.0 {
            return;
        }
        self.epoch = Some(time);
        self.common_offset[0] += self.common_offset[1] * dt;
        // P <- F P F' + Q, where each offset grows by dt times its drift: of mean and covariance
        // only the rows and columns of offsets change.
        let clocks: Vec<usize> = self.clock_indices().collect();
        for &k in &clocks {
            self.mean[k] += dt * self.mean[k + 1];
            let (mut offset, drift) = self.covariance.columns_range_pair_mut(k, k + 1);
            // Columns first, P F', then rows, F (P F').
            offset.axpy(dt, &drift, 1.0);
        }
        for &k in &clocks {
            let (mut offset, drift) = self.covariance.rows_range_pair_mut(k, k + 1);
            offset += drift * dt;
            self.covariance[(k, k)] += OFFSET_WALK * dt;
            self.covariance[(k + 1, k + 1)] += DRIFT_WALK * dt;
        }
        self.wander(dt, &clocks);
    }

    /// Adds the clocks' own random walks; that of the reference moves it relative to all others.
    fn wander(&mut self, dt: f64, indices: &[usize]) {
        for clock in self.cameras.values_mut() {
            let walked = clock.walk * dt;
            clock.prior += walked;
            match clock.index {
                _ if walked == 0.0 => {}
                Some(index) => self.covariance[(index, index)] += walked,
                None => {
                    for &k in indices {
                        indices.iter().for_each(|&l| self.covariance[(k, l)] += walked);
                    }
                }
            }
        }
    }

    /// Mean and covariance of some components of the state.
    pub(super) fn marginal(&self, components: &[usize]) -> (DVector<f64>, DMatrix<f64>) {
        let n = components.len();
        (
            DVector::from_fn(n, |i, _| self.mean[components[i]]),
            DMatrix::from_fn(n, n, |i, k| self.covariance[(components[i], components[k])]),
        )
    }

    /// Replaces the belief about some components; those correlated with them move along.
    pub(super) fn learn(
        &mut self,
        components: &[usize],
        mean: &DVector<f64>,
        covariance: &DMatrix<f64>,
    ) {
        let (before_mean, before) = self.marginal(components);
        let Some(factor) = before.clone().cholesky() else {
            return;
        };
        let n = self.mean.len();
        let ties =
            DMatrix::from_fn(n, components.len(), |i, k| self.covariance[(i, components[k])]);
        // Regression on the replaced components c: G = P[:, c] P[c, c]^-1.
        let gain = factor.solve(&ties.transpose()).transpose();
        // m <- m + G (m_c,new - m_c) and P <- P + G (P_cc,new - P_cc) G'.
        let next_mean = &self.mean + &gain * (mean - before_mean);
        let next = &self.covariance + &gain * (covariance - before) * gain.transpose();
        let possible = (0..n).all(|i| next[(i, i)] >= 0.0);
        if possible && next_mean.iter().chain(next.iter()).all(|value| value.is_finite()) {
            self.mean = next_mean;
            self.covariance = (&next + next.transpose()) / 2.0;
            self.settle();
        }
    }

    /// Takes in the factors by which the bearings of some cameras repeat one another in a window.
    pub(super) fn see_inflations(&mut self, cameras: &[CameraName], inflations: &[f64]) {
        for (camera, inflation) in cameras.iter().zip(inflations) {
            if let Some(clock) = self.cameras.get_mut(camera) {
                let mean = clock.inflation.get_or_insert(*inflation);
                *mean += INFLATION_WEIGHT * (inflation - *mean);
            }
        }
    }

    /// Handles a report that a clock is worse than it was: standard deviations of offset (s) and
    /// drift (s/s). The mean stays, and may be off by that much.
    pub(super) fn worsen(&mut self, camera: &CameraName, deviations: [f64; 2]) {
        let stood = self.forget(camera, deviations);
        let index = self.cameras.get(camera).and_then(|clock| clock.index);
        for (index, [offset, drift]) in index.into_iter().zip(stood) {
            (self.mean[index], self.mean[index + 1]) = (offset, drift);
        }
        self.settle();
    }

    /// Handles a camera's change to another clock, of these standard deviations of offset (s) and
    /// drift (s/s).
    pub(super) fn replace(&mut self, camera: &CameraName, deviations: [f64; 2]) {
        let is_reference = self.cameras.get(camera).is_some_and(|clock| clock.index.is_none());
        let stood = self.reference_offset_and_drift();
        if is_reference {
            // The others were known relative to the clock before.
            self.widen(camera);
        }
        self.forget(camera, deviations);
        if is_reference {
            // The new reference starts at true time; the old one's offset goes into all others.
            let now = self.reference_offset_and_drift();
            let others: Vec<usize> = self.clock_indices().collect();
            for i in 0..2 {
                self.common_offset[i] -= now[i];
                others.iter().for_each(|&k| self.mean[k + i] += stood[i]);
            }
        }
        self.settle();
    }

    /// Gives a clock other deviations and forgets all that was learnt of it; returns the offset and
    /// drift believed before (`None` for the reference).
    fn forget(&mut self, camera: &CameraName, [offset_sd, drift_sd]: [f64; 2]) -> Option<[f64; 2]> {
        let common_offset = self.reference_offset_and_drift();
        let clock = self.cameras.get_mut(camera)?;
        (clock.prior, clock.drift_prior) = (offset_sd.powi(2), drift_sd.powi(2));
        let index = clock.index;
        self.settle();
        // The new deviations change the clocks' shares: keep the common time where it was.
        for (i, stepped) in self.reference_offset_and_drift().into_iter().enumerate() {
            self.common_offset[i] += common_offset[i] - stepped;
        }
        let stood = index.map(|index| [self.mean[index], self.mean[index + 1]]);
        self.widen(camera);
        stood
    }

    /// Forgets all that was learnt of a clock that may have jumped: it is no better known than a
    /// clock that is not as good as reported.
    pub(super) fn widen_jumped(&mut self, camera: &CameraName) {
        self.widen_by(camera, LIARS_SD_S.powi(2));
    }

    /// Forgets all that was learnt of a clock: only its reported deviations remain.
    pub(super) fn widen(&mut self, camera: &CameraName) {
        self.widen_by(camera, 0.0);
    }

    /// Forgets all that was learnt of a clock, whose offset may have changed by as much as a
    /// variance says, s^2, beside what was reported.
    fn widen_by(&mut self, camera: &CameraName, jumped: f64) {
        let (Some(clock), Some(reference)) = (self.cameras.get(camera).copied(), self.reference())
        else {
            return;
        };
        let Some(index) = clock.index else {
            // All other offsets are relative to the reference: they share its deviation.
            let others: Vec<usize> = self.clock_indices().collect();
            for (i, variance) in [clock.prior + jumped, clock.drift_prior].into_iter().enumerate() {
                for (&k, &l) in others.iter().flat_map(|k| others.iter().map(move |l| (k, l))) {
                    self.covariance[(k + i, l + i)] += variance;
                }
            }
            return;
        };
        // Relative to true time the clock is as reported; relative to the reference, which may be
        // off from true time as well, it has both variances.
        let common = self.reference_offset_and_drift();
        let variances = [
            clock.prior + jumped + reference.prior + OFFSET_FLOOR_S.powi(2),
            clock.drift_prior + reference.drift_prior + DRIFT_FLOOR.powi(2),
        ];
        for (i, variance) in variances.into_iter().enumerate() {
            // At true time again, which lies at minus the reference's own offset from it.
            self.mean[index + i] = -common[i];
            self.covariance.row_mut(index + i).fill(0.0);
            self.covariance.column_mut(index + i).fill(0.0);
            self.covariance[(index + i, index + i)] = variance;
        }
        self.settle();
    }

    /// Forgets all that was learnt of any clock.
    pub(super) fn reset_all(&mut self) {
        let mut reset = Self { epoch: self.epoch, ..Self::default() };
        let mut cameras: Vec<(&CameraName, &ClockEntry)> = self.cameras.iter().collect();
        // In the order in which they were heard: the reference first.
        cameras.sort_by_key(|(_, clock)| clock.index.map_or(0, |index| index + 1));
        for (camera, clock) in cameras {
            let pose = clock.pose.map(|pose| pose.reported);
            reset.add(camera, [clock.prior.sqrt(), clock.drift_prior.sqrt()], clock.walk, pose);
        }
        *self = reset;
    }

    /// Recomputes each clock's share in the common time, from the offsets now.
    fn settle(&mut self) {
        let readings = self.cameras.values().map(|clock| StatedClock {
            offset: self.relative(clock, 0, 0.0),
            variance: clock.prior,
        });
        self.common = common_time(&readings.collect::<Vec<_>>());
    }

    /// The clocks, each with its share in the common time.
    fn shares(&self) -> impl Iterator<Item = (&ClockEntry, f64)> {
        self.cameras.values().zip(self.common.shares.iter().copied())
    }

    /// A clock's offset (component 0) or drift (1) relative to the reference, the offset `ahead`
    /// seconds after the epoch.
    fn relative(&self, clock: &ClockEntry, component: usize, ahead: f64) -> f64 {
        clock.index.map_or(0.0, |index| match component {
            0 => self.mean[index] + ahead * self.mean[index + 1],
            _ => self.mean[index + 1],
        })
    }

    fn ahead(&self, time: Timestamp) -> f64 {
        self.epoch.map_or(0.0, |epoch| time.seconds_since(epoch))
    }

    /// Whether all offsets are such as clocks may have: beyond [`MAX_OFFSET_S`] a fit went astray.
    pub(super) fn is_possible(&self) -> bool {
        self.clock_indices().all(|index| self.mean[index].abs() <= MAX_OFFSET_S)
    }

    /// Factor by which the bearings of a camera have repeated one another in the latest windows;
    /// `None` before any.
    pub(super) fn inflation(&self, camera: &CameraName) -> Option<f64> {
        self.cameras.get(camera)?.inflation
    }

    /// Offset and drift of the reference from true time at the epoch.
    fn reference_offset_and_drift(&self) -> [f64; 2] {
        std::array::from_fn(|i| {
            let common = self.shares().map(|(clock, share)| share * self.relative(clock, i, 0.0));
            // Common time = sum of share_k x_k, relative to the reference; the reference itself is
            // at minus that.
            self.common_offset[i] - common.sum::<f64>()
        })
    }
}

#[cfg(test)]
mod tests;
