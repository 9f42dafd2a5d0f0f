//! One bearing into one state: an iterated extended Kalman update in the coordinates of
//! [`RangeChart`], with the camera's shared errors considered (Schmidt); what they are is told of apart.

use std::f64::consts::PI;

use crossfix_filter::KinematicState;
use crossfix_geometry::{BearingModel, SightLine};
use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Matrix6, Matrix6x2, Point3, Vector2, Vector6};

use crate::range_chart::Chart;
use crate::uncertainty::{CameraUncertainty, SharedErrors, SharedTies, Shifts};

/// Rounds of the iterated update: from a range known to a factor of three it takes four or five.
const MAX_ROUNDS: usize = 10;
/// The linearisation has settled when what a round leaves out, the square of the angle of its step,
/// is less than this share of the bearing's noise.
const SETTLED: f64 = 0.01;
/// A range known worse than this (standard deviation of its logarithm) is looked for along the
/// sight line first: from its middle the iteration may not find the crossing.
pub(crate) const VAGUE_LOG_RANGE_SD: f64 = 0.1;

/// A bearing with what its camera is uncertain of.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured<'a> {
    pub(crate) line: &'a SightLine,
    pub(crate) camera: &'a CameraUncertainty,
    /// What is known of the camera's shared errors.
    pub(crate) errors: &'a SharedErrors,
}

/// A state after a bearing.
#[derive(Clone, Debug)]
pub(crate) struct Updated {
    pub(crate) state: KinematicState,
    /// Squared Mahalanobis distance of the bearing, two degrees of freedom.
    pub(crate) nis: f64,
    /// Logarithm of the bearing's likelihood, 1/sr.
    pub(crate) log_likelihood: f64,
    pub(crate) told: Told,
}

/// What a bearing tells of all that goes with it, or what it tells in the mean over the models.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Told {
    /// What the update does to the state's covariance with any error: `carried * ties`, ...
    pub(crate) carried: Matrix6<f64>,
    /// ... less `gained` times the camera's own errors' covariance with it.
    pub(crate) gained: SharedTies,
    /// How the bearing follows position and velocity before it, ...
    pub(crate) by: Matrix2x6<f64>,
    /// ... and the camera's errors.
    pub(crate) shifts: Shifts,
    /// The inverse S^-1 of the innovation's covariance, ...
    pub(crate) weight: Matrix2<f64>,
    /// ... and its product with the innovation, S^-1 z: an error of which C is the covariance with
    /// the bearing is thought to be C S^-1 z larger, ...
    pub(crate) pull: Vector2<f64>,
    /// ... with the covariance of that over the models, ...
    pub(crate) pull_spread: Matrix2<f64>,
    /// ... and how the state goes with it.
    pub(crate) moved: Matrix6x2<f64>,
}

impl Told {
    /// In the mean over models of such probabilities.
    pub(crate) fn over<'a>(models: impl Iterator<Item = (&'a Updated, f64)> + Clone) -> Self {
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
        for (Updated { state: after, told, .. }, probability) in models.clone() {
            mean.carried += told.carried * probability;
            mean.gained += told.gained * probability;
            mean.by += told.by * probability;
            mean.shifts += told.shifts * probability;
            mean.weight += told.weight * probability;
            mean.pull += told.pull * probability;
            state += after.mean * probability;
        }
        for (Updated { state: after, told, .. }, probability) in models {
            let pull = told.pull - mean.pull;
            mean.pull_spread += pull * pull.transpose() * probability;
            mean.moved += (after.mean - state) * pull.transpose() * probability;
        }
        mean
    }
}

/// The state after a bearing of its time; `seen_from` is where the camera stands that follows the
/// target alone, so that the range is uncertain from there. `None` if the numbers fail.
pub(crate) fn updated(
    prior: &KinematicState,
    seen_from: Option<Point3<f64>>,
    measured: &Measured<'_>,
) -> Option<Updated> {
    let Measured { line, camera, errors } = *measured;
    let chart = match seen_from {
        Some(origin) => Chart::by_range(origin, prior)?,
        None => Chart::cartesian(prior),
    };
    let (covariance, ties) = chart.expressed(&prior.covariance, &errors.ties);
    let is_own = seen_from == Some(line.origin);
    let mut coordinates = Vector6::zeros();
    if !is_own && seen_from.is_some() && covariance.m33 > VAGUE_LOG_RANGE_SD.powi(2) {
        coordinates[2] = chart.nearest_to(line)?;
    }
    for round in 1.. {
        let point = chart.point(&coordinates);
        let model = BearingModel::new(line.origin, point.place)?;
        let offset = model.offset(line)?;
        let shifts = camera.shifts(&model, point.velocity);
        // Of the state only the place is seen: the first three coordinates.
        let by: Matrix2x3<f64> = model.by_position() * point.place_by;
        let tied: Matrix6x2<f64> = ties * shifts.transpose();
        let seen: Matrix6x2<f64> = covariance.fixed_columns::<3>(0) * by.transpose();
        let across = seen + tied;
        let cross: Matrix2<f64> = by * tied.fixed_rows::<3>(0);
        let noise = camera.noise(&model, point.velocity, &model.covariance_of(line))
            + errors.spread(&shifts);
        let spread = by * seen.fixed_rows::<3>(0) + cross + cross.transpose() + noise;
        let determinant = spread.determinant();
        let inverse = spread.try_inverse()?;
        if !(determinant > 0.0 && spread.m11 > 0.0) {
            return None;
        }
        let innovation: Vector2<f64> =
            offset + by * coordinates.fixed_rows::<3>(0) - shifts * errors.mean;
        let gain = across * inverse;
        let next = gain * innovation;
        let moved = (point.place_by * (next - coordinates).fixed_rows::<3>(0)).norm() / model.range;
        coordinates = next;
        let settled = moved.powi(2) < SETTLED * (noise.trace() / 2.0).sqrt();
        if !(is_own || settled || round == MAX_ROUNDS) {
            continue;
        }
        // Not negative but for rounding, where the spread is nearly singular.
        let nis = innovation.dot(&(inverse * innovation)).max(0.0);
        let point = chart.point(&coordinates);
        let (covariance, carried, gain) =
            chart.from(&point, covariance - gain * across.transpose(), &by, gain);
        let state = KinematicState {
            mean: point.mean(),
            covariance: (covariance + covariance.transpose()) / 2.0,
        };
        // Where a place was known to no kilometre, rounding may leave of it less than nothing.
        let positive = state.covariance.cholesky().is_some();
        return (positive && state.is_finite() && nis.is_finite()).then(|| Updated {
            state,
            nis,
            log_likelihood: -(nis + (4.0 * PI.powi(2) * determinant).ln()) / 2.0,
            told: Told {
                carried,
                gained: gain * shifts,
                by: by * chart.place_by_state(),
                shifts,
                weight: inverse,
                pull: inverse * innovation,
                pull_spread: Matrix2::zeros(),
                moved: Matrix6x2::zeros(),
            },
        });
    }
    None
}
