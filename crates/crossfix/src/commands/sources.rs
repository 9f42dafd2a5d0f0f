use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail, ensure};
use crossfix_video::{
    Frame, GigeCamera, GigeOptions, Live, LiveCamera, LiveEvent, RtspCamera, RtspOptions,
    RtspTransport, StreamAddress, StreamLatency, TimedBy, UsbCamera, UsbOptions, gige_cameras,
    usb_cameras,
};
use serde::Serialize;

use crate::commands::examples;
use crate::commands::numbers;
use crate::config::{self, CameraFile, SourceConfig};
use crate::eye::jpeg;
#[cfg(feature = "onvif")]
use crate::onvif;
use crate::output::{self, Draft};
use crate::pace::wall_seconds;
#[cfg(not(feature = "onvif"))]
use crate::parts;
use crate::shutdown::Shutdown;

/// How often it is checked whether to stop. With twice as much a watch may last 0.2 s longer than
/// asked.
const POLL: Duration = Duration::from_millis(100);
/// How long cameras on the network may take to answer a broadcast. With half of it cameras would be
/// missed that wait for up to half a second before they answer, as ONVIF's discovery allows.
const ANSWERED_WITHIN: Duration = Duration::from_secs(1);
/// Most different errors that are listed: a camera that fails in more ways is useless anyway. With
/// half as many the same.
const MOST_TROUBLES: usize = 10;

/// Try a camera: what it sends, how often, and what its clock is worth.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix sources rtsp://10.0.0.5/stream1",
    "crossfix sources -c configs/site/north.toml --picture north.jpg",
    "crossfix sources",
    "crossfix sources /dev/video0 --size 1280x720",
    "crossfix sources http://10.0.0.5/onvif/device_service --user eye --password-file password",
]))]
pub struct Args {
    /// The stream, rtsp://HOST/PATH. One that wants to know who asks is better tried with -c: a
    /// command line can be read by others.
    ///
    /// Or a camera of this host, /dev/video0, or an industrial one, gige://10.0.0.7. Of a network
    /// camera's device service (ONVIF), http://HOST/PATH, its streams are listed. Without, those of
    /// this host are.
    #[arg(conflicts_with = "config")]
    url: Option<String>,
    /// A camera's configuration (TOML) whose stream is tried.
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// List industrial cameras (GigE Vision), too, and network cameras (ONVIF) where the build has
    /// them: asks all on this host's networks.
    #[arg(long, conflicts_with_all = ["url", "config"])]
    lan: bool,
    /// Who asks a network camera, if it is not in the address.
    #[arg(long, requires = "password_file", conflicts_with = "config")]
    user: Option<String>,
    /// The file whose first line is the password.
    #[arg(long, value_name = "FILE", requires = "user")]
    password_file: Option<PathBuf>,
    /// Ask for datagrams.
    #[arg(long, conflicts_with = "config")]
    udp: bool,
    /// The size of the images of a camera of this host, as 1280x720; as it is set otherwise.
    #[arg(long, value_name = "SIZE", value_parser = size, conflicts_with = "config")]
    size: Option<[u32; 2]>,
    /// How long it is watched, s: cameras say what their clock shows every few seconds.
    #[arg(
        long,
        default_value_t = 8.0,
        value_name = "SECONDS",
        value_parser = numbers::seconds_of_a_day
    )]
    seconds: f64,
    /// The file to write its last image to (JPEG).
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What was observed of a camera.
#[derive(Debug, Default, Serialize)]
pub struct Tried {
    pub url: String,
    pub width: usize,
    pub height: usize,
    pub frames: u64,
    /// Frames that could not be decoded.
    pub bad_frames: u64,
    /// Frames dropped because this host was too slow.
    pub left_out: u64,
    /// Time until the first image came, s.
    pub first_image_s: f64,
    /// Frames per second.
    pub rate_hz: f64,
    /// The longest time between two images, s.
    pub longest_interval_s: f64,
    /// Time until the camera first reported what its clock shows, s.
    pub first_report_s: Option<f64>,
    /// Median time from the capture time that the camera states to the image's arrival, s: the
    /// delay on the way plus the difference of the two clocks.
    pub arrival_after_capture_s: Option<f64>,
    /// How far the camera's clock is ahead of this host's, s; only given if that is too much to be
    /// plausible.
    pub camera_ahead_s: Option<f64>,
    /// Errors that occurred.
    pub troubles: Vec<String>,
}

