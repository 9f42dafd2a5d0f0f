//! A camera's lens as adjustable numbers: the projection with its derivatives.

use crossfix_geometry::{Distortion, Intrinsics, Pixel};
use nalgebra::{DMatrix, Matrix2, Matrix2x3, Vector2, Vector3};

/// Largest number of parameters of a lens: the logarithms of focal length and aspect, principal
/// point (2), distortion (up to 5).
pub(crate) const MOST_LENS_NUMBERS: usize = 9;

/// Standard deviation of the logarithm of the focal length in a lens file from a checkerboard that
/// was shown from nearby: lenses change their focal length when they focus, and video is cropped
/// otherwise than pictures. With half of it a change by 2 % is four deviations, and the pose takes
/// on a part of it as range.
const LOG_FOCAL_SD: f64 = 0.01;
/// Standard deviation of the logarithm of the pixels' aspect: it is the sensor's, which no focusing
/// changes. With half of it the same.
const LOG_ASPECT_SD: f64 = 0.001;
/// Standard deviation of the principal point, as a share of the image's width: 3 of 1920 pixels.
/// With half of it nearly the same: a turn of the camera does almost what a shift of it does.
const CENTRE_SD: f64 = 3.0 / 1920.0;
/// Standard deviation of a distortion coefficient, as a share of its value. With half of it a file
/// that is off by a third is two deviations off, and poses are bent by what its lens keeps.
const DISTORTION_SD: f64 = 1.0 / 3.0;
/// Standard deviation that keeps a number fixed, as where a coefficient is zero. With half of it
/// the same.
const FIXED_SD: f64 = 1e-9;

/// A place in the image with its derivatives.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Projection {
    pub(crate) pixel: Vector2<f64>,
    /// By the point in the camera's frame, pixels per metre.
    pub(crate) by_point: Matrix2x3<f64>,
    /// By each parameter of the lens.
    pub(crate) by_lens: [Vector2<f64>; MOST_LENS_NUMBERS],
}

/// Number of adjustable parameters of a lens.
pub(crate) fn numbers(intrinsics: &Intrinsics) -> usize {
    4 + match intrinsics.distortion {
        Distortion::None => 0,
        Distortion::BrownConrady(_) => 5,
        Distortion::Fisheye(_) => 4,
    }
}

/// Parameters of a lens, in the form in which they are compared with their prior.
pub(crate) fn values(intrinsics: &Intrinsics) -> Vec<f64> {
    let Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
    let mut values = vec![fx.ln(), (fy / fx).ln(), cx, cy];
    values.extend(coefficients(&intrinsics.distortion));
    values
}

/// How far a lens may deviate from its file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LensFreedom {
    /// Not at all: it was calibrated as it is used, at a distance.
    Keep,
    /// The focal length (1 %).
    Focal,
    /// All: the focal length (1 %), the pixels' aspect (0.1 %), the principal point (3 of 1920
    /// pixels), each coefficient of distortion (a third of itself).
    #[default]
    All,
    /// All, and widely: the file is a guess, as from a data sheet. Focal length 5 %, aspect 0.3 %,
    /// principal point 20 of 1920 pixels, distortion as most lenses have it. Only where much of the
    /// image is covered.
    Guess,
}

/// Standard deviations of a lens that nobody has measured, in the order and units of a file's
/// above: a data sheet's focal length, the aspect, and the principal point, as sensors sit a
/// hundredth of their width off the axis. With half of them a data sheet that is 10 % off is four
/// deviations off.
const GUESSED: [f64; 3] = [0.05, 0.003, 20.0 / 1920.0];
/// The same for Brown and Conrady's coefficients (k1, k2, p1, p2, k3): beyond these a lens for
/// surveillance would show straight walls as barrels. With half of them such lenses are kept near
/// the guess, and their corners stay bent.
const GUESSED_BROWN_CONRADY: [f64; 5] = [0.2, 0.2, 0.003, 0.003, 0.1];
/// The same for a fisheye's coefficients (k1 to k4). With half of them the corners of such a lens
/// stay bent as well.
const GUESSED_FISHEYE: [f64; 4] = [0.05; 4];

