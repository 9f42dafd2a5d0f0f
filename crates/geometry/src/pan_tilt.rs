//! A mount that turns a camera about its own centre.

use nalgebra::{Rotation3, Unit, Vector3};

use crate::scanning::camera_from_paper;
use crate::{GeometryError, Pose, ScanAngles};

/// A mount that turns a camera about the camera's own centre: first about the vertical axis of the
/// camera at rest, to the left, by the azimuth, then about the camera's own horizontal axis,
/// upwards, by the elevation. So the camera's axis points along [`ScanAngles::bearing`] of the two
/// angles (Klochko 2020, eq. 2), and [`ScanAngles::of`] is the cue for a direction (eq. 3).
///
/// ```
/// use crossfix_geometry::{PanTilt, Pose, ScanAngles};
/// use nalgebra::{Point3, Vector3};
///
/// // It looks north at rest, and turns all about.
/// let rest = Pose::looking_at(Point3::origin(), Point3::new(0.0, 1.0, 0.0))?;
/// let mount = PanTilt::new(rest, [-3.2, 3.2], [-0.3, 1.5])?;
/// // West and up: a quarter of a turn to the left, and 45 degrees up.
/// let quarter = std::f64::consts::FRAC_PI_2;
/// let turned = mount.pose(ScanAngles { azimuth: quarter, elevation: quarter / 2.0 });
/// let axis = turned.rotation() * Vector3::z();
/// assert!((axis - Vector3::new(-1.0, 0.0, 1.0).normalize()).norm() < 1e-12);
/// # Ok::<(), crossfix_geometry::GeometryError>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PanTilt {
    rest: Pose,
    azimuth: [f64; 2],
    elevation: [f64; 2],
}

impl PanTilt {
    /// A mount from the camera's pose with both angles at zero, and the limits of each angle (least
    /// and most, rad).
    ///
    /// # Errors
    /// [`GeometryError::Reach`] if a least angle is above its most, or a limit is beyond a turn
    /// (azimuth) or a quarter of one (elevation).
    pub fn new(rest: Pose, azimuth: [f64; 2], elevation: [f64; 2]) -> Result<Self, GeometryError> {
        use std::f64::consts::{FRAC_PI_2, TAU};
        if is_range_within(azimuth, TAU) && is_range_within(elevation, FRAC_PI_2) {
            Ok(Self { rest, azimuth, elevation })
        } else {
            Err(GeometryError::Reach)
        }
    }

    /// The same mount with another pose at zero angles.
    #[must_use]
    pub fn resting_at(self, rest: Pose) -> Self {
        Self { rest, ..self }
    }

    /// The camera's pose with both angles at zero.
    pub fn rest(&self) -> &Pose {
        &self.rest
    }

    /// Least and most azimuth, rad.
    pub fn azimuth(&self) -> [f64; 2] {
        self.azimuth
    }

    /// Least and most elevation, rad.
    pub fn elevation(&self) -> [f64; 2] {
        self.elevation
    }

    /// The camera's pose at angles, whether or not the mount reaches them.
    pub fn pose(&self, angles: ScanAngles) -> Pose {
        // The camera's y axis points down: a turn to the left is negative about it. Upwards is
        // positive about x.
        let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), -angles.azimuth)
            * Rotation3::from_axis_angle(&Vector3::x_axis(), angles.elevation);
        self.rest.turned(&turn)
    }

    /// The angles at which the camera's axis points along a direction (in the camera's frame at
    /// rest), or as near to it as the mount reaches.
    pub fn aim(&self, direction: &Unit<Vector3<f64>>) -> ScanAngles {
        let paper = Unit::new_unchecked(camera_from_paper(direction.into_inner()));
        let ScanAngles { azimuth, elevation } = ScanAngles::of(&paper);
        ScanAngles {
            azimuth: nearest_turn(azimuth, self.azimuth),
            elevation: elevation.clamp(self.elevation[0], self.elevation[1]),
        }
    }
}

/// The same angle plus or minus whole turns, within bounds; where none is, the nearer bound.
fn nearest_turn(angle: f64, [least, most]: [f64; 2]) -> f64 {
    use std::f64::consts::TAU;
    // The limits lie within a turn either way, so one turn more or less is enough.
    let turns = [angle, angle - TAU, angle + TAU];
    let beyond = |angle: &f64| (angle - angle.clamp(least, most)).abs();
    let nearest = turns.into_iter().min_by(|a, b| beyond(a).total_cmp(&beyond(b)));
    nearest.unwrap_or(angle).clamp(least, most)
}

/// Whether these are the least and the most of angles, neither farther from zero than the bound.
fn is_range_within([least, most]: [f64; 2], bound: f64) -> bool {
    (-bound..=bound).contains(&least) && (-bound..=bound).contains(&most) && least <= most
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::*;

    fn mount() -> PanTilt {
        let rest =
            Pose::looking_at(Point3::new(1.0, 2.0, 3.0), Point3::new(40.0, 30.0, 9.0)).unwrap();
        PanTilt::new(rest, [-3.2, 3.2], [-1.5, 1.5]).unwrap()
    }

    #[test]
    fn the_camera_turns_left_and_up_and_its_horizontal_axis_stays_level() {
        let rest = Pose::looking_at(Point3::origin(), Point3::new(0.0, 1.0, 0.0)).unwrap();
        let mount = PanTilt::new(rest, [-1.0, 1.0], [-0.1, 0.5]).unwrap();
        let turned = mount.pose(ScanAngles { azimuth: 0.3, elevation: 0.2 });
        let axis = turned.rotation() * Vector3::z();
        assert!(axis.x < 0.0 && axis.z > 0.0, "west of north, and up: {axis}");
        assert!((turned.rotation() * Vector3::x()).z.abs() < 1e-12);
        // Behind it, below it: as far as it goes.
        let back = mount.aim(&Unit::new_normalize(Vector3::new(0.1, 0.5, -1.0)));
        assert_eq!((back.azimuth.abs(), back.elevation), (1.0, -0.1));
    }

    #[test]
    fn impossible_reaches_are_refused() {
        let rest = *mount().rest();
        for (azimuth, elevation) in [
            ([1.0, -1.0], [0.0, 1.0]),
            ([f64::NAN, 1.0], [0.0, 1.0]),
            ([-1.0, 1.0], [0.0, 1.6]),
            ([-7.0, 1.0], [0.0, 1.0]),
        ] {
            assert!(PanTilt::new(rest, azimuth, elevation).is_err());
        }
    }

    proptest! {
        #[test]
        fn what_is_aimed_at_lies_on_the_axis(azimuth in -3.1..3.1, elevation in -1.4..1.4) {
            let mount = mount();
            let angles = ScanAngles { azimuth, elevation };
            let axis = mount.pose(angles).rotation() * Vector3::z();
            let at_rest = mount.rest().rotation().inverse() * axis;
            let paper = angles.bearing().into_inner();
            prop_assert!((at_rest - camera_from_paper(paper)).norm() < 1e-12);
            let back = mount.aim(&Unit::new_normalize(at_rest));
            prop_assert!((back.azimuth - azimuth).abs() < 1e-9);
            prop_assert!((back.elevation - elevation).abs() < 1e-9);
        }
    }
}
