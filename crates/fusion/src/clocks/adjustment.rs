//! Adjustment of a window: fits the target's trajectory, the clocks and the poses to its bearings
//! together.

mod robust;
mod target;

use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Matrix3, Vector2, Vector3};

use super::batch_means::BatchMeans;
use super::curve::{Basis, Curve, CurvePoint, TimedPlace};
use super::window::WindowBearing;
use crate::spatial::CHI_SQUARE_2_MEDIAN;
use robust::{BearingCost, OUTLIER, RobustCost};
use target::{PlaceShift, PlaceShifts, PredictedTarget};

/// Largest factor on a camera's covariances: larger residuals are due to a mistake, not to noise,
/// and are not made likely by taking them for noise. With half of it a camera that reports a third
/// of its noise never has its clock learnt.
pub(super) const MAX_SCALE: f64 = 16.0;
/// Most iterations of one descent, which bounds its time; most take three to six, and half of it
/// would do for these.
const MAX_ROUNDS: usize = 25;
/// Levenberg-Marquardt damping relative to the diagonal, at first. With half of it the same: it
/// changes by factors of ten.
const FIRST_DAMPING: f64 = 1e-4;
/// Damping at which a descent is given up: its steps are ten thousandths by then. With half of it
/// the same, for the same reason.
const MAX_DAMPING: f64 = 1e4;
/// A descent ends when the sum of squared distances falls by less than this. With half, the same.
const SETTLED: f64 = 1e-3;
/// Densities of the jerk that are tried, m^2/s^5, powers of ten: straight lines to racing drones.
/// With half of the upper end the fit of a racing drone takes its turns for errors of the clocks.
const DENSITIES: std::ops::RangeInclusive<i32> = -5..=4;

/// The time of a bearing.
#[derive(Clone, Copy, Debug)]
struct BearingTime {
    /// By the reference's clock, s.
    reference_s: f64,
    /// After the prior's epoch by the camera's own clock, s.
    since_epoch_s: f64,
}

/// The most likely state with one density of the jerk.
#[derive(Clone, Debug)]
struct DensityFit {
    state: WindowState,
    /// As [`DENSITIES`].
    density: i32,
    /// Twice the log evidence (Laplace's), up to a constant.
    evidence: f64,
}

/// Indices of a camera's unknowns among the components of the prior.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unknowns {
    /// Index of its clock's offset, with the drift the next; `None` for the reference.
    pub(super) clock: Option<usize>,
    /// Index of its pose error: three of rotation, three of position; `None` where it is exact.
    pub(super) pose: Option<usize>,
}

/// Prior of the cameras' clocks and poses.
#[derive(Clone, Debug)]
pub(super) struct ClockAndPosePrior {
    pub(super) mean: DVector<f64>,
    pub(super) precision: DMatrix<f64>,
    /// Time at which the prior's offsets hold, s after the window's beginning.
    pub(super) epoch_s: f64,
    pub(super) cameras: Vec<Unknowns>,
}

/// State that is fitted: coefficients of the target's trajectory, clocks and poses of the cameras.
#[derive(Clone, Debug)]
struct WindowState {
    coefficients: DVector<f64>,
    cameras: DVector<f64>,
}

/// Minus twice the log posterior density at a state, up to a constant, with half its gradient and
/// half its second derivative (Gauss-Newton's).
#[derive(Clone, Debug)]
struct Quadratic {
    cost: f64,
    gradient: DVector<f64>,
    information: DMatrix<f64>,
}

/// Result of an adjustment.
#[derive(Clone, Debug)]
pub(super) struct AdjustedCameras {
    pub(super) cameras: DVector<f64>,
    pub(super) covariance: DMatrix<f64>,
    /// Factor on each camera's reported covariances: 1 where these agree with its residuals.
    pub(super) scales: Vec<f64>,
    /// Factor by which the bearings of each camera repeat one another, at least 1.
    pub(super) inflations: Vec<f64>,
    /// Share of each camera's bearings that do not fit.
    pub(super) outlier_shares: Vec<f64>,
    /// Squared Mahalanobis distance of clocks and poses from their prior.
    pub(super) pulled: f64,
    /// Twice the log evidence of these bearings under the prior, up to what is the same for any
    /// prior.
    pub(super) evidence: f64,
}

