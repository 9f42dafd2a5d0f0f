//! The bound over a volume, for cameras at given places.

use crossfix_geometry::{Camera, PixelCovariance};
use nalgebra::{Matrix6, Point3};
use serde::Serialize;

use super::{
    BearingInformation, CameraInformation, CommonErrors, FisherInformation, LineGeometry,
    TimeOffsets, Volume,
};

/// A fix is degenerate if its worst axis has a deviation more than this many times its best one's.
/// Two like cameras at one range have that ratio where their lines cross at 11 degrees; with half
/// of it, 23 degrees would count as degenerate.
pub const DEGENERATE_RATIO: f64 = 10.0;

/// A camera at a place where it stands or might stand.
#[derive(Clone, Debug)]
pub struct PlannedCamera {
    /// Its name.
    pub name: String,
    /// Its model and place.
    pub camera: Camera,
    /// Frames per second.
    pub rate_hz: f64,
    /// Standard deviation of its clock, whose error is the same throughout a window, s.
    pub clock_sd_s: f64,
    /// Standard deviation of a pixel measurement, pixels per axis, independent from frame to frame.
    pub pixel_sd_px: f64,
    /// Standard deviation of the error that its bearings of one target have in common for about as
    /// long as a window, rad per axis: a tracker sits beside a target's middle for a while.
    pub lasting_noise_rad: f64,
    /// Covariance of its pose: rotation about its own axes (rad), then position (m).
    pub pose_covariance: Matrix6<f64>,
    /// Standard deviation of a bearing due to the lens, rad per axis.
    pub lens_sd_rad: f64,
}

impl PlannedCamera {
    /// Errors that all of its bearings of one target have in common: pose, lens, clock (for a
    /// target at this speed) and the lasting noise.
    fn errors(&self, speed_mps: f64) -> CommonErrors {
        CommonErrors::of_pose(self.camera.pose().rotation(), &self.pose_covariance)
            .and(&CommonErrors::isotropic(self.lens_sd_rad.hypot(self.lasting_noise_rad), 0.0))
            .and(&CommonErrors::of_clock(self.clock_sd_s, speed_mps))
    }

    /// The same camera with pose, lens and clock known exactly.
    #[must_use]
    pub fn exact(&self) -> Self {
        let pose_covariance = Matrix6::zeros();
        Self { pose_covariance, lens_sd_rad: 0.0, clock_sd_s: 0.0, ..self.clone() }
    }
}

/// A target's size, and the size in the image that it must have to be seen.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TargetSize {
    /// The target's size, m.
    pub size_m: f64,
    /// Pixels that it must span.
    pub least_px: f64,
}

/// What a plan assumes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Assumptions {
    /// How long a target has been seen, s; it flies straight for that time.
    pub window_s: f64,
    /// A target's speed, m/s, which turns an error of the clock into one of position.
    pub speed_mps: f64,
    /// Prior of a target's velocity: standard deviation, m/s per axis; `None`: nothing is known.
    pub velocity_prior_sd_mps: Option<f64>,
    /// The size from which a target is seen; `None`: however small it is.
    pub target: Option<TargetSize>,
    /// Range beyond which no camera sees a target, m.
    pub max_range_m: Option<f64>,
}

impl Assumptions {
    /// The range up to which a camera sees the target, m; `None`: without limit.
    pub fn reach_m(&self, camera: &Camera) -> Option<f64> {
        let lens = camera.model().intrinsics();
        let focal = (lens.fx * lens.fy).sqrt();
        // A target of size s at a range r spans f s / r pixels.
        let by_size = self.target.map(|target| target.size_m * focal / target.least_px);
        [by_size, self.max_range_m].into_iter().flatten().reduce(f64::min)
    }
}

/// Accuracy of a target's state.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Accuracy {
    /// Standard deviation of the position in space, root of the covariance's trace, m.
    pub position_sd_m: f64,
    /// Standard deviation along the axis that is known best, m.
    pub best_axis_sd_m: f64,
    /// Standard deviation along the axis that is known worst, m.
    pub worst_axis_sd_m: f64,
    /// That worst axis, ENU, pointing upwards.
    pub worst_axis: [f64; 3],
    /// Standard deviation of the velocity in space, root of the covariance's trace, m/s.
    pub velocity_sd_mps: f64,
}

