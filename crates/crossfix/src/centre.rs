//! The fusion as its two shells, live and offline, need it: messages are read, refused, counted and
//! reported in one way.

use std::collections::BTreeSet;
use std::time::Instant;

use crossfix_fusion::{CameraReport, Fusion, FusionConfig, FusionConfigError, Output, Standing};
use crossfix_message::{
    BearingFrame, CameraCalibration, CameraHealth, CameraName, Channel, Counter, DecodeError,
    Health, Payload, Timestamp, decode,
};

use crate::pose_watch::PoseWatch;
use crate::repeats::Repeats;

/// The fusion, with the checks that a message must pass before it gets there.
pub struct Centre {
    fusion: Fusion,
    /// Cameras that are listened to; `None` means all.
    cameras: Option<Vec<CameraName>>,
    refused: Refusals,
    repeats: Repeats,
    frames: u64,
    poses: PoseWatch,
    scene_begins: Timestamp,
    /// Cameras that have announced that they send no more.
    ended: BTreeSet<CameraName>,
}

/// Counts of what was turned away before it reached the fusion.
#[derive(Debug, Default)]
struct Refusals {
    malformed: u64,
    too_large: u64,
    newer: u64,
    foreign: u64,
    mismatched: u64,
    bad_calibrations: u64,
}

/// A message that names the camera it comes from.
trait OfCamera: Payload {
    fn camera(&self) -> &str;
}

impl OfCamera for BearingFrame {
    fn camera(&self) -> &str {
        &self.camera
    }
}

impl OfCamera for CameraCalibration {
    fn camera(&self) -> &str {
        &self.camera
    }
}

impl OfCamera for Health {
    fn camera(&self) -> &str {
        &self.component
    }
}

/// Why a message is not used.
#[derive(Debug, thiserror::Error)]
enum Unread {
    #[error(transparent)]
    Decode(DecodeError),
    #[error("it says that it is of `{message}`")]
    Mismatched { message: String },
}

/// Reads a message that came under a camera's key. The transport permits a camera only its own key,
/// so the message must name that camera and no other.
fn read_of<M: OfCamera>(camera: &CameraName, data: &[u8]) -> Result<M, Unread> {
    let message: M = decode(data).map_err(Unread::Decode)?;
    if message.camera() == camera.as_str() {
        return Ok(message);
    }
    Err(Unread::Mismatched { message: message.camera().chars().take(100).collect() })
}

impl Centre {
    /// A fusion that listens to some cameras, or to all.
    pub fn new(
        config: FusionConfig,
        cameras: Option<Vec<CameraName>>,
    ) -> Result<Self, FusionConfigError> {
        Ok(Self {
            fusion: Fusion::new(config)?,
            cameras,
            refused: Refusals::default(),
            repeats: Repeats::default(),
            frames: 0,
            poses: PoseWatch::default(),
            scene_begins: Timestamp::EPOCH,
            ended: BTreeSet::new(),
        })
    }

    /// Whether messages of a camera are used.
    pub fn listens_to(&self, camera: &CameraName) -> bool {
        self.cameras.as_ref().is_none_or(|cameras| cameras.contains(camera))
    }

    /// Takes a message in and returns the fusion's outputs. `sender` is named in warnings, if there
    /// are any.
    pub fn take(&mut self, channel: &Channel, data: &[u8], sender: &str) -> Vec<Output> {
        let Some(camera) = channel.camera() else {
            return Vec::new();
        };
        if !self.listens_to(camera) {
            self.refused.foreign += 1;
            self.repeats.warn("foreign", Instant::now(), || {
                format!("camera `{camera}`{sender} is not configured here: not used")
            });
            return Vec::new();
        }
        let outputs = match channel {
            Channel::Bearings(_) => {
                match self.used(camera, read_of::<BearingFrame>(camera, data), sender) {
                    Some(frame) => self.fusion.ingest(&frame),
                    None => Vec::new(),
                }
            }
            Channel::Calibration(_) => {
                self.calibrate(camera, data, sender);
                Vec::new()
            }
            Channel::CameraHealth(_) => {
                match self.used(camera, read_of::<Health>(camera, data), sender) {
                    Some(health) => self.hear_of(camera, &health),
                    None => Vec::new(),
                }
            }
            _ => Vec::new(),
        };
        if let Some(why) = self.fusion.why_nothing() {
            self.repeats
                .warn("nothing found", Instant::now(), || format!("nothing is found: {why}"));
        }
        if self.poses.check(&self.fusion) {
            for camera in self.alone() {
                let problem = || problem_of_one_alone(&camera);
                self.repeats.warn(&format!("alone {camera}"), Instant::now(), problem);
            }
            for (camera, problem) in self.poses.problems() {
                self.repeats.warn(&format!("moved {camera}"), Instant::now(), || problem);
            }
        }
        self.follow(outputs)
    }

