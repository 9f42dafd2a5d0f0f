//! The target of a bearing, and how the cameras' errors shift it.

use nalgebra::Vector3;

use super::super::curve::Basis;

/// A bearing's target at a state, as a camera with the stated pose would see it: its place, and the
/// shift of that place by each component of the cameras' errors.
#[derive(Clone, Debug)]
pub(super) struct PredictedTarget {
    pub(super) basis: Basis,
    pub(super) place: Vector3<f64>,
    pub(super) shifts: PlaceShifts,
}

/// Shifts of a place by components of one camera's errors: two of its clock and six of its pose at
/// most.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PlaceShifts {
    all: [PlaceShift; 8],
    count: usize,
}

/// Shift of a place by one component of the errors.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PlaceShift {
    /// Index of the component in the prior.
    pub(super) component: usize,
    /// Derivative of the place by it.
    pub(super) by: Vector3<f64>,
}

impl PlaceShifts {
    pub(super) fn add(&mut self, component: usize, by: Vector3<f64>) {
        self.all[self.count] = PlaceShift { component, by };
        self.count += 1;
    }

    pub(super) fn all(&self) -> &[PlaceShift] {
        &self.all[..self.count]
    }
}
