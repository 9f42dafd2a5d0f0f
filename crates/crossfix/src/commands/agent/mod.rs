mod live;
mod reload;
mod report;
mod seeking;
#[cfg(feature = "centre")]
mod simulated;
mod start;
mod stream_health;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use crossfix_correlation::Plane;
use crossfix_message::{BearingFrame, Channel, Payload, Timestamp};
use crossfix_transport::{AliveToken, Delivery, Link, LinkPublisher, NetworkConfig, Role};
use crossfix_video::{CaptureTime, Frame, FrameClock, FrameSource};
use crossfix_vision::ImageTracker;

use self::seeking::Seeking;
use self::start::Start;
use self::stream_health::StreamHealth;
use crate::calibrated::Calibrated;
use crate::commands::examples;
use crate::commands::numbers;
use crate::config::{self, CameraFile, ClockConfig, SourceConfig};
use crate::eye::{CameraIdentity, brightness};
use crate::health::{HealthArgs, HealthReporter};
use crate::lookout::Lookout;
use crate::network;
use crate::output;
use crate::pace::wall_seconds;
#[cfg(not(feature = "centre"))]
use crate::parts;
use crate::recorded::{self, Lacks};
use crate::repeats::Repeats;
use crate::service;
use crate::shutdown::{LEAVE, LONG_LEAVE, Shutdown};

pub use self::report::CALIBRATION_PERIOD;
#[cfg(feature = "centre")]
pub use self::simulated::truth_frame;

/// An agent this far behind its source is too slow for it: the fusion centre waits half a second
/// for late frames. With half of it each short stall of the host would be reported; with twice as
/// much frames come too late to be fused and nobody says why.
pub const BEHIND: Duration = Duration::from_millis(500);