/// One window's bearings, with the prior of its cameras.
#[derive(Clone, Debug)]
pub(super) struct Adjustment<'a> {
    sights: &'a [WindowBearing],
    curve: Curve,
    prior: &'a ClockAndPosePrior,
    /// Factor on each camera's covariances.
    scales: Vec<f64>,
    /// Weight of each camera's bearings: inverse of the factor by which they repeat one another.
    weights: Vec<f64>,
}

impl<'a> Adjustment<'a> {
    pub(super) fn new(
        sights: &'a [WindowBearing],
        curve: Curve,
        prior: &'a ClockAndPosePrior,
        inflations: &[f64],
    ) -> Self {
        let weights = inflations.iter().map(|inflation| inflation.recip()).collect();
        Self { sights, curve, prior, scales: vec![1.0; prior.cameras.len()], weights }
    }

    /// Fits trajectory, clocks and poses; `None` if the numbers fail. Evidences compare for equal
    /// weights.
    pub(super) fn solve(mut self, density: i32) -> Option<AdjustedCameras> {
        // Huber's cost still draws the far ones in, while all may be far off; the trimmed one, from
        // then on, lets those of other objects go.
        let (state, _) = self.descend(self.begin()?, density, RobustCost::Huber)?;
        self.rescale(&state, RobustCost::Huber);
        let mut best = self.best_density(state, density)?;
        if self.rescale(&best.state, RobustCost::Trimmed) {
            best = self.best_density(best.state, best.density)?;
        }
        let DensityFit { state, density, evidence } = best;
        let inflations = self.inflations(&state);
        let outlier_shares =
            self.squares(&state).iter().map(|squares| outlier_share(squares)).collect();
        let (covariance, pulled) = self.posterior(&state, density)?;
        Some(AdjustedCameras {
            cameras: state.cameras,
            covariance,
            scales: self.scales,
            inflations,
            outlier_shares,
            pulled,
            evidence,
        })
    }

    /// Sets each camera's covariance factor from its residuals: after the first descent, when not
    /// all may fit, from their median; in the end from the mean of those that fit. Returns whether
    /// a factor has changed much.
    fn rescale(&mut self, state: &WindowState, cost: RobustCost) -> bool {
        let squares = self.squares(state);
        let mut changed = false;
        for (scale, mut squares) in self.scales.iter_mut().zip(squares) {
            if cost == RobustCost::Trimmed {
                squares.retain(|squared| *squared <= OUTLIER);
            }
            squares.sort_unstable_by(f64::total_cmp);
            let count = squares.len() as f64;
            let typical = match (cost, squares.get(squares.len() / 2)) {
                (_, None) => continue,
                (RobustCost::Huber, Some(median)) => median / CHI_SQUARE_2_MEDIAN,
                (RobustCost::Trimmed, Some(_)) => squares.iter().sum::<f64>() / (2.0 * count),
            };
            // Up to three standard errors (of the median; four of the mean) above 1 are chance for
            // a camera whose covariances are right. The squares hold the factor so far.
            let found = typical * *scale;
            let is_chance = found < 1.0 + 4.0 / count.sqrt();
            let next = if is_chance { 1.0 } else { found.min(MAX_SCALE) };
            changed |= (next / *scale - 1.0).abs() > 0.1;
            *scale = next;
        }
        changed
    }

    /// Factor by which the bearings of each camera repeat one another.
    fn inflations(&self, state: &WindowState) -> Vec<f64> {
        let mut means = vec![BatchMeans::default(); self.scales.len()];
        for sight in self.sights {
            let place = self.target(sight, state).place;
            let residual = whitened(sight, place, self.scales[sight.camera]);
            if let Some(residual) = residual.filter(|z| z.norm_squared() <= OUTLIER) {
                means[sight.camera].add(sight.time_s, residual, sight.allowance);
            }
        }
        means.iter().map(BatchMeans::inflation).collect()
    }

