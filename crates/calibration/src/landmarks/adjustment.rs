//! Levenberg-Marquardt adjustment of pose and lens to clicks.

use crossfix_geometry::turn_vector;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix6};

use super::LandmarkPicture;
use super::seen::{self, ClickResidual, POSE, PoseAndLens};
use crate::lens::{self, LensUncertainty};

/// Steps at most: from a place that is wrong by half of the landmarks' range it takes fifteen. With
/// half of it a poor start may end before it has settled.
const STEPS: usize = 40;
/// Relative decrease of the cost below which nothing changes any more. With half of it the same.
const SETTLED: f64 = 1e-9;
/// Two poses fit alike if the clicks tell them apart by less than this difference of squares: three
/// deviations. With half of it a wrong pose is returned without a word where clicks err by 2.1
/// deviations, as in one picture of thirty.
const INDISTINGUISHABLE: f64 = 9.0;
/// Poses are the same if they are within this many deviations, squared. With half of it two starts
/// that stop a little short of one pose may count as two, and the picture is refused.
const SAME: f64 = 25.0;

/// State of least cost near a start.
#[derive(Clone, Debug)]
pub(super) struct AdjustedCamera {
    pub(super) state: PoseAndLens,
    /// Sum of squared residuals, in deviations, of clicks, lens and survey.
    pub(super) cost: f64,
    /// Covariance of rotation, centre and lens from the landmarks' independent errors.
    pub(super) covariance: DMatrix<f64>,
    /// Covariance that the common turn of all directions adds.
    by_sky_turn: DMatrix<f64>,
}

impl AdjustedCamera {
    /// Whether another pose fits as well, and is a different one.
    pub(super) fn is_rivalled_by(&self, other: &Self) -> bool {
        // Costs are squares of deviations: a difference of 9 is three deviations.
        if other.cost > self.cost + INDISTINGUISHABLE {
            return false;
        }
        let turned = turn_vector(&(self.state.rotation.inverse() * other.state.rotation)).norm();
        let moved = other.state.centre - self.state.centre;
        // Mahalanobis distance of the centres, and the turn compared with its variance.
        let place = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let turns = self.covariance.fixed_view::<3, 3>(0, 0).trace();
        let apart = place.cholesky().map_or(0.0, |factor| moved.dot(&factor.solve(&moved)));
        apart > SAME && turned * turned > SAME * turns
    }

    /// The pose's covariance with the lens fixed, and the lens's uncertainty with how the pose
    /// follows it.
    pub(super) fn pose_and_lens(&self) -> Option<(Matrix6<f64>, LensUncertainty)> {
        let all = &self.covariance + &self.by_sky_turn;
        let count = all.nrows() - POSE;
        let tied = all.view((0, POSE), (POSE, count));
        let lens = all.view((POSE, POSE), (count, count)).into_owned();
        // Regression of the pose on the lens: C(pose, lens) C(lens)^-1.
        let pose_by_lens = lens.clone().cholesky()?.solve(&tied.transpose()).transpose();
        // C(pose | lens) = C(pose) - B C(lens, pose).
        let given_lens = all.view((0, 0), (POSE, POSE)) - &pose_by_lens * tied.transpose();
        let given_lens = (&given_lens + given_lens.transpose()) * 0.5;
        let pose = Matrix6::from_column_slice(given_lens.as_slice());
        Some((pose, LensUncertainty { covariance: lens, pose_by_lens }))
    }
}

/// Normal equations at a state.
struct Equations {
    cost: f64,
    information: DMatrix<f64>,
    right: DVector<f64>,
}

impl Equations {
    fn at(picture: &LandmarkPicture, state: &PoseAndLens) -> Option<Self> {
        let count = POSE + lens::numbers(&state.intrinsics);
        let mut equations = Self {
            cost: 0.0,
            information: DMatrix::zeros(count, count),
            right: DVector::zeros(count),
        };
        // Cost r' W r, information J' W J, right side -J' W r.
        for landmark in &picture.landmarks {
            let seen = seen::see(&landmark.at, landmark.pixel, state)?;
            let weight = seen.noise(landmark.click_sd_px).try_inverse()?;
            let ClickResidual { residual, by, .. } = seen;
            equations.cost += residual.dot(&(weight * residual));
            equations.information += by.transpose() * weight * &by;
            equations.right -= by.transpose() * (weight * residual);
        }
        let found = lens::values(&state.intrinsics);
        let known = lens::values(&picture.intrinsics);
        let deviations = picture.freedom.prior_sd(&picture.intrinsics);
        for (number, sd) in deviations.into_iter().enumerate() {
            equations.hold(POSE + number, found[number] - known[number], sd);
        }
        if let Some(place) = &picture.place {
            for axis in 0..3 {
                let off = state.centre[axis] - place.position[axis];
                equations.hold(3 + axis, off, place.sd_m[axis]);
            }
        }
        Some(equations)
    }

