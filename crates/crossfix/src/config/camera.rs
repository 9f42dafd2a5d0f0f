use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, ensure};
use crossfix_calibration::{intrinsics_from_camchain, intrinsics_from_yaml};
use crossfix_geometry::{Camera, ImageSize, Intrinsics, Pixel, PixelCovariance};
use crossfix_message::{CameraCalibration, CameraName, Channel, ClockSource, Timestamp, decode};
#[cfg(feature = "centre")]
use crossfix_simulation::{Scene, SceneCamera};
use crossfix_video::{
    FrameClock, GigeCamera, GigeOptions, GstreamerCamera, LiveCamera, RtspCamera, StreamLatency,
    UsbCamera, UsbOptions,
};
use crossfix_vision::{DetectorConfig, PixelBox, TrackerConfig};
use serde::{Deserialize, Serialize};

use super::mount::MountConfig;
use super::pose::PoseConfig;
use super::{FileKind, SourceConfig};
use crate::calibrated::Calibrated;
use crate::recorded;

/// One camera: its name, lens and pose, where its pictures come from, and how it follows targets.
/// Paths are relative to the file.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraFile {
    /// The camera's name, unique in the site.
    pub name: CameraName,
    /// The network's file (TOML).
    pub network: PathBuf,
    /// The site's calibration (TOML, by crossfix calibrate): its lens and pose replace `intrinsics`
    /// and `pose`, and times that `clock` has corrected are corrected further by its clock.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<PathBuf>,
    /// Intrinsics (YAML of OpenCV, ROS or Kalibr: `camchain.yaml#cam1` picks one of several
    /// cameras). May be absent with a recording, which has its own; if both this and `pose` are
    /// there, they replace the recorded calibration.
    pub intrinsics: Option<PathBuf>,
    /// Where the camera stands, and its direction of view.
    pub pose: Option<PoseConfig>,
    /// The mount that turns the camera, if it has one: the camera then looks for what the fusion
    /// centre tells it to look for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mount: Option<MountConfig>,
    /// For a camera without a mount: whether it reports which of its tracks is the target that the
    /// fusion centre tells it to look for.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub takes_cues: bool,
    /// Where the pictures come from.
    pub source: SourceConfig,
    /// How accurate the capture times are, and how they are corrected.
    #[serde(default)]
    pub clock: ClockConfig,
    /// Small pictures for people.
    #[serde(default)]
    pub preview: PreviewConfig,
    /// Targets to follow from the first image on: left, top, width, height in pixels.
    #[serde(default)]
    pub boxes: Vec<[f64; 4]>,
    /// How targets are found and followed.
    #[serde(default)]
    pub tracker: TrackerConfig,
}

/// Clock SD of an industrial camera, s: it stamps the exposure itself, and its clock is read over a
/// quick network. With half of it a clock that is read to a millisecond would seem twice as good
/// as it is.
const GIGE_CLOCK_SD_S: f64 = 1e-3;
/// Clock SD of a camera of this host, s: from the driver's times and from an exposure time that
/// nobody has stated. With half of it half of an exposure of 20 ms would be two SDs.
const USB_CLOCK_SD_S: f64 = 0.01;

/// How accurate capture times are, and how they are corrected.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClockConfig {
    /// What sets the camera's clock: `ntp`, `ptp`, `gnss`, `host` (nothing does), `simulated`;
    /// `frame-count` (default of files), where there is no clock; `camera` (default of streams),
    /// where it is unknown what sets it; `arrival`, where a stream's own times are not to be
    /// trusted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<ClockSourceName>,
    /// How far the camera's clock is ahead at the start, s. Of a stream it includes how much later
    /// than the exposure the instant is that the camera reports.
    pub offset_s: f64,
    /// How much too fast the clock runs, millionths.
    pub drift_ppm: f64,
    /// Standard deviation of a corrected capture time, s. Default 0.001, of a stream 0.1, as some
    /// cameras report when an image was sent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sd_s: Option<f64>,
}

/// A clock's source as it is written in files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ClockSourceName {
    FrameCount,
    Host,
    Ntp,
    Ptp,
    Gnss,
    Simulated,
    Camera,
    Arrival,
}

impl From<ClockSourceName> for ClockSource {
    fn from(name: ClockSourceName) -> Self {
        match name {
            ClockSourceName::FrameCount => Self::FrameCount,
            ClockSourceName::Host => Self::Host,
            ClockSourceName::Ntp => Self::Ntp,
            ClockSourceName::Ptp => Self::Ptp,
            ClockSourceName::Gnss => Self::Gnss,
            ClockSourceName::Simulated => Self::Simulated,
            ClockSourceName::Camera => Self::Camera,
            ClockSourceName::Arrival => Self::Arrival,
        }
    }
}

