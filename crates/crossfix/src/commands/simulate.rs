mod live;
mod scenario;

use std::io::{BufWriter, Write};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use crossfix_geometry::{Pixel, PixelCovariance};
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, ClockSource, Key, Payload, SiteName, Timestamp,
};
use crossfix_recording::{Entry, RecordingWriter, Source};
use crossfix_simulation::{Scene, SimulatedCamera, World};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::commands::agent::truth_frame;
use crate::commands::examples;
use crate::commands::numbers;
use crate::config;
use crate::import::{imported, labelled};
use crate::output::{self, Draft};
use crate::pace::wall_seconds;
use crate::shutdown::Shutdown;

/// What is said where a scene is not made to its end.
const STOPPED: &str = "asked to stop: what was not complete is removed";

/// Turn a scene into a recording of bearings with truth, into video files or into live streams; or
/// write a scenario.
#[derive(Debug, clap::Args)]
#[command(
    after_help = examples(&[
        "crossfix simulate configs/demo/scene.toml -o recordings/two-uavs.mcap",
        "crossfix simulate configs/demo/scene.toml --video videos",
        "crossfix simulate configs/demo/scene.toml --rtsp 127.0.0.1:8554",
        "crossfix simulate --scenario crowd --targets 50 --cameras 8 --clutter 5",
    ])
)]
pub struct Args {
    /// The scene (TOML).
    #[arg(required_unless_present = "scenario", conflicts_with = "scenario")]
    scene: Option<PathBuf>,
    /// The recording (MCAP) to write: bearings as cameras would measure them, calibrations, truth.
    /// With --rtsp, at the times at which they are played.
    #[arg(
        short,
        long,
        value_name = "FILE",
        required_unless_present_any = ["video", "scenario", "rtsp"]
    )]
    output: Option<PathBuf>,
    /// The folder to write a rendered video (Y4M) of each camera to.
    #[arg(long, value_name = "DIR")]
    video: Option<PathBuf>,
    /// Play the scene's cameras as live streams at this address, rtsp://ADDRESS/CAMERA, until its
    /// end.
    #[arg(long, value_name = "ADDRESS")]
    rtsp: Option<SocketAddr>,
    /// When the streams' scene begins, seconds since the Unix epoch. Default: a second from now.
    #[arg(long, value_name = "SECONDS", value_parser = numbers::wall_time, requires = "rtsp")]
    start_at: Option<f64>,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
    /// Standard deviation of a bearing in the recording, pixels per axis.
    #[arg(long, default_value_t = 0.3, value_name = "PIXELS", value_parser = numbers::noise_pixels)]
    noise_px: f64,
    /// Override a key of the scene, e.g. duration_s=10.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// The folder to write a scenario (passive-bearings/1) to, of a site that the options below
    /// describe: a ring of cameras about 600 m by 600 m.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["output", "video", "sets", "rtsp"])]
    scenario: Option<PathBuf>,
    #[command(flatten)]
    site: scenario::SiteArgs,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen();
    if let Some(folder) = &args.scenario {
        let site =
            args.site.site().build().context("the site that the options describe is impossible")?;
        let exposures = scenario::write(&site, folder, &shutdown)?;
        output::line(format!("{exposures} exposures written to {}", folder.display()));
    }
    args.scene.as_ref().map_or(Ok(()), |scene| simulate(args, scene, shutdown))
}

fn simulate(args: &Args, path: &Path, shutdown: Shutdown) -> anyhow::Result<()> {
    let scene: Scene = config::load(path, &args.sets, config::FileKind::Scene)?;
    let world =
        scene.build().with_context(|| format!("the scene {} has an error", path.display()))?;
    let begins = match (args.rtsp, args.start_at) {
        (Some(_), Some(wall_s)) => Timestamp::from_seconds(wall_s),
        (Some(_), None) => Timestamp::from_seconds(wall_seconds() + live::RUN_UP_S),
        (None, _) => Timestamp::EPOCH,
    };
    if let Some(path) = &args.output {
        let made = SimulatedBearings { world: &world, noise_px: args.noise_px, begins };
        let messages = made.record(path, scene.seed, &shutdown)?;
        output::line(format!("{messages} messages written to {}", path.display()));
    }
    if let Some(folder) = &args.video {
        film(&world, folder, &shutdown)?;
    }
    if let Some(address) = args.rtsp {
        live::play(&world, address, begins, &shutdown.with_stdin(args.stop_with_stdin))?;
    }
    Ok(())
}

/// What cameras with perfect clocks and trackers but noisy pixels would publish of a scene.
struct SimulatedBearings<'a> {
    world: &'a World,
    /// Standard deviation of a pixel.
    noise_px: f64,
    /// When the scene begins.
    begins: Timestamp,
}

