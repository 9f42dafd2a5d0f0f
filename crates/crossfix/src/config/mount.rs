//! Mounts: cameras that turn towards what they are to see.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use crossfix_geometry::{PanTilt, Pose};
use crossfix_message::CameraCalibration;
#[cfg(feature = "centre")]
use crossfix_simulation::SceneMount;
#[cfg(feature = "onvif")]
use crossfix_video::Login;
use serde::{Deserialize, Serialize};
use url::Url;

use super::CameraFile;
#[cfg(feature = "onvif")]
use super::stream::login;

/// Least SD of a mount's angles that is accepted, mrad: a fifth of an arc second; no mount knows
/// its angles better. With half of it the same.
const LEAST_SD_MRAD: f64 = 0.001;

/// A mount that turns a camera about its own centre. The camera's pose is that with both angles at
/// zero.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MountConfig {
    /// Range of azimuth, positive to the left: least and most, degrees. -360 to 360.
    pub azimuth_deg: [f64; 2],
    /// Range of elevation, positive upwards: least and most, degrees. -90 to 90.
    pub elevation_deg: [f64; 2],
    /// Standard deviation of each angle that the mount reports, mrad. The error stays the same
    /// until the mount turns again. 0.001 to 500.
    pub angle_sd_mrad: f64,
    /// How the mount is commanded, if it is a network camera's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub onvif: Option<OnvifConfig>,
}

/// A mount controlled by ONVIF, which reports where it points as numbers from -1 to 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnvifConfig {
    /// The camera's device service, as `crossfix sources --lan` lists it:
    /// http://HOST/onvif/device_service.
    pub url: Url,
    /// User name to log in with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// The file whose first line is the password.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// Azimuths at which the mount reports a pan of -1 and of 1, degrees. Azimuths count to the
    /// left, most cameras' pans to the right. -720 to 720.
    pub pan_deg: [f64; 2],
    /// Elevations at which the mount reports a tilt of -1 and of 1, degrees. -360 to 360.
    pub tilt_deg: [f64; 2],
    /// The zoom for which the lens is calibrated, 0 to 1: the zoom is kept there. Absent: the zoom
    /// at which the camera is found.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub zoom: Option<f64>,
}

impl OnvifConfig {
    /// The login, if the camera wants one.
    #[cfg(feature = "onvif")]
    pub fn login(&self) -> anyhow::Result<Option<Login>> {
        login("mount.onvif.", self.user.as_deref(), self.password_file.as_deref())
    }

    fn check(&self) -> anyhow::Result<()> {
        let is_whole = matches!(self.url.scheme(), "http" | "https") && self.url.has_host();
        ensure!(is_whole, "key `mount.onvif.url` does not begin with http://HOST/");
        ensure!(
            self.url.username().is_empty() && self.url.password().is_none(),
            "key `mount.onvif.url` names a user: give `mount.onvif.user` and \
             `mount.onvif.password_file`"
        );
        for (key, [least, most], bound) in
            [("pan_deg", self.pan_deg, 720.0), ("tilt_deg", self.tilt_deg, 360.0)]
        {
            let within = |angle: f64| (-bound..=bound).contains(&angle);
            ensure!(
                within(least) && within(most) && (most - least).abs() >= 1.0,
                "key `mount.onvif.{key}` is [{least}, {most}]: it must be two different angles \
                 from -{bound} to {bound}"
            );
        }
        ensure!(
            self.zoom.is_none_or(|zoom| (0.0..=1.0).contains(&zoom)),
            "key `mount.onvif.zoom` must be from 0 to 1"
        );
        Ok(())
    }
}

impl MountConfig {
    /// The mount of a scene's camera.
    #[cfg(feature = "centre")]
    pub fn of(mount: &SceneMount) -> Self {
        let SceneMount { azimuth_deg, elevation_deg, angle_sd_mrad, .. } = *mount;
        Self {
            azimuth_deg,
            elevation_deg,
            angle_sd_mrad: angle_sd_mrad.max(LEAST_SD_MRAD),
            onvif: None,
        }
    }

    /// The mount's geometry, given the camera's pose at rest.
    fn pan_tilt(&self, rest: Pose) -> anyhow::Result<PanTilt> {
        ensure!(
            (LEAST_SD_MRAD..=500.0).contains(&self.angle_sd_mrad),
            "key `mount.angle_sd_mrad` is {}: it must be from 0.001 to 500",
            self.angle_sd_mrad
        );
        if let Some(onvif) = &self.onvif {
            onvif.check()?;
            for (key, [least, most], of) in [
                ("azimuth_deg", self.azimuth_deg, onvif.pan_deg),
                ("elevation_deg", self.elevation_deg, onvif.tilt_deg),
            ] {
                let (from, to) = (of[0].min(of[1]), of[0].max(of[1]));
                ensure!(
                    from <= least && most <= to,
                    "key `mount.{key}` is [{least}, {most}], and the mount says places from \
                     {from} to {to} only (`mount.onvif`)"
                );
            }
        }
        let radians = |degrees: [f64; 2]| degrees.map(f64::to_radians);
        PanTilt::new(rest, radians(self.azimuth_deg), radians(self.elevation_deg))
            .context("keys `mount.azimuth_deg`, `mount.elevation_deg`")
    }
}

impl CameraFile {
    /// Whether the camera searches for the targets that the fusion centre announces to it (cues).
    pub fn looks_for_cues(&self) -> bool {
        self.takes_cues || self.mount.is_some()
    }

    /// The geometry of the camera's mount, if it has one, given the camera's pose at rest.
    pub fn pan_tilt(&self, rest: &Pose) -> anyhow::Result<Option<PanTilt>> {
        self.mount.as_ref().map(|mount| mount.pan_tilt(*rest)).transpose()
    }

    /// A calibration message of the camera, with the file's statements on its mount and on cues
    /// added.
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