/// Small pictures for people.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PreviewConfig {
    /// Pictures per second; 0 means none. Default 4.
    pub rate_hz: f64,
    /// Divisor of the camera's width and height, 1/n. Default 2, half.
    pub divisor: u32,
}

impl Default for PreviewConfig {
    fn default() -> Self {
        Self { rate_hz: 4.0, divisor: 2 }
    }
}

impl CameraFile {
    /// Reads the file and resolves its paths against the file's folder.
    pub fn load(path: &Path, sets: &[String]) -> anyhow::Result<Self> {
        let mut file: Self = super::load(path, sets, FileKind::Camera)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        file.network = folder.join(&file.network);
        file.intrinsics = file.intrinsics.map(|intrinsics| folder.join(intrinsics));
        file.calibration = file.calibration.map(|calibration| folder.join(calibration));
        if let Some(onvif) = file.mount.as_mut().and_then(|mount| mount.onvif.as_mut()) {
            onvif.password_file = onvif.password_file.take().map(|file| folder.join(file));
        }
        match &mut file.source {
            SourceConfig::Video { path, .. } | SourceConfig::Recording { path, .. } => {
                *path = folder.join(&*path);
            }
            SourceConfig::Simulation { scene, .. } => *scene = folder.join(&*scene),
            SourceConfig::Usb { .. } | SourceConfig::Gige { .. } => {}
            SourceConfig::Gstreamer(pipeline) => {
                pipeline.password_file =
                    pipeline.password_file.take().map(|file| folder.join(file));
            }
            SourceConfig::Stream(stream) => {
                stream.password_file = stream.password_file.take().map(|file| folder.join(file));
            }
        }
        if file.source.is_live() && file.boxes.is_empty() && file.tracker.detector.is_none() {
            // No boxes can be given for a scene that has not been filmed yet, so a detector finds
            // the targets.
            file.tracker.detector = Some(DetectorConfig::default());
        }
        file.clock.source = Some(file.clock.source.unwrap_or_else(|| file.usual_clock().0));
        file.clock.sd_s = Some(file.clock_sd_s());
        Ok(file)
    }

    /// Checks all that can be checked without starting, and returns the camera.
    pub fn camera(&self, path: &Path) -> anyhow::Result<Camera> {
        let wrong = || format!("the configuration file {} has an error", path.display());
        self.check().and_then(|()| self.source.check_there()).with_context(wrong)?;
        self.described(path)
    }

    /// The camera that the file describes, whether or not its pictures exist yet.
    pub fn described(&self, path: &Path) -> anyhow::Result<Camera> {
        let wrong = || format!("the configuration file {} has an error", path.display());
        self.check().with_context(wrong)?;
        if let Some(calibrated) = self.calibrated().with_context(wrong)? {
            self.check_boxes(calibrated.camera()).with_context(wrong)?;
            self.pan_tilt(calibrated.camera().pose()).with_context(wrong)?;
            return Ok(calibrated.camera().clone());
        }
        match (&self.intrinsics, &self.pose, &self.source) {
            (Some(intrinsics), Some(pose), _) => {
                let intrinsics = read_lens(intrinsics).with_context(wrong)?;
                let pose = pose.pose().context("section [pose]").with_context(wrong)?;
                let camera = Camera::new(intrinsics, pose)?;
                self.check_lens(&camera).with_context(wrong)?;
                self.pan_tilt(camera.pose()).with_context(wrong)?;
                Ok(camera)
            }
            (None, None, SourceConfig::Recording { path, .. }) => {
                let calibration = recorded_calibration(path, &self.name).with_context(wrong)?;
                Ok(calibration.parse()?.camera)
            }
            _ => Err(anyhow!("give both `intrinsics` and [pose], or `calibration`"))
                .with_context(wrong),
        }
    }

    /// The lens that the file's intrinsics describe, whatever else is missing.
    pub fn lens(&self, path: &Path) -> anyhow::Result<Intrinsics> {
        let intrinsics = self.intrinsics.as_ref().with_context(|| {
            format!(
                "the configuration file {} has no key `intrinsics`: a lens file is begun with",
                path.display()
            )
        })?;
        read_lens(intrinsics)
            .with_context(|| format!("the configuration file {} has an error", path.display()))
    }

    /// The pose's standard deviations as the file declares them: rotation, rad, and position, m.
    #[cfg(feature = "centre")]
    pub fn declared_pose_sd(&self) -> Option<(f64, f64)> {
        self.pose.as_ref().and_then(PoseConfig::deviations)
    }

    /// The camera as the site's calibration describes it, if the file names one.
    pub fn calibrated(&self) -> anyhow::Result<Option<Calibrated>> {
        let load = |path: &PathBuf| Calibrated::load(path, &self.name).context("key `calibration`");
        self.calibration.as_ref().map(load).transpose()
    }

