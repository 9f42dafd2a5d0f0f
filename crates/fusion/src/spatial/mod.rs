//! Spatial processing: sight lines of several cameras, taken at different times, become a fix.
//!
//! [`map`] is the weighted solution for position and velocity, with a prior on the velocity;
//! [`Observability`] says what a system could see, and what not. The papers' own systems are in
//! [`crate::papers`].

mod map;
mod observability;

use std::f64::consts::LN_2;

use crossfix_filter::KinematicState;
use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::Matrix2;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use crate::{Exposure, Sighting};

pub use map::{MapSolution, map};
pub(crate) use observability::determined;
pub use observability::{Observability, Quantity, WeakAxis};

/// A sight line with the time at which it was seen.
#[derive(Clone, Debug, PartialEq)]
pub struct TimedLine {
    /// The sight line, world frame.
    pub line: SightLine,
    /// Its capture time.
    pub time: Timestamp,
    /// Standard deviation of that time, s.
    pub time_sd_s: f64,
    /// Standard deviation of the line's origin, m per axis.
    pub origin_sd_m: f64,
}

impl TimedLine {
    /// A line whose time and origin are known exactly.
    pub fn exact(line: SightLine, time: Timestamp) -> Self {
        Self { line, time, time_sd_s: 0.0, origin_sd_m: 0.0 }
    }

    /// Covariance of the direction to a target at `range` whose velocity has a prior of
    /// `velocity_sd` (m/s per axis): the line's own, plus what its uncertain time and origin add.
    pub(crate) fn noise_at(&self, range: f64, velocity_sd: f64) -> Matrix2<f64> {
        // Variance across the line, m^2, of clock and origin: (v sd(t))^2 + sd_c^2; over r^2 it is
        // an angle's.
        let variance =
            (velocity_sd * TYPICAL_SPEED * self.time_sd_s).powi(2) + self.origin_sd_m.powi(2);
        self.line.covariance + Matrix2::identity() * (variance / range.powi(2))
    }
}

/// Identity of a sight line.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LineId {
    /// The line's camera.
    pub camera: CameraName,
    /// Sequence number of the camera's frame.
    pub sequence: u64,
    /// Index among the frame's lines.
    pub index: usize,
}

impl LineId {
    /// Of an exposure's line.
    pub(crate) fn new(exposure: &Exposure, index: usize) -> Self {
        Self { camera: exposure.camera.clone(), sequence: exposure.sequence, index }
    }

    pub(crate) fn is_of(&self, exposure: &Exposure) -> bool {
        self.camera == exposure.camera && self.sequence == exposure.sequence
    }

    /// The line's sighting, if its exposure is among these.
    pub(crate) fn sighting_in<'a>(&self, exposures: &[&'a Exposure]) -> Option<&'a Sighting> {
        exposures.iter().find(|exposure| self.is_of(exposure))?.sightings.get(self.index)
    }
}

/// Solution of one period: where something was, and how fast.
#[derive(Clone, Debug, PartialEq)]
pub struct Fix {
    /// The state's time: that of the newest line.
    pub time: Timestamp,
    /// Position and velocity with their covariance.
    pub state: KinematicState,
    /// Whether the velocity was solved for, or is only the prior's zero.
    pub velocity: VelocityKnowledge,
    /// Solver that has found it.
    pub solver: crossfix_message::Solver,
    /// How well the system was conditioned.
    pub observability: Observability,
}

/// Whether a fix knows its velocity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VelocityKnowledge {
    /// It was solved for.
    Solved,
    /// The solver does not solve for it.
    Unknown,
}

/// Speed of most targets as a share of the velocity prior, which is wide enough for the fastest: it
/// sets how far an uncertain clock moves a line. With the whole prior the lines of uncertain clocks
/// would meet anywhere.
pub(crate) const TYPICAL_SPEED: f64 = 0.3;

/// Standard deviation of an uninformative velocity prior, m/s per axis: faster than any UAV. With
/// half of it a velocity that bearings determine to between 50 and 100 m/s counts as unobserved.
pub(crate) const VAGUE_VELOCITY_SD: f64 = 100.0;

/// Median of a chi-square of two degrees of freedom, 2 ln 2: a property of the distribution, and
/// no choice.
pub(crate) const CHI_SQUARE_2_MEDIAN: f64 = 2.0 * LN_2;

/// The squared Mahalanobis distance within which a true value of `dimensions` lies with probability
/// `p`.
pub(crate) fn chi_square(p: f64, dimensions: usize) -> f64 {
    // A positive number of degrees of freedom is all that the distribution asks for.
    ChiSquared::new(dimensions as f64)
        .map_or(f64::INFINITY, |distribution| distribution.inverse_cdf(p))
}

#[cfg(test)]
pub(crate) mod tests_support {
    use crossfix_geometry::{Bearing, tangent_basis};
    use nalgebra::{Point3, Unit, Vector2, Vector3};

    use super::*;

    /// Standard deviation of a direction per tangent, rad: 0.1 m at 150 m.
    pub(crate) const SIGMA: f64 = 0.1 / 150.0;

    /// Cameras 150 m from the origin whose lines of sight to it are mutually orthogonal.
    pub(crate) fn orthogonal_cameras() -> [Point3<f64>; 3] {
        let elevation = 35.264_389_7_f64.to_radians();
        [0.0f64, 120.0, 240.0].map(|azimuth| {
            let azimuth = azimuth.to_radians();
            let (cos, sin) = (elevation.cos(), elevation.sin());
            Point3::from(Vector3::new(cos * azimuth.cos(), cos * azimuth.sin(), sin) * -150.0)
        })
    }

    /// Cameras whose lines of sight to the origin lie in the horizontal plane.
    pub(crate) fn coplanar_cameras() -> [Point3<f64>; 3] {
        [0.0f64, -90.0, 90.0].map(|azimuth| {
            let (sin, cos) = azimuth.to_radians().sin_cos();
            Point3::new(-150.0 * cos, -150.0 * sin, 0.0)
        })
    }

    /// The exact line from a camera to a target at a time.
    pub(crate) fn line_at(camera: Point3<f64>, target: Point3<f64>, time_s: f64) -> TimedLine {
        let direction = Unit::new_normalize(target - camera);
        let bearing = Bearing::new(*direction, Matrix2::identity() * SIGMA * SIGMA).unwrap();
        let line = SightLine {
            origin: camera,
            direction,
            basis: tangent_basis(&direction),
            covariance: *bearing.covariance(),
        };
        TimedLine::exact(line, Timestamp::from_seconds(time_s))
    }

    /// The same with noise of [`SIGMA`] on both tangents.
    pub(crate) fn noisy_line_at(
        camera: Point3<f64>,
        target: Point3<f64>,
        time_s: f64,
        normal: &mut impl FnMut() -> f64,
    ) -> TimedLine {
        let mut exact = line_at(camera, target, time_s);
        let noise = exact.line.basis * Vector2::new(normal(), normal()) * SIGMA;
        exact.line.direction = Unit::new_normalize(exact.line.direction.into_inner() + noise);
        exact.line.basis = tangent_basis(&exact.line.direction);
        exact
    }
}
