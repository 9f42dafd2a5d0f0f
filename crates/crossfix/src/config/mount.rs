//! Cameras that look where they are told.

use anyhow::{Context, ensure};
use crossfix_geometry::{PanTilt, Pose};
use crossfix_message::CameraCalibration;
#[cfg(feature = "centre")]
use crossfix_simulation::SceneMount;
use serde::{Deserialize, Serialize};

use super::CameraFile;

/// No mount knows its angles better, mrad: a tenth of an arc second.
const LEAST_SD_MRAD: f64 = 0.001;

/// What turns a camera about its own centre. Its pose is that with both angles at zero.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MountConfig {
    /// How far it turns to the left: least and most, degrees. -360 to 360.
    pub azimuth_deg: [f64; 2],
    /// How far it turns upwards: least and most, degrees. -90 to 90.
    pub elevation_deg: [f64; 2],
    /// Standard deviation of each angle that it says, mrad: of an error that stays the same until it
    /// turns again. 0.001 to 500.
    pub angle_sd_mrad: f64,
}

impl MountConfig {
    /// Of a camera of a scene.
    #[cfg(feature = "centre")]
    pub fn of(mount: &SceneMount) -> Self {
        let SceneMount { azimuth_deg, elevation_deg, angle_sd_mrad, .. } = *mount;
        Self { azimuth_deg, elevation_deg, angle_sd_mrad: angle_sd_mrad.max(LEAST_SD_MRAD) }
    }

    /// Its geometry, by the camera's pose at rest.
    fn pan_tilt(&self, rest: Pose) -> anyhow::Result<PanTilt> {
        ensure!(
            (LEAST_SD_MRAD..=500.0).contains(&self.angle_sd_mrad),
            "key `mount.angle_sd_mrad` is {}: it must be from 0.001 to 500",
            self.angle_sd_mrad
        );
        let radians = |degrees: [f64; 2]| degrees.map(f64::to_radians);
        PanTilt::new(rest, radians(self.azimuth_deg), radians(self.elevation_deg))
            .context("keys `mount.azimuth_deg`, `mount.elevation_deg`")
    }
}

impl CameraFile {
    /// Whether the camera looks for what the fusion centre tells it to look for.
    pub fn looks_for_cues(&self) -> bool {
        self.takes_cues || self.mount.is_some()
    }

    /// What turns the camera, if something does, by its pose at rest.
    pub fn pan_tilt(&self, rest: &Pose) -> anyhow::Result<Option<PanTilt>> {
        self.mount.as_ref().map(|mount| mount.pan_tilt(*rest)).transpose()
    }

    /// A calibration of the camera, with what the file says of its mount and of cues.
    pub fn with_mount(
        &self,
        message: CameraCalibration,
        rest: &Pose,
    ) -> anyhow::Result<CameraCalibration> {
        Ok(match self.pan_tilt(rest)? {
            Some(mount) => message.on_mount(&mount),
            None if self.takes_cues => message.taking_cues(),
            None => message,
        })
    }
}
