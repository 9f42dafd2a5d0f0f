//! One camera as its site's calibration file describes it: lens, pose and clock.

use std::path::Path;

use anyhow::{Context, ensure};
use crossfix_calibration::{CalibratedCamera, SiteCalibration};
use crossfix_geometry::{Camera, Pixel};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, ImageTrackState, Preview, Timestamp,
};

/// Reads a site's calibration file.
pub fn load(path: &Path) -> anyhow::Result<SiteCalibration> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read the calibration {}", path.display()))?;
    let site = SiteCalibration::from_toml(&text)
        .with_context(|| format!("the calibration {} has an error", path.display()))?;
    ensure!(!site.cameras().is_empty(), "the calibration {} has no cameras", path.display());
    Ok(site)
}

/// That a site's file lacks a camera, and which it has.
fn lacks_camera(path: &Path, site: &SiteCalibration, name: &CameraName) -> String {
    let known: Vec<&str> = site.cameras().iter().map(|camera| camera.name.as_str()).collect();
    format!(
        "the calibration {} has no camera `{name}`: it has {}",
        path.display(),
        known.join(", ")
    )
}

/// One camera of a site's calibration.
#[derive(Clone, Debug)]
pub struct Calibrated {
    site: SiteCalibration,
    camera: CalibratedCamera,
}

impl Calibrated {
    /// Reads the site's file and picks the camera of this name.
    pub fn load(path: &Path, name: &CameraName) -> anyhow::Result<Self> {
        let site = load(path)?;
        let camera = site.camera(name).cloned().with_context(|| lacks_camera(path, &site, name))?;
        Ok(Self { site, camera })
    }

    /// All that the site's file says of the camera.
    #[cfg(feature = "centre")]
    pub fn calibrated_camera(&self) -> &CalibratedCamera {
        &self.camera
    }

    /// Lens and pose.
    pub fn camera(&self) -> &Camera {
        &self.camera.camera
    }

    /// The message that describes the camera from a time (common time) on.
    pub fn message(&self, from: Timestamp) -> CameraCalibration {
        /// A row may be read out this long before its frame's time, s. With half of it the same: no
        /// read-out takes a second, and half of one lies before the frame's time.
        const EARLIER_S: f64 = 1.0;
        self.site.message(&self.camera, from.plus_seconds(-EARLIER_S))
    }

    /// Common time of an instant by another camera's clock; `own` unchanged if the site lacks that
    /// camera.
    pub fn common_of(&self, camera: &CameraName, own: Timestamp) -> Timestamp {
        self.site.camera(camera).map_or(own, |camera| middle_time(camera, own.nanos()).0)
    }

    /// Common time of an instant by this camera's clock.
    pub fn common(&self, own: Timestamp) -> Timestamp {
        middle_time(&self.camera, own.nanos()).0
    }

    /// [`recalibrate`] with this camera.
    pub fn apply(&self, frame: &mut BearingFrame) -> u64 {
        recalibrate(frame, &self.camera)
    }

    /// Sets a preview picture's time to the common time.
    pub fn apply_to_preview(&self, preview: &mut Preview) {
        preview.capture_time_ns = middle_time(&self.camera, preview.capture_time_ns).0.nanos();
    }
}

/// Common time at which a frame's middle row was read out, and its standard deviation, s.
pub fn middle_time(camera: &CalibratedCamera, own_ns: i64) -> (Timestamp, f64) {
    let height = f64::from(camera.camera.model().intrinsics().size.height);
    camera.common_time(Timestamp::from_nanos(own_ns), height / 2.0)
}

/// Computes a frame's bearings again from their pixels, and sets its time to the common time: that
/// at which the rows of its targets were read out, on average. Returns how many bearings had to be
/// left out.
pub fn recalibrate(frame: &mut BearingFrame, camera: &CalibratedCamera) -> u64 {
    let row = middle_row(frame, camera);
    let (time, sd_s) = camera.common_time(Timestamp::from_nanos(frame.capture_time_ns), row);
    frame.capture_time_ns = time.nanos();
    frame.capture_time_sd_s = frame.capture_time_sd_s.hypot(sd_s);
    let before = frame.tracks.len();
    frame.tracks.retain_mut(|track| set_bearing(track, camera));
    (before - frame.tracks.len()) as u64
}

/// Computes a track's bearing from its pixel; `false` if the pixel has none.
fn set_bearing(track: &mut BearingTrack, camera: &CalibratedCamera) -> bool {
    let Ok(bearing) = camera.bearing(Pixel::new(track.pixel_x, track.pixel_y)) else {
        return false;
    };
    track.bearing = Some(bearing.direction().into_inner().into());
    track.covariance_xx = bearing.covariance().m11;
    track.covariance_xy = bearing.covariance().m12;
    track.covariance_yy = bearing.covariance().m22;
    true
}

