use cam_geom::{Pixels, Points};
use nalgebra::{Matrix2, Point3, RowVector2, RowVector3, Unit, Vector2, Vector3, Vector5};
use opencv_ros_camera::{Distortion as OpenCvDistortion, RosOpenCvIntrinsics, TermCriteria};

use crate::{Bearing, GeometryError, Pose, SightLine, fisheye, tangent_basis};

/// Steps of the fixed-point inversion of the Brown-Conrady distortion: the widest lens measured
/// needs 40. Half of it would leave ten to spare.
const FIXED_POINT_STEPS: usize = 100;
/// A direction farther than this from the one that its pixel maps back to was folded into the image
/// by the lens polynomial, rad. With half of it the same: others come back to a thousandth of a
/// pixel.
const FOLDED_RAD: f64 = 1e-3;

/// A place in the recorded (distorted) image, pixels; (0, 0) is the middle of the top left pixel,
/// x right, y down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pixel(Vector2<f64>);

impl Pixel {
    /// Column and row.
    pub fn new(x: f64, y: f64) -> Self {
        Self(Vector2::new(x, y))
    }

    /// Column.
    pub fn x(&self) -> f64 {
        self.0.x
    }

    /// Row.
    pub fn y(&self) -> f64 {
        self.0.y
    }
}

/// Covariance of a place in the recorded image, pixels^2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelCovariance(pub Matrix2<f64>);

impl PixelCovariance {
    /// The same standard deviation, in pixels, on both axes.
    pub fn isotropic(standard_deviation: f64) -> Self {
        Self(Matrix2::identity() * standard_deviation.powi(2))
    }
}

/// Sides of an image, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageSize {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// How a lens bends straight lines.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// Not at all.
    None,
    /// Brown-Conrady, `k1 k2 p1 p2 k3` (ROS `plumb_bob`).
    BrownConrady([f64; 5]),
    /// Kannala-Brandt, `k1 k2 k3 k4` (ROS `equidistant`, OpenCV `fisheye`).
    Fisheye([f64; 4]),
}

/// The parameters of a camera model, pixels; not yet checked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Sides of the image.
    pub size: ImageSize,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, column.
    pub cx: f64,
    /// Principal point, row.
    pub cy: f64,
    /// The lens distortion.
    pub distortion: Distortion,
}

/// A camera model: pixels to directions and back.
#[derive(Clone, Debug)]
pub struct CameraModel {
    intrinsics: Intrinsics,
    brown_conrady: RosOpenCvIntrinsics<f64>,
}

fn check(
    what: &'static str,
    value: f64,
    good: bool,
    must: &'static str,
) -> Result<(), GeometryError> {
    if good { Ok(()) } else { Err(GeometryError::Intrinsics { what, value, must }) }
}

impl CameraModel {
    /// A model from its parameters.
    ///
    /// # Errors
    /// [`GeometryError::Intrinsics`] naming the parameter that no camera can have.
    pub fn new(intrinsics: Intrinsics) -> Result<Self, GeometryError> {
        let Intrinsics { size, fx, fy, cx, cy, distortion } = intrinsics;
        let [width, height] = [f64::from(size.width), f64::from(size.height)];
        check("the image width", width, width >= 1.0, "it must be at least 1 pixel")?;
        check("the image height", height, height >= 1.0, "it must be at least 1 pixel")?;
        for (what, focal) in [("fx", fx), ("fy", fy)] {
            let good = focal.is_finite() && focal > 0.0;
            check(what, focal, good, "a focal length must be a positive number of pixels")?;
        }
        check("fy", fy, (0.5..2.0).contains(&(fy / fx)), "it must be within a factor of 2 of fx")?;
        for (what, centre, side) in [("cx", cx, width), ("cy", cy, height)] {
            let good = (-side..=2.0 * side).contains(&centre);
            check(what, centre, good, "the principal point must lie in or near the image")?;
        }
        let opencv = match distortion {
            Distortion::BrownConrady(k) => OpenCvDistortion::from_opencv_vec(Vector5::from(k)),
            Distortion::None | Distortion::Fisheye(_) => OpenCvDistortion::zero(),
        };
        let coefficients: &[f64] = match &distortion {
            Distortion::None => &[],
            Distortion::BrownConrady(k) => k,
            Distortion::Fisheye(k) => k,
        };
        for &k in coefficients {
            check("a distortion coefficient", k, k.is_finite(), "it must be a finite number")?;
        }
        let brown_conrady =
            RosOpenCvIntrinsics::from_params_with_distortion(fx, 0.0, fy, cx, cy, opencv);
        Ok(Self { intrinsics, brown_conrady })
    }

