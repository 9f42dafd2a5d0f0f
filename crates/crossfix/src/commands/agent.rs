use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use crossfix_message::{
    BearingFrame, Channel, Counter, Health, Payload, Timestamp, TrueState, TruthFrame, decode,
};
use crossfix_recording::RecordingReader;
use crossfix_simulation::{Scene, SimulatedCamera, World};
use crossfix_transport::{Delivery, Link, LinkPublisher, Role};
use crossfix_video::{CaptureTime, Frame, FrameClock, FrameSource, Pixels, VideoError};
use crossfix_vision::ImageTracker;

use crate::config::{self, CameraFile, ClockConfig, SourceConfig};
use crate::eye::{CameraIdentity, brightness};
use crate::output;
use crate::pace::{Pace, wall_seconds};
use crate::shutdown::Shutdown;

/// How often the calibration is said again, for those who came late.
const CALIBRATION_PERIOD: Duration = Duration::from_secs(2);
/// How often the agent says how it does.
const HEALTH_PERIOD: Duration = Duration::from_secs(1);

/// Run one camera host: find and follow targets, publish their bearings.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  crossfix agent -c configs/site/north.toml")]
pub struct Args {
    /// The camera's configuration (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Override a key of the configuration, e.g. preview.rate_hz=0.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Begin without waiting for the fusion centre.
    #[arg(long)]
    no_wait: bool,
    /// Wait for the recorder as well.
    #[arg(long)]
    wait_for_recorder: bool,
    /// When recorded and simulated sources begin, seconds since the Unix epoch: the same for all
    /// agents of a replay. Now, without.
    #[arg(long, value_name = "SECONDS")]
    start_at: Option<f64>,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// What an agent has open.
struct Agent {
    identity: CameraIdentity,
    calibration: Vec<u8>,
    link: Link,
    bearings: LinkPublisher,
    calibrations: LinkPublisher,
    health: LinkPublisher,
    previews: LinkPublisher,
    calibrated_at: Option<Instant>,
    healthy_at: Option<Instant>,
    frames: u64,
    bad_frames: u64,
    now: Timestamp,
    shutdown: Shutdown,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_stdin(args.stop_with_stdin);
    let file = CameraFile::load(&args.config, &args.sets)?;
    let camera = file.camera(&args.config)?;
    let network = config::load_network(&file.network)?;
    let calibration = file.calibration(&camera)?.encode();
    let identity = CameraIdentity { name: file.name.clone(), camera, clock_source: file.clock.source.into() };