/// The image row whose read-out time is used as the frame's time: the mean row of its targets.
fn middle_row(frame: &BearingFrame, camera: &CalibratedCamera) -> f64 {
    let height = f64::from(camera.camera.model().intrinsics().size.height);
    let seen = frame.tracks.iter().filter(|track| track.state() == ImageTrackState::Tracking);
    let rows: Vec<f64> = seen.map(|track| track.pixel_y).collect();
    if rows.is_empty() { height / 2.0 } else { rows.iter().sum::<f64>() / rows.len() as f64 }
}

/// Time that the camera's own clock showed when a frame was taken: the inverse of [`recalibrate`],
/// which has set the frame to common time.
#[cfg(feature = "centre")]
pub fn own_time(frame: &BearingFrame, camera: &CalibratedCamera) -> Timestamp {
    /// Fixed-point steps: the clock's offset changes by less than a hundredth of the change of its
    /// time, so each step leaves less than a hundredth of the error. With half as many the time of
    /// a clock that is off by an hour may be 4 ms wrong.
    const STEPS: usize = 6;
    let common = Timestamp::from_nanos(frame.capture_time_ns);
    let row = middle_row(frame, camera);
    (0..STEPS).fold(common, |own, _| {
        let (shown, _) = camera.common_time(own, row);
        own.plus_seconds(common.seconds_since(shown))
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use crossfix_message::BearingTrack;

    use super::*;

    /// A camera that looks along its z axis, whose clock is half a minute slow, with a read-out of
    /// 20 ms.
    pub(crate) const SITE: &str = r#"
        form = 1
        [[camera]]
        name = "north"
        position_m = [10.0, 20.0, 2.0]
        rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        pose_covariance = [[0.0, 0, 0, 0, 0, 0], [0.0, 0, 0, 0, 0, 0], [0.0, 0, 0, 0, 0, 0],
                           [0.0, 0, 0, 0, 0, 0], [0.0, 0, 0, 0, 0, 0], [0.0, 0, 0, 0, 0, 0]]
        range_m = 50.0
        [camera.lens]
        model = "pinhole"
        size = [1000, 500]
        focal_px = [1000.0, 1000.0]
        centre_px = [500.0, 250.0]
        distortion = []
        covariance = [[0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0]]
        pose_by_lens = [[0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0],
                        [0.0, 0, 0, 0], [0.0, 0, 0, 0], [0.0, 0, 0, 0]]
        [camera.clock]
        knots_s = [[0.0, 30.0, 0.001], [100.0, 30.0, 0.001]]
        rate = 0.0
        rate_sd = 0.0
        wander_s = 0.0
        readout_s = 0.02
        [camera.noise]
        white_px = 0.5
        lasting_px = 0.0
        lasting_s = 1.0
        frame_s = 0.04
    "#;

    fn calibrated(name: &str) -> anyhow::Result<Calibrated> {
        let file = tempfile::NamedTempFile::new()?;
        std::fs::write(file.path(), SITE)?;
        Calibrated::load(file.path(), &name.parse()?)
    }

    #[test]
    fn a_frame_gets_the_common_time_of_its_row_and_the_lens_s_direction() {
        let camera = calibrated("north").unwrap();
        let track = BearingTrack {
            pixel_x: 600.0,
            pixel_y: 500.0,
            state: ImageTrackState::Tracking.into(),
            ..Default::default()
        };
        let mut frame = BearingFrame {
            capture_time_ns: Timestamp::from_seconds(7.0).nanos(),
            tracks: vec![track],
            ..Default::default()
        };
        assert_eq!(camera.apply(&mut frame), 0);
        let time_s = Timestamp::from_nanos(frame.capture_time_ns).seconds();
        // The last row is read out half the read-out after the frame's time.
        assert!((time_s - 37.01).abs() < 1e-6, "{time_s}");
        assert!((frame.capture_time_sd_s - 1e-3).abs() < 1e-9);
        let bearing = frame.tracks[0].bearing.unwrap();
        assert!((bearing.x / bearing.z - 0.1).abs() < 1e-12);
        assert!((bearing.y / bearing.z - 0.25).abs() < 1e-12);
        let message = camera.message(Timestamp::from_seconds(30.0)).parse().unwrap();
        assert_eq!(message.camera.pose().position().x, 10.0);
        #[cfg(feature = "centre")]
        assert!((own_time(&frame, camera.calibrated_camera()).seconds() - 7.0).abs() < 1e-8);
    }

    #[test]
    fn a_camera_that_the_file_has_not_is_told_which_it_has() {
        let error = calibrated("south").unwrap_err().to_string();
        assert!(error.contains("no camera `south`: it has north"), "{error}");
    }
}
