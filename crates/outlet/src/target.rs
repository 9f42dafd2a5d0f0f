//! A track for other programs: on the Earth, with course, speed and one standard deviation of each.

use crossfix_geometry::Geodetic;
use crossfix_message::{Timestamp, TrackNumber, TrackState};
use nalgebra::{Matrix2, Matrix3, Matrix6, Vector3};

/// A target at an instant, on the Earth.
#[derive(Clone, Debug, PartialEq)]
pub struct Target {
    /// The track's identity.
    pub id: u64,
    /// The track's state. A lost track is contained in one snapshot only.
    pub state: TrackState,
    /// Its position: WGS84, height above the ellipsoid.
    pub place: Geodetic,
    /// Velocity in east, north and up at its position, m/s.
    pub velocity: Vector3<f64>,
    /// Covariance of position and velocity in the same axes, m and m/s. It contains the errors of
    /// the cameras' poses and clocks, and that of the whole site if a calibration states it.
    pub covariance: Matrix6<f64>,
    /// When it was last seen.
    pub seen: Timestamp,
}

/// A quantity and its standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uncertain {
    /// The value.
    pub value: f64,
    /// Its standard deviation.
    pub sd: f64,
}

/// A target's motion as course, speed and slope.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Direction over ground, degrees clockwise from north, from 0 to less than 360.
    pub course_deg: Uncertain,
    /// Speed in space, m/s.
    pub speed_mps: Uncertain,
    /// Angle of climb, degrees, upwards positive.
    pub slope_deg: Uncertain,
}

/// Least speed that is divided by, m/s: below it there is no direction. With half of it the same.
const SLOWEST_MPS: f64 = 1e-6;

impl Target {
    /// The track's number as it is shown to people.
    pub fn number(&self) -> TrackNumber {
        TrackNumber(self.id)
    }

    /// Standard deviations in east, north and up, m.
    pub fn place_sd_m(&self) -> Vector3<f64> {
        self.covariance.fixed_view::<3, 3>(0, 0).diagonal().map(|v| v.max(0.0).sqrt())
    }

    /// Standard deviations of the velocity in east, north and up, m/s.
    pub fn velocity_sd_mps(&self) -> Vector3<f64> {
        self.covariance.fixed_view::<3, 3>(3, 3).diagonal().map(|v| v.max(0.0).sqrt())
    }

    /// The horizontal standard deviation in the direction in which it is largest, m.
    pub fn horizontal_sd_m(&self) -> f64 {
        let horizontal: Matrix2<f64> = self.covariance.fixed_view::<2, 2>(0, 0).into_owned();
        // largest eigenvalue of [a c; c b] = (a + b) / 2 + sqrt(((a - b) / 2)^2 + c^2)
        let half_trace = horizontal.trace() / 2.0;
        let half_difference = (horizontal[(0, 0)] - horizontal[(1, 1)]) / 2.0;
        let largest = half_trace + half_difference.hypot(horizontal[(0, 1)]);
        largest.max(0.0).sqrt()
    }

    /// Course, speed and slope, each with its standard deviation to first order.
    pub fn motion(&self) -> Motion {
        let velocity = self.velocity;
        let covariance: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        // standard deviation of the velocity along a unit vector u: sqrt(u' P u)
        let sd_along = |axis: Vector3<f64>| (axis.dot(&(covariance * axis))).max(0.0).sqrt();
        let speed = velocity.norm().max(SLOWEST_MPS);
        let over_ground = velocity.x.hypot(velocity.y).max(SLOWEST_MPS);
        let along = velocity / speed;
        // The horizontal unit vector at right angles to the course: d(course) = across . dv /
        // over_ground.
        let across = Vector3::new(velocity.y, -velocity.x, 0.0) / over_ground;
        // The unit vector along which the slope grows: d(slope) = upwards . dv / speed.
        let upwards = Vector3::new(
            -velocity.z * velocity.x / over_ground,
            -velocity.z * velocity.y / over_ground,
            over_ground,
        ) / speed;
        let degrees = |radians: f64| radians.to_degrees().min(180.0);
        Motion {
            course_deg: Uncertain {
                value: velocity.x.atan2(velocity.y).to_degrees().rem_euclid(360.0),
                sd: degrees(sd_along(across) / over_ground),
            },
            speed_mps: Uncertain { value: velocity.norm(), sd: sd_along(along) },
            slope_deg: Uncertain {
                value: velocity.z.atan2(over_ground).to_degrees(),
                sd: degrees(sd_along(upwards) / speed),
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector6;

    use super::*;

    fn target(velocity: Vector3<f64>, covariance: Matrix6<f64>) -> Target {
        Target {
            id: 7,
            state: TrackState::Confirmed,
            place: Geodetic::from_degrees(48.0, 11.0, 500.0).unwrap(),
            velocity,
            covariance,
            seen: Timestamp::EPOCH,
        }
    }

    #[test]
    fn the_horizontal_deviation_is_that_of_the_worst_direction() {
        let mut covariance = Matrix6::from_diagonal(&Vector6::new(1.0, 4.0, 9.0, 1.0, 1.0, 1.0));
        assert_relative_eq!(target(Vector3::x(), covariance).horizontal_sd_m(), 2.0);
        // A line to the north-east: one metre along it, nothing across.
        for (row, column) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            covariance[(row, column)] = 0.5;
        }
        assert_relative_eq!(target(Vector3::x(), covariance).horizontal_sd_m(), 1.0);
    }

    #[test]
    fn motion_is_that_of_a_hand_calculation() {
        // 3 east, 4 north, 5 up: course atan(3/4), speed 5 sqrt 2, slope 45 degrees.
        let covariance = Matrix6::identity() * 0.04;
        let motion = target(Vector3::new(3.0, 4.0, 5.0), covariance).motion();
        assert_relative_eq!(motion.course_deg.value, 36.869_897_6, epsilon = 1e-6);
        assert_relative_eq!(motion.course_deg.sd, (0.2_f64 / 5.0).to_degrees(), epsilon = 1e-9);
        assert_relative_eq!(motion.speed_mps.value, 50_f64.sqrt());
        assert_relative_eq!(motion.speed_mps.sd, 0.2, epsilon = 1e-12);
        assert_relative_eq!(motion.slope_deg.value, 45.0);
        assert_relative_eq!(
            motion.slope_deg.sd,
            (0.2 / 50_f64.sqrt()).to_degrees(),
            epsilon = 1e-9
        );
        let west = target(-Vector3::x(), covariance).motion();
        assert_relative_eq!(west.course_deg.value, 270.0);
    }

    #[test]
    fn what_stands_still_has_numbers_too() {
        let motion = target(Vector3::zeros(), Matrix6::identity()).motion();
        for uncertain in [motion.course_deg, motion.speed_mps, motion.slope_deg] {
            assert!(uncertain.value.is_finite() && uncertain.sd.is_finite(), "{motion:?}");
        }
        // The direction of motion is unknown.
        let slow = target(Vector3::x() * 1e-9, Matrix6::identity()).motion();
        assert_eq!(slow.slope_deg.sd, 180.0);
    }
}