    /// The parameters it was made from.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// The direction, camera frame, that falls on a pixel.
    ///
    /// # Errors
    /// [`GeometryError::NoInverse`] where the lens model cannot be undone.
    pub fn direction(&self, pixel: Pixel) -> Result<Unit<Vector3<f64>>, GeometryError> {
        let Intrinsics { fx, fy, cx, cy, distortion, .. } = self.intrinsics;
        let no_inverse = || GeometryError::NoInverse { x: pixel.x(), y: pixel.y() };
        let plane = Vector2::new((pixel.x() - cx) / fx, (pixel.y() - cy) / fy);
        if !plane.iter().all(|v| v.is_finite()) {
            return Err(GeometryError::NotFinite { what: "a pixel" });
        }
        let direction = match distortion {
            Distortion::None => Vector3::new(plane.x, plane.y, 1.0),
            Distortion::Fisheye(k) => fisheye::unproject(k, plane).ok_or_else(no_inverse)?,
            Distortion::BrownConrady(_) => {
                let distorted = Pixels::new(RowVector2::new(pixel.x(), pixel.y()));
                // Not `Eps`: the iteration would never end where it does not converge.
                let criteria = TermCriteria::MaxIter(FIXED_POINT_STEPS);
                let undistorted = self.brown_conrady.undistort_ext(&distorted, criteria);
                let ray = self.brown_conrady.undistorted_pixel_to_camera(&undistorted);
                Vector3::new(ray.data[0], ray.data[1], ray.data[2])
            }
        };
        let direction = Unit::try_new(direction, 1e-12).ok_or_else(no_inverse)?;
        // A fixed-point inversion can converge to a wrong branch far outside the image: the
        // direction must project back to its pixel.
        let back = self.project(&direction).ok_or_else(no_inverse)?;
        if (back.0 - pixel.0).norm() < 1e-3 { Ok(direction) } else { Err(no_inverse()) }
    }

    /// The pixel on which a direction of the camera frame falls, in or outside the image.
    ///
    /// `None` if it lies behind the camera, unless the lens is a fisheye, which maps every
    /// direction.
    pub fn project(&self, direction: &Vector3<f64>) -> Option<Pixel> {
        let Intrinsics { fx, fy, cx, cy, distortion, .. } = self.intrinsics;
        // On the plane z = 1, bent by the lens, then in pixels.
        let plane = match distortion {
            Distortion::Fisheye(k) => fisheye::project(k, direction),
            _ if direction.z <= 1e-9 => return None,
            Distortion::None => direction.xy() / direction.z,
            Distortion::BrownConrady(_) => {
                let point = Points::new(RowVector3::new(direction.x, direction.y, direction.z));
                let linear = self.brown_conrady.camera_to_undistorted_pixel(&point);
                let pixel = self.brown_conrady.distort(&linear).data;
                return Some(Pixel::new(pixel[0], pixel[1]));
            }
        };
        Some(Pixel::new(fx * plane.x + cx, fy * plane.y + cy))
    }

    /// Whether a direction of the camera frame falls inside the image.
    pub fn sees(&self, direction: &Vector3<f64>) -> bool {
        let ImageSize { width, height } = self.intrinsics.size;
        self.project(direction).is_some_and(|p| {
            // Pixel 0 reaches from -1/2 to 1/2.
            (-0.5..f64::from(width) - 0.5).contains(&p.x())
                && (-0.5..f64::from(height) - 0.5).contains(&p.y())
        })
    }

    /// The bearing of a pixel, with the pixel's covariance propagated to the tangent plane.
    ///
    /// # Errors
    /// [`GeometryError`] where the lens model cannot be undone or the covariance is impossible.
    pub fn bearing(
        &self,
        pixel: Pixel,
        covariance: PixelCovariance,
    ) -> Result<Bearing, GeometryError> {
        let direction = self.direction(pixel)?;
        let no_inverse = || GeometryError::NoInverse { x: pixel.x(), y: pixel.y() };
        let tangent_per_pixel = self
            .pixels_per_radian(&direction)
            .and_then(|j| j.try_inverse())
            .ok_or_else(no_inverse)?;
        // J^-1 C J^-T, with J the pixels per radian.
        let tangent = tangent_per_pixel * covariance.0 * tangent_per_pixel.transpose();
        Bearing::new(direction.into_inner(), tangent)
    }