    /// Squared Mahalanobis distances of each camera's bearings.
    fn squares(&self, state: &WindowState) -> Vec<Vec<f64>> {
        let mut squares = vec![Vec::new(); self.scales.len()];
        for sight in self.sights {
            let seen = BearingResidual::at(
                sight,
                self.target(sight, state).place,
                self.scales[sight.camera],
            );
            squares[sight.camera].push(seen.map_or(f64::INFINITY, |seen| seen.squared));
        }
        squares
    }

    /// Start of the descent: clocks and poses of the prior, a trajectory through the track's
    /// places.
    fn begin(&self) -> Option<WindowState> {
        let cameras = self.prior.mean.clone();
        let places = self.sights.iter().map(|sight| TimedPlace {
            time_s: self.time(sight, &cameras).reference_s,
            place: sight.place,
        });
        Some(WindowState { coefficients: self.curve.fit(places, 1.0)?, cameras })
    }

    /// Time of a bearing with the clocks of a state.
    fn time(&self, sight: &WindowBearing, cameras: &DVector<f64>) -> BearingTime {
        let since_epoch_s = sight.time_s - self.prior.epoch_s;
        let clock = self.prior.cameras[sight.camera].clock;
        let offset = clock.map_or(0.0, |place| cameras[place] + cameras[place + 1] * since_epoch_s);
        BearingTime { reference_s: sight.time_s - offset, since_epoch_s }
    }

    /// The target of a bearing. A clock that is ahead by o shows the target where it was o ago: the
    /// offset moves the place by minus the velocity, the drift by that times the time since the
    /// epoch. A camera whose stated pose is turned by d and moved by c against its true one has the
    /// target at p + d x (p - origin) + c.
    fn target(&self, sight: &WindowBearing, state: &WindowState) -> PredictedTarget {
        let BearingTime { reference_s, since_epoch_s } = self.time(sight, &state.cameras);
        let basis = self.curve.basis(reference_s);
        // p(t - o - d t'): dp/do = -v, dp/dd = -v t', with t' the time since the epoch.
        let CurvePoint { mut place, velocity } = basis.at(&state.coefficients);
        let Unknowns { clock, pose } = self.prior.cameras[sight.camera];
        let mut shifts = PlaceShifts::default();
        if let Some(first) = clock {
            shifts.add(first, -velocity);
            shifts.add(first + 1, -velocity * since_epoch_s);
        }
        if let Some(first) = pose {
            let away = place - sight.line.origin.coords;
            for axis in 0..3 {
                let unit = Vector3::ith(axis, 1.0);
                // d (x) away = sum over the axes of d_i (e_i x away), to first order in the turn.
                let turned = unit.cross(&away);
                shifts.add(first + axis, turned);
                shifts.add(first + 3 + axis, unit);
                place +=
                    turned * state.cameras[first + axis] + unit * state.cameras[first + 3 + axis];
            }
        }
        PredictedTarget { basis, place, shifts }
    }

    /// Climbs to the jerk density of the greatest evidence.
    fn best_density(&self, state: WindowState, first: i32) -> Option<DensityFit> {
        let mut best = self.with_evidence(state, first)?;
        for step in [-1, 1] {
            let mut moved = false;
            while DENSITIES.contains(&(best.density + step)) {
                let Some(next) = self.with_evidence(best.state.clone(), best.density + step) else {
                    break;
                };
                // It climbs one way only, as long as the evidence grows: a second maximum is not
                // searched for.
                if next.evidence <= best.evidence {
                    break;
                }
                best = next;
                moved = true;
            }
            if moved {
                break;
            }
        }
        Some(best)
    }

    /// Descends with a density of the jerk.
    fn with_evidence(&self, state: WindowState, density: i32) -> Option<DensityFit> {
        let (state, Quadratic { cost, information, .. }) =
            self.descend(state, density, RobustCost::Trimmed)?;
        // ln det A = 2 sum ln L_ii for A = L L'.
        let factor = information.cholesky()?;
        let log_determinant = 2.0 * factor.l_dirty().diagonal().map(f64::ln).sum();
        let before = self.prior.precision.clone().cholesky()?;
        let log_before: f64 = 2.0 * before.l_dirty().diagonal().map(f64::ln).sum();
        // ln det(s R) = 2 ln s + ln det R for the two coordinates of a bearing.
        let scale = |camera: usize| 2.0 * self.weights[camera] * self.scales[camera].ln();
        let scales = self.sights.iter().map(|sight| scale(sight.camera)).sum::<f64>();
        let width = self.curve.log_width(jerk(density));
        // 2 ln Z = ln det(prior precision) - cost - ln det A - widths of curve prior and bearing
        // noise.
        let evidence = log_before - cost - log_determinant - width - scales;
        evidence.is_finite().then_some(DensityFit { state, density, evidence })
    }

