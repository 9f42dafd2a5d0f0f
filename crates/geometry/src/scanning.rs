//! The receivers of Klochko 2020: an optical one whose image lies behind the
//! lens, and a scanning thermal one that gives two angles. Their axes are the
//! paper's: z towards the object, y up, so x points to the left of a camera
//! that looks along z.
//!
//! To the rest of the system a scanning receiver is a camera like any other:
//! [`ScanMeasurement::bearing`] is its measurement in a camera's frame. It meets each target at
//! another time, so it sends one message per target, with the time at which the beam met that
//! target. Its pose is that of its zero direction, and the intrinsics of its calibration say where
//! it scans.
//!
//! ```
//! use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pose, ScanAngles, ScanMeasurement};
//! use nalgebra::Point3;
//!
//! // It scans 53 degrees to each side of north.
//! let field = Intrinsics {
//!     size: ImageSize { width: 800, height: 400 },
//!     fx: 300.0, fy: 300.0, cx: 399.5, cy: 199.5,
//!     distortion: Distortion::None,
//! };
//! let pose = Pose::looking_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0))?;
//! let receiver = Camera::new(field, pose)?;
//! let measured = ScanMeasurement {
//!     angles: ScanAngles { azimuth: 0.5, elevation: 0.2 },
//!     azimuth_sd: 2e-3,
//!     elevation_sd: 1e-3,
//! };
//! let sight_line = receiver.sight_line(&measured.bearing()?);
//! // Azimuth counts to the left, which is west of north; elevation upwards.
//! assert!(sight_line.direction.x < 0.0 && sight_line.direction.z > 0.0);
//! # Ok::<(), crossfix_geometry::GeometryError>(())
//! ```

use nalgebra::{Matrix2, Matrix3x2, Unit, Vector3};

use crate::{Bearing, GeometryError, tangent_basis};

/// Transforms a vector of the paper's axes (x left, y up, z forward) to the camera's frame (x
/// right, y down, z forward), or back: half a turn about z.
pub fn camera_from_paper(vector: Vector3<f64>) -> Vector3<f64> {
    Vector3::new(-vector.x, -vector.y, vector.z)
}

/// The direction from an image point of an optical receiver (Klochko 2020, eq. 1), paper's axes.
///
/// `x`, `y` and the focal length `f` are in the same unit; the image is upside down, hence the
/// signs. `None` if the focal length is not positive.
pub fn optical_bearing(x: f64, y: f64, f: f64) -> Option<Unit<Vector3<f64>>> {
    (f > 0.0).then(|| Unit::new_normalize(Vector3::new(-x, -y, f)))
}

/// Azimuth and elevation of a scanning receiver, rad, paper's axes: azimuth from z towards x in
/// the horizontal plane, elevation above that plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanAngles {
    /// phi, in the horizontal plane, from the z axis towards x.
    pub azimuth: f64,
    /// theta, above the horizontal plane.
    pub elevation: f64,
}

impl ScanAngles {
    /// The direction of the angles (Klochko 2020, eq. 2).
    pub fn bearing(self) -> Unit<Vector3<f64>> {
        let (sin_azimuth, cos_azimuth) = self.azimuth.sin_cos();
        let (sin_elevation, cos_elevation) = self.elevation.sin_cos();
        Unit::new_normalize(Vector3::new(
            cos_elevation * sin_azimuth,
            sin_elevation,
            cos_elevation * cos_azimuth,
        ))
    }

    /// The angles of a direction (Klochko 2020, eq. 3; erratum: without the factor mu in the
    /// azimuth, and with atan2 for the right quadrant).
    pub fn of(bearing: &Unit<Vector3<f64>>) -> Self {
        Self { azimuth: bearing.x.atan2(bearing.z), elevation: bearing.y.clamp(-1.0, 1.0).asin() }
    }

    /// Derivatives of the direction by azimuth and elevation, as columns, paper's axes.
    fn derivative(self) -> Matrix3x2<f64> {
        let (sin_azimuth, cos_azimuth) = self.azimuth.sin_cos();
        let (sin_elevation, cos_elevation) = self.elevation.sin_cos();
        Matrix3x2::from_columns(&[
            // d/dphi of (cos theta sin phi, sin theta, cos theta cos phi), then d/dtheta.
            Vector3::new(cos_azimuth, 0.0, -sin_azimuth) * cos_elevation,
            Vector3::new(-sin_elevation * sin_azimuth, cos_elevation, -sin_elevation * cos_azimuth),
        ])
    }