impl Accuracy {
    /// Accuracy by a covariance of `[p, v]` (m, m/s).
    pub fn of(covariance: &Matrix6<f64>) -> Self {
        let position = covariance.fixed_view::<3, 3>(0, 0).into_owned();
        let eigen = position.symmetric_eigen();
        let worst = eigen.eigenvalues.imax();
        let axis = eigen.eigenvectors.column(worst).into_owned();
        let axis = if axis.z < 0.0 { -axis } else { axis };
        Self {
            position_sd_m: position.trace().sqrt(),
            best_axis_sd_m: eigen.eigenvalues.min().max(0.0).sqrt(),
            worst_axis_sd_m: eigen.eigenvalues.max().sqrt(),
            worst_axis: axis.into(),
            velocity_sd_mps: covariance.fixed_view::<3, 3>(3, 3).trace().sqrt(),
        }
    }

    /// Whether one axis is known so much worse than another that the fix is hardly one.
    pub fn is_degenerate(&self) -> bool {
        self.worst_axis_sd_m > DEGENERATE_RATIO * self.best_axis_sd_m
    }
}

/// Prediction for one cube.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Cell {
    /// Index of its layer, from below.
    pub layer: usize,
    /// Its middle, ENU, m.
    pub centre_m: [f64; 3],
    /// The cameras that see it, by their indices in the list.
    pub cameras: Vec<usize>,
    /// Accuracy of a target there; `None` if fewer than two cameras see it, or only along one line.
    pub accuracy: Option<Accuracy>,
}

/// A camera with the times of its bearings.
pub(super) struct TimedCamera<'a> {
    camera: &'a Camera,
    times: TimeOffsets,
    reach_m: f64,
    errors: CommonErrors,
    noise: PixelCovariance,
}

impl<'a> TimedCamera<'a> {
    /// A camera whose newest bearing is `phase` of its frame interval old; at least one bearing is
    /// in the window.
    pub(super) fn new(
        planned: &'a PlannedCamera,
        phase: f64,
        assumptions: &'a Assumptions,
    ) -> Self {
        let count = (assumptions.window_s * planned.rate_hz).floor().max(1.0) as usize;
        let times = (0..count).map(|n| -(n as f64 + phase) / planned.rate_hz).collect();
        Self {
            camera: &planned.camera,
            times,
            reach_m: assumptions.reach_m(&planned.camera).unwrap_or(f64::INFINITY),
            errors: planned.errors(assumptions.speed_mps),
            noise: PixelCovariance::isotropic(planned.pixel_sd_px),
        }
    }

    /// Information of its bearings of a target at a point; `None` if it does not see that.
    pub(super) fn information(&self, point: Point3<f64>) -> Option<FisherInformation> {
        let range = (point - self.camera.pose().position()).norm();
        if range > self.reach_m {
            return None;
        }
        let sight_line = self.camera.sight_line_to(point, self.noise)?;
        let line = LineGeometry::of(&sight_line, range)?;
        let mut information = CameraInformation::default();
        information.add_all(&line, &BearingInformation::new(&sight_line.covariance)?, &self.times);
        Some(information.marginal(&self.errors))
    }
}

/// Information before anything is seen.
pub(super) fn prior(assumptions: &Assumptions) -> FisherInformation {
    assumptions
        .velocity_prior_sd_mps
        .map_or_else(FisherInformation::default, FisherInformation::velocity_prior)
}

/// The accuracy of what this number of cameras know together.
pub(super) fn accuracy(cameras: usize, information: &FisherInformation) -> Option<Accuracy> {
    // For one camera with a prior on the velocity rounding can give an inverse, but there is no
    // fix.
    let covariance = if cameras < 2 { None } else { information.covariance() };
    covariance.as_ref().map(Accuracy::of)
}

/// The bound in each cube of a volume, of the state at the end of the window: what a tracker can
/// know at that time.
///
/// A target flies straight; its direction from the cameras is taken as constant over the window.
/// The cameras are not synchronised: their phases are spread evenly.
pub fn predict(cameras: &[PlannedCamera], volume: &Volume, assumptions: &Assumptions) -> Vec<Cell> {
    let phase = |index: usize| index as f64 / cameras.len() as f64;
    let observers: Vec<TimedCamera> = cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| TimedCamera::new(camera, phase(index), assumptions))
        .collect();
    let centres = volume.centres();
    centres.map(|(layer, centre)| cell(layer, centre, &observers, assumptions)).collect()
}

