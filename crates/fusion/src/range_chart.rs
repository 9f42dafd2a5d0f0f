//! Coordinates in which the bearings of one camera do not change the range.
//!
//! Seen from a camera that stands still, a target at twice the distance and twice the speed gives
//! the same bearings for ever: this direction of the state is unobservable. In Cartesian
//! coordinates it turns with every update, and a linearised filter takes the difference for
//! information: within seconds it is sure of a range that no bearing contains. In the coordinates
//! direction, logarithm of the range, and velocity divided by the range, the unobservable direction
//! is one axis that never turns, a bearing is a linear measurement of the direction alone, and an
//! uncertain range is nearly Gaussian.

use crossfix_filter::KinematicState;
use crossfix_geometry::{Ray, passing_ranges};
use nalgebra::{
    Matrix2x3, Matrix3, Matrix3x2, Matrix3x6, Matrix6, Matrix6x2, Point3, Unit, Vector3, Vector6,
};

use crate::uncertainty::SharedTies;

/// Coordinates of a target's state, as differences from one given state.
// Made and used in one update: never stored, so the size of the larger variant costs nothing.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub(crate) enum StateChart {
    /// Position and velocity: for targets that several cameras place.
    Cartesian(KinematicState),
    /// Direction, range and velocity by range: for targets that one camera alone follows.
    ByRange(RangeChart),
}

/// Direction (along two tangents, rad), logarithm of the range, and velocity divided by the range
/// (1/s, world axes), as differences from those of one state, seen from one place.
#[derive(Clone, Debug)]
pub(crate) struct RangeChart {
    origin: Point3<f64>,
    direction: Unit<Vector3<f64>>,
    tangents: Matrix3x2<f64>,
    range: f64,
    /// Velocity divided by the range, 1/s.
    share: Vector3<f64>,
}

/// A point of the chart in the world.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ChartPoint {
    pub(crate) place: Point3<f64>,
    pub(crate) velocity: Vector3<f64>,
    /// Derivative of the position by the first three coordinates.
    pub(crate) place_by: Matrix3<f64>,
}

/// An update of position and velocity.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StateUpdate {
    /// The covariance after it.
    pub(crate) covariance: Matrix6<f64>,
    /// I - K H, which the state's covariance with any other error is multiplied by.
    pub(crate) carried: Matrix6<f64>,
    /// The gain K.
    pub(crate) gain: Matrix6x2<f64>,
}

impl StateChart {
    /// The Cartesian chart about a state, for a target that several cameras place.
    pub(crate) fn cartesian(state: &KinematicState) -> Self {
        Self::Cartesian(state.clone())
    }

    /// The range chart about a state as seen from `origin`; `None` if the state lies there.
    pub(crate) fn by_range(origin: Point3<f64>, state: &KinematicState) -> Option<Self> {
        RangeChart::new(origin, state).map(Self::ByRange)
    }

    /// The covariance of position and velocity, and their cross-covariance with some errors, both
    /// in the chart's coordinates.
    pub(crate) fn expressed(
        &self,
        covariance: &Matrix6<f64>,
        ties: &SharedTies,
    ) -> (Matrix6<f64>, SharedTies) {
        match self {
            Self::Cartesian(_) => (*covariance, *ties),
            Self::ByRange(chart) => {
                let by = chart.by_state();
                (by * covariance * by.transpose(), by * ties)
            }
        }
    }

    /// Derivative of the first three coordinates by position and velocity.
    pub(crate) fn place_by_state(&self) -> Matrix3x6<f64> {
        match self {
            Self::Cartesian(_) => Matrix3x6::identity(),
            Self::ByRange(chart) => chart.by_state().fixed_rows::<3>(0).into_owned(),
        }
    }

    /// Transforms the result of an update back from the chart at one of its points. The update
    /// measured the position with the Jacobian `by` (on the first three coordinates) and the gain
    /// K.
    pub(crate) fn from(
        &self,
        point: &ChartPoint,
        covariance: Matrix6<f64>,
        by: &Matrix2x3<f64>,
        gain: Matrix6x2<f64>,
    ) -> StateUpdate {
        // I - K H, where H = [by, 0].
        let mut left = Matrix6::identity();
        let mut of_place = left.fixed_columns_mut::<3>(0);
        of_place -= gain * by;
        match self {
            Self::Cartesian(_) => StateUpdate { covariance, carried: left, gain },
            Self::ByRange(chart) => {
                let state_by = chart.state_by(point);
                let covariance = state_by * covariance * state_by.transpose();
                // From state to chart at the old point, from chart to state at the new one.
                let carried = state_by * left * chart.by_state();
                StateUpdate { covariance, carried, gain: state_by * gain }
            }
        }
    }

    /// The point with these coordinates.
    pub(crate) fn point(&self, coordinates: &Vector6<f64>) -> ChartPoint {
        match self {
            Self::Cartesian(state) => ChartPoint {
                place: state.position() + coordinates.fixed_rows::<3>(0),
                velocity: state.velocity() + coordinates.fixed_rows::<3>(3),
                place_by: Matrix3::identity(),
            },
            Self::ByRange(chart) => chart.point(coordinates),
        }
    }