    /// Levenberg-Marquardt descent to the most likely state.
    fn descend(
        &self,
        mut state: WindowState,
        density: i32,
        cost: RobustCost,
    ) -> Option<(WindowState, Quadratic)> {
        let mut here = self.quadratic(&state, density, cost);
        let mut damping = FIRST_DAMPING;
        for _ in 0..MAX_ROUNDS {
            // (A + lambda diag A) step = gradient.
            let mut damped = here.information.clone();
            for i in 0..damped.nrows() {
                damped[(i, i)] *= 1.0 + damping;
            }
            let next =
                damped.cholesky().map(|factor| self.moved(&state, &factor.solve(&here.gradient)));
            let there = next.as_ref().map(|next| self.quadratic(next, density, cost));
            match (next, there) {
                (Some(next), Some(there)) if there.cost < here.cost => {
                    let gained = here.cost - there.cost;
                    (state, here) = (next, there);
                    damping /= 10.0;
                    if gained < SETTLED {
                        break;
                    }
                }
                _ if damping > MAX_DAMPING => break,
                // The step is no better, but hardly worse: this is the minimum.
                (Some(_), Some(there)) if there.cost - here.cost < SETTLED => break,
                _ => damping *= 10.0,
            }
        }
        here.cost.is_finite().then_some((state, here))
    }

    fn moved(&self, state: &WindowState, step: &DVector<f64>) -> WindowState {
        let points = state.coefficients.len();
        WindowState {
            coefficients: &state.coefficients - step.rows(0, points),
            cameras: &state.cameras - step.rows(points, state.cameras.len()),
        }
    }

    fn quadratic(&self, state: &WindowState, density: i32, robust: RobustCost) -> Quadratic {
        let mut quadratic = self.prior_quadratic(state, density);
        for sight in self.sights {
            let target = self.target(sight, state);
            let share = self.weights[sight.camera];
            let Some(seen) = BearingResidual::at(sight, target.place, self.scales[sight.camera])
            else {
                // Behind the camera: as far off as can be.
                quadratic.cost += share * robust.of(1e6).cost;
                continue;
            };
            let BearingCost { cost, weight } = robust.of(seen.squared);
            quadratic.cost += share * cost;
            if weight > 0.0 {
                quadratic.add(&target, state.coefficients.len(), &seen, share * weight);
            }
        }
        quadratic.information.fill_lower_triangle_with_upper_triangle();
        quadratic
    }

    /// The prior's part of the cost: of the trajectory, and of clocks and poses.
    fn prior_quadratic(&self, state: &WindowState, density: i32) -> Quadratic {
        let (points, cameras) = (state.coefficients.len(), state.cameras.len());
        let mut information = DMatrix::zeros(points + cameras, points + cameras);
        self.curve.add_prior(&mut information, jerk(density));
        information.view_mut((points, points), (cameras, cameras)).copy_from(&self.prior.precision);
        // Distance d from the prior's mean, 0 for the trajectory: cost d' A d, half gradient A d.
        let mut away = DVector::zeros(points + cameras);
        away.rows_mut(0, points).copy_from(&state.coefficients);
        away.rows_mut(points, cameras).copy_from(&(&state.cameras - &self.prior.mean));
        let gradient = &information * &away;
        Quadratic { cost: away.dot(&gradient), gradient, information }
    }

