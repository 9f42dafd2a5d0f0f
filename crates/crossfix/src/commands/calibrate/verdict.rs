//! Verdict on a camera that a flight has calibrated, and what to do about it.

use crossfix_calibration::CameraResult;

/// Beginning of the verdict on a camera that must not be used.
pub const WRONG: &str = "wrong";

/// A camera with a pointing error above this is weak, mrad: at 100 m a target lies half a metre
/// aside. With half of it a minute's flight would not do.
const WEAK_POINTING_MRAD: f64 = 5.0;
/// A camera with a position error above this is weak, too, m. With twice as much targets may lie a
/// metre aside at any distance.
const WEAK_POSITION_M: f64 = 0.5;
/// A camera whose position error exceeds this share of its range is not calibrated at all. With
/// half of it a camera that a longer flight would place is called wrong instead of weak.
const NOWHERE: f64 = 0.5;
/// Nor is one whose rotation is uncertain by more than this, mrad: its covariance holds for small
/// turns, and the second-order term of a larger one exceeds the labels' errors. Flights that hover
/// or go straight gave 79 and more, with positions a hundred metres wrong. With half of it a camera
/// that a longer flight would help is called wrong instead of weak.
const ANYHOW_MRAD: f64 = 50.0;
/// Labels with errors above this belong to something else, mrad: lens files leave up to 4. With
/// half of it cameras with such files might be called wrong.
const WRONG_MRAD: f64 = 8.0;
/// Errors of labels by hand or by a tracker do not exceed this, pixels. With half of it good labels
/// made by hand might be refused.
const WRONG_PX: f64 = 3.0;
/// An error of more than [`WRONG_PX`] only counts if it is also more than this, mrad: of a short
/// flight the wrong camera's labels lie no farther off. With half of it good labels of a narrow
/// lens might be refused.
const WRONG_PX_MRAD: f64 = 2.0;
/// No clock wanders by more than this within a flight, ms: phones wander by 60. With half of it the
/// same.
const WRONG_WANDER_MS: f64 = 300.0;
/// A focal length that has changed by more than this share belongs to another lens than the file's,
/// or nothing determined the target's distance: lenses change by 2 %. With half of it cameras with
/// such lenses would be weak.
const WEAK_FOCAL: f64 = 0.025;
/// A camera with a smaller share of fitting labels has also seen something else. With half of it
/// one of which every other label is of something else would be good.
const WEAK_SHARE: f64 = 0.8;
/// A camera whose residuals change permanently by more than this has been moved, pixels: of 147
/// that stood still none changed by more than 1.0, which happens as targets cross other parts of
/// the image. With half of it one that stood still might be said to have moved.
const MOVED_PX: f64 = 2.0;
/// The change must also be more than this many SDs of a second's mean: those that stood still
/// reached 1.8 at most; two that were knocked by 9 pixels changed by 3.2 and 12. With half of it
/// only [`MOVED_PX`] would count.
const MOVED_DEVIATIONS: f64 = 2.5;

/// Standard deviations of a camera's pose, roots of the sums of the variances.
#[derive(Clone, Copy, Debug)]
pub struct PoseSd {
    pub position_m: f64,
    pub pointing_mrad: f64,
}

/// The verdict: good; weak, and what helps; wrong, and why.
pub fn of(camera: &CameraResult, pose_sd: PoseSd, wander_ms: f64) -> String {
    wrong(camera, pose_sd, wander_ms)
        .map(|why| format!("{WRONG}: {why}"))
        .or_else(|| weak(camera, pose_sd).map(|why| format!("weak: {why}")))
        .unwrap_or_else(|| "good".to_owned())
}

fn wrong(camera: &CameraResult, pose_sd: PoseSd, wander_ms: f64) -> Option<String> {
    let name = &camera.name;
    let mrad = |px: f64| px / camera.intrinsics().fx * 1e3;
    // Unless the camera is upside down, the image's rows point downwards in the world.
    let is_upside_down = camera.camera.pose().rotation().matrix()[(2, 1)] > 0.5;
    let moved =
        camera.moved.filter(|moved| moved.by_px > MOVED_PX && moved.deviations > MOVED_DEVIATIONS);
    if is_upside_down {
        Some(
            "upside down, so heights may count downwards in the log or survey (north-east-down?)"
                .to_owned(),
        )
    } else if let Some(moved) = moved {
        Some(format!(
            "moved by {:.0} px at {:.0} s of its own time: calibrate before and after that apart \
             (--to {name}={:.0}, --from {name}={:.0})",
            moved.by_px, moved.time_s, moved.time_s, moved.time_s
        ))
    } else if mrad(camera.noise.sd_px()) > WRONG_MRAD
        || (camera.residual_px > WRONG_PX && mrad(camera.residual_px) > WRONG_PX_MRAD)
    {
        Some(
            "its labels lie far beside the target's way (another target, lens file or log?)"
                .to_owned(),
        )
    } else if wander_ms > WRONG_WANDER_MS {
        Some(format!(
            "its clock would wander by {wander_ms:.0} ms (another target, lens file or frame rate?)"
        ))
    } else if pose_sd.position_m > NOWHERE * camera.range_m || pose_sd.pointing_mrad > ANYHOW_MRAD {
        Some(
            "nothing tells where it stands: the flight hovered, or went straight, where this \
             camera saw it"
                .to_owned(),
        )
    } else {
        None
    }
}

fn weak(camera: &CameraResult, pose_sd: PoseSd) -> Option<String> {
    if (camera.used as f64) < WEAK_SHARE * camera.labels as f64 {
        Some("many labels are not the target's".to_owned())
    } else if (camera.focal_ratio - 1.0).abs() > WEAK_FOCAL {
        Some(
            "its focal length is far from its file's (another lens file, or fly nearer and farther)"
                .to_owned(),
        )
    } else if pose_sd.position_m > WEAK_POSITION_M || pose_sd.pointing_mrad > WEAK_POINTING_MRAD {
        Some(format!(
            "fly longer, near and far, high and low, through all of its image ({})",
            known_worst(camera)
        ))
    } else {
        None
    }
}

/// The direction in which the camera's position is known worst, in words.
fn known_worst(camera: &CameraResult) -> String {
    let place = camera.pose_covariance.fixed_view::<3, 3>(3, 3).into_owned().symmetric_eigen();
    let worst = place.eigenvalues.imax();
    let axis = place.eigenvectors.column(worst);
    let level = axis.x.hypot(axis.y);
    let sd_m = place.eigenvalues[worst].max(0.0).sqrt();
    // An axis has no sign: the half towards the north or east is named.
    let azimuth = axis.x.atan2(axis.y).to_degrees().rem_euclid(180.0);
    let steep = axis.z.abs().atan2(level).to_degrees();
    if steep > 60.0 {
        format!("its height is known worst, to {sd_m:.2} m")
    } else {
        format!("its place is known worst along {azimuth:.0} degrees from north, to {sd_m:.2} m")
    }
}