/// Run one camera host: find and follow targets, publish their bearings.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix agent -c configs/site/north.toml",
]))]
pub struct Args {
    /// The camera's configuration (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Override a key of the configuration, e.g. preview.rate_hz=0.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Begin without waiting for the fusion centre and the other cameras.
    #[arg(long)]
    no_wait: bool,
    /// Wait for the recorder as well.
    #[arg(long)]
    wait_for_recorder: bool,
    /// When the source begins, seconds since the Unix epoch: the same for all agents of a replay.
    /// Without, agents of files and scenes wait for each other, and one that is late joins those
    /// that play.
    #[arg(long, value_name = "SECONDS", value_parser = numbers::wall_time)]
    start_at: Option<f64>,
    #[command(flatten)]
    health: HealthArgs,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// State of a running agent, with its open connections.
struct Agent {
    /// The camera's file, and the overrides of its keys.
    config: PathBuf,
    sets: Vec<String>,
    identity: CameraIdentity,
    /// Lens, pose and clock from the site's calibration, if there is one.
    calibrated: Option<Calibrated>,
    calibration: Vec<u8>,
    link: Link,
    /// Presence of the fusion centres that listen to this camera.
    lookout: Lookout,
    /// Token of being alive; declared once the agent can receive messages.
    alive: Option<AliveToken>,
    bearings: LinkPublisher,
    calibrations: LinkPublisher,
    health: HealthReporter,
    previews: LinkPublisher,
    calibrated_at: Option<Instant>,
    healthy_at: Option<Instant>,
    frames: u64,
    bad_frames: u64,
    unseen_bearings: u64,
    /// Number of images for which the mount did not report where it pointed.
    without_pointing: u64,
    /// Number of tracks in the newest frame.
    tracks: u32,
    behind: Duration,
    scene_begins: Timestamp,
    now: Timestamp,
    /// State of the stream, if the source is one.
    stream: Option<StreamHealth>,
    /// The search for cued targets, if the camera takes cues.
    seeking: Option<Seeking>,
    repeats: Repeats,
    shutdown: Shutdown,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_reload().with_stdin(args.stop_with_stdin);
    let file = CameraFile::load(&args.config, &args.sets)?;
    let camera = file.camera(&args.config)?;
    let network = config::load_network(&file.network)?;
    let identity =
        CameraIdentity { name: file.name.clone(), camera, clock_source: file.clock_source() };
    let calibrated = file.calibrated()?;
    let begins = source_begins(&file, calibrated.as_ref())?;
    let Some(link) = network::open(&network, &Role::Camera(file.name.clone()), &shutdown)? else {
        return Ok(());
    };
    let mut agent = Agent::new(args, identity, link, &network, file.source.is_unpaced(), shutdown)?;
    agent.calibrated = calibrated;
    service::ready(&format!("camera {}", file.name));
    let Some(start) = agent.begin(args, &file, &network, begins)? else {
        return agent.finish(Ok(()));
    };
    let seen = agent.play(&file, begins, &start);
    agent.finish(seen)
}

/// The time at which a source begins: of a recording the common time of all its cameras, of a video
/// the camera's own time; a scene begins when it is started.
fn source_begins(file: &CameraFile, calibrated: Option<&Calibrated>) -> anyhow::Result<Timestamp> {
    match &file.source {
        SourceConfig::Recording { path, .. } => first_bearing(path, calibrated),
        SourceConfig::Video { start_s, .. } => Ok(Timestamp::from_seconds(*start_s)),
        SourceConfig::Simulation { .. } => Ok(Timestamp::EPOCH),
        SourceConfig::Stream(_)
        | SourceConfig::Usb { .. }
        | SourceConfig::Gige { .. }
        | SourceConfig::Gstreamer(_) => Ok(Timestamp::from_seconds(wall_seconds())),
    }
}

/// The capture time corrected for the known error of the camera's clock, which from the source's
/// start on shows `own = t (1 + drift) + offset`.
fn corrected(own: CaptureTime, start: Timestamp, clock: &ClockConfig) -> CaptureTime {
    let own_s = own.time.seconds_since(start);
    let true_s = (own_s - clock.offset_s) / (1.0 + clock.drift_ppm * 1e-6);
    CaptureTime { time: start.plus_seconds(true_s), ..own }
}

impl Agent {
    fn new(
        args: &Args,
        identity: CameraIdentity,
        link: Link,
        network: &NetworkConfig,
        is_unpaced: bool,
        shutdown: Shutdown,
    ) -> anyhow::Result<Self> {
        // A source played as fast as possible waits for its receivers; a live one cannot.
        let delivery = if is_unpaced { Delivery::Every } else { Delivery::Queued };
        let name = identity.name.clone();
        let lookout = Lookout::for_centres_of(&link, network, &name)?;
        Ok(Self {
            lookout,
            config: args.config.clone(),
            sets: args.sets.clone(),
            bearings: link.publisher(Channel::Bearings(name.clone()), delivery)?,
            calibrations: link.publisher(Channel::Calibration(name.clone()), delivery)?,
            health: HealthReporter::new(
                &args.health,
                &link,
                Channel::CameraHealth(name.clone()),
                delivery,
            )?,
            previews: link.publisher(Channel::Preview(name), Delivery::Picture)?,
            identity,
            calibrated: None,
            calibration: Vec::new(),
            alive: None,
            link,
            calibrated_at: None,
            healthy_at: None,
            frames: 0,
            bad_frames: 0,
            unseen_bearings: 0,
            without_pointing: 0,
            tracks: 0,
            behind: Duration::ZERO,
            scene_begins: Timestamp::EPOCH,
            now: Timestamp::EPOCH,
            stream: None,
            seeking: None,
            repeats: Repeats::default(),
            shutdown,
        })
    }

    /// Waits until it is time to begin; `None` if it was asked to stop before.
    fn begin(
        &mut self,
        args: &Args,
        file: &CameraFile,
        network: &NetworkConfig,
        begins: Timestamp,
    ) -> anyhow::Result<Option<Start>> {
        // A live source cannot wait.
        let is_live = file.source.is_live();
        let start = if args.no_wait || is_live {
            self.appear()?;
            Some(Start::now())
        } else {
            self.wait(args.wait_for_recorder, file, network, begins, args.start_at.is_some())?
        };
        let start = start.map(|start| args.start_at.map_or(start, Start::at_wall_time));
        if let Some(start) = &start {
            let is_scene = matches!(file.source, SourceConfig::Simulation { .. });
            let valid_from = if is_scene {
                Timestamp::from_seconds(start.wall_s)
            } else {
                self.common_begin(file, begins)
            };
            if is_scene {
                self.scene_begins = valid_from;
            }
            let message = match &self.calibrated {
                Some(calibrated) => calibrated.message(valid_from),
                None => file.calibration(&self.identity.camera, valid_from)?,
            };
            let message = file.with_mount(message, self.identity.camera.pose())?;
            self.calibration = message.encode();
            self.now = valid_from;
        }
        Ok(start)
    }

