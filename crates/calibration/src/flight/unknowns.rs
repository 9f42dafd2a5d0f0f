//! In what order the unknowns stand.
//!
//! What changes with time makes a chain in which each is tied to its neighbours alone: a step of it
//! begins with the knots of what drifts (each camera's clock, then the three axes of the log's bias)
//! and goes on with the way's coefficients up to the next knots. What does not change follows.

use super::spline::{IN_A_STEP, SPAN, Spline};

/// Steps that one row may touch: beyond the one that it is in, the way and the knots reach into the
/// next one, and a clock's wander puts its knots in another step than the way's.
const STEPS_IN_A_ROW: usize = 3;

/// The order, for so many cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Order {
    pub(super) cameras: usize,
    /// Axes of the log's bias: three, or none without a log.
    axes: usize,
    pub(super) steps: usize,
}

impl Order {
    /// Of a flight of this way with so many axes of a log's bias.
    pub(super) fn of(way: &Spline, cameras: usize, axes: usize) -> Self {
        Self { cameras, axes, steps: way.coefficients.len() / IN_A_STEP }
    }

    /// Unknowns of one step.
    fn step(self) -> usize {
        self.cameras + self.axes + 3 * IN_A_STEP
    }

    /// Unknowns of the chain.
    pub(super) fn chain(self) -> usize {
        self.steps * self.step()
    }

    /// Two unknowns of one row are less than this apart.
    pub(super) fn band(self) -> usize {
        STEPS_IN_A_ROW * self.step()
    }

    /// An axis of a coefficient of the way.
    pub(super) fn way(self, coefficient: usize, axis: usize) -> usize {
        let (step, within) = (coefficient / IN_A_STEP, coefficient % IN_A_STEP);
        step * self.step() + self.cameras + self.axes + 3 * within + axis
    }

    /// A knot of a camera's clock.
    pub(super) fn wander(self, knot: usize, camera: usize) -> usize {
        knot * self.step() + camera
    }

    /// A knot of the log's bias.
    pub(super) fn bias(self, knot: usize, axis: usize) -> usize {
        knot * self.step() + self.cameras + axis
    }
}

/// The steps that a row touches.
#[derive(Clone, Copy, Debug)]
pub(super) struct Touched {
    first: usize,
    last: usize,
}

impl Touched {
    /// By the way from a coefficient on, and knots from one on.
    pub(super) fn by(coefficient: usize, knot: usize) -> Self {
        let last = (coefficient + SPAN - 1) / IN_A_STEP;
        Self { first: knot.min(coefficient / IN_A_STEP), last: last.max(knot + 1) }
    }

    /// By two rows together.
    pub(super) fn and(self, other: Self) -> Self {
        Self { first: self.first.min(other.first), last: self.last.max(other.last) }
    }

    /// Whether one row may touch them.
    pub(super) fn fit(self) -> bool {
        self.last - self.first < STEPS_IN_A_ROW
    }
}