    let link = Link::open(&network, &Role::Camera(file.name.clone()))?;
    let name = file.name.clone();
    let _alive = link.declare_alive(Channel::Alive(name.clone()))?;
    let mut agent = Agent {
        bearings: link.publisher(Channel::Bearings(name.clone()), Delivery::Every)?,
        calibrations: link.publisher(Channel::Calibration(name.clone()), Delivery::Every)?,
        health: link.publisher(Channel::CameraHealth(name.clone()), Delivery::Every)?,
        previews: link.publisher(Channel::Preview(name), Delivery::MayDrop)?,
        identity,
        calibration,
        link,
        calibrated_at: None,
        healthy_at: None,
        frames: 0,
        bad_frames: 0,
        now: Timestamp::EPOCH,
        shutdown,
    };
    if !args.no_wait && !agent.wait(args.wait_for_recorder)? {
        return agent.finish();
    }
    let start = args.start_at.unwrap_or_else(wall_seconds);
    match &file.source {
        SourceConfig::Recording { path, speed } => agent.replay(path, Pace { start, speed: *speed })?,
        SourceConfig::Video { path, start_s, rate_hz, speed } => {
            let clock = FrameClock {
                start: Timestamp::from_seconds(*start_s),
                fallback_rate_hz: *rate_hz,
                sd_s: file.clock.sd_s,
            };
            let mut source = crossfix_video::open(path, clock)?;
            let pace = Pace { start, speed: *speed };
            agent.watch(&file, source.as_mut(), pace, Timestamp::from_seconds(*start_s))?;
        }
        SourceConfig::Simulation { scene, publish_truth } => {
            let mut source = SimulatedSource::open(scene, &file, start)?;
            let truth = if *publish_truth {
                Some(TruthPublisher::new(&agent.link, source.world.clone(), start)?)
            } else {
                None
            };
            let shutdown = agent.shutdown.clone();
            let truth = truth.map(|truth| std::thread::spawn(move || truth.run(&shutdown)));
            // Its frames carry wall times from `start` on.
            agent.watch(&file, &mut source, Pace { start, speed: 1.0 }, Timestamp::from_seconds(start))?;
            if let Some(thread) = truth {
                let _ = thread.join();
            }
        }
    }
    agent.finish()
}

/// The image time corrected by what is known of the camera's clock: `own = t (1 + drift) + offset`
/// from the source's start on.
fn corrected(own: CaptureTime, start: Timestamp, clock: &ClockConfig) -> CaptureTime {
    let own_s = own.time.seconds_since(start);
    let true_s = (own_s - clock.offset_s) / (1.0 + clock.drift_ppm * 1e-6);
    CaptureTime { time: start.plus_seconds(true_s), sd_s: clock.sd_s }
}

impl Agent {
    /// Waits for those who must hear every frame. Says whether to go on.
    fn wait(&self, recorder: bool) -> anyhow::Result<bool> {
        let mut needed = vec![Channel::FusionAlive];
        needed.extend(recorder.then_some(Channel::RecorderAlive));
        tracing::info!("camera `{}` waits for the fusion centre", self.identity.name);
        let shutdown = self.shutdown.clone();
        let forever = Duration::from_secs(365 * 24 * 3600);
        if let Err(error) = self.link.wait_for(&needed, forever, || !shutdown.requested()) {
            if self.shutdown.requested() {
                return Ok(false);
            }
            return Err(error.into());
        }
        // A token comes with its peer's other declarations, but the subscription may come after it.
        while !self.bearings.has_subscribers()? && !self.shutdown.requested() {
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(!self.shutdown.requested())
    }

    /// Says calibration and health again when it is time.
    fn keep_up(&mut self) -> anyhow::Result<()> {
        let due = |at: Option<Instant>, period: Duration| at.is_none_or(|at| at.elapsed() >= period);
        if due(self.calibrated_at, CALIBRATION_PERIOD) {
            self.calibrations.put(self.calibration.clone())?;
            self.calibrated_at = Some(Instant::now());
        }
        if due(self.healthy_at, HEALTH_PERIOD) {
            self.say_health(false)?;
            self.healthy_at = Some(Instant::now());
        }
        Ok(())
    }

    fn say_health(&self, ended: bool) -> anyhow::Result<()> {
        let health = Health {
            component: self.identity.name.to_string(),
            time_ns: self.now.nanos(),
            handled: self.frames,
            counters: vec![Counter { name: "bad_frames".to_owned(), value: self.bad_frames }],
            ended,
            ..Default::default()
        };
        Ok(self.health.put(health.encode())?)
    }

    fn publish(&mut self, frame: &BearingFrame) -> anyhow::Result<()> {
        self.now = Timestamp::from_nanos(frame.capture_time_ns);
        self.keep_up()?;
        self.frames += 1;
        Ok(self.bearings.put(frame.encode())?)
    }

    /// Follows targets in a source's frames until its end.
    fn watch(
        &mut self,
        file: &CameraFile,
        source: &mut dyn FrameSource,
        pace: Pace,
        start: Timestamp,
    ) -> anyhow::Result<()> {
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
                    if self.bad_frames == 0 {
                        tracing::warn!("{error}; going on, and counted from now on");
                    }
                    self.bad_frames += 1;
                    continue;
                }
                Err(error) => {
                    // What is lost is the rest of this video; the others see on.
                    tracing::error!("camera `{}` sees no more: {error}", self.identity.name);
                    self.bad_frames += 1;
                    return Ok(());
                }
            };
            self.check_size(&frame)?;
            let capture = corrected(frame.capture, start, &file.clock);
            if !pace.wait(capture.time.seconds_since(start), &self.shutdown) {
                return Ok(());
            }
            let Some(image) = brightness(&frame) else {
                continue;
            };
            let tracks = tracker.step(&image, capture.time);
            let message = self.identity.bearing_frame(frame.index, capture, tracks);
            self.publish(&message)?;
            let rate = file.preview.rate_hz;
            let due = shown.is_none_or(|last| capture.time.seconds_since(last) * rate >= 1.0);
            if rate > 0.0 && due {
                shown = Some(capture.time);
                let preview = self.identity.preview(&image, capture, file.preview.divisor as usize);
                if let Some(preview) = preview {
                    self.previews.put(preview.encode())?;
                }
            }
        }
    }

    /// Pixels of another size than the intrinsics' would become wrong bearings without a word.
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
    fn replay(&mut self, path: &Path, pace: Pace) -> anyhow::Result<()> {
        let begin = first_bearing(path)?;
        let key = Channel::Bearings(self.identity.name.clone());
        let mut failed = None;
        let report = RecordingReader::open(path)?.for_each(|entry| {
            if entry.key.channel != key || failed.is_some() {
                return Ok(());
            }
            if !pace.wait(entry.data_time.seconds_since(begin), &self.shutdown) {
                return Ok(());
            }
            let frame: BearingFrame = decode(&entry.data)?;
            failed = self.publish(&frame).err();
            Ok::<_, crossfix_message::DecodeError>(())
        })?;
        if let Some(damage) = report.damage {
            tracing::warn!("{} is torn: {damage}; everything before was used", path.display());
        }
        failed.map_or(Ok(()), Err)
    }

    /// Says that nothing more will come, and closes.
    fn finish(self) -> anyhow::Result<()> {
        self.say_health(true)?;
        let name = self.identity.name.clone();
        let (frames, bad) = (self.frames, self.bad_frames);
        let Self { bearings, calibrations, health, previews, link, .. } = self;
        drop((bearings, calibrations, health, previews));
        link.close()?;
        output::line(format!("camera `{name}`: {frames} frames published, {bad} bad frames"));
        Ok(())
    }
}

