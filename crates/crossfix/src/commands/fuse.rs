use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_fusion::{Fusion, Output};
use crossfix_message::{
    BearingFrame, CameraCalibration, CameraName, Channel, Counter, DecodeError, Health, Key, Payload,
    Timestamp, decode,
};
use crossfix_transport::{Delivery, GapCounter, Link, LinkPublisher, Received, Role};

use crate::commands::rejections::{RejectionLog, camera_health, report_camera};
use crate::config::{self, FusionFile};
use crate::output;
use crate::shutdown::Shutdown;

const HEALTH_PERIOD: Duration = Duration::from_secs(1);
const POLL: Duration = Duration::from_millis(20);

/// Run the fusion centre: bearings in, tracks out.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  crossfix fuse -c configs/site/fusion.toml")]
pub struct Args {
    /// The fusion centre's configuration (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Override a key of the configuration, e.g. tracking.acceleration_density=2.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// What the fusion centre has open.
struct Centre {
    fusion: Fusion,
    cameras: Vec<CameraName>,
    tracks: LinkPublisher,
    events: LinkPublisher,
    health: LinkPublisher,
    gaps: GapCounter,
    rejections: RejectionLog,
    malformed: u64,
    newer: u64,
    foreign: u64,
    mismatched: u64,
    frames: u64,
    now: Timestamp,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_stdin(args.stop_with_stdin);
    let file = FusionFile::load(Some(&args.config), &args.sets)?;
    let network = file.network.as_ref().with_context(|| {
        format!("{}: key `network` is missing: name the network file", args.config.display())
    })?;
    let network = config::load_network(network)?;
    let link = Link::open(&network, &Role::Fusion)?;
    let cameras = file.cameras.clone().unwrap_or_else(|| network.cameras.keys().cloned().collect());
    let mut centre = Centre {
        fusion: Fusion::new(file.fusion())?,
        cameras,
        tracks: link.publisher(Channel::Tracks, Delivery::Every)?,
        events: link.publisher(Channel::Events, Delivery::Every)?,
        health: link.publisher(Channel::FusionHealth, Delivery::Every)?,
        gaps: GapCounter::default(),
        rejections: RejectionLog::default(),
        malformed: 0,
        newer: 0,
        foreign: 0,
        mismatched: 0,
        frames: 0,
        now: Timestamp::EPOCH,
    };
    let kinds = ["bearings", "calibration", "health"];
    let subscription = link.subscribe(&kinds.map(|kind| Key::of_all_cameras(link.site(), kind)))?;
    let alive = link.declare_alive(Channel::FusionAlive)?;
    tracing::info!("the fusion centre of `{}` is up", link.site());

    let mut healthy_at = Instant::now();
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL) {
            centre.take(&received)?;
        }
        if healthy_at.elapsed() >= HEALTH_PERIOD {
            healthy_at = Instant::now();
            centre.say_health(subscription.dropped(), false)?;
        }
    }
    // What has arrived is still handled: a stop loses nothing.
    while let Some(received) = subscription.next(POLL) {
        centre.take(&received)?;
    }
    let last = centre.fusion.flush();
    centre.publish(last)?;
    centre.say_health(subscription.dropped(), true)?;
    let frames = centre.frames;
    drop((alive, subscription, centre));
    link.close()?;
    output::line(format!("fusion centre: {frames} track frames published"));
    Ok(())
}

/// A message that names the camera that it is of.
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

/// Why a message is not used.
#[derive(Debug, thiserror::Error)]
enum Unread {
    #[error(transparent)]
    Decode(DecodeError),
    #[error("a message under the key of camera `{key}` says that it is of `{message}`")]
    Mismatched { key: CameraName, message: String },
}

/// Reads a message that came under a camera's key: what a transport lets a camera send is of that
/// camera and of no other.
fn read_of<M: OfCamera>(camera: &CameraName, data: &[u8]) -> Result<M, Unread> {
    let message: M = decode(data).map_err(Unread::Decode)?;
    if message.camera() == camera.as_str() {
        return Ok(message);
    }
    let said = message.camera().chars().take(100).collect();
    Err(Unread::Mismatched { key: camera.clone(), message: said })
}

