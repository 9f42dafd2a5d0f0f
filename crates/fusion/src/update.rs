//! The measurement update of one state by one bearing: an iterated extended Kalman update in the
//! coordinates of [`StateChart`]. The camera's shared errors are considered (Schmidt) and not part
//! of the state; what the bearing tells of them is returned separately ([`CrossUpdate`]).
//!
//! Notation: P is the state's covariance, H the bearing's Jacobian by the state, s the camera's
//! shared errors (each in units of its own standard deviation), J their effect on the bearing
//! (`shifts`), X the cross-covariance of state and s (`ties`), R the bearing's noise, z the
//! innovation and S its covariance.

use std::f64::consts::PI;

use crossfix_filter::KinematicState;
use crossfix_geometry::{BearingModel, SightLine};
use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Matrix6, Matrix6x2, Point3, Vector2, Vector6};

use crate::range_chart::{ChartPoint, StateChart, StateUpdate};
use crate::uncertainty::{CameraUncertainty, SharedErrors, SharedTies, Shifts};

/// Most rounds of the iterated update: with a range known to a factor of three it takes four or
/// five. With half of it the vaguest end before they have converged.
pub(crate) const MAX_ROUNDS: usize = 10;
/// The iteration has converged when what the linearisation leaves out, the square of the round's
/// step (as an angle), is less than this share of the standard deviation of the bearing's noise.
/// With half of it some updates take a round more, for the same result.
pub(crate) const SETTLED: f64 = 0.01;
/// If the logarithm of the range has a larger standard deviation than this, the iteration starts
/// where the sight line passes nearest to the bearing: started at the middle of the range it may
/// not find the crossing. With half of it targets whose range is known to 7 % are shown as
/// directions; with twice as much, the crossing may be missed.
pub(crate) const VAGUE_LOG_RANGE_SD: f64 = 0.1;

/// A bearing with the uncertainties of its camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured<'a> {
    pub(crate) line: &'a SightLine,
    pub(crate) camera: &'a CameraUncertainty,
    /// What the track knows of the camera's shared errors.
    pub(crate) errors: &'a SharedErrors,
}

/// A state updated by a bearing.
#[derive(Clone, Debug)]
pub(crate) struct Updated {
    pub(crate) state: KinematicState,
    /// Normalised innovation squared of the bearing, two degrees of freedom.
    pub(crate) nis: f64,
    /// Logarithm of the bearing's likelihood, 1/sr.
    pub(crate) log_likelihood: f64,
    pub(crate) update: CrossUpdate,
}

/// What a bearing tells of errors outside the state that are correlated with it; for one motion
/// model, or as the mean over the models.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CrossUpdate {
    /// carried = I - K H. The update turns Y, the cross-covariance of the state with any outside
    /// error, into `carried * Y`, ...
    pub(crate) carried: Matrix6<f64>,
    /// ... less `gained` times the covariance of the camera's own errors with that error; gained =
    /// K J.
    pub(crate) gained: SharedTies,
    /// H: the bearing's Jacobian by position and velocity before the update, ...
    pub(crate) by: Matrix2x6<f64>,
    /// ... and J: its Jacobian by the camera's errors.
    pub(crate) shifts: Shifts,
    /// S^-1, the inverse of the innovation's covariance, ...
    pub(crate) weight: Matrix2<f64>,
    /// ... and its product with the innovation, S^-1 z: the estimate of an error whose covariance
    /// with the bearing is C grows by C S^-1 z, ...
    pub(crate) pull: Vector2<f64>,
    /// ... the covariance of S^-1 z over the models (zero for one model), ...
    pub(crate) pull_spread: Matrix2<f64>,
    /// ... and the covariance of the updated state's mean with S^-1 z over the models.
    pub(crate) moved: Matrix6x2<f64>,
}

/// The update of one motion model.
#[derive(Clone, Copy)]
pub(crate) struct ModelUpdate<'a> {
    pub(crate) after: &'a Updated,
    /// The model's probability after the bearing.
    pub(crate) probability: f64,
}

impl CrossUpdate {
    /// The mean over motion models, and the spread over them.
    pub(crate) fn over<'a>(models: impl Iterator<Item = ModelUpdate<'a>> + Clone) -> Self {
        let mut mean = Self {
            carried: Matrix6::zeros(),
            gained: SharedTies::zeros(),
            by: Matrix2x6::zeros(),
            shifts: Shifts::zeros(),
            weight: Matrix2::zeros(),
            pull: Vector2::zeros(),
            pull_spread: Matrix2::zeros(),
            moved: Matrix6x2::zeros(),
        };
        let mut state = Vector6::zeros();
        for ModelUpdate { after: Updated { state: after, update, .. }, probability } in
            models.clone()
        {
            mean.carried += update.carried * probability;
            mean.gained += update.gained * probability;
            mean.by += update.by * probability;
            mean.shifts += update.shifts * probability;
            mean.weight += update.weight * probability;
            mean.pull += update.pull * probability;
            state += after.mean * probability;
        }
        for ModelUpdate { after: Updated { state: after, update, .. }, probability } in models {
            let pull = update.pull - mean.pull;
            mean.pull_spread += pull * pull.transpose() * probability;
            mean.moved += (after.mean - state) * pull.transpose() * probability;
        }
        mean
    }
}