    /// The angles to which an image point cues the scanning receiver that stands beside the optical
    /// one (Klochko 2020, eq. 3 corrected: phi = atan2(-x, f)).
    pub fn cue(x: f64, y: f64, f: f64) -> Option<Self> {
        optical_bearing(x, y, f).map(|bearing| Self::of(&bearing))
    }
}

/// One target's measurement by a scanning receiver.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanMeasurement {
    /// The angles, paper's axes.
    pub angles: ScanAngles,
    /// Standard deviation of the azimuth, rad; the deviation of the direction is smaller by the
    /// cosine of the elevation.
    pub azimuth_sd: f64,
    /// Standard deviation of the elevation, rad.
    pub elevation_sd: f64,
}

impl ScanMeasurement {
    /// The bearing in the camera's frame (x right, y down, z forward), with the angles' covariance
    /// on its tangent plane.
    ///
    /// # Errors
    /// [`GeometryError`] if a number is not finite, a standard deviation is not positive, or the
    /// elevation is a right angle, where the azimuth says nothing.
    pub fn bearing(&self) -> Result<Bearing, GeometryError> {
        let direction = Unit::new_normalize(camera_from_paper(self.angles.bearing().into_inner()));
        let paper = self.angles.derivative();
        let derivative = Matrix3x2::from_columns(&[
            camera_from_paper(paper.column(0).into_owned()),
            camera_from_paper(paper.column(1).into_owned()),
        ]);
        // With J = B' d(direction)/d(angles) on the tangents B: covariance = J diag(sd^2) J'.
        let tangents = tangent_basis(&direction).transpose() * derivative;
        let variances = Matrix2::new(self.azimuth_sd.powi(2), 0.0, 0.0, self.elevation_sd.powi(2));
        Bearing::new(direction.into_inner(), tangents * variances * tangents.transpose())
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

    fn measured(azimuth: f64, elevation: f64) -> ScanMeasurement {
        let angles = ScanAngles { azimuth, elevation };
        ScanMeasurement { angles, azimuth_sd: 2e-3, elevation_sd: 1e-3 }
    }

    #[test]
    fn left_and_up_of_the_paper_are_left_and_up_of_the_camera() {
        let bearing = measured(0.3, 0.1).bearing().unwrap().direction();
        assert!(bearing.x < 0.0 && bearing.y < 0.0 && bearing.z > 0.9);
        assert!((bearing.x.atan2(bearing.z) + 0.3).abs() < 1e-12);
    }

    #[test]
    fn an_azimuths_error_shrinks_with_the_elevations_cosine() {
        // Straight ahead, the tangents are the camera's x and y.
        let ahead = *measured(0.0, 0.0).bearing().unwrap().covariance();
        assert!((ahead - Matrix2::new(4e-6, 0.0, 0.0, 1e-6)).norm() < 1e-15);
        let up = *measured(0.0, 1.0).bearing().unwrap().covariance();
        assert!((up - Matrix2::new(4e-6 * 1f64.cos().powi(2), 0.0, 0.0, 1e-6)).norm() < 1e-15);
    }

    #[test]
    fn impossible_angles_are_refused() {
        assert!(measured(f64::NAN, 0.0).bearing().is_err());
        assert!(measured(0.3, std::f64::consts::FRAC_PI_2).bearing().is_err());
        assert!(ScanMeasurement { azimuth_sd: 0.0, ..measured(0.3, 0.1) }.bearing().is_err());
    }

    proptest! {
        #[test]
        fn a_small_change_of_the_angles_is_what_the_covariance_says(
            azimuth in -3.0..3.0, elevation in -1.4..1.4, da in -1e-4..1e-4f64, de in -1e-4..1e-4f64,
        ) {
            let (here, there) = (measured(azimuth, elevation), measured(azimuth + da, elevation + de));
            let bearing = here.bearing().unwrap();
            let offset = tangent_basis(&bearing.direction()).transpose()
                * there.bearing().unwrap().direction().into_inner();
            // The squared Mahalanobis distance is that of the angles.
            let distance = offset.dot(&(bearing.covariance().try_inverse().unwrap() * offset));
            let expected = (da / 2e-3).powi(2) + (de / 1e-3).powi(2);
            prop_assert!((distance - expected).abs() < 1e-5, "{distance} {expected}");
        }

        #[test]
        fn angles_come_back_from_their_bearing(azimuth in -3.1..3.1, elevation in -1.5..1.5) {
            let back = ScanAngles::of(&ScanAngles { azimuth, elevation }.bearing());
            prop_assert!((back.azimuth - azimuth).abs() < 1e-9);
            prop_assert!((back.elevation - elevation).abs() < 1e-9);
        }
    }
}