    fn hold(&mut self, unknown: usize, off: f64, sd: f64) {
        let weight = sd.powi(-2);
        self.cost += off * off * weight;
        self.information[(unknown, unknown)] += weight;
        self.right[unknown] -= off * weight;
    }

    /// The step, with each unknown's information enlarged by the share `damping` of itself.
    fn step(&self, damping: f64) -> Option<DVector<f64>> {
        let mut damped = self.information.clone();
        for k in 0..damped.nrows() {
            damped[(k, k)] *= 1.0 + damping;
        }
        Some(Scaled::of(&damped)?.solve(&self.right))
    }
}

/// Cholesky factor of a matrix of unknowns whose units differ by many powers of ten: scaled to a
/// unit diagonal.
struct Scaled {
    factor: Cholesky<f64, Dyn>,
    scale: DVector<f64>,
}

impl Scaled {
    fn of(matrix: &DMatrix<f64>) -> Option<Self> {
        let scale = matrix.diagonal().map(|value| value.sqrt().recip());
        if !scale.iter().all(|value| value.is_finite()) {
            return None;
        }
        let unit = |i: usize, j: usize| matrix[(i, j)] * scale[i] * scale[j];
        let factor = DMatrix::from_fn(matrix.nrows(), matrix.ncols(), unit).cholesky()?;
        Some(Self { factor, scale })
    }

    fn solve(&self, right: &DVector<f64>) -> DVector<f64> {
        self.factor.solve(&right.component_mul(&self.scale)).component_mul(&self.scale)
    }

    fn inverse(&self) -> DMatrix<f64> {
        let unit = self.factor.inverse();
        // A^-1 = D (D A D)^-1 D.
        DMatrix::from_fn(unit.nrows(), unit.ncols(), |i, j| {
            unit[(i, j)] * self.scale[i] * self.scale[j]
        })
    }
}

/// The best state near a start; `None` if none is found, or some unknown is not determined at all.
pub(super) fn adjust(picture: &LandmarkPicture, start: PoseAndLens) -> Option<AdjustedCamera> {
    let mut state = start;
    let mut equations = Equations::at(picture, &state)?;
    // Levenberg-Marquardt: a step that raises the cost is tried again, ten times more damped.
    let mut damping = 1e-3;
    for _ in 0..STEPS {
        let Some(step) = equations.step(damping) else {
            damping *= 10.0;
            continue;
        };
        let next = state.moved(&step);
        match Equations::at(picture, &next) {
            Some(after) if after.cost <= equations.cost => {
                let fell = equations.cost - after.cost;
                (state, equations) = (next, after);
                damping /= 10.0;
                if fell < SETTLED * (1.0 + equations.cost) {
                    break;
                }
            }
            _ => damping *= 10.0,
        }
    }
    let covariance = Scaled::of(&equations.information)?.inverse();
    let by_sky_turn = by_sky_turn(picture, &state, &covariance)?;
    let is_finite = covariance.iter().chain(&by_sky_turn).all(|value| value.is_finite());
    is_finite.then_some(AdjustedCamera { state, cost: equations.cost, covariance, by_sky_turn })
}

/// Covariance that a common turn of all directions adds to the unknowns (consider covariance,
/// Schmidt): the unknowns respond to the turn as they respond to the clicks that it moves.
fn by_sky_turn(
    picture: &LandmarkPicture,
    state: &PoseAndLens,
    covariance: &DMatrix<f64>,
) -> Option<DMatrix<f64>> {
    let mut pulled = DMatrix::zeros(covariance.nrows(), 3);
    for landmark in &picture.landmarks {
        let seen = seen::see(&landmark.at, landmark.pixel, state)?;
        let weight = seen.noise(landmark.click_sd_px).try_inverse()?;
        pulled += seen.by.transpose() * weight * seen.by_sky_turn;
    }
    // P J' W J_turn is the response of the unknowns to the turn.
    let follows = covariance * pulled;
    Some(&follows * picture.sky_turn * follows.transpose())
}