    fn check(&self) -> anyhow::Result<()> {
        self.tracker.validate().context("section [tracker]")?;
        let clock = &self.clock;
        let sd_s = self.clock_sd_s();
        ensure!(
            (0.0..10.0).contains(&sd_s),
            "key `clock.sd_s` is {sd_s}: it must be from 0 to 10 s"
        );
        ensure!(
            clock.offset_s.is_finite() && clock.drift_ppm.abs() < 1e5,
            "keys `clock.offset_s`, `clock.drift_ppm`: {} s and {} ppm are no clock's",
            clock.offset_s,
            clock.drift_ppm
        );
        let preview = &self.preview;
        ensure!(
            (0.0..=30.0).contains(&preview.rate_hz),
            "key `preview.rate_hz` is {}: it must be from 0 to 30",
            preview.rate_hz
        );
        ensure!(
            (1..=64).contains(&preview.divisor),
            "key `preview.divisor` is {}: it must be from 1 to 64",
            preview.divisor
        );
        for place in &self.boxes {
            let [x, y, width, height] = *place;
            ensure!(
                PixelBox { x, y, width, height }.is_possible(),
                "key `boxes`: {place:?} is no box: left and top within 1e6 pixels, sides of 1 to \
                 1000"
            );
        }
        self.source.check_pace()
    }

    /// Checks what needs the lens: that every pixel has a direction, and that the boxes are in its
    /// image.
    fn check_lens(&self, camera: &Camera) -> anyhow::Result<()> {
        let ImageSize { width, height } = camera.model().intrinsics().size;
        let (right, bottom) = (f64::from(width) - 1.0, f64::from(height) - 1.0);
        for (x, y) in [
            (0.0, 0.0),
            (right, 0.0),
            (0.0, bottom),
            (right, bottom),
            (right / 2.0, 0.0),
            (0.0, bottom / 2.0),
        ] {
            let bearing = camera.model().bearing(Pixel::new(x, y), PixelCovariance::isotropic(1.0));
            bearing.with_context(|| {
                format!(
                    "the lens shows no direction at pixel ({x}, {y}): are the distortion \
                     coefficients in their order?"
                )
            })?;
        }
        self.check_boxes(camera)
    }

    /// Checks that boxes are in the camera's image.
    fn check_boxes(&self, camera: &Camera) -> anyhow::Result<()> {
        let ImageSize { width, height } = camera.model().intrinsics().size;
        for &[x, y, w, h] in &self.boxes {
            ensure!(
                x + w > 0.0 && y + h > 0.0 && x < f64::from(width) && y < f64::from(height),
                "key `boxes`: [{x}, {y}, {w}, {h}] lies outside of the image of {width}x{height} \
                 pixels"
            );
        }
        Ok(())
    }

    /// Opens the pictures and compares their size with the lens's: errors that an agent would
    /// otherwise find only when it starts.
    pub fn check_pictures(&self, camera: &Camera) -> anyhow::Result<()> {
        let SourceConfig::Video { path, .. } = &self.source else {
            return Ok(());
        };
        let wrong = || format!("key `source.path`: {}", path.display());
        let mut source = crossfix_video::open(path, FrameClock::default()).with_context(wrong)?;
        let frame = source.next_frame().with_context(wrong)?;
        let frame = frame
            .with_context(|| format!("key `source.path`: {} holds no frame", path.display()))?;
        let ImageSize { width, height } = camera.model().intrinsics().size;
        ensure!(
            (frame.width, frame.height) == (width as usize, height as usize),
            "{} has frames of {}x{} pixels, the intrinsics are for {width}x{height}: calibrate at \
             the size of the video",
            path.display(),
            frame.width,
            frame.height
        );
        Ok(())
    }

    /// The message that describes the camera. A replay without a calibration of its own uses the
    /// recorded message unchanged, so that the same bytes give the same tracks.
    pub fn calibration(
        &self,
        camera: &Camera,
        valid_from: Timestamp,
    ) -> anyhow::Result<CameraCalibration> {
        match &self.source {
            SourceConfig::Recording { path, .. } if self.intrinsics.is_none() => {
                recorded_calibration(path, &self.name)
            }
            _ => {
                let message = CameraCalibration::new(&self.name, camera, valid_from);
                let declared = self.pose.as_ref().and_then(PoseConfig::deviations);
                Ok(match declared {
                    Some((rotation_rad, position_m)) => {
                        message.with_pose_sd(rotation_rad, position_m)
                    }
                    None => message,
                })
            }
        }
    }