    /// The common time at which a source begins.
    fn common_begin(&self, file: &CameraFile, begins: Timestamp) -> Timestamp {
        let is_common = matches!(file.source, SourceConfig::Recording { .. });
        let calibrated = self.calibrated.as_ref().filter(|_| !is_common);
        calibrated.map_or(begins, |camera| camera.common(begins))
    }

    /// Declares this agent present on the network.
    fn appear(&mut self) -> anyhow::Result<()> {
        self.alive = Some(self.link.declare_alive(Channel::Alive(self.identity.name.clone()))?);
        Ok(())
    }

    /// Follows targets in the source's images until its end.
    fn play(&mut self, file: &CameraFile, begins: Timestamp, start: &Start) -> anyhow::Result<()> {
        match &file.source {
            SourceConfig::Recording { path, speed } => self.replay(path, begins, start, *speed),
            SourceConfig::Video { path, rate_hz, speed, .. } => {
                let clock = FrameClock {
                    start: begins,
                    fallback_rate_hz: *rate_hz,
                    sd_s: file.clock_sd_s(),
                };
                let mut source = crossfix_video::open(path, clock)?;
                self.begin_to_seek(file, None)?;
                self.watch(file, source.as_mut(), begins, start, *speed)
            }
            SourceConfig::Stream(_)
            | SourceConfig::Usb { .. }
            | SourceConfig::Gige { .. }
            | SourceConfig::Gstreamer(_) => {
                self.begin_to_seek(file, seeking::mount_of(file)?)?;
                match file.live(Some(self.identity.camera.model().intrinsics().size))? {
                    Some(camera) => self.watch_live(file, camera, begins),
                    None => Ok(()),
                }
            }
            #[cfg(feature = "centre")]
            SourceConfig::Simulation { scene, publish_truth } => {
                self.play_scene(file, scene, *publish_truth, start)
            }
            #[cfg(not(feature = "centre"))]
            SourceConfig::Simulation { .. } => Err(parts::is_left_out("the simulator", "centre")),
        }
    }

    fn publish(&mut self, mut frame: BearingFrame) -> anyhow::Result<()> {
        if let Some(calibrated) = &self.calibrated {
            self.unseen_bearings += calibrated.apply(&mut frame);
        }
        self.seek(&mut frame);
        self.now = Timestamp::from_nanos(frame.capture_time_ns);
        self.keep_up()?;
        self.frames += 1;
        self.tracks = frame.tracks.len().try_into().unwrap_or(u32::MAX);
        Ok(self.bearings.put(frame.encode())?)
    }

    /// Follows targets in a source's frames until its end.
    fn watch(
        &mut self,
        file: &CameraFile,
        source: &mut dyn FrameSource,
        begins: Timestamp,
        start: &Start,
        speed: f64,
    ) -> anyhow::Result<()> {
        let pace = start.pace(speed);
        let mut tracker = ImageTracker::new(file.tracker.clone())?;
        for place in file.boxes() {
            tracker.take_up(place);
        }
        let mut shown: Option<Timestamp> = None;
        loop {
            let frame = match source.next_frame() {
                Ok(Some(frame)) => frame,
                Ok(None) => return Ok(()),
                Err(error) if error.is_one_frame() => {
                    self.bad_frames += 1;
                    self.repeats.warn("bad frame", Instant::now(), || format!("{error}; going on"));
                    continue;
                }
                // The rest of this video is lost; the other cameras go on.
                Err(error) => {
                    return Err(error)
                        .with_context(|| format!("camera `{}` sees no more", self.identity.name));
                }
            };
            self.check_size(&frame)?;
            let own = CaptureTime { sd_s: file.clock_sd_s(), ..frame.capture };
            let capture = corrected(own, begins, &file.clock);
            let since_s = capture.time.seconds_since(begins);
            if !pace.wait(since_s, &self.shutdown) {
                return Ok(());
            }
            let Some(image) = brightness(&frame) else {
                continue;
            };
            let message = self.see(&mut tracker, &image, frame.index, capture.time, capture);
            if !start.is_caught_up(since_s, pace.behind(since_s)) {
                self.keep_up()?;
                continue;
            }
            self.note_behind(pace.behind(since_s));
            self.publish(message)?;
            self.show(file, &mut shown, &image, capture)?;
        }
    }