    /// A bearing's pixel with its covariance in the image; `None` as for [`Self::project`].
    pub fn pixel(&self, bearing: &Bearing) -> Option<(Pixel, PixelCovariance)> {
        let direction = bearing.direction();
        let jacobian = self.pixels_per_radian(&direction)?;
        let covariance = jacobian * bearing.covariance() * jacobian.transpose();
        Some((self.project(&direction)?, PixelCovariance(covariance)))
    }

    /// Jacobian of the projection along the tangents at a direction, pixels per radian, by central
    /// differences (relative error about 1e-9).
    fn pixels_per_radian(&self, direction: &Unit<Vector3<f64>>) -> Option<Matrix2<f64>> {
        let by_first = self.pixels_along(direction, Vector2::x())?;
        let by_second = self.pixels_along(direction, Vector2::y())?;
        Some(Matrix2::from_columns(&[by_first, by_second]))
    }

    /// The column of that Jacobian for an axis of the tangents.
    fn pixels_along(
        &self,
        direction: &Unit<Vector3<f64>>,
        axis: Vector2<f64>,
    ) -> Option<Vector2<f64>> {
        /// Step of the difference to either side, rad: its error grows with the square of the step,
        /// that of rounding with the inverse. With half of it rounding is twice as large, and still
        /// far below a bearing's noise.
        const STEP: f64 = 1e-5;
        let basis = tangent_basis(direction);
        let ahead = self.project(&(direction.into_inner() + basis * (axis * STEP)))?;
        let behind = self.project(&(direction.into_inner() + basis * (axis * -STEP)))?;
        Some((ahead.0 - behind.0) / (2.0 * STEP))
    }
}

/// A camera model with its pose.
#[derive(Clone, Debug)]
pub struct Camera {
    model: CameraModel,
    pose: Pose,
}

impl Camera {
    /// A camera from its parameters and its pose.
    ///
    /// # Errors
    /// [`GeometryError`] if the parameters are no camera's.
    pub fn new(intrinsics: Intrinsics, pose: Pose) -> Result<Self, GeometryError> {
        Ok(Self { model: CameraModel::new(intrinsics)?, pose })
    }

    /// The same camera in another pose.
    #[must_use]
    pub fn posed(&self, pose: Pose) -> Self {
        Self { model: self.model.clone(), pose }
    }

    /// Its model.
    pub fn model(&self) -> &CameraModel {
        &self.model
    }

    /// Its pose.
    pub fn pose(&self) -> &Pose {
        &self.pose
    }

    /// A bearing of this camera as a sight line in the world. The covariance stays as it is: its
    /// axes are turned with the bearing.
    pub fn sight_line(&self, bearing: &Bearing) -> SightLine {
        let rotation = self.pose.rotation();
        let direction = bearing.direction();
        SightLine {
            origin: self.pose.position(),
            direction: rotation * direction,
            basis: rotation.matrix() * tangent_basis(&direction),
            covariance: *bearing.covariance(),
        }
    }

    /// The pixel on which a world point falls; `None` as for [`CameraModel::project`].
    pub fn project(&self, point: Point3<f64>) -> Option<Pixel> {
        self.model.project(&self.pose.camera_from_world(point))
    }

    /// The sight line on which this camera sees a world point, with this covariance of its place in
    /// the image; `None` if the point is not in the image.
    ///
    /// Unlike [`Camera::sees`] this rejects directions far outside the field of view that a lens
    /// polynomial folds back into the image.
    pub fn sight_line_to(
        &self,
        point: Point3<f64>,
        covariance: PixelCovariance,
    ) -> Option<SightLine> {
        let place = self.pose.camera_from_world(point);
        if !self.model.sees(&place) {
            return None;
        }
        let bearing = self.model.bearing(self.model.project(&place)?, covariance).ok()?;
        // |u x p| = |p| sin of the angle between both directions.
        let across = bearing.direction().cross(&place).norm();
        (across < FOLDED_RAD * place.norm()).then(|| self.sight_line(&bearing))
    }