    /// Frames per second, if the file or its scene states it.
    #[cfg(feature = "centre")]
    pub fn rate_hz(&self) -> anyhow::Result<Option<f64>> {
        match &self.source {
            SourceConfig::Video { rate_hz, .. } => Ok(Some(*rate_hz)),
            SourceConfig::Simulation { scene, .. } => {
                let scene: Scene = super::load(scene, &[], FileKind::Scene)?;
                let named = |camera: &&SceneCamera| camera.name == self.name;
                Ok(scene.cameras.iter().find(named).map(|camera| camera.rate_hz))
            }
            SourceConfig::Usb { rate_hz, .. } | SourceConfig::Gige { rate_hz, .. } => Ok(*rate_hz),
            SourceConfig::Recording { .. }
            | SourceConfig::Stream(_)
            | SourceConfig::Gstreamer(_) => Ok(None),
        }
    }

    /// What sets the clock of the capture times.
    pub fn clock_source(&self) -> ClockSource {
        self.clock.source.unwrap_or_else(|| self.usual_clock().0).into()
    }

    /// Standard deviation of a corrected capture time, s.
    pub fn clock_sd_s(&self) -> f64 {
        self.clock.sd_s.unwrap_or_else(|| self.usual_clock().1)
    }

    /// Clock source of this kind of source, and its standard deviation, s, where the file does not
    /// state them.
    fn usual_clock(&self) -> (ClockSourceName, f64) {
        match self.source {
            SourceConfig::Stream(_) | SourceConfig::Gstreamer(_) => {
                (ClockSourceName::Camera, StreamLatency::default().sd_s)
            }
            SourceConfig::Usb { .. } => (ClockSourceName::Host, USB_CLOCK_SD_S),
            SourceConfig::Gige { .. } => (ClockSourceName::Host, GIGE_CLOCK_SD_S),
            _ => (ClockSourceName::FrameCount, 1e-3),
        }
    }

    /// The live camera that it watches, if any. A camera of this host is set to `size`, or left as
    /// it is set.
    pub fn live(&self, size: Option<ImageSize>) -> anyhow::Result<Option<LiveCamera>> {
        let by_arrival = self.clock_source() == ClockSource::Arrival;
        let by_arrival_sd_s = by_arrival.then(|| self.clock_sd_s());
        Ok(match &self.source {
            SourceConfig::Stream(stream) => {
                Some(LiveCamera::Stream(RtspCamera::new(stream.options(by_arrival_sd_s)?)))
            }
            SourceConfig::Gige { address, rate_hz, latency_s } => {
                Some(LiveCamera::Gige(GigeCamera::new(GigeOptions {
                    address: *address,
                    size: size.map(|size| [size.width, size.height]),
                    rate_hz: *rate_hz,
                    latency_s: *latency_s,
                    sd_s: self.clock_sd_s(),
                    heeds_stamps: !by_arrival,
                })))
            }
            SourceConfig::Gstreamer(pipeline) => {
                let options = pipeline.options(by_arrival_sd_s)?;
                Some(LiveCamera::Gstreamer(GstreamerCamera::new(options)))
            }
            SourceConfig::Usb { device, rate_hz, latency_s } => {
                Some(LiveCamera::Usb(UsbCamera::new(UsbOptions {
                    device: device.clone(),
                    size: size.map(|size| [size.width, size.height]),
                    rate_hz: *rate_hz,
                    latency_s: *latency_s,
                    sd_s: self.clock_sd_s(),
                })))
            }
            _ => None,
        })
    }

    /// The boxes of targets to follow from the first image on.
    pub fn boxes(&self) -> impl Iterator<Item = PixelBox> {
        self.boxes.iter().map(|&[x, y, width, height]| PixelBox { x, y, width, height })
    }
}

/// The first calibration of a camera in a recording.
fn recorded_calibration(recording: &Path, name: &CameraName) -> anyhow::Result<CameraCalibration> {
    let channel = Channel::Calibration(name.clone());
    let found = recorded::find(recording, |entry| {
        (entry.key.channel == channel).then(|| decode::<CameraCalibration>(&entry.data))
    })?;
    let found = found.with_context(|| {
        format!("{} has no calibration of camera `{name}`", recording.display())
    })?;
    found.with_context(|| format!("the calibration of camera `{name}` in {}", recording.display()))
}

/// Reads a lens file. Of a file of several cameras (Kalibr's) the one named after `#` is read.
fn read_lens(path: &Path) -> anyhow::Result<Intrinsics> {
    let named = path.to_str().filter(|_| !path.exists()).and_then(|path| path.rsplit_once('#'));
    let file = named.map_or(path, |(file, _)| Path::new(file));
    let text = std::fs::read_to_string(file)
        .with_context(|| format!("key `intrinsics`: cannot read {}", file.display()))?;
    let read = match named {
        Some((_, camera)) => intrinsics_from_camchain(&text, camera),
        None => intrinsics_from_yaml(&text),
    };
    read.with_context(|| format!("the intrinsics file {} has an error", file.display()))
}