/// Data time of the first bearing of any camera of a recording.
fn first_bearing(path: &Path) -> anyhow::Result<Timestamp> {
    let mut first: Option<Timestamp> = None;
    RecordingReader::open(path)?.for_each(|entry| {
        if matches!(entry.key.channel, Channel::Bearings(_)) {
            first = Some(first.map_or(entry.data_time, |f| f.min(entry.data_time)));
        }
        Ok::<_, std::convert::Infallible>(())
    })?;
    first.with_context(|| format!("{} holds no bearings", path.display()))
}

/// A simulated camera as a source of frames, with the times that its own clock shows.
struct SimulatedSource {
    world: World,
    camera: SimulatedCamera,
    start: Timestamp,
    next: u64,
}

impl SimulatedSource {
    fn open(path: &Path, file: &CameraFile, start: f64) -> anyhow::Result<Self> {
        let scene: Scene = config::load(path, &[])?;
        let world = scene.build().with_context(|| format!("the scene {} has an error", path.display()))?;
        let camera = world
            .camera(file.name.as_str())
            .with_context(|| format!("the scene {} has no camera `{}`", path.display(), file.name))?
            .clone();
        Ok(Self { world, camera, start: Timestamp::from_seconds(start), next: 0 })
    }
}

impl FrameSource for SimulatedSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        if self.next >= self.camera.frames() {
            return Ok(None);
        }
        let rendered = self.camera.frame(self.next);
        self.next += 1;
        Ok(Some(Frame {
            index: rendered.index,
            capture: CaptureTime { time: self.start.plus_seconds(rendered.own_s), sd_s: 0.0 },
            width: rendered.width,
            height: rendered.height,
            pixels: Pixels::Gray8(rendered.brightness),
        }))
    }
}

/// Publishes where the targets of a scene really are, ten times a second.
struct TruthPublisher {
    publisher: LinkPublisher,
    world: World,
    start: f64,
}

impl TruthPublisher {
    const RATE_HZ: f64 = 10.0;

    fn new(link: &Link, world: World, start: f64) -> anyhow::Result<Self> {
        Ok(Self { publisher: link.publisher(Channel::Truth, Delivery::Every)?, world, start })
    }

    fn run(self, shutdown: &Shutdown) {
        let pace = Pace { start: self.start, speed: 1.0 };
        for step in 0..(self.world.duration_s() * Self::RATE_HZ) as u32 {
            let t = f64::from(step) / Self::RATE_HZ;
            if !pace.wait(t, shutdown) {
                return;
            }
            let frame = truth_frame(&self.world, t, self.start);
            if let Err(error) = self.publisher.put(frame.encode()) {
                tracing::warn!("truth is not published any more: {error}");
                return;
            }
        }
    }
}

/// The truth of a scene at a time from its start, which lies `start` seconds after the Unix epoch.
pub fn truth_frame(world: &World, t: f64, start: f64) -> TruthFrame {
    let targets = world.truth(t).into_iter().map(|state| TrueState {
        id: state.id,
        position: Some(state.position.into()),
        velocity: Some(state.velocity.into()),
    });
    TruthFrame {
        time_ns: Timestamp::from_seconds(start).plus_seconds(t).nanos(),
        targets: targets.collect(),
        ..Default::default()
    }
}
