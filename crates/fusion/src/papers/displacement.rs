use nalgebra::Vector3;

/// How a target moves between the instants of two lines (Klochko 2020, eq. 5).
///
/// The scales are prior standard deviations per axis: the rank is decided against them, and an
/// unknown that the data do not determine stays near zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Displacement {
    /// `dM = V dt`: three unknowns.
    Velocity {
        /// Scale of V, m/s.
        velocity_scale: f64,
    },
    /// `dM = V dt + V' dt^2 / 2`: six unknowns.
    Acceleration {
        /// Scale of V, m/s.
        velocity_scale: f64,
        /// Scale of V', m/s^2.
        acceleration_scale: f64,
    },
}

/// A vector of unknowns of the motion.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MotionTerm {
    /// Its scale per axis: a prior standard deviation.
    pub(crate) scale: f64,
    /// The factor by which it moves the target.
    pub(crate) factor: f64,
}

impl Displacement {
    /// Each vector of unknowns, with how it moves the target in `dt` seconds.
    pub(crate) fn terms(self, dt: f64) -> Vec<MotionTerm> {
        let by_velocity = |scale| MotionTerm { scale, factor: dt };
        match self {
            Self::Velocity { velocity_scale } => vec![by_velocity(velocity_scale)],
            Self::Acceleration { velocity_scale, acceleration_scale } => vec![
                by_velocity(velocity_scale),
                MotionTerm { scale: acceleration_scale, factor: dt * dt / 2.0 },
            ],
        }
    }

    /// Number of its unknowns.
    pub(crate) fn unknowns(self) -> usize {
        match self {
            Self::Velocity { .. } => 3,
            Self::Acceleration { .. } => 6,
        }
    }
}

/// `dM` of a motion that has been found (Klochko 2020, eq. 5), m.
pub(crate) fn displacement(
    velocity: Vector3<f64>,
    acceleration: Option<Vector3<f64>>,
    dt: f64,
) -> Vector3<f64> {
    velocity * dt + acceleration.unwrap_or_default() * (dt * dt / 2.0)
}
