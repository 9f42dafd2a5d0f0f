use std::net::Ipv4Addr;
use std::path::PathBuf;

use anyhow::ensure;
use serde::{Deserialize, Serialize};

use super::{GstreamerConfig, StreamConfig};

/// The last second of this century: a later start counts as an error. With half of it starts
/// after 2034 would be refused.
const LAST_START_S: f64 = 4_102_444_800.0;

/// Where pictures, or bearings made elsewhere, come from.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum SourceConfig {
    /// A video file or a folder of images.
    Video {
        /// .mp4 (H.264), .y4m, or a folder of PNG or JPEG images.
        path: PathBuf,
        /// Capture time of the first frame, s since the Unix epoch, 0 to 4102444800. Default 0.
        #[serde(default)]
        start_s: f64,
        /// Frame rate of image folders, 1/s, 0.001 to 10000. Default 30.
        #[serde(default = "thirty")]
        rate_hz: f64,
        /// Speed of playing relative to real time, up to 1000; 0 is as fast as possible. Default 1.
        #[serde(default = "one")]
        speed: f64,
    },
    /// A simulated camera of a scene, in real time.
    Simulation {
        /// The scene (TOML).
        scene: PathBuf,
        /// Whether this agent publishes the truth as well. Default false.
        #[serde(default)]
        publish_truth: bool,
    },
    /// The live stream of a network camera.
    Stream(StreamConfig),
    /// A camera of this host, as Linux shows it.
    Usb {
        /// Its device, `/dev/video0`; `crossfix sources` lists them.
        device: PathBuf,
        /// Frames per second. Absent: the highest rate that the camera offers at the size of the
        /// intrinsics.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rate_hz: Option<f64>,
        /// Time from the middle of the exposure to the driver's time stamp, s, -10 to 10. Default:
        /// 0 where the driver says when the exposure began, half a frame interval where it does
        /// not.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        latency_s: Option<f64>,
    },
    /// An industrial camera on the network, GigE Vision.
    Gige {
        /// Its address, `10.0.0.7`; `crossfix sources --lan` lists them.
        address: Ipv4Addr,
        /// Frames per second. Absent: as the camera is set.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        rate_hz: Option<f64>,
        /// Time from the middle of the exposure to the camera's time stamp, s, -10 to 10. Default:
        /// minus half the exposure time that the camera reports, as it stamps the start of the
        /// exposure.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        latency_s: Option<f64>,
    },
    /// A GStreamer pipeline, in builds with the feature `gstreamer`.
    Gstreamer(GstreamerConfig),
    /// The recorded bearings of this camera.
    Recording {
        /// The recording (MCAP).
        path: PathBuf,
        /// Speed of playing relative to real time, up to 1000; 0 is as fast as possible. Default 1.
        #[serde(default = "one")]
        speed: f64,
    },
}

fn one() -> f64 {
    1.0
}

fn thirty() -> f64 {
    30.0
}

impl SourceConfig {
    /// Checks the source's start, frame rate and speed.
    pub(super) fn check_pace(&self) -> anyhow::Result<()> {
        let (rate_hz, start_s, speed) = match *self {
            Self::Video { rate_hz, start_s, speed, .. } => (rate_hz, start_s, speed),
            Self::Recording { speed, .. } => (thirty(), 0.0, speed),
            Self::Stream(ref stream) => return stream.check(),
            Self::Gstreamer(ref pipeline) => return pipeline.check(),
            Self::Usb { rate_hz, latency_s, .. } | Self::Gige { rate_hz, latency_s, .. } => {
                ensure!(
                    rate_hz.is_none_or(|rate_hz| (0.1..=1000.0).contains(&rate_hz)),
                    "key `source.rate_hz` must be from 0.1 to 1000 frames a second"
                );
                ensure!(
                    latency_s.is_none_or(|latency_s| (-10.0..=10.0).contains(&latency_s)),
                    "key `source.latency_s` must be from -10 to 10 s"
                );
                return Ok(());
            }
            Self::Simulation { .. } => return Ok(()),
        };
        ensure!(
            (0.001..=10_000.0).contains(&rate_hz),
            "key `source.rate_hz` is {rate_hz}: it must be from 0.001 to 10000 frames a second"
        );
        ensure!(
            (0.0..=LAST_START_S).contains(&start_s),
            "key `source.start_s` is {start_s}: it must be from 0 to {LAST_START_S} s since the \
             Unix epoch"
        );
        ensure!(
            (0.0..=1000.0).contains(&speed),
            "key `source.speed` is {speed}: it must be from 0 (as fast as it goes) to 1000"
        );
        Ok(())
    }

    /// Checks that the source's files exist.
    pub(super) fn check_there(&self) -> anyhow::Result<()> {
        let (key, file) = match self {
            Self::Video { path, .. } | Self::Recording { path, .. } => ("source.path", path),
            Self::Simulation { scene, .. } => ("source.scene", scene),
            Self::Usb { device, .. } => ("source.device", device),
            Self::Gige { .. } => return Ok(()),
            Self::Stream(stream) => return stream.options(None).map(drop),
            Self::Gstreamer(pipeline) => return pipeline.options(None).map(drop),
        };
        ensure!(file.exists(), "key `{key}`: {} is not there", file.display());
        Ok(())
    }

    /// Whether it is played as fast as possible.
    pub fn is_unpaced(&self) -> bool {
        match *self {
            Self::Video { speed, .. } | Self::Recording { speed, .. } => speed == 0.0,
            Self::Simulation { .. }
            | Self::Stream(_)
            | Self::Usb { .. }
            | Self::Gige { .. }
            | Self::Gstreamer(_) => false,
        }
    }

    /// Whether this program decodes compressed video of it.
    pub fn has_video(&self) -> bool {
        matches!(self, Self::Stream(_) | Self::Video { .. })
    }

    /// Whether it is a live camera.
    pub fn is_live(&self) -> bool {
        matches!(self, Self::Stream(_) | Self::Usb { .. } | Self::Gige { .. } | Self::Gstreamer(_))
    }
}
