mod processes;

use std::collections::BTreeMap;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_calibration::intrinsics_to_yaml;
use crossfix_message::{CameraName, Channel, TrackFrame, TrackNumber, TrackState, decode};
use crossfix_simulation::{Scene, SimulatedCamera, World};
use crossfix_transport::{Link, NetworkConfig, Role};
use crossfix_vision::{DetectorConfig, TrackerConfig};
use indicatif::{ProgressBar, ProgressStyle};

use crate::commands::evaluate::{Question, evaluate, render};
use crate::commands::examples;
use crate::commands::numbers;
use crate::commands::view::{EarthArgs, save_recording};
use crate::config::{
    self, CameraFile, ClockConfig, ClockSourceName, FusionFile, MountConfig, PoseConfig,
    SourceConfig, StreamConfig,
};
use crate::output;
use crate::pace::wall_seconds;
use crate::shutdown::{LEAVE, Shutdown};
use processes::{CameraProcesses, CentreProcesses, stop_all};

/// The scene that the demo plays, as in `configs/demo`.
const SCENE: &str = include_str!("../../../../configs/demo/scene.toml");
/// The narrow camera, which is turned towards the targets.
const NARROW: &str = include_str!("../../../../configs/demo/narrow.toml");
/// Pose SDs (rotation, mrad; position, m) of a camera on a mount, at rest, as found by a flight of
/// ten minutes. With the accuracy of a careful survey alone it would be no better than the wide
/// cameras.
const MOUNTED_POSE_SD: (f64, f64) = (0.1, 0.02);
/// How long child processes may take to start, and to stop. With half of it the demo may fail on a
/// slow host.
const PATIENCE: Duration = Duration::from_secs(20);
/// Time from the start of the last component to the first frame, s. With half of it the agents of a
/// slow host would begin behind their scene.
const RUN_UP_S: f64 = 1.0;
/// Time granted for finding the tracks, not counted against them, s after the targets appear. With
/// half of it targets whose tracks are being found would count as missed.
const SETTLING_S: f64 = 1.5;

/// See it work: a simulated site, real processes, Zenoh, fusion, a recording, and the error.
///
/// Renders what three cameras see of two UAVs, runs one agent per camera, the fusion centre and the
/// recorder as processes joined by Zenoh on this machine, and compares the tracks with the truth.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix demo --duration 20 --output demo-output",
    "crossfix demo --live",
    "crossfix demo --hand-off",
]))]
pub struct Args {
    /// Seed of the random sky and noise: the same seed gives the same scene.
    #[arg(long, default_value_t = 1, value_name = "N")]
    seed: u64,
    /// How long the scene lasts, seconds.
    #[arg(
        long,
        default_value_t = 25.0,
        value_name = "SECONDS",
        value_parser = numbers::demo_seconds
    )]
    duration: f64,
    /// The folder to write recording, picture, configurations and logs to.
    #[arg(short, long, default_value = "demo-output", value_name = "DIR")]
    output: PathBuf,
    /// Simulate network cameras: the agents get nothing but their streams (RTSP, H.264), take the
    /// times of the images from them, and find the targets by themselves.
    #[arg(long)]
    live: bool,
    /// Add a fourth camera, with a narrow view, on a mount that the fusion centre turns towards the
    /// targets.
    #[arg(long, conflicts_with = "live")]
    hand_off: bool,
    /// Open the live viewer (Rerun), if it is installed.
    #[arg(long)]
    view: bool,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

/// The demo's files.
struct DemoFiles {
    folder: PathBuf,
    network: PathBuf,
    fusion: PathBuf,
    cameras: BTreeMap<CameraName, PathBuf>,
    recording: PathBuf,
    picture: PathBuf,
    /// The simulated network cameras, if the demo uses them.
    streams: Option<CameraStreams>,
}