impl SimulatedBearings<'_> {
    /// Writes a recording; returns the number of its messages.
    fn record(&self, path: &Path, seed: u64, shutdown: &Shutdown) -> anyhow::Result<u64> {
        let &Self { world, begins, .. } = self;
        let site: SiteName = "simulation".parse()?;
        let mut entries = Vec::new();
        for (index, camera) in world.cameras().iter().enumerate() {
            let calibration = CameraCalibration::new(camera.name(), camera.camera(), begins)
                .with_pose_sd(0.0, 0.0);
            let key = Key::new(site.clone(), Channel::Calibration(camera.name().clone()));
            entries.push(imported(key, begins, calibration.encode()));
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(index as u64);
            for frame in 0..camera.frames() {
                ensure!(!shutdown.requested(), STOPPED);
                entries.push(self.exposure(camera, frame, &site, &mut rng)?);
            }
        }
        for step in 0..(world.duration_s() * 10.0) as u32 {
            let t = f64::from(step) / 10.0;
            let key = Key::new(site.clone(), Channel::Truth);
            entries.push(imported(
                key,
                begins.plus_seconds(t),
                truth_frame(world, t, begins).encode(),
            ));
        }
        entries.sort_by_key(|entry| entry.data_time);
        let draft = Draft::new(path, &[])?;
        let mut writer = RecordingWriter::create(draft.path())?;
        writer.sign(&Source::of("simulate"))?;
        for entry in &entries {
            ensure!(!shutdown.requested(), STOPPED);
            writer.write(entry)?;
        }
        let messages = writer.finish()?;
        draft.keep()?;
        Ok(messages)
    }

    /// One frame of a camera.
    fn exposure(
        &self,
        camera: &SimulatedCamera,
        frame: u64,
        site: &SiteName,
        rng: &mut ChaCha8Rng,
    ) -> anyhow::Result<Entry> {
        let &Self { world, noise_px, begins } = self;
        let t = camera.true_time(frame);
        let mut tracks = Vec::new();
        for target in world.truth(t) {
            let Some(exact) = camera.camera().project(target.position) else { continue };
            if !camera.camera().sees(target.position) {
                continue;
            }
            let mut normal = || -> f64 { StandardNormal.sample(rng) };
            let pixel =
                Pixel::new(exact.x() + noise_px * normal(), exact.y() + noise_px * normal());
            let bearing =
                camera.camera().model().bearing(pixel, PixelCovariance::isotropic(noise_px))?;
            tracks.push(labelled(target.id, &bearing, pixel));
        }
        let time = begins.plus_seconds(t);
        let message = BearingFrame {
            camera: camera.name().to_string(),
            sequence: frame,
            capture_time_ns: time.nanos(),
            clock_source: ClockSource::Simulated.into(),
            exposure_s: camera.description().exposure_s,
            tracks,
            ..Default::default()
        };
        let key = Key::new(site.clone(), Channel::Bearings(camera.name().clone()));
        Ok(imported(key, time, message.encode()))
    }
}

/// Writes a video of each camera to a folder; what is not complete is removed again.
fn film(world: &World, folder: &Path, shutdown: &Shutdown) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    for camera in world.cameras() {
        let path = folder.join(format!("{}.y4m", camera.name()));
        let draft = Draft::new(&path, &[])?;
        let is_whole = film_camera(camera, draft.path(), shutdown)
            .with_context(|| format!("cannot write {}", path.display()))?;
        ensure!(is_whole, STOPPED);
        draft.keep()?;
        output::line(format!("{} frames written to {}", camera.frames(), path.display()));
    }
    Ok(())
}

/// Writes a camera's rendered frames as Y4M, brightness only; returns false if it is asked to stop
/// before the end.
fn film_camera(
    camera: &SimulatedCamera,
    path: &Path,
    shutdown: &Shutdown,
) -> std::io::Result<bool> {
    let mut file = BufWriter::new(std::fs::File::create(path)?);
    let description = camera.description();
    let [width, height] = description.size_px;
    // Y4M writes the rate as a fraction.
    let millihertz = (description.rate_hz * 1000.0).round() as u64;
    writeln!(file, "YUV4MPEG2 W{width} H{height} F{millihertz}:1000 Ip A1:1 Cmono")?;
    for index in 0..camera.frames() {
        if shutdown.requested() {
            return Ok(false);
        }
        writeln!(file, "FRAME")?;
        file.write_all(&camera.frame(index).brightness)?;
    }
    file.flush()?;
    Ok(true)
}
