use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use crossfix_video::{
    Frame, Latency, Live, RtspCamera, RtspOptions, RtspTransport, Sight, StreamAddress, TimedBy,
};
use serde::Serialize;

use crate::commands::numbers;
use crate::config::CameraFile;
use crate::eye::jpeg;
use crate::output::{self, Draft};
use crate::pace::wall_seconds;
use crate::shutdown::Shutdown;

/// How often is looked whether it is to stop.
const POLL: Duration = Duration::from_millis(100);
/// Different troubles that are told: a camera that fails in more ways has failed.
const MOST_TROUBLES: usize = 10;

/// Try a camera: what it sends, how often, and what its clock is worth.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  crossfix sources rtsp://10.0.0.5/stream1\n  crossfix sources -c configs/site/north.toml --picture north.jpg"
)]
pub struct Args {
    /// The stream, rtsp://HOST/PATH. One that wants to know who asks is better tried with -c: a
    /// command line can be read by others.
    #[arg(required_unless_present = "config", conflicts_with = "config")]
    url: Option<String>,
    /// A camera's configuration (TOML) whose stream is tried.
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Ask for datagrams.
    #[arg(long, conflicts_with = "config")]
    udp: bool,
    /// How long it is watched, s: cameras say what their clock shows every few seconds.
    #[arg(long, default_value_t = 8.0, value_name = "SECONDS", value_parser = numbers::positive)]
    seconds: f64,
    /// The file to write its last image to (JPEG).
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What a camera does.
#[derive(Debug, Default, Serialize)]
pub struct Tried {
    pub url: String,
    pub width: usize,
    pub height: usize,
    pub frames: u64,
    /// Frames that could not be decoded.
    pub bad_frames: u64,
    /// Frames that this host was too slow for.
    pub left_out: u64,
    /// Until the first image came, s.
    pub first_image_s: f64,
    /// 1/s.
    pub rate_hz: f64,
    /// The longest time between two images, s.
    pub longest_interval_s: f64,
    /// Until the camera said what its clock shows, s.
    pub first_report_s: Option<f64>,
    /// How long after the time that the camera says an image was here, the median, s: what it takes to
    /// come here and what the two clocks are apart.
    pub arrival_after_capture_s: Option<f64>,
    /// By how much the camera's clock is ahead of this host's, where that is too much to be believed, s.
    pub camera_ahead_s: Option<f64>,
    /// What went wrong.
    pub troubles: Vec<String>,
}

impl Tried {
    /// Takes an image in; returns how long after the time that the camera says it was here, s.
    fn see(&mut self, frame: &Frame, before: Option<&Frame>, begun: Instant) -> Option<f64> {
        (self.width, self.height) = (frame.width, frame.height);
        let arrival = frame.live?;
        let at_s = arrival.at.saturating_duration_since(begun).as_secs_f64();
        if self.frames == 0 {
            self.first_image_s = at_s;
        }
        self.frames += 1;
        if let Some(before) = before.and_then(|frame| frame.live) {
            let interval_s = arrival.at.saturating_duration_since(before.at).as_secs_f64();
            self.longest_interval_s = self.longest_interval_s.max(interval_s);
        }
        match arrival.timed_by {
            TimedBy::Camera => {
                self.first_report_s.get_or_insert(at_s);
                let at = wall_seconds() - arrival.at.elapsed().as_secs_f64();
                Some(at - frame.capture.time.seconds())
            }
            TimedBy::ArrivalAgainstCamera { camera_ahead_s } => {
                self.camera_ahead_s = Some(camera_ahead_s);
                None
            }
            TimedBy::Arrival | TimedBy::Remembered => None,
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let options = options(args)?;
    let url = options.address.to_string();
    let (tried, last) = try_out(options, args.seconds);
    if let (Some(path), Some(frame)) = (&args.picture, &last) {
        write(path, frame)?;
    }
    if args.json {
        output::json(&tried)?;
    } else {
        print(&tried);
    }
    match (last, tried.troubles.first()) {
        (Some(_), _) => Ok(()),
        (None, Some(trouble)) => bail!("no image: {trouble}"),
        (None, None) => bail!("no image came from {url} within {} s", args.seconds),
    }
}

fn options(args: &Args) -> anyhow::Result<RtspOptions> {
    if let Some(path) = &args.config {
        let file = CameraFile::load(path, &[])?;
        let wrong = || format!("the configuration file {} has an error", path.display());
        let stream = file.stream().with_context(wrong)?;
        return stream.with_context(|| format!("{} has no stream as its source", path.display()));
    }
    let (address, login) = StreamAddress::parse(args.url.as_deref().unwrap_or_default())?;
    let transport = if args.udp { RtspTransport::Udp } else { RtspTransport::Tcp };
    Ok(RtspOptions { address, login, transport, heeds_reports: true, latency: Latency::default() })
}

/// Watches a stream for some seconds; returns its last image as well.
pub fn try_out(options: RtspOptions, seconds: f64) -> (Tried, Option<Frame>) {
    let shutdown = Shutdown::listen();
    let mut tried = Tried { url: options.address.to_string(), ..Tried::default() };
    let camera = RtspCamera::new(options);
    let begun = Instant::now();
    let live = Live::start(move |silence| Ok(Box::new(camera.open(silence)?)));
    let mut last: Option<Frame> = None;
    let mut delays_s = Vec::new();
    while begun.elapsed().as_secs_f64() < seconds && !shutdown.requested() {
        match live.next(POLL) {
            Sight::Frame(frame) => {
                delays_s.extend(tried.see(&frame, last.as_ref(), begun));
                last = Some(frame);
            }
            Sight::Trouble(trouble) => {
                tried.bad_frames += u64::from(trouble.is_one_frame());
                let trouble = trouble.to_string();
                if !tried.troubles.contains(&trouble) && tried.troubles.len() < MOST_TROUBLES {
                    tried.troubles.push(trouble);
                }
            }
            Sight::Nothing => {}
        }
    }
    tried.left_out = live.counts().left_out;
    let span_s = begun.elapsed().as_secs_f64() - tried.first_image_s;
    tried.rate_hz = (tried.frames.saturating_sub(1) + tried.left_out) as f64 / span_s;
    delays_s.sort_unstable_by(f64::total_cmp);
    tried.arrival_after_capture_s = delays_s.get(delays_s.len() / 2).copied();
    (tried, last)
}

fn write(path: &Path, frame: &Frame) -> anyhow::Result<()> {
    let brightness: Vec<u8> = frame.brightness().iter().map(|&b| b.round() as u8).collect();
    let picture = jpeg(&brightness, frame.width, frame.height);
    ensure!(picture.is_some(), "an image of {}x{} is no JPEG", frame.width, frame.height);
    let draft = Draft::new(path, &[])?;
    std::fs::write(draft.path(), picture.unwrap_or_default())
        .with_context(|| format!("cannot write {}", path.display()))?;
    draft.keep()
}

fn print(tried: &Tried) {
    output::line(&tried.url);
    for trouble in &tried.troubles {
        output::line(format!("  trouble   {trouble}"));
    }
    if tried.frames == 0 {
        return;
    }
    output::line(format!(
        "  images    {}x{}, {:.2} a second, the first after {:.1} s, never more than {:.0} ms apart",
        tried.width,
        tried.height,
        tried.rate_hz,
        tried.first_image_s,
        tried.longest_interval_s * 1e3
    ));
    output::line(format!(
        "  lost      {} of {} could not be decoded, {} came too fast for this host",
        tried.bad_frames,
        tried.frames + tried.bad_frames + tried.left_out,
        tried.left_out
    ));
    let clock = match (tried.camera_ahead_s, tried.first_report_s, tried.arrival_after_capture_s) {
        (Some(ahead_s), ..) => format!(
            "is {ahead_s:+.1} s from this host's: set the camera, or this host, to a time server; \
             until then images are timed by their arrival"
        ),
        (None, Some(report_s), Some(delay_s)) => format!(
            "told after {report_s:.1} s; images are here {:.0} ms after the time that it says",
            delay_s * 1e3
        ),
        _ => "not told: images are timed by their arrival, to 0.1 s or so".to_owned(),
    };
    output::line(format!("  clock     {clock}"));
}
