//! The order in which the unknowns stand.
//!
//! Unknowns that change with time make a chain in which each is tied to its neighbours alone: a
//! step of the chain begins with the knots of what drifts (each camera's clock, then the three axes
//! of the log's bias) and goes on with the trajectory's coefficients up to the next knots. Unknowns
//! that do not change with time follow.

use super::spline::{IN_A_STEP, SPAN, TrajectorySpline};

/// Steps of the chain that one row may touch: trajectory and knots reach from a row's own step into
/// the next one, and a clock's wander may have its knots in another step than the trajectory's.
const STEPS_IN_A_ROW: usize = 3;

/// The order of the unknowns for a number of cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct UnknownOrder {
    pub(super) cameras: usize,
    /// Axes of the log's bias: three, or none without a log.
    axes: usize,
    pub(super) steps: usize,
}

impl UnknownOrder {
    /// Order for a flight with this trajectory and this number of axes of a log's bias.
    pub(super) fn of(way: &TrajectorySpline, cameras: usize, axes: usize) -> Self {
        Self { cameras, axes, steps: way.coefficients.len() / IN_A_STEP }
    }

    /// Number of unknowns in one step.
    fn step(self) -> usize {
        self.cameras + self.axes + 3 * IN_A_STEP
    }

    /// Number of unknowns in the chain.
    pub(super) fn chain(self) -> usize {
        self.steps * self.step()
    }

    /// Bandwidth: two unknowns of one row are less than this apart.
    pub(super) fn band(self) -> usize {
        STEPS_IN_A_ROW * self.step()
    }

    /// Index of one axis of a coefficient of the trajectory.
    pub(super) fn way(self, coefficient: usize, axis: usize) -> usize {
        let (step, within) = (coefficient / IN_A_STEP, coefficient % IN_A_STEP);
        step * self.step() + self.cameras + self.axes + 3 * within + axis
    }

    /// Index of a knot of a camera's clock.
    pub(super) fn wander(self, knot: usize, camera: usize) -> usize {
        knot * self.step() + camera
    }

    /// Index of a knot of the log's bias.
    pub(super) fn bias(self, knot: usize, axis: usize) -> usize {
        knot * self.step() + self.cameras + axis
    }
}

/// Range of the chain's steps that a row touches.
#[derive(Clone, Copy, Debug)]
pub(super) struct Touched {
    first: usize,
    last: usize,
}

impl Touched {
    /// Steps of a row that uses [`SPAN`] coefficients from `coefficient` on, and two knots from
    /// `knot` on.
    pub(super) fn by(coefficient: usize, knot: usize) -> Self {
        let last = (coefficient + SPAN - 1) / IN_A_STEP;
        Self { first: knot.min(coefficient / IN_A_STEP), last: last.max(knot + 1) }
    }

    /// Range that covers two rows together.
    pub(super) fn and(self, other: Self) -> Self {
        Self { first: self.first.min(other.first), last: self.last.max(other.last) }
    }

    /// Whether one row may touch this range.
    pub(super) fn fit(self) -> bool {
        self.last - self.first < STEPS_IN_A_ROW
    }
}