/// Simulated network cameras: where their streams are served, and the files for that.
struct CameraStreams {
    address: SocketAddr,
    scene: PathBuf,
    /// The recording of the true positions.
    truth: PathBuf,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let begun = Instant::now();
    let shutdown = Shutdown::listen();
    let mut scene: Scene = config::parse(SCENE, &[])?;
    if args.hand_off {
        scene.cameras.push(config::parse(NARROW, &[])?);
    }
    scene.seed = args.seed;
    scene.duration_s = args.duration;
    let world = scene.build()?;
    let network = free_network(&world)?;
    let streams = args.live.then(|| free_streams(&args.output)).transpose()?;
    let files = write_files(&args.output, &scene, &world, &network, streams)?;
    if play(args, &files, &network, &shutdown)? == Ending::Interrupted {
        let recording = files.recording.display();
        output::line(format!(
            "stopped early; the recording is readable: crossfix view {recording}"
        ));
        return Ok(());
    }
    tracing::info!("drawing the picture");
    save_recording(&files.recording, &files.picture, &EarthArgs::default())?;
    let truth = files.streams.as_ref().map(|streams| streams.truth.clone());
    let question = Question { skip_s: 1.0 + SETTLING_S, truth, ..Question::default() };
    let evaluation = evaluate(&files.recording, &question)?;
    if args.json {
        return output::json(&evaluation);
    }
    output::line(format!("\n{}\n", render(&evaluation)));
    output::line(format!("recording       {}", files.recording.display()));
    if let Some(streams) = &files.streams {
        output::line(format!("truth           {}", streams.truth.display()));
    }
    output::line(format!("picture         {}", files.picture.display()));
    output::line(format!("configurations  {}", files.folder.display()));
    output::line(format!(
        "look at it      rerun --bind 127.0.0.1 {}    (pip install rerun-sdk==0.36.3)",
        files.picture.display()
    ));
    output::line(format!("took            {:.0} s", begun.elapsed().as_secs_f64()));
    Ok(())
}

/// How the play ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    Complete,
    Interrupted,
}