impl LensFreedom {
    /// Standard deviation of each parameter in a lens file.
    pub(crate) fn prior_sd(self, intrinsics: &Intrinsics) -> Vec<f64> {
        let centre = CENTRE_SD * f64::from(intrinsics.size.width);
        let mut deviations = vec![LOG_FOCAL_SD, LOG_ASPECT_SD, centre, centre];
        let distortion = coefficients(&intrinsics.distortion);
        deviations.extend(distortion.iter().map(|k| (k.abs() * DISTORTION_SD).max(FIXED_SD)));
        if self == Self::Guess {
            let [focal, aspect, centre] = GUESSED;
            let centre = centre * f64::from(intrinsics.size.width);
            deviations = vec![focal, aspect, centre, centre];
            deviations.extend(match intrinsics.distortion {
                Distortion::None => &[][..],
                Distortion::BrownConrady(_) => &GUESSED_BROWN_CONRADY,
                Distortion::Fisheye(_) => &GUESSED_FISHEYE,
            });
        }
        let free = match self {
            Self::Keep => 0,
            Self::Focal => 1,
            Self::All | Self::Guess => deviations.len(),
        };
        // The logarithm of the focal length is the first parameter: `Focal` frees it alone.
        deviations[free..].fill(FIXED_SD);
        deviations
    }
}

/// A lens moved by a step in its parameters.
pub(crate) fn moved(intrinsics: &Intrinsics, step: &[f64]) -> Intrinsics {
    let mut values = values(intrinsics);
    values.iter_mut().zip(step).for_each(|(value, step)| *value += step);
    // The first two are ln(fx) and ln(fy / fx).
    let fx = values[0].exp();
    let mut distortion = intrinsics.distortion;
    match &mut distortion {
        Distortion::None => {}
        Distortion::BrownConrady(k) => k.copy_from_slice(&values[4..9]),
        Distortion::Fisheye(k) => k.copy_from_slice(&values[4..8]),
    }
    let [fy, cx, cy] = [fx * values[1].exp(), values[2], values[3]];
    Intrinsics { size: intrinsics.size, fx, fy, cx, cy, distortion }
}

fn coefficients(distortion: &Distortion) -> &[f64] {
    match distortion {
        Distortion::None => &[],
        Distortion::BrownConrady(k) => k,
        Distortion::Fisheye(k) => k,
    }
}

/// Projection of a point of the camera's frame; `None` behind the camera.
pub(crate) fn project(intrinsics: &Intrinsics, point: &Vector3<f64>) -> Option<Projection> {
    let Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
    let plane = match &intrinsics.distortion {
        Distortion::None => brown_conrady(&[0.0; 5], point)?,
        Distortion::BrownConrady(k) => brown_conrady(k, point)?,
        Distortion::Fisheye(k) => fisheye(k, point)?,
    };
    let scale = Matrix2::from_diagonal(&Vector2::new(fx, fy));
    let seen = scale * plane.place;
    // By ln(fx) both axes scale, as fy / fx is a parameter of its own.
    let mut by_lens = [Vector2::zeros(); MOST_LENS_NUMBERS];
    by_lens[0] = seen;
    by_lens[1].y = seen.y;
    by_lens[2].x = 1.0;
    by_lens[3].y = 1.0;
    for (by_lens, by_coefficient) in by_lens[4..].iter_mut().zip(plane.by_coefficient) {
        *by_lens = scale * by_coefficient;
    }
    Some(Projection {
        pixel: seen + Vector2::new(cx, cy),
        by_point: scale * plane.by_point,
        by_lens,
    })
}

/// Uncertainty of a lens after a calibration. Its parameters are the logarithm of the focal length,
/// that of the pixels' aspect, the principal point (2, pixels) and the distortion coefficients.
#[derive(Clone, Debug, PartialEq)]
pub struct LensUncertainty {
    /// Covariance of the parameters.
    pub covariance: DMatrix<f64>,
    /// Derivative of the pose (a small rotation about the camera's axes, rad; the centre, m) with
    /// respect to them: where a flight has been seen, pose and lens together are right, wherever
    /// each of them may be.
    pub pose_by_lens: DMatrix<f64>,
}

/// A target as a camera sees it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TargetView<'a> {
    /// In the camera's frame.
    pub(crate) direction: Vector3<f64>,
    pub(crate) range_m: f64,
    /// The camera's rotation.
    pub(crate) world_from_camera: &'a nalgebra::Rotation3<f64>,
}