/// The bearing's measurement equation, linearised at one point of the chart.
struct Linearised {
    /// H: Jacobian by the first three coordinates; a bearing depends on the position only.
    by: Matrix2x3<f64>,
    shifts: Shifts,
    /// The bearing's noise, with the spread of the camera's errors.
    noise: Matrix2<f64>,
    /// P H' + X J', the covariance of state and bearing.
    across: Matrix6x2<f64>,
    /// S^-1 and |S|.
    inverse: Matrix2<f64>,
    determinant: f64,
    innovation: Vector2<f64>,
    /// Distance of the point from the camera, m.
    range: f64,
}

impl Linearised {
    /// At the point with these coordinates; P and X are the state's covariance and ties. `None` if
    /// the numbers fail.
    fn at(
        point: &ChartPoint,
        coordinates: &Vector6<f64>,
        covariance: &Matrix6<f64>,
        ties: &SharedTies,
        &Measured { line, camera, errors }: &Measured<'_>,
    ) -> Option<Self> {
        let model = BearingModel::new(line.origin, point.place)?;
        let residual = model.residual(line)?;
        let shifts = camera.shifts(&model, point.velocity);
        let by: Matrix2x3<f64> = model.by_position() * point.place_by;
        let tied: Matrix6x2<f64> = ties * shifts.transpose();
        // Cov(state, bearing) = P H' + X J', and Cov(predicted position, shift) = H X J'.
        let seen: Matrix6x2<f64> = covariance.fixed_columns::<3>(0) * by.transpose();
        let cross: Matrix2<f64> = by * tied.fixed_rows::<3>(0);
        let noise = camera.noise(&model, point.velocity, &model.covariance_of(line))
            + errors.spread(&shifts);
        // S = H P H' + H X J' + J X' H' + J W J' + R, with W the covariance of s.
        let spread = by * seen.fixed_rows::<3>(0) + cross + cross.transpose() + noise;
        let (determinant, inverse) = (spread.determinant(), spread.try_inverse()?);
        // z of the iterated filter, linearised at this point: residual + H x - J E(s).
        let innovation = residual + by * coordinates.fixed_rows::<3>(0) - shifts * errors.mean;
        (determinant > 0.0 && spread.m11 > 0.0).then(|| Self {
            by,
            shifts,
            noise,
            across: seen + tied,
            inverse,
            determinant,
            innovation,
            range: model.range,
        })
    }

    /// The update that has come to these coordinates by this gain, with the prior covariance in the
    /// chart's coordinates. `None` if the numbers fail.
    fn completed_at(
        &self,
        chart: &StateChart,
        coordinates: &Vector6<f64>,
        covariance: &Matrix6<f64>,
        gain: Matrix6x2<f64>,
    ) -> Option<Updated> {
        let Self { innovation, across, inverse, determinant, by, shifts, .. } = *self;
        // Only rounding can make it negative, where S is nearly singular.
        let nis = innovation.dot(&(inverse * innovation)).max(0.0);
        let point = chart.point(coordinates);
        // P <- P - K S K', and back to position and velocity.
        let StateUpdate { covariance, carried, gain } =
            chart.from(&point, covariance - gain * across.transpose(), &by, gain);
        let state = KinematicState {
            mean: point.mean(),
            covariance: (covariance + covariance.transpose()) / 2.0,
        };
        // If the prior range was uncertain by kilometres, rounding may leave a covariance that is
        // not positive definite.
        let positive = state.covariance.cholesky().is_some();
        (positive && nis.is_finite()).then(|| Updated {
            state,
            nis,
            // ln N(z; 0, S) in two dimensions: -(z' S^-1 z + ln((2 pi)^2 |S|)) / 2.
            log_likelihood: -(nis + (4.0 * PI.powi(2) * determinant).ln()) / 2.0,
            update: CrossUpdate {
                carried,
                gained: gain * shifts,
                by: by * chart.place_by_state(),
                shifts,
                weight: inverse,
                pull: inverse * innovation,
                pull_spread: Matrix2::zeros(),
                moved: Matrix6x2::zeros(),
            },
        })
    }
}

/// The state updated by a bearing of the same time. `seen_from` is the position of the camera that
/// alone follows the target, so that the range from there is uncertain. `None` if the numbers fail.
pub(crate) fn bearing_update(
    prior: &KinematicState,
    seen_from: Option<Point3<f64>>,
    measured: &Measured<'_>,
) -> Option<Updated> {
    let chart = match seen_from {
        Some(origin) => StateChart::by_range(origin, prior)?,
        None => StateChart::cartesian(prior),
    };
    // P and X in the chart's coordinates, whose origin is the prior mean.
    let (covariance, ties) = chart.expressed(&prior.covariance, &measured.errors.ties);
    // In the range chart a bearing of the following camera itself measures the direction alone,
    // linearly: one round is enough.
    let is_own = seen_from == Some(measured.line.origin);
    let mut coordinates = Vector6::zeros();
    if !is_own && seen_from.is_some() && covariance.m33 > VAGUE_LOG_RANGE_SD.powi(2) {
        coordinates[2] = chart.nearest_to(measured.line)?;
    }
    for round in 1.. {
        let point = chart.point(&coordinates);
        let seen = Linearised::at(&point, &coordinates, &covariance, &ties, measured)?;
        // K = (P H' + X J') S^-1, and the next point is K z.
        let gain = seen.across * seen.inverse;
        let next = gain * seen.innovation;
        let moved = point.place_by * (next - coordinates).fixed_rows::<3>(0);
        let moved = moved.norm() / seen.range;
        coordinates = next;
        let settled = moved.powi(2) < SETTLED * (seen.noise.trace() / 2.0).sqrt();
        if !(is_own || settled || round == MAX_ROUNDS) {
            continue;
        }
        return seen.completed_at(&chart, &coordinates, &covariance, gain);
    }
    None
}