    /// The logarithmic range coordinate at which the chart's sight line passes nearest to `line`;
    /// `None` if that lies behind either camera, or in the Cartesian chart, which has no such
    /// coordinate.
    pub(crate) fn nearest_to(&self, line: &crossfix_geometry::SightLine) -> Option<f64> {
        match self {
            Self::Cartesian(_) => None,
            Self::ByRange(chart) => chart.nearest_to(line),
        }
    }
}

impl RangeChart {
    fn new(origin: Point3<f64>, state: &KinematicState) -> Option<Self> {
        let (direction, range) = Unit::try_new_and_get(state.position() - origin, 1e-6)?;
        let tangents = crossfix_geometry::tangent_basis(&direction);
        Some(Self { origin, direction, tangents, range, share: state.velocity() / range })
    }

    /// Derivative of the coordinates by position and velocity, at the chart's own state.
    fn by_state(&self) -> Matrix6<f64> {
        let mut by = Matrix6::zeros();
        // Rows: da = T' dp / r, d(ln r) = u' dp / r, d(v/r) = dv / r - (v/r) d(ln r).
        let along = self.direction.transpose() / self.range;
        by.fixed_view_mut::<2, 3>(0, 0).copy_from(&(self.tangents.transpose() / self.range));
        by.fixed_view_mut::<1, 3>(2, 0).copy_from(&along);
        by.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-self.share * along));
        by.fixed_view_mut::<3, 3>(3, 3).fill_with_identity();
        by.fixed_view_mut::<3, 3>(3, 3).scale_mut(1.0 / self.range);
        by
    }

    fn point(&self, coordinates: &Vector6<f64>) -> ChartPoint {
        // u = (u0 + T a) / |u0 + T a| and r = r0 exp(c).
        let aside = self.direction.into_inner() + self.tangents * coordinates.fixed_rows::<2>(0);
        let (direction, length) = Unit::new_and_get(aside);
        let range = self.range * coordinates[2].exp();
        // d (d/|d|) = (I - u u') T / |d| per coordinate across.
        let across = (self.tangents
            - direction.into_inner() * (direction.transpose() * self.tangents))
            / length;
        let mut place_by = Matrix3::zeros();
        place_by.fixed_view_mut::<3, 2>(0, 0).copy_from(&(across * range));
        place_by.set_column(2, &(direction.into_inner() * range));
        // v = (v0/r0 + w) r: velocity in ranges per second scales with the unknown range.
        let velocity = (self.share + coordinates.fixed_rows::<3>(3)) * range;
        ChartPoint { place: self.origin + direction.into_inner() * range, velocity, place_by }
    }

    /// Derivative of position and velocity by the coordinates, at a point.
    fn state_by(&self, point: &ChartPoint) -> Matrix6<f64> {
        // dp/d(a, c) as in `place_by`, dv/dc = v, dv/dw = r I.
        let range = (point.place - self.origin).norm();
        let mut by = Matrix6::zeros();
        by.fixed_view_mut::<3, 3>(0, 0).copy_from(&point.place_by);
        by.fixed_view_mut::<3, 1>(3, 2).copy_from(&point.velocity);
        by.fixed_view_mut::<3, 3>(3, 3).fill_with_identity();
        by.fixed_view_mut::<3, 3>(3, 3).scale_mut(range);
        by
    }

    /// The coordinate ln(r / r0) at which the sight line passes nearest to `line`.
    fn nearest_to(&self, line: &crossfix_geometry::SightLine) -> Option<f64> {
        let sight = Ray { origin: self.origin, direction: self.direction };
        let [here, there] = passing_ranges(sight, line.ray());
        (here > 0.0 && there > 0.0).then(|| (here / self.range).ln())
    }
}

impl ChartPoint {
    /// Position and velocity.
    pub(crate) fn mean(&self) -> Vector6<f64> {
        let mut mean = Vector6::zeros();
        mean.fixed_rows_mut::<3>(0).copy_from(&self.place.coords);
        mean.fixed_rows_mut::<3>(3).copy_from(&self.velocity);
        mean
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state() -> KinematicState {
        KinematicState {
            mean: Vector6::new(30.0, 80.0, 40.0, 6.0, -3.0, 1.0),
            covariance: Matrix6::identity(),
        }
    }

    #[test]
    fn the_derivatives_are_each_others_inverse_and_the_finite_differences() {
        let chart = RangeChart::new(Point3::new(1.0, 2.0, 3.0), &state()).unwrap();
        let here = chart.point(&Vector6::zeros());
        assert!((here.mean() - state().mean).norm() < 1e-9);
        assert!((chart.by_state() * chart.state_by(&here) - Matrix6::identity()).norm() < 1e-12);
        for axis in 0..6 {
            let step = Vector6::ith(axis, 1e-6);
            let slope = (chart.point(&step).mean() - chart.point(&-step).mean()) / 2e-6;
            assert!((slope - chart.state_by(&here).column(axis)).norm() < 1e-5, "axis {axis}");
        }
    }

    #[test]
    fn what_scales_place_and_velocity_is_the_range_axis_alone() {
        let origin = Point3::new(1.0, 2.0, 3.0);
        let chart = RangeChart::new(origin, &state()).unwrap();
        let doubled = chart.point(&Vector6::ith(2, 2.0_f64.ln()));
        assert!((doubled.place - origin - (state().position() - origin) * 2.0).norm() < 1e-9);
        assert!((doubled.velocity - state().velocity() * 2.0).norm() < 1e-9);
    }
}