impl TargetView<'_> {
    /// Its place in the camera's frame, m.
    fn point(&self) -> Vector3<f64> {
        self.direction * self.range_m
    }
}

impl LensUncertainty {
    /// Covariance of a target's pixel due to the lens, with the pose following it, pixels^2: large
    /// where the image was not covered.
    pub(crate) fn covariance_px2(
        &self,
        intrinsics: &Intrinsics,
        target: &TargetView<'_>,
    ) -> Option<Matrix2<f64>> {
        let seen = project(intrinsics, &target.point())?;
        let count = self.covariance.nrows();
        let by_lens = DMatrix::from_fn(2, count, |axis, number| seen.by_lens[number][axis]);
        // d(pixel) / d(lens) = direct part + d(pixel) / d(pose) x d(pose) / d(lens)
        let by = by_lens + by_pose(&seen, target) * &self.pose_by_lens;
        let covariance = &by * &self.covariance * by.transpose();
        Some(covariance.fixed_view::<2, 2>(0, 0).into_owned())
    }
}

/// Covariance of a pixel due to a pose's covariance, for the same target.
pub(crate) fn pose_covariance_px2(
    intrinsics: &Intrinsics,
    target: &TargetView<'_>,
    covariance: &nalgebra::Matrix6<f64>,
) -> Option<Matrix2<f64>> {
    let by = by_pose(&project(intrinsics, &target.point())?, target);
    Some(by * covariance * by.transpose())
}

/// Derivative of a pixel by the camera's rotation about its own axes and by its centre.
fn by_pose(seen: &Projection, target: &TargetView<'_>) -> nalgebra::Matrix2x6<f64> {
    let mut by_pose = nalgebra::Matrix2x6::zeros();
    // R <- R exp(d) turns the point by point x d, and a centre moved by c moves it by -R' c.
    let turn = seen.by_point * target.point().cross_matrix();
    by_pose.fixed_columns_mut::<3>(0).copy_from(&turn);
    let by_centre = -seen.by_point * target.world_from_camera.matrix().transpose();
    by_pose.fixed_columns_mut::<3>(3).copy_from(&by_centre);
    by_pose
}

/// The direction in which a pixel is seen, by the geometry crate's model.
pub(crate) fn direction(intrinsics: &Intrinsics, pixel: Pixel) -> Option<Vector3<f64>> {
    let model = crossfix_geometry::CameraModel::new(*intrinsics).ok()?;
    Some(model.direction(pixel).ok()?.into_inner())
}

/// A place on the image plane at unit focal length.
struct OnPlane {
    place: Vector2<f64>,
    by_point: Matrix2x3<f64>,
    by_coefficient: [Vector2<f64>; 5],
}

/// Brown-Conrady: `x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)`, y alike.
fn brown_conrady(k: &[f64; 5], point: &Vector3<f64>) -> Option<OnPlane> {
    if point.z <= 1e-6 * point.norm() {
        return None;
    }
    let &[k1, k2, p1, p2, k3] = k;
    let (x, y) = (point.x / point.z, point.y / point.z);
    let r2 = x * x + y * y;
    let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    // slope = d(radial) / d(r^2)
    let slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let place = Vector2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    );
    // d(distorted) / d(x, y) is symmetric: this is its element off the diagonal.
    let across = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
    let by_pinhole = Matrix2::new(
        radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        across,
        across,
        radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    );
    // d(x, y) / d(point) for x = X / Z, y = Y / Z
    let pinhole_by_point = Matrix2x3::new(1.0, 0.0, -x, 0.0, 1.0, -y) / point.z;
    let pinhole = Vector2::new(x, y);
    let by_coefficient = [
        pinhole * r2,
        pinhole * (r2 * r2),
        Vector2::new(2.0 * x * y, r2 + 2.0 * y * y),
        Vector2::new(r2 + 2.0 * x * x, 2.0 * x * y),
        pinhole * (r2 * r2 * r2),
    ];
    Some(OnPlane { place, by_point: by_pinhole * pinhole_by_point, by_coefficient })
}