    /// Takes a calibration in. An impossible one is counted, and the camera's earlier calibration
    /// stays in use.
    fn calibrate(&mut self, camera: &CameraName, data: &[u8], sender: &str) {
        let read = read_of::<CameraCalibration>(camera, data);
        let Some(message) = self.used(camera, read, sender) else {
            return;
        };
        if let Err(error) = self.fusion.calibrate(&message) {
            self.refused.bad_calibrations += 1;
            self.repeats.warn(&format!("calibration {camera}"), Instant::now(), || {
                let cause = std::error::Error::source(&error).map(|source| format!(": {source}"));
                format!("not used{sender}: {error}{}", cause.unwrap_or_default())
            });
        }
    }

    fn hear_of(&mut self, camera: &CameraName, health: &Health) -> Vec<Output> {
        if health.scene_begins_ns != 0 {
            self.scene_begins = Timestamp::from_nanos(health.scene_begins_ns);
        }
        if health.ended {
            self.ended.insert(camera.clone());
            self.fusion.camera_ended(camera)
        } else {
            self.ended.remove(camera);
            Vec::new()
        }
    }

    /// The message if it could be read; otherwise counts why not and returns `None`.
    fn used<M>(&mut self, camera: &CameraName, read: Result<M, Unread>, sender: &str) -> Option<M> {
        match read {
            Ok(message) => return Some(message),
            Err(Unread::Decode(error)) => {
                self.refuse(
                    &format!("a message under the key of camera `{camera}`"),
                    sender,
                    &error,
                );
            }
            Err(error @ Unread::Mismatched { .. }) => {
                self.refused.mismatched += 1;
                self.repeats.warn(&format!("mismatched {camera}"), Instant::now(), || {
                    format!(
                        "a message under the key of camera `{camera}`{sender} is not used: {error}"
                    )
                });
            }
        }
        None
    }

    /// Counts a message that cannot be read, and warns of it; `sender` is named in the warning.
    pub fn refuse(&mut self, what: &str, sender: &str, error: &DecodeError) {
        let (counter, kind) = match error {
            DecodeError::Malformed { .. } => (&mut self.refused.malformed, "malformed"),
            DecodeError::TooLarge { .. } => (&mut self.refused.too_large, "too large"),
            DecodeError::NewerMajor { .. } => (&mut self.refused.newer, "newer"),
        };
        *counter += 1;
        self.repeats.warn(&format!("{kind} {what}"), Instant::now(), || {
            format!("{what}{sender} is not used: {error}")
        });
    }

    /// Handles all that is still queued in the fusion.
    pub fn flush(&mut self) -> Vec<Output> {
        let outputs = self.fusion.flush();
        self.poses.finish(&self.fusion);
        let outputs = self.follow(outputs);
        self.repeats.end();
        outputs
    }

    /// Logs that a camera is left out, or used again.
    fn report_camera(&mut self, camera: &CameraName, standing: Standing) {
        if standing == Standing::Excluded {
            self.repeats.warn(&format!("left out {camera}"), Instant::now(), || {
                format!(
                    "camera `{camera}` is left out: its bearings do not fit the tracks that the \
                     others hold; check its pose and its clock"
                )
            });
        } else {
            self.repeats.info(&format!("used again {camera}"), Instant::now(), || {
                format!("camera `{camera}` is used again: its bearings fit the tracks")
            });
        }
    }

    /// Counts the fusion's outputs, and logs those that are meant for people.
    fn follow(&mut self, outputs: Vec<Output>) -> Vec<Output> {
        for output in &outputs {
            match output {
                Output::Tracks(_) => self.frames += 1,
                Output::Rejected(rejection) => {
                    let kind = format!("{} {}", rejection.camera, rejection.reason.counter());
                    self.repeats.warn(&kind, Instant::now(), || format!("not used: {rejection}"));
                }
                Output::Camera(camera, standing) => self.report_camera(camera, *standing),
                Output::Event(_) | Output::Smoothed(_) | Output::Cues(_) => {}
            }
        }
        outputs
    }

    /// The watch over whether cameras still stand as they were calibrated.
    pub fn poses(&self) -> &PoseWatch {
        &self.poses
    }

    /// Whether a camera has announced that it sends no more.
    pub fn has_ended(&self, camera: &CameraName) -> bool {
        self.ended.contains(camera)
    }

    /// The cameras that the fusion leaves out.
    pub fn left_out(&self) -> Vec<CameraName> {
        let reports = self.fusion.cameras();
        let left_out = reports.filter(|report| report.standing == Standing::Excluded);
        left_out.map(|report| report.camera).collect()
    }

    /// The cameras of whose bearings none is of the targets that others see in their view.
    fn alone(&self) -> Vec<CameraName> {
        let reports = self.fusion.cameras();
        let alone = reports.filter(|it| it.is_alone && it.standing != Standing::Excluded);
        alone.map(|report| report.camera).collect()
    }

    /// Logs the counts of repeated warnings that are due.
    pub fn remind(&mut self, now: Instant) {
        self.repeats.remind(now);
    }

    /// Warns by request of the shell; repeats of a kind are counted instead of logged.
    pub fn warn(&mut self, kind: &str, text: impl FnOnce() -> String) {
        self.repeats.warn(kind, Instant::now(), text);
    }

