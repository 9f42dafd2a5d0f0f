//! A camera's accuracy for planning, from its file or its calibration.

use std::path::Path;

use crossfix_calibration::CalibratedCamera;
use crossfix_evaluation::bound::PlannedCamera;
use crossfix_fusion::pose_covariance_of_careful_survey;
use nalgebra::Matrix6;

use crate::config::CameraFile;

/// Frames per second of a camera whose file does not say. With half of it a plan expects SDs that
/// are up to 1.4 times as large.
const DEFAULT_RATE_HZ: f64 = 30.0;
/// Standard deviation of an image tracker's target position where none is given, pixels per axis.
/// With half of it a plan promises SDs that are up to half as large.
const DEFAULT_PIXEL_SD_PX: f64 = 0.5;

/// A camera described by its file and by the calibration that the file names.
pub fn of_file(
    file: &CameraFile,
    path: &Path,
    rate_hz: Option<f64>,
) -> anyhow::Result<PlannedCamera> {
    let camera = file.described(path)?;
    let clock_sd_s = file.clock_sd_s();
    if let Some(calibrated) = file.calibrated()? {
        let mut planned = of_calibrated(calibrated.calibrated_camera(), clock_sd_s);
        planned.rate_hz = rate_hz.unwrap_or(planned.rate_hz);
        return Ok(planned);
    }
    let mut pose_covariance = pose_covariance_of_careful_survey();
    if let Some((rotation_sd_rad, position_sd_m)) = file.declared_pose_sd() {
        hold(&mut pose_covariance, 0, rotation_sd_rad);
        hold(&mut pose_covariance, 3, position_sd_m);
    }
    Ok(PlannedCamera {
        name: file.name.to_string(),
        camera,
        rate_hz: rate_hz.unwrap_or(DEFAULT_RATE_HZ),
        clock_sd_s,
        pixel_sd_px: DEFAULT_PIXEL_SD_PX,
        lasting_noise_rad: 0.0,
        pose_covariance,
        lens_sd_rad: 0.0,
    })
}

/// A camera described by its calibration; its clock error is the calibration's deviation and
/// `clock_sd_s` (s) together.
pub fn of_calibrated(camera: &CalibratedCamera, clock_sd_s: f64) -> PlannedCamera {
    let found_s = camera.clock.knots_s.get(camera.clock.knots_s.len() / 2).map_or(0.0, |k| k[2]);
    PlannedCamera {
        name: camera.name.to_string(),
        camera: camera.camera.clone(),
        rate_hz: camera.frame_s.recip(),
        clock_sd_s: clock_sd_s.hypot(found_s),
        pixel_sd_px: camera.noise.white_px,
        lasting_noise_rad: camera.noise.lasting_px / camera.camera.model().intrinsics().fx,
        pose_covariance: camera.pose_covariance,
        lens_sd_rad: camera.lens_sd_rad(),
    }
}

/// Makes the rotation (`first` 0) or position (`first` 3) of a pose uncorrelated with the rest,
/// with one deviation on each axis.
pub fn hold(pose_covariance: &mut Matrix6<f64>, first: usize, sd: f64) {
    pose_covariance.fixed_rows_mut::<3>(first).fill(0.0);
    pose_covariance.fixed_columns_mut::<3>(first).fill(0.0);
    pose_covariance.fixed_view_mut::<3, 3>(first, first).fill_diagonal(sd * sd);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_option_for_the_rotation_leaves_the_position_alone() {
        let mut covariance = Matrix6::from_fn(|row, column| if row == column { 4.0 } else { 1.0 });
        hold(&mut covariance, 0, 3.0);
        assert_eq!(covariance[(1, 1)], 9.0);
        assert_eq!((covariance[(0, 1)], covariance[(4, 2)], covariance[(2, 4)]), (0.0, 0.0, 0.0));
        assert_eq!((covariance[(4, 4)], covariance[(3, 5)]), (4.0, 1.0));
    }
}