/// Kannala-Brandt: with the angle t from the axis, the distance from the principal point is
/// `t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)`.
fn fisheye(k: &[f64; 4], point: &Vector3<f64>) -> Option<OnPlane> {
    let r2 = point.x * point.x + point.y * point.y;
    // On the axis the direction across is undefined: a radius of next to nothing keeps the
    // quotients finite.
    let r = r2.sqrt().max(1e-9 * point.norm());
    let length2 = r2 + point.z * point.z;
    if length2 <= 0.0 {
        return None;
    }
    // bent = the distance at unit focal length, slope = d(bent) / d(angle).
    let angle = r.atan2(point.z);
    let t2 = angle * angle;
    let bent = angle * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    let slope = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
    let outward = Vector2::new(point.x, point.y) / r;
    let angle_by_point =
        Vector3::new(outward.x * point.z, outward.y * point.z, -r).transpose() / length2;
    // place = outward x bent: outwards it changes with the angle, and across with bent / r.
    let mut by_point = outward * angle_by_point * slope;
    let turning = (Matrix2::identity() - outward * outward.transpose()) * (bent / r);
    let mut left = by_point.fixed_columns_mut::<2>(0);
    left += turning;
    let power = |n: i32| outward * (angle * t2.powi(n));
    let by_coefficient = [power(1), power(2), power(3), power(4), Vector2::zeros()];
    Some(OnPlane { place: outward * bent, by_point, by_coefficient })
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{CameraModel, ImageSize};
    use proptest::prelude::*;

    use super::*;

    fn lens(distortion: Distortion) -> Intrinsics {
        let size = ImageSize { width: 1920, height: 1080 };
        Intrinsics { size, fx: 1400.0, fy: 1420.0, cx: 955.0, cy: 545.0, distortion }
    }

    fn lenses() -> impl Strategy<Value = Distortion> {
        prop_oneof![
            Just(Distortion::None),
            (-0.2..0.1, 0.0..0.1, -1e-2..1e-2, -1e-2..1e-2, -0.02..0.02)
                .prop_map(|(k1, k2, p1, p2, k3)| Distortion::BrownConrady([k1, k2, p1, p2, k3])),
            (-0.05..0.05, -0.01..0.01).prop_map(|(k1, k2)| Distortion::Fisheye([k1, k2, 0.0, 0.0])),
        ]
    }

    proptest! {
        #[test]
        fn it_projects_as_the_geometry_does(
            distortion in lenses(), x in -0.6..0.6, y in -0.4..0.4, z in 10.0..200.0,
        ) {
            let intrinsics = lens(distortion);
            let point = Vector3::new(x * z, y * z, z);
            let theirs = CameraModel::new(intrinsics).unwrap().project(&point).unwrap();
            let ours = project(&intrinsics, &point).unwrap().pixel;
            prop_assert!((ours - Vector2::new(theirs.x(), theirs.y())).norm() < 1e-6);
        }

        #[test]
        fn its_derivatives_are_those_of_differences(
            distortion in lenses(), x in -0.6..0.6, y in -0.4..0.4, z in 10.0..200.0,
        ) {
            let intrinsics = lens(distortion);
            let point = Vector3::new(x * z, y * z, z);
            let at = project(&intrinsics, &point).unwrap();
            for axis in 0..3 {
                let step = Vector3::ith(axis, 1e-3);
                let ahead = project(&intrinsics, &(point + step)).unwrap().pixel;
                let behind = project(&intrinsics, &(point - step)).unwrap().pixel;
                let expected = (ahead - behind) / 2e-3;
                prop_assert!((at.by_point.column(axis) - expected).norm() < 1e-4);
            }
            for number in 0..numbers(&intrinsics) {
                let mut step = [0.0; MOST_LENS_NUMBERS];
                step[number] = 1e-6;
                let ahead = project(&moved(&intrinsics, &step), &point).unwrap().pixel;
                step[number] = -1e-6;
                let behind = project(&moved(&intrinsics, &step), &point).unwrap().pixel;
                let expected = (ahead - behind) / 2e-6;
                prop_assert!((at.by_lens[number] - expected).norm() < 1e-2, "{number}");
            }
        }
    }

    #[test]
    fn behind_the_camera_nothing_is_seen() {
        let pinhole = lens(Distortion::None);
        assert!(project(&pinhole, &Vector3::new(0.0, 0.0, -1.0)).is_none());
    }
}