    /// Number of track frames so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Why no target is found although two cameras see something at the same time.
    pub fn why_nothing(&self) -> Option<String> {
        self.fusion.why_nothing().map(ToString::to_string)
    }

    /// Current data time; the epoch before there are any data.
    pub fn now(&self) -> Timestamp {
        self.fusion.now().unwrap_or_default()
    }

    /// The component's health; the shell adds what the transport has counted, in `counted`.
    pub fn health(&self, counted: &[(&'static str, u64)]) -> Health {
        let refused = &self.refused;
        let own = [
            ("received_bad_calibration", refused.bad_calibrations),
            ("received_foreign_camera", refused.foreign),
            ("received_malformed", refused.malformed),
            ("received_mismatched", refused.mismatched),
            ("received_newer_version", refused.newer),
            ("received_too_large", refused.too_large),
        ];
        let counted =
            own.into_iter().chain(counted.iter().copied()).chain(self.fusion.counters().iter());
        let counters = counted.map(|(name, value)| Counter { name: name.to_owned(), value });
        let mut counters: Vec<Counter> = counters.collect();
        counters.sort_by(|a, b| a.name.cmp(&b.name));
        let left_out = self.left_out();
        let left_out = left_out.iter().map(|camera| format!("camera `{camera}` is left out"));
        let moved = self.poses.problems().map(|(_, problem)| problem);
        let alone = self.alone().into_iter().map(|camera| problem_of_one_alone(&camera));
        let nothing = self.why_nothing().map(|why| format!("nothing is found: {why}"));
        Health {
            component: "fusion".to_owned(),
            time_ns: self.now().nanos(),
            handled: self.frames,
            counters,
            cameras: self.fusion.cameras().map(|report| camera_health(&report)).collect(),
            problems: left_out.chain(moved).chain(alone).chain(nothing).collect(),
            scene_begins_ns: self.scene_begins.nanos(),
            tracks: self.fusion.tracks().count().try_into().unwrap_or(u32::MAX),
            ..Default::default()
        }
    }
}

fn problem_of_one_alone(camera: &CameraName) -> String {
    format!(
        "camera `{camera}` sees something, but none of the targets that others see in its view: \
         check its pose and its clock, and what stands before it"
    )
}

/// A camera's report as a wire message.
fn camera_health(report: &CameraReport) -> CameraHealth {
    let standing = match report.standing {
        Standing::Good => crossfix_message::CameraStanding::Good,
        Standing::Doubted => crossfix_message::CameraStanding::Doubted,
        Standing::Excluded => crossfix_message::CameraStanding::Excluded,
    };
    let clock = report.clock;
    CameraHealth {
        camera: report.camera.to_string(),
        standing: standing.into(),
        noise_factor: report.noise_factor,
        clock_offset_s: clock.map_or(0.0, |c| c.offset_s),
        clock_offset_sd_s: clock.map_or(0.0, |c| c.sd_s),
        clock_relative_sd_s: clock.map_or(0.0, |c| c.relative_sd_s),
        clock_drift: clock.map_or(0.0, |c| c.drift),
        clock_drift_sd: clock.map_or(0.0, |c| c.drift_sd),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn count(centre: &Centre, name: &str) -> u64 {
        centre
            .health(&[])
            .counters
            .iter()
            .find(|counter| counter.name == name)
            .map_or(0, |c| c.value)
    }

    #[test]
    fn what_comes_under_one_cameras_key_speaks_for_no_other() {
        let [north, east]: [CameraName; 2] = ["north", "east"].map(|name| name.parse().unwrap());
        let mut centre = Centre::new(FusionConfig::default(), None).unwrap();
        let frame = BearingFrame { camera: "north".into(), ..Default::default() }.encode();
        let calibration =
            CameraCalibration { camera: "north".into(), ..Default::default() }.encode();
        let ended =
            Health { component: "north".into(), ended: true, ..Default::default() }.encode();
        let mut take = |channel: Channel, data: &[u8]| drop(centre.take(&channel, data, ""));
        take(Channel::Bearings(north.clone()), &frame);
        take(Channel::Bearings(east.clone()), &frame);
        take(Channel::Calibration(east.clone()), &calibration);
        take(Channel::CameraHealth(east), &ended);
        take(Channel::Bearings(north.clone()), &[0xff; 40]);
        take(Channel::Calibration(north), &calibration);
        assert_eq!(count(&centre, "received_mismatched"), 3);
        assert_eq!(count(&centre, "received_malformed"), 1);
        assert_eq!(count(&centre, "received_bad_calibration"), 1);
        assert_eq!(count(&centre, "frames"), 1);
    }

    #[test]
    fn cameras_that_are_not_configured_are_counted() {
        let [north, east]: [CameraName; 2] = ["north", "east"].map(|name| name.parse().unwrap());
        let mut centre = Centre::new(FusionConfig::default(), Some(vec![north])).unwrap();
        let frame = BearingFrame { camera: "east".into(), ..Default::default() }.encode();
        centre.take(&Channel::Bearings(east), &frame, "");
        assert_eq!(count(&centre, "received_foreign_camera"), 1);
    }
}