    /// Whether a world point falls inside the image.
    pub fn sees(&self, point: Point3<f64>) -> bool {
        self.model.sees(&self.pose.camera_from_world(point))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn model(distortion: Distortion) -> CameraModel {
        CameraModel::new(Intrinsics {
            size: ImageSize { width: 1920, height: 1080 },
            fx: 1400.0,
            fy: 1405.0,
            cx: 955.0,
            cy: 545.0,
            distortion,
        })
        .unwrap()
    }

    fn lenses() -> impl Strategy<Value = Distortion> {
        prop_oneof![
            Just(Distortion::None),
            (-0.15..0.1, 0.0..0.1, -1e-3..1e-3, -1e-3..1e-3)
                .prop_map(|(k1, k2, p1, p2)| Distortion::BrownConrady([k1, k2, p1, p2, 0.0])),
            (-0.05..0.05, -0.01..0.01).prop_map(|(k1, k2)| Distortion::Fisheye([k1, k2, 0.0, 0.0])),
        ]
    }

    proptest! {
        #[test]
        fn a_pixel_comes_back_from_its_direction(lens in lenses(), x in 0.0..1919.0, y in 0.0..1079.0) {
            let model = model(lens);
            let direction = model.direction(Pixel::new(x, y)).unwrap();
            let back = model.project(&direction).unwrap();
            prop_assert!((back.x() - x).hypot(back.y() - y) < 1e-4);
        }

        #[test]
        fn a_covariance_comes_back_from_its_bearing(lens in lenses(), x in 100.0..1800.0, y in 100.0..1000.0) {
            let model = model(lens);
            let covariance = PixelCovariance(Matrix2::new(0.5, 0.1, 0.1, 0.2));
            let bearing = model.bearing(Pixel::new(x, y), covariance).unwrap();
            let (_, back) = model.pixel(&bearing).unwrap();
            prop_assert!((back.0 - covariance.0).norm() < 1e-6);
        }

        #[test]
        fn any_pixel_has_a_direction_or_an_error(lens in lenses(), x in -1e7..1e7, y in -1e7..1e7) {
            let _ = model(lens).direction(Pixel::new(x, y));
        }
    }

    #[test]
    fn a_fisheye_sees_beyond_ninety_degrees() {
        let model = model(Distortion::Fisheye([0.0; 4]));
        let behind = Vector3::new(1.0, 0.0, -0.2).normalize();
        let pixel = model.project(&behind).unwrap();
        let back = model.direction(pixel).unwrap();
        assert!((back.into_inner() - behind).norm() < 1e-9);
        assert!(model.sees(&Vector3::z()) && !model.sees(&-Vector3::z()));
    }

    #[test]
    fn a_pixel_of_standard_deviation_one_is_one_over_the_focal_length() {
        let bearing = model(Distortion::None)
            .bearing(Pixel::new(955.0, 545.0), PixelCovariance::isotropic(1.0))
            .unwrap();
        assert!((bearing.covariance().m11.sqrt() - 1.0 / 1400.0).abs() < 1e-9);
        assert!((bearing.covariance().m22.sqrt() - 1.0 / 1405.0).abs() < 1e-9);
    }

    #[test]
    fn a_sight_line_goes_to_its_point_and_to_none_that_the_lens_folds_in() {
        let pose = Pose::looking_at(Point3::origin(), Point3::new(0.0, 100.0, 0.0)).unwrap();
        let lens = *model(Distortion::BrownConrady([-0.3, 0.0, 0.0, 0.0, 0.0])).intrinsics();
        let camera = Camera::new(lens, pose).unwrap();
        let seen = Point3::new(20.0, 100.0, -10.0);
        let line = camera.sight_line_to(seen, PixelCovariance::isotropic(0.5)).unwrap();
        assert!(line.miss_distance(seen) < 1e-3);
        // r (1 - 0.3 r^2) comes back to 0 at r = 1.83.
        let folded = Point3::new(180.0, 100.0, 0.0);
        assert!(camera.sees(folded));
        assert!(camera.sight_line_to(folded, PixelCovariance::isotropic(0.5)).is_none());
    }

    #[test]
    fn impossible_intrinsics_are_named() {
        let good = *model(Distortion::None).intrinsics();
        for (bad, name) in [
            (Intrinsics { fx: -1.0, ..good }, "fx"),
            (Intrinsics { fy: f64::NAN, ..good }, "fy"),
            (Intrinsics { cx: 1e5, ..good }, "cx"),
            (Intrinsics { size: ImageSize { width: 0, height: 1 }, ..good }, "the image width"),
        ] {
            let error = CameraModel::new(bad).unwrap_err();
            assert!(
                matches!(error, GeometryError::Intrinsics { what, .. } if what == name),
                "{error}"
            );
        }
    }
}
