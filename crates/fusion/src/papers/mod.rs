//! The papers' method of finding targets (Klochko 2020): each period is solved for fixes, and fixes
//! that follow from each other are grouped until a group is good enough to be a target.
//! `initiation.method = "grouping"` chooses it in place of the hypotheses of
//! [`Fusion`](crate::Fusion); `initiation.solver` chooses the system that a period is solved by.
//! Once a track has begun, both methods treat it alike.
//!
//! | here | unknowns | where it is from |
//! |---|---|---|
//! | [`pair`] | two ranges | Klochko 2020, eqs. 7-9 |
//! | [`triple`] | three ranges, velocity | Klochko 2020, eqs. 10-11 |
//! | [`stacked`] | n ranges, velocity | the same for n cameras |
//! | [`stacked_with`] | n ranges, velocity, acceleration | the same with equation 5 in full |
//! | [`pair_range_covariance`], [`triple_range_covariance`] | | the accuracy of ranges, equations 12 and 13 |
//! | [`Grouping`] | | temporal processing, both algorithms |
//!
//! All work in the world frame: where the paper turns the axes of receiver k into those of receiver
//! 1 (`P_k`) and has the base vector `b_k`, here the sight lines are world vectors and `b_k` is the
//! difference of the cameras' centres. That is the same system in other axes. Kalinov's detectors
//! of manoeuvres are in `crossfix_filter`.

mod accuracy;
mod displacement;
mod fixes;
mod grouped;
mod grouping;
mod pair;
mod stacked;
mod triple;

use nalgebra::{Point3, Vector3};

use crate::spatial::Observability;

pub use accuracy::{pair_range_covariance, triple_range_covariance};
pub use displacement::Displacement;
pub use grouping::{Group, Grouping, GroupingRules, PeriodFix, TemporalGate};
pub use pair::{PairSolution, pair};
pub use stacked::{stacked, stacked_with};
pub use triple::triple;

pub(crate) use grouped::Grouped;

/// Ranges and velocity: what the papers' systems solve for.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeSolution {
    /// Range from each camera, m, in the order of the lines.
    pub ranges: Vec<f64>,
    /// Velocity at the first line's time, m/s.
    pub velocity: Vector3<f64>,
    /// Acceleration, m/s^2, where the motion has one (Klochko 2020, eq. 5).
    pub acceleration: Option<Vector3<f64>>,
    /// The target at the first line's time, refined by the pair solution with the displacement
    /// removed (Klochko 2020, below equation 11).
    pub position: Point3<f64>,
    /// How well the system was conditioned, and whether the pseudo-inverse had to be used.
    pub observability: Observability,
}