impl Tried {
    /// Takes an image in; returns how long after its stated capture time it arrived, s.
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
            TimedBy::Camera | TimedBy::Driver => {
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

fn size(text: &str) -> Result<[u32; 2], String> {
    let sides: Vec<Result<u32, _>> = text.split('x').map(str::parse).collect();
    match sides.as_slice() {
        [Ok(width), Ok(height)] => Ok([*width, *height]),
        _ => Err("columns and rows are wanted, as in 1280x720".to_owned()),
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    if let Some(service) = args.url.as_deref().filter(|url| url.starts_with("http")) {
        return describe(service, args);
    }
    let Some(camera) = camera(args)? else { return list(args) };
    let address = camera.address();
    let (tried, last) = try_out(camera, args.seconds);
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
        (None, None) => bail!("no image came from {address} within {} s", args.seconds),
    }
}

/// The camera to be tried; `None` if none is named.
fn camera(args: &Args) -> anyhow::Result<Option<LiveCamera>> {
    if let Some(path) = &args.config {
        let file = CameraFile::load(path, &[])?;
        let wrong = || format!("the configuration file {} has an error", path.display());
        let size = match &file.source {
            // These cameras are set to the image size of the lens.
            SourceConfig::Usb { .. } | SourceConfig::Gige { .. } => {
                Some(file.described(path)?.model().intrinsics().size)
            }
            _ => None,
        };
        let live = file.live(size).with_context(wrong)?;
        let none = || format!("{} has no live camera as its source", path.display());
        return live.with_context(none).map(Some);
    }
    let Some(address) = args.url.as_deref() else { return Ok(None) };
    if address.starts_with('/') {
        let (device, size) = (address.into(), args.size);
        let options = UsbOptions {
            device,
            size,
            rate_hz: None,
            latency_s: None,
            sd_s: StreamLatency::default().sd_s,
        };
        return Ok(Some(LiveCamera::Usb(UsbCamera::new(options))));
    }
    if let Some(address) = address.strip_prefix("gige://") {
        let address = address.parse().with_context(|| format!("`{address}` is no address"))?;
        let sd_s = StreamLatency::default().sd_s;
        let options = GigeOptions {
            address,
            size: args.size,
            rate_hz: None,
            latency_s: None,
            sd_s,
            heeds_stamps: true,
        };
        return Ok(Some(LiveCamera::Gige(GigeCamera::new(options))));
    }
    let (address, in_address) = StreamAddress::parse(address)?;
    let login = config::login("", args.user.as_deref(), args.password_file.as_deref())?;
    ensure!(
        in_address.is_none() || login.is_none(),
        "the address names a user: leave out --user and --password-file"
    );
    let login = in_address.or(login);
    let transport = if args.udp { RtspTransport::Udp } else { RtspTransport::Tcp };
    let latency = StreamLatency::default();
    let options = RtspOptions { address, login, transport, heeds_reports: true, latency };
    Ok(Some(LiveCamera::Stream(RtspCamera::new(options))))
}

/// Prints a network camera's streams, and whether it has a mount.
#[cfg(feature = "onvif")]
fn describe(service: &str, args: &Args) -> anyhow::Result<()> {
    let service = service.parse().context("this is no address")?;
    let login = config::login("", args.user.as_deref(), args.password_file.as_deref())?;
    let camera = onvif::describe(&service, login.as_ref())?;
    if args.json {
        return output::json(&camera);
    }
    output::line(&camera.name);
    for onvif::OfferedStream { profile, url } in &camera.streams {
        output::line(format!("  stream    {url}  {profile}"));
    }
    if let Some([pan, tilt]) = camera.position {
        output::line(format!("  mount     says pan {pan}, tilt {tilt}, of -1 to 1"));
    }
    Ok(())
}

/// The error of a build without ONVIF.
#[cfg(not(feature = "onvif"))]
fn describe(_: &str, _: &Args) -> anyhow::Result<()> {
    Err(parts::is_left_out("network cameras by ONVIF", "onvif"))
}

/// Lists the cameras attached to this host and, if asked to search, those on its networks.
fn list(args: &Args) -> anyhow::Result<()> {
    let own = usb_cameras().into_iter();
    let mut cameras: Vec<Listed> =
        own.map(|(device, name)| Listed { device: device.display().to_string(), name }).collect();
    if args.lan {
        let found = gige_cameras(ANSWERED_WITHIN)
            .map_err(|what| anyhow!("nobody on the network can be asked: {what}"))?;
        let listed = |(address, name)| Listed { device: format!("gige://{address}"), name };
        cameras.extend(found.into_iter().map(listed));
        #[cfg(feature = "onvif")]
        cameras.extend(
            onvif::cameras(ANSWERED_WITHIN)?
                .into_iter()
                .map(|(device, name)| Listed { device, name }),
        );
    }
    if args.json {
        return output::json(&cameras);
    }
    if cameras.is_empty() {
        output::line(
            "no camera hangs on this host, or this user may not watch it (group video); a network \
             camera is tried by its address, rtsp://HOST/PATH; --lan looks for industrial ones",
        );
    }
    for Listed { device, name } in cameras {
        output::line(format!("{device}  {name}"));
    }
    Ok(())
}

/// A camera of this host, or one on the network that has answered.
#[derive(Debug, Serialize)]
struct Listed {
    device: String,
    name: String,
}

/// Watches a camera for some seconds; returns what was observed, and its last image.
pub fn try_out(camera: LiveCamera, seconds: f64) -> (Tried, Option<Frame>) {
    let shutdown = Shutdown::listen();
    let mut tried = Tried { url: camera.address(), ..Tried::default() };
    let begun = Instant::now();
    let live = Live::start(move |silence| camera.open(silence));
    let mut last: Option<Frame> = None;
    let mut delays_s = Vec::new();
    while begun.elapsed().as_secs_f64() < seconds && !shutdown.requested() {
        match live.next(POLL) {
            LiveEvent::Frame(frame) => {
                delays_s.extend(tried.see(&frame, last.as_ref(), begun));
                last = Some(frame);
            }
            LiveEvent::Trouble(trouble) => {
                tried.bad_frames += u64::from(trouble.is_one_frame());
                let trouble = trouble.to_string();
                if !tried.troubles.contains(&trouble) && tried.troubles.len() < MOST_TROUBLES {
                    tried.troubles.push(trouble);
                }
            }
            LiveEvent::Nothing => {}
        }
    }
    tried.left_out = live.counts().left_out;
    // The first image begins the time, and is itself not counted.
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
        "  images    {}x{}, {:.2} a second, the first after {:.1} s, never more than {:.0} ms \
         apart",
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