fn cell(
    layer: usize,
    centre: Point3<f64>,
    observers: &[TimedCamera<'_>],
    assumptions: &Assumptions,
) -> Cell {
    let mut information = prior(assumptions);
    let mut seen = Vec::new();
    for (index, observer) in observers.iter().enumerate() {
        if let Some(theirs) = observer.information(centre) {
            information += &theirs;
            seen.push(index);
        }
    }
    let accuracy = accuracy(seen.len(), &information);
    Cell { layer, centre_m: centre.into(), cameras: seen, accuracy }
}

/// The smallest target, m, that two cameras see at a point when it must span `least_px` pixels;
/// `None` if fewer than two have the point in their images.
pub fn smallest_target(
    cameras: &[PlannedCamera],
    point: Point3<f64>,
    least_px: f64,
) -> Option<f64> {
    let mut sizes: Vec<f64> =
        cameras.iter().filter_map(|planned| size_of(least_px, &planned.camera, point)).collect();
    sizes.sort_by(f64::total_cmp);
    sizes.get(1).copied()
}

/// What spans this number of pixels at a point, m; `None` if the camera does not have it in its
/// image.
fn size_of(pixels: f64, camera: &Camera, point: Point3<f64>) -> Option<f64> {
    let lens = camera.model().intrinsics();
    let range = (point - camera.pose().position()).norm();
    camera.sees(point).then(|| pixels * range / (lens.fx * lens.fy).sqrt())
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{Distortion, ImageSize, Intrinsics, Pose};

    use super::*;

    fn assumptions() -> Assumptions {
        Assumptions {
            window_s: 1.0,
            speed_mps: 15.0,
            velocity_prior_sd_mps: Some(15.0),
            target: None,
            max_range_m: None,
        }
    }

    fn planned(position: [f64; 3], target: [f64; 3]) -> PlannedCamera {
        let size = ImageSize { width: 1001, height: 801 };
        let lens = Intrinsics {
            size,
            fx: 1000.0,
            fy: 1000.0,
            cx: 500.0,
            cy: 400.0,
            distortion: Distortion::None,
        };
        let pose = Pose::looking_at(position.into(), target.into()).unwrap();
        let camera = Camera::new(lens, pose).unwrap();
        PlannedCamera {
            name: String::new(),
            camera,
            rate_hz: 30.0,
            clock_sd_s: 0.0,
            pixel_sd_px: 0.5,
            lasting_noise_rad: 0.0,
            pose_covariance: Matrix6::zeros(),
            lens_sd_rad: 0.0,
        }
    }

    /// One cube of 2 m round a point.
    fn cell(cameras: &[PlannedCamera], point: [f64; 3], assumptions: &Assumptions) -> Cell {
        let point = Point3::from(point);
        let half = nalgebra::Vector3::repeat(1.0);
        let volume = Volume::new(point - half, point + half, Some(2.0)).unwrap();
        predict(cameras, &volume, assumptions).into_iter().next().unwrap()
    }

    #[test]
    fn a_window_of_bearings_is_the_line_fitted_to_them() {
        let target = [0.0, 0.0, 50.0];
        let cameras = [planned([-100.0, 0.0, 50.0], target), planned([0.0, -100.0, 50.0], target)];
        let without = Assumptions { velocity_prior_sd_mps: None, ..assumptions() };
        let accuracy = cell(&cameras, target, &without).accuracy.unwrap();
        // North and east are seen by one camera each, up by both: sigma = 0.5 px / 1000 px * 100 m.
        // Variance of a line through n points, read at the last: sigma^2 (4n - 2) / (n (n + 1)).
        let n = 30.0;
        let single = 0.05_f64.powi(2) * (4.0 * n - 2.0) / (n * (n + 1.0));
        let sd = (2.5 * single).sqrt();
        // The second camera's newest bearing is half an interval old.
        assert!(
            (accuracy.position_sd_m / sd - 1.0).abs() < 0.04,
            "{} against {sd}",
            accuracy.position_sd_m
        );
        let slope = 0.05 * 30.0 * (12.0 / (n * (n * n - 1.0))).sqrt();
        assert!((accuracy.velocity_sd_mps / (slope * 2.5_f64.sqrt()) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn one_camera_is_no_fix_and_behind_is_not_seen() {
        let target = [0.0, 0.0, 50.0];
        let cameras = [planned([-100.0, 0.0, 50.0], target), planned([0.0, -100.0, 50.0], target)];
        let beside = cell(&cameras, [60.0, 0.0, 50.0], &assumptions());
        assert_eq!(beside.cameras, [0]);
        assert_eq!(beside.accuracy, None);
        assert_eq!(cell(&cameras, [-150.0, -150.0, 50.0], &assumptions()).cameras, [0; 0]);
    }

    #[test]
    fn a_small_target_is_not_seen_from_afar() {
        let target = [0.0, 0.0, 50.0];
        let cameras = [planned([-100.0, 0.0, 50.0], target), planned([0.0, -60.0, 50.0], target)];
        let small = TargetSize { size_m: 0.4, least_px: 6.0 };
        let assumptions = Assumptions { target: Some(small), ..assumptions() };
        // 0.4 m * 1000 px / 6 px.
        assert!((assumptions.reach_m(&cameras[0].camera).unwrap() - 66.7).abs() < 0.1);
        assert_eq!(cell(&cameras, target, &assumptions).cameras, [1]);
        // The farther camera is the second: 100 m * 6 px / 1000 px.
        assert!((smallest_target(&cameras, target.into(), 6.0).unwrap() - 0.6).abs() < 1e-9);
        assert_eq!(smallest_target(&cameras[..1], target.into(), 6.0), None);
        let near = Assumptions { target: None, max_range_m: Some(50.0), ..assumptions };
        assert_eq!(cell(&cameras, target, &near).cameras, [0; 0]);
    }

    #[test]
    fn a_shallow_crossing_is_degenerate_along_the_lines() {
        let target = [0.0, 0.0, 50.0];
        let cameras = [planned([-100.0, -3.0, 50.0], target), planned([-100.0, 3.0, 50.0], target)];
        let accuracy = cell(&cameras, target, &assumptions()).accuracy.unwrap();
        assert!(accuracy.is_degenerate());
        assert!(accuracy.worst_axis[0].abs() > 0.999, "{accuracy:?}");
        // 1 / sin of 3.4 degrees, over root 2 times the deviation across.
        let ratio = accuracy.worst_axis_sd_m / accuracy.best_axis_sd_m;
        assert!((ratio - 100.0 / 3.0).abs() < 1.0, "{ratio}");
    }

    #[test]
    fn what_a_camera_does_wrong_all_the_time_stays() {
        let target = [0.0, 0.0, 50.0];
        let cameras = [planned([-100.0, 0.0, 50.0], target), planned([0.0, -100.0, 50.0], target)];
        let sd = |change: fn(&mut PlannedCamera)| {
            let mut cameras = cameras.clone();
            cameras.iter_mut().for_each(change);
            cell(&cameras, target, &assumptions()).accuracy.unwrap().position_sd_m
        };
        let exact = sd(|_| ());
        // 0.1 m on two axes, on the third over root 2.
        let floor = 0.1 * 2.5_f64.sqrt();
        let by_turns = sd(|camera| {
            camera.pose_covariance.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(1e-6);
        });
        assert!((by_turns / floor.hypot(exact) - 1.0).abs() < 0.01);
        let by_lens = sd(|camera| camera.lens_sd_rad = 1e-3);
        assert!((by_lens / by_turns - 1.0).abs() < 1e-6);
        let floor = 0.15 / 3.0_f64.sqrt() * 2.5_f64.sqrt();
        let by_clocks = sd(|camera| camera.clock_sd_s = 0.01);
        assert!((by_clocks / floor.hypot(exact) - 1.0).abs() < 0.01);
        // A turn about the optical axis moves no target on it, one about the camera's y axis moves
        // it sideways: the turns are about each camera's own axes.
        let about_axis = sd(|camera| camera.pose_covariance[(2, 2)] = 1e-6);
        assert!((about_axis / exact - 1.0).abs() < 1e-6);
        let sideways = sd(|camera| camera.pose_covariance[(1, 1)] = 1e-6);
        assert!((sideways / (0.1 * 2.0_f64.sqrt()).hypot(exact) - 1.0).abs() < 0.01);
    }
}
