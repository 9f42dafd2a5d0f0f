use std::f64::consts::PI;

use nalgebra::{Matrix2, Matrix3x2, Point3, Unit, Vector2, Vector3};

use crate::GeometryError;

/// Largest deviation from 1 of the length of a vector that passes as a unit vector. With half of it
/// vectors printed with six decimals, up to 9e-7 off, may be refused.
const UNIT_TOLERANCE: f64 = 1e-6;

/// The two tangents of the unit sphere at `direction`, as columns.
///
/// The first is the frame's x axis made perpendicular to the direction (its y axis where the
/// direction lies within 0.1 rad of x), the second is the cross product of direction and first. A
/// bearing's covariance is expressed in these axes.
pub fn tangent_basis(direction: &Unit<Vector3<f64>>) -> Matrix3x2<f64> {
    let axis = if direction.x.abs() < 0.995 { Vector3::x() } else { Vector3::y() };
    let first = (axis - direction.into_inner() * direction.dot(&axis)).normalize();
    Matrix3x2::from_columns(&[first, direction.cross(&first)])
}

/// The direction from a camera to a target in the camera's frame, with its covariance.
///
/// The covariance is 2x2, rad^2, on the tangent plane, in the axes of [`tangent_basis`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bearing {
    direction: Unit<Vector3<f64>>,
    covariance: Matrix2<f64>,
}

impl Bearing {
    /// The largest standard deviation along a tangent, rad: a direction known no better than to
    /// half a turn may be any.
    pub const WIDEST_RAD: f64 = PI;

    /// A bearing from a vector of length one and a positive definite covariance.
    ///
    /// # Errors
    /// [`GeometryError`] if a number is not finite, the length differs from 1 by more than 1e-6, or
    /// the covariance is not positive definite or wider than [`Self::WIDEST_RAD`].
    pub fn new(vector: Vector3<f64>, covariance: Matrix2<f64>) -> Result<Self, GeometryError> {
        if !vector.iter().chain(covariance.iter()).all(|v| v.is_finite()) {
            return Err(GeometryError::NotFinite { what: "a bearing" });
        }
        let length = vector.norm();
        if (length - 1.0).abs() > UNIT_TOLERANCE {
            return Err(GeometryError::NotUnit { length });
        }
        let [xx, xy, yy] = [covariance.m11, covariance.m12, covariance.m22];
        // Sylvester: all leading minors are positive.
        if xx <= 0.0 || yy <= 0.0 || xx * yy <= xy * xy {
            return Err(GeometryError::NotPositive { xx, xy, yy });
        }
        if xx.max(yy) > Self::WIDEST_RAD.powi(2) {
            return Err(GeometryError::Anywhere { sd: xx.max(yy).sqrt() });
        }
        let direction = Unit::new_unchecked(vector / length);
        Ok(Self { direction, covariance: Matrix2::new(xx, xy, xy, yy) })
    }

    /// The unit vector, camera frame.
    pub fn direction(&self) -> Unit<Vector3<f64>> {
        self.direction
    }

    /// The covariance on the tangent plane, rad^2.
    pub fn covariance(&self) -> &Matrix2<f64> {
        &self.covariance
    }
}

/// A bearing placed in the world: a ray with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SightLine {
    /// The camera's centre, world, metres.
    pub origin: Point3<f64>,
    /// The direction to the target, world.
    pub direction: Unit<Vector3<f64>>,
    /// The tangents (columns, world) in which the covariance is expressed.
    pub basis: Matrix3x2<f64>,
    /// Covariance along the tangents, rad^2.
    pub covariance: Matrix2<f64>,
}

/// Squared sine of the angle below which two directions count as parallel: their lines would pass
/// nearest at a range beyond all use. With half of it the same: on a base of 100 m it is 3000 km.
const PARALLEL: f64 = 1e-9;

/// A straight line from a point on, without an uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it begins, metres.
    pub origin: Point3<f64>,
    /// Where it goes.
    pub direction: Unit<Vector3<f64>>,
}

/// The ranges (m) along two rays at which they pass nearest to each other; a range is negative
/// where that point is behind the origin.
///
/// ```
/// use crossfix_geometry::{Ray, passing_ranges};
/// use nalgebra::{Point3, Vector3};
/// let north = Ray { origin: Point3::origin(), direction: Vector3::y_axis() };
/// let west = Ray { origin: Point3::new(30.0, 40.0, 1.0), direction: -Vector3::x_axis() };
/// let [along_north, along_west] = passing_ranges(north, west);
/// assert!((along_north - 40.0).abs() < 1e-9 && (along_west - 30.0).abs() < 1e-9);
/// ```
pub fn passing_ranges(one: Ray, other: Ray) -> [f64; 2] {
    let (u, v) = (one.direction, other.direction);
    // Minimises |s u - t v - b|^2 over the ranges s and t, with the base line b and c = u.v:
    // s = (u.b - c v.b) / (1 - c^2), t = (c u.b - v.b) / (1 - c^2).
    let base = other.origin - one.origin;
    let cosine = u.dot(&v);
    let sine_squared = (1.0 - cosine * cosine).max(PARALLEL);
    let (along_u, along_v) = (u.dot(&base), v.dot(&base));
    [along_u - cosine * along_v, cosine * along_u - along_v].map(|range| range / sine_squared)
}

impl SightLine {
    /// The ray itself.
    pub fn ray(&self) -> Ray {
        Ray { origin: self.origin, direction: self.direction }
    }

    /// The distance of a point from the ray, metres; the distance from the origin if the point lies
    /// behind it.
    pub fn miss_distance(&self, point: Point3<f64>) -> f64 {
        let offset = point - self.origin;
        let along = offset.dot(&self.direction);
        if along < 0.0 {
            offset.norm()
        } else {
            (offset - self.direction.into_inner() * along).norm()
        }
    }

    /// Residual of the direction to a point: its part across this ray, on the ray's tangent plane,
    /// rad.
    ///
    /// `None` if the point lies at or behind the origin.
    pub fn tangent_residual(&self, point: Point3<f64>) -> Option<Vector2<f64>> {
        let offset = point - self.origin;
        let distance = offset.norm();
        (offset.dot(&self.direction) > 0.0).then(|| self.basis.transpose() * (offset / distance))
    }

    /// The standard deviation as the root of the mean variance over both tangents, rad.
    pub fn standard_deviation(&self) -> f64 {
        (self.covariance.trace() / 2.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn tangents_are_orthonormal_everywhere(x in -1.0..1.0, y in -1.0..1.0, z in -1.0..1.0) {
            prop_assume!(Vector3::new(x, y, z).norm() > 1e-3);
            let direction = Unit::new_normalize(Vector3::new(x, y, z));
            let basis = tangent_basis(&direction);
            prop_assert!((basis.transpose() * basis - Matrix2::identity()).norm() < 1e-12);
            prop_assert!((basis.transpose() * direction.into_inner()).norm() < 1e-12);
        }
    }

    #[test]
    fn impossible_bearings_are_refused() {
        let covariance = Matrix2::identity() * 1e-6;
        let refused = |v, c| Bearing::new(v, c).unwrap_err();
        assert!(matches!(
            refused(Vector3::new(0.0, 0.0, 1.1), covariance),
            GeometryError::NotUnit { .. }
        ));
        assert!(matches!(
            refused(Vector3::new(0.0, f64::NAN, 1.0), covariance),
            GeometryError::NotFinite { .. }
        ));
        assert!(matches!(
            refused(Vector3::z(), Matrix2::new(1.0, 2.0, 2.0, 1.0)),
            GeometryError::NotPositive { .. }
        ));
    }
}