/// Starts all components, follows the run to its end, and stops them.
fn play(
    args: &Args,
    files: &DemoFiles,
    network: &NetworkConfig,
    shutdown: &Shutdown,
) -> anyhow::Result<Ending> {
    let centre = CentreProcesses::start(args, files)?;
    let link = Link::open(network, &Role::Observer)?;
    let subscription = link.subscribe(&[link.key(Channel::Tracks).to_string()])?;
    let go_on = || !shutdown.requested();
    link.wait_for(&[Channel::FusionAlive], PATIENCE, go_on)
        .context("the fusion centre did not come up")?;
    let begins_at = wall_seconds() + RUN_UP_S;
    let mut cameras = CameraProcesses::start(files, begins_at)?;
    let bar = progress_bar(args.duration);
    let mut ending = Ending::Complete;
    let mut tracks = BTreeMap::new();
    loop {
        let goes_on = cameras.go_on(&files.folder)?;
        if shutdown.requested() {
            ending = Ending::Interrupted;
        }
        if !goes_on || ending == Ending::Interrupted {
            break;
        }
        let elapsed = (wall_seconds() - begins_at).clamp(0.0, args.duration);
        bar.set_position((elapsed * 10.0) as u64);
        if let Some(message) = newest(&subscription, &mut tracks) {
            bar.set_message(message);
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    bar.finish_and_clear();
    stop_all(centre, cameras, ending)?;
    drop(subscription);
    link.close(LEAVE)?;
    Ok(ending)
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

fn progress_bar(duration: f64) -> ProgressBar {
    let bar = ProgressBar::new((duration * 10.0) as u64);
    let style = ProgressStyle::with_template("{elapsed:>4} [{bar:30}] {msg}")
        .map(|s| s.progress_chars("=> "));
    if let Ok(style) = style {
        bar.set_style(style);
    }
    bar.set_message("starting the agents, the fusion centre and the recorder");
    bar
}

/// The newest state of every confirmed track as a line of the progress bar. A frame holds only the
/// tracks that it changes, so `tracks` keeps the others.
fn newest(
    subscription: &crossfix_transport::Subscription,
    tracks: &mut BTreeMap<u64, crossfix_message::Track>,
) -> Option<String> {
    let mut heard = false;
    while let Some(received) = subscription.next(Duration::ZERO) {
        let Ok(frame) = decode::<TrackFrame>(&received.data) else {
            continue;
        };
        heard = true;
        for track in frame.tracks {
            if track.state() == TrackState::Lost {
                tracks.remove(&track.id);
            } else {
                tracks.insert(track.id, track);
            }
        }
    }
    let confirmed: Vec<String> = tracks
        .values()
        .filter(|track| track.state() == TrackState::Confirmed)
        .filter_map(|track| {
            let p = track.position?;
            let number = TrackNumber(track.id);
            Some(format!("#{number} ({:.0}, {:.0}, {:.0}) m", p.x, p.y, p.z))
        })
        .collect();
    heard.then(|| format!("{} tracks  {}", confirmed.len(), confirmed.join("  ")))
}

/// A network on ports of this machine that are free at present.
fn free_network(world: &World) -> anyhow::Result<NetworkConfig> {
    // All ports are kept open until all are known, so that none is assigned twice.
    let mut listeners = Vec::new();
    let fusion = free_endpoint(&mut listeners)?;
    let mut cameras = BTreeMap::new();
    for camera in world.cameras() {
        cameras.insert(camera.name().clone(), free_endpoint(&mut listeners)?);
    }
    Ok(NetworkConfig {
        site: "demo".parse()?,
        mode: Default::default(),
        routers: Vec::new(),
        unsecured: false,
        security: None,
        anchor: None,
        fusion: Some(fusion),
        areas: BTreeMap::new(),
        cameras,
    })
}

/// An endpoint on a free port, which is kept open by a listener that is added.
fn free_endpoint(listeners: &mut Vec<TcpListener>) -> anyhow::Result<String> {
    let listener = open_free_port()?;
    let port = listener.local_addr()?.port();
    listeners.push(listener);
    Ok(format!("tcp/127.0.0.1:{port}"))
}

fn open_free_port() -> anyhow::Result<TcpListener> {
    TcpListener::bind("127.0.0.1:0").context("no free port on 127.0.0.1")
}

/// Network cameras on a port of this machine that is free at present.
fn free_streams(folder: &Path) -> anyhow::Result<CameraStreams> {
    let listener = open_free_port()?;
    Ok(CameraStreams {
        address: listener.local_addr()?,
        scene: folder.join("scene.toml"),
        truth: folder.join("truth.mcap"),
    })
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// The pose of a camera of the scene, as a person would write it in its file.
fn pose_of(camera: &SimulatedCamera) -> PoseConfig {
    let pose = PoseConfig::of(camera.camera().pose());
    if camera.pan_tilt().is_none() {
        return pose;
    }
    let (rotation_sd_mrad, position_sd_m) = MOUNTED_POSE_SD;
    PoseConfig {
        rotation_sd_mrad: Some(rotation_sd_mrad),
        position_sd_m: Some(position_sd_m),
        ..pose
    }
}

/// Writes the site's files, as a person would.
fn write_files(
    folder: &Path,
    scene: &Scene,
    world: &World,
    network: &NetworkConfig,
    streams: Option<CameraStreams>,
) -> anyhow::Result<DemoFiles> {
    std::fs::create_dir_all(folder.join("logs"))
        .with_context(|| format!("cannot make {}", folder.display()))?;
    let mut files = DemoFiles {
        folder: folder.to_owned(),
        network: folder.join("network.toml"),
        fusion: folder.join("fusion.toml"),
        cameras: BTreeMap::new(),
        recording: folder.join("demo.mcap"),
        picture: folder.join("demo.rrd"),
        streams,
    };
    write(&folder.join("scene.toml"), &toml::to_string(scene)?)?;
    write(&files.network, &toml::to_string(network)?)?;
    let fusion = FusionFile { network: Some("network.toml".into()), ..FusionFile::default() };
    write(&files.fusion, &toml::to_string(&fusion)?)?;
    for (index, camera) in world.cameras().iter().enumerate() {
        let name = camera.name().clone();
        let lens = camera.camera().model().intrinsics();
        write(&folder.join(format!("{name}.yaml")), &intrinsics_to_yaml(name.as_str(), lens))?;
        let source = match &files.streams {
            Some(CameraStreams { address, .. }) => {
                SourceConfig::Stream(StreamConfig::open_to_all(format!("rtsp://{address}/{name}")))
            }
            None => {
                SourceConfig::Simulation { scene: "scene.toml".into(), publish_truth: index == 0 }
            }
        };
        let path = folder.join(format!("{name}.toml"));
        write(&path, &toml::to_string(&camera_file(camera, source))?)?;
        files.cameras.insert(name, path);
    }
    Ok(files)
}

fn camera_file(camera: &SimulatedCamera, source: SourceConfig) -> CameraFile {
    let name = camera.name().clone();
    let clock = &camera.description().clock;
    // For a network camera nobody knows its reporting delay that well, so the defaults apply.
    let is_simulated = matches!(source, SourceConfig::Simulation { .. });
    CameraFile {
        network: "network.toml".into(),
        calibration: None,
        intrinsics: Some(format!("{name}.yaml").into()),
        pose: Some(pose_of(camera)),
        source,
        clock: ClockConfig {
            source: is_simulated.then_some(ClockSourceName::Simulated),
            offset_s: clock.offset_s,
            drift_ppm: clock.drift_ppm,
            sd_s: is_simulated.then_some(1e-4),
        },
        preview: Default::default(),
        mount: camera.description().mount.as_ref().map(MountConfig::of),
        takes_cues: false,
        boxes: Vec::new(),
        tracker: TrackerConfig {
            detector: Some(DetectorConfig::default()),
            ..TrackerConfig::default()
        },
        name,
    }
}