    /// Posterior covariance of clocks and poses, and their squared distance from the prior.
    fn posterior(&self, state: &WindowState, density: i32) -> Option<(DMatrix<f64>, f64)> {
        let (points, cameras) = (state.coefficients.len(), state.cameras.len());
        let information = self.quadratic(state, density, RobustCost::Trimmed).information;
        // The cameras' columns of A^-1: their covariance, with the trajectory marginalised.
        let mut unit = DMatrix::zeros(points + cameras, cameras);
        unit.view_mut((points, 0), (cameras, cameras)).fill_with_identity();
        let covariance = information.cholesky()?.solve(&unit).rows(points, cameras).into_owned();
        let away = &state.cameras - &self.prior.mean;
        let pulled = away.dot(&(&self.prior.precision * &away));
        let possible = covariance.iter().all(|value| value.is_finite()) && pulled.is_finite();
        possible.then_some((covariance, pulled))
    }
}

fn outlier_share(squares: &[f64]) -> f64 {
    squares.iter().filter(|squared| **squared > OUTLIER).count() as f64
        / squares.len().max(1) as f64
}

/// Residual of a bearing with the target at a place, in units of its noise; `None` if the place
/// lies behind the camera.
fn whitened(sight: &WindowBearing, target: Vector3<f64>, scale: f64) -> Option<Vector2<f64>> {
    let residual = sight.line.tangent_residual(target.into())?;
    // z <- L^-1 z, where R = L L'.
    (sight.line.covariance * scale).cholesky()?.l().solve_lower_triangular(&residual)
}

/// Density of the jerk, m^2/s^5.
fn jerk(power: i32) -> f64 {
    10.0_f64.powi(power)
}

/// The residual of a bearing, with the target at a given place.
#[derive(Clone, Copy, Debug)]
struct BearingResidual {
    /// Squared Mahalanobis distance of the residual.
    squared: f64,
    /// With H as the derivative of the residual z by the place: H' R^-1 z, and H' R^-1 H.
    pull: Vector3<f64>,
    information: Matrix3<f64>,
}

impl BearingResidual {
    /// `None` if the place lies behind the camera.
    fn at(sight: &WindowBearing, target: Vector3<f64>, scale: f64) -> Option<Self> {
        let residual: Vector2<f64> = sight.line.tangent_residual(target.into())?;
        let away = target - sight.line.origin.coords;
        let range = away.norm();
        let direction = away / range;
        // H, the derivative of the direction by the target's place: B' (I - u u') / r.
        let across: Matrix2x3<f64> = sight.line.basis.transpose()
            * (Matrix3::identity() - direction * direction.transpose())
            / range;
        let inverse: Matrix2<f64> = (sight.line.covariance * scale).try_inverse()?;
        let weighed = across.transpose() * inverse;
        let squared = residual.dot(&(inverse * residual));
        let seen = Self { squared, pull: weighed * residual, information: weighed * across };
        seen.squared.is_finite().then_some(seen)
    }
}

impl Quadratic {
    /// Adds a bearing; the cameras' components come after the `points` ones of the trajectory. Of
    /// the information, which is symmetric, the upper triangle alone: there a component's ties to
    /// the trajectory lie in one column.
    fn add(
        &mut self,
        target: &PredictedTarget,
        points: usize,
        seen: &BearingResidual,
        weight: f64,
    ) {
        let (pull, information) = (seen.pull * weight, seen.information * weight);
        let shifts = target.shifts.all();
        let Basis { first, place, .. } = target.basis;
        // The place is the sum of four coefficients, each times its weight a: J = [a1 I .. a4 I].
        for (i, a) in place.iter().enumerate() {
            let row = 3 * (first + i);
            let mut part = self.gradient.fixed_rows_mut::<3>(row);
            part += pull * *a;
            for (k, b) in place.iter().enumerate().skip(i) {
                let mut block = self.information.fixed_view_mut::<3, 3>(row, 3 * (first + k));
                block += information * (a * b);
            }
            for PlaceShift { component, by } in shifts {
                let tied = information * by * *a;
                let mut beside = self.information.fixed_view_mut::<3, 1>(row, points + component);
                beside += tied;
            }
        }
        // Each error of the camera moves the place by its shift: the cameras' columns of J.
        for (k, PlaceShift { component: other, by }) in shifts.iter().enumerate() {
            self.gradient[points + other] += by.dot(&pull);
            let told = information * by;
            for PlaceShift { component: one, by } in &shifts[..=k] {
                let [row, column] = [one.min(other), one.max(other)];
                self.information[(points + row, points + column)] += told.dot(by);
            }
        }
    }
}
