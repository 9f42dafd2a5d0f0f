//! The receivers of paper 002: an optical one whose image lies behind the
//! lens, and a scanning thermal one that gives two angles. Their axes are the
//! paper's: z towards the object, y up, so x points to the left of a camera
//! that looks along z.

use nalgebra::{Unit, Vector3};

/// The direction from an image point of an optical receiver (002, equation 1), paper's axes.
///
/// `x`, `y` and the focal length `f` in one unit; the image is upside down, hence the signs.
/// `None` if the focal length is not positive.
pub fn optical_bearing(x: f64, y: f64, f: f64) -> Option<Unit<Vector3<f64>>> {
    (f > 0.0).then(|| Unit::new_normalize(Vector3::new(-x, -y, f)))
}

/// Azimuth and elevation of a scanning receiver, rad, paper's axes: azimuth from z towards x in
/// the horizontal plane, elevation above that plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanAngles {
    /// phi, in the horizontal plane from the axis z.
    pub azimuth: f64,
    /// theta, above the horizontal plane.
    pub elevation: f64,
}

impl ScanAngles {
    /// The direction of the angles (002, equation 2).
    pub fn bearing(self) -> Unit<Vector3<f64>> {
        let (sin_azimuth, cos_azimuth) = self.azimuth.sin_cos();
        let (sin_elevation, cos_elevation) = self.elevation.sin_cos();
        Unit::new_normalize(Vector3::new(
            cos_elevation * sin_azimuth,
            sin_elevation,
            cos_elevation * cos_azimuth,
        ))
    }

    /// The angles of a direction (002, equation 3; erratum: without the factor mu in the azimuth,
    /// and with the quadrant).
    pub fn of(bearing: &Unit<Vector3<f64>>) -> Self {
        Self { azimuth: bearing.x.atan2(bearing.z), elevation: bearing.y.clamp(-1.0, 1.0).asin() }
    }

    /// The angles to which an image point cues the scanning receiver beside its optical one
    /// (002, equation 3 mended: phi = atan2(-x, f)).
    pub fn cue(x: f64, y: f64, f: f64) -> Option<Self> {
        optical_bearing(x, y, f).map(|bearing| Self::of(&bearing))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_cue_is_the_mended_equation() {
        let cue = ScanAngles::cue(2.0, -1.0, 10.0).unwrap();
        assert!((cue.azimuth - f64::atan2(-2.0, 10.0)).abs() < 1e-15);
        assert!((cue.elevation - (1.0 / 105f64.sqrt()).asin()).abs() < 1e-15);
    }

    proptest! {
        #[test]
        fn angles_come_back_from_their_bearing(azimuth in -3.1..3.1, elevation in -1.5..1.5) {
            let back = ScanAngles::of(&ScanAngles { azimuth, elevation }.bearing());
            prop_assert!((back.azimuth - azimuth).abs() < 1e-9);
            prop_assert!((back.elevation - elevation).abs() < 1e-9);
        }
    }
}
