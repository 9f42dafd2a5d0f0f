use std::f64::consts::TAU;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

/// The path of a target. Metres, seconds, world frame (ENU).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum FlightPath {
    /// Straight, at constant velocity.
    Straight {
        /// Position at the start.
        from_m: [f64; 3],
        /// Velocity.
        velocity_mps: [f64; 3],
    },
    /// Around a centre, with a sine of its own on each axis: circles, eights, helices that never
    /// end.
    Curved {
        /// The centre.
        centre_m: [f64; 3],
        /// Amplitude to either side, per axis.
        amplitude_m: [f64; 3],
        /// Period of the sine, per axis.
        period_s: [f64; 3],
        /// Phase at the start, in turns, per axis.
        phase_turns: [f64; 3],
    },
}

impl FlightPath {
    /// Position and velocity at a time `t`, s from the scene's start.
    pub fn state(&self, t: f64) -> (Point3<f64>, Vector3<f64>) {
        match self {
            Self::Straight { from_m, velocity_mps } => {
                let velocity = Vector3::from(*velocity_mps);
                (Point3::from(*from_m) + velocity * t, velocity)
            }
            Self::Curved { centre_m, amplitude_m, period_s, phase_turns } => {
                let angle = |axis: usize| TAU * (t / period_s[axis] + phase_turns[axis]);
                let position = Point3::from(Vector3::from_fn(|i, _| {
                    centre_m[i] + amplitude_m[i] * angle(i).sin()
                }));
                let velocity =
                    Vector3::from_fn(|i, _| amplitude_m[i] * TAU / period_s[i] * angle(i).cos());
                (position, velocity)
            }
        }
    }

    /// Whether every number is finite and every period positive.
    pub(crate) fn is_possible(&self) -> bool {
        match self {
            Self::Straight { from_m, velocity_mps } => {
                from_m.iter().chain(velocity_mps).all(|v| v.is_finite())
            }
            Self::Curved { centre_m, amplitude_m, period_s, phase_turns } => {
                let finite =
                    centre_m.iter().chain(amplitude_m).chain(phase_turns).all(|v| v.is_finite());
                finite && period_s.iter().all(|p| p.is_finite() && *p > 0.0)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn the_velocity_is_the_positions_derivative(t in 0.0..60.0, amplitude in 1.0..50.0, period in 5.0..60.0) {
            let path = FlightPath::Curved {
                centre_m: [0.0, 0.0, 50.0],
                amplitude_m: [amplitude, amplitude / 2.0, 3.0],
                period_s: [period, period / 2.0, 11.0],
                phase_turns: [0.1, 0.2, 0.3],
            };
            let h = 1e-5;
            let numeric = (path.state(t + h).0 - path.state(t - h).0) / (2.0 * h);
            prop_assert!((numeric - path.state(t).1).norm() < 1e-6 * (1.0 + amplitude));
        }
    }
}