impl Centre {
    fn take(&mut self, received: &Received) -> anyhow::Result<()> {
        let outputs = match &received.key.channel {
            Channel::Bearings(camera) | Channel::Calibration(camera) | Channel::CameraHealth(camera)
                if !self.cameras.contains(camera) =>
            {
                if self.foreign == 0 {
                    tracing::warn!(
                        "camera `{camera}` is not configured here: not used, and counted from now on"
                    );
                }
                self.foreign += 1;
                return Ok(());
            }
            Channel::Calibration(camera) => {
                if let Some(message) = self.used(read_of::<CameraCalibration>(camera, &received.data))
                    && let Err(error) = self.fusion.calibrate(&message)
                {
                    tracing::warn!("a calibration was not used: {error}");
                }
                return Ok(());
            }
            Channel::Bearings(camera) => {
                let Some(frame) = self.used(read_of::<BearingFrame>(camera, &received.data)) else {
                    return Ok(());
                };
                let missing = self.gaps.see(camera.as_str(), frame.sequence);
                if missing > 0 {
                    tracing::warn!(
                        "{missing} frames of camera `{camera}` are missing before {}",
                        frame.sequence
                    );
                }
                self.fusion.ingest(&frame)
            }
            Channel::CameraHealth(camera) => {
                match self.used(decode::<Health>(&received.data).map_err(Unread::Decode)) {
                    Some(health) if health.ended => self.fusion.camera_ended(camera),
                    _ => return Ok(()),
                }
            }
            _ => return Ok(()),
        };
        self.publish(outputs)
    }

    /// A message that was read, or `None` and why not is counted.
    fn used<M>(&mut self, read: Result<M, Unread>) -> Option<M> {
        let error = match read {
            Ok(message) => return Some(message),
            Err(error) => error,
        };
        let counter = match error {
            Unread::Decode(DecodeError::Malformed { .. }) => &mut self.malformed,
            Unread::Decode(DecodeError::NewerMajor { .. }) => &mut self.newer,
            Unread::Mismatched { .. } => &mut self.mismatched,
        };
        if *counter == 0 {
            tracing::warn!("{error}; not used, and counted from now on");
        }
        *counter += 1;
        None
    }

    fn publish(&mut self, outputs: Vec<Output>) -> anyhow::Result<()> {
        for output in outputs {
            match output {
                Output::Tracks(frame) => {
                    self.now = Timestamp::from_nanos(frame.time_ns);
                    self.frames += 1;
                    self.tracks.put(frame.encode())?;
                }
                Output::Event(event) => {
                    tracing::info!("track {} {}", event.track_id, event.kind().as_str_name());
                    self.events.put(event.encode())?;
                }
                Output::Rejected(rejection) => self.rejections.report(&rejection),
                Output::Camera(camera, standing) => report_camera(&camera, standing),
            }
        }
        Ok(())
    }

    fn say_health(&self, dropped: u64, ended: bool) -> anyhow::Result<()> {
        let own = [
            ("received_dropped", dropped),
            ("received_foreign_camera", self.foreign),
            ("received_malformed", self.malformed),
            ("received_mismatched", self.mismatched),
            ("received_missing", self.gaps.missing()),
            ("received_newer_version", self.newer),
        ];
        let mut counters: Vec<Counter> = own
            .into_iter()
            .chain(self.fusion.counters().iter())
            .map(|(name, value)| Counter { name: name.to_owned(), value })
            .collect();
        counters.sort_by(|a, b| a.name.cmp(&b.name));
        let health = Health {
            component: "fusion".to_owned(),
            time_ns: self.now.nanos(),
            handled: self.frames,
            counters,
            cameras: self.fusion.cameras().map(|report| camera_health(&report)).collect(),
            ended,
            ..Default::default()
        };
        Ok(self.health.put(health.encode())?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_comes_under_one_cameras_key_speaks_for_no_other() {
        let [north, east]: [CameraName; 2] = ["north", "east"].map(|name| name.parse().unwrap());
        let frame = BearingFrame { camera: "north".into(), ..Default::default() }.encode();
        let calibration = CameraCalibration { camera: "north".into(), ..Default::default() }.encode();
        assert!(read_of::<BearingFrame>(&north, &frame).is_ok());
        assert!(read_of::<CameraCalibration>(&north, &calibration).is_ok());
        let refused = [
            read_of::<BearingFrame>(&east, &frame).map(drop),
            read_of::<CameraCalibration>(&east, &calibration).map(drop),
        ];
        for result in refused {
            assert!(matches!(&result, Err(Unread::Mismatched { message, .. }) if message == "north"));
        }
        assert!(matches!(read_of::<BearingFrame>(&north, &[0xff; 40]), Err(Unread::Decode(_))));
    }
}