    /// Publishes a preview of an image, if enough time has passed since the last one.
    fn show(
        &self,
        file: &CameraFile,
        shown: &mut Option<Timestamp>,
        image: &Plane,
        capture: CaptureTime,
    ) -> anyhow::Result<()> {
        let rate = file.preview.rate_hz;
        // With `abs`, a clock that was set back does not suspend the previews.
        let since = |last: Timestamp| capture.time.seconds_since(last).abs();
        if rate <= 0.0 || shown.is_some_and(|last| since(last) * rate < 1.0) {
            return Ok(());
        }
        *shown = Some(capture.time);
        let preview = self.identity.preview(image, capture, file.preview.divisor as usize);
        if let Some(mut preview) = preview {
            if let Some(calibrated) = &self.calibrated {
                calibrated.apply_to_preview(&mut preview);
            }
            self.previews.put(preview.encode())?;
        }
        Ok(())
    }

    /// Checks that a frame has the intrinsics' size: other pixels would silently give wrong
    /// bearings.
    fn check_size(&self, frame: &Frame) -> anyhow::Result<()> {
        let size = self.identity.camera.model().intrinsics().size;
        let (width, height) = (size.width as usize, size.height as usize);
        ensure!(
            (frame.width, frame.height) == (width, height),
            "frame {} of camera `{}` has {}x{} pixels, its intrinsics are for {width}x{height}: \
             calibrate at the size of the video",
            frame.index,
            self.identity.name,
            frame.width,
            frame.height,
        );
        Ok(())
    }

    /// Publishes the recorded bearings of this camera.
    fn replay(
        &mut self,
        path: &Path,
        begins: Timestamp,
        start: &Start,
        speed: f64,
    ) -> anyhow::Result<()> {
        let pace = start.pace(speed);
        let key = Channel::Bearings(self.identity.name.clone());
        let mut lacks = Lacks::default();
        let shutdown = self.shutdown.clone();
        recorded::for_each_until(path, &mut lacks, &shutdown, |lacks, entry| {
            let own = entry.data_time;
            let time = self.calibrated.as_ref().map_or(own, |camera| camera.common(own));
            let since_s = time.seconds_since(begins);
            if entry.key.channel != key
                || !start.is_caught_up(since_s, pace.behind(since_s))
                || !pace.wait(since_s, &self.shutdown)
            {
                return Ok(());
            }
            self.note_behind(pace.behind(since_s));
            match lacks.read::<BearingFrame>(&entry.data) {
                Some(frame) => self.publish(frame),
                None => {
                    self.bad_frames += 1;
                    Ok(())
                }
            }
        })?;
        lacks.say(path);
        Ok(())
    }

    /// Announces that nothing more will come, and closes. Fails if the source ended with an error,
    /// or if it had more bad frames than good ones.
    fn finish(mut self, seen: anyhow::Result<()>) -> anyhow::Result<()> {
        service::stopping();
        self.say_health(true)?;
        let name = self.identity.name.clone();
        let (frames, bad) = (self.frames, self.bad_frames);
        let leave = if self.shutdown.requested() { LEAVE } else { LONG_LEAVE };
        let Self { alive, bearings, calibrations, health, previews, seeking, link, .. } = self;
        drop((alive, bearings, calibrations, health, previews, seeking));
        link.close(leave)?;
        output::line(format!("camera `{name}`: {frames} frames published, {bad} bad frames"));
        seen?;
        ensure!(
            bad <= frames,
            "camera `{name}`: {bad} of {} frames could not be decoded",
            frames + bad
        );
        Ok(())
    }
}

/// Time of the first bearing of any camera in a recording.
fn first_bearing(path: &Path, calibrated: Option<&Calibrated>) -> anyhow::Result<Timestamp> {
    let mut first: Option<Timestamp> = None;
    recorded::for_each(path, &mut Lacks::default(), |_, entry| {
        if let Channel::Bearings(name) = &entry.key.channel {
            let own = entry.data_time;
            let time = calibrated.map_or(own, |camera| camera.common_of(name, own));
            first = Some(first.map_or(time, |first| first.min(time)));
        }
        Ok(())
    })?;
    first.with_context(|| format!("{} holds no bearings", path.display()))
}
