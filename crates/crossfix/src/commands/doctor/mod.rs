//! Finds what will keep a part of a site from working, before it is needed.

mod clock;
mod security;

use std::fmt;
use std::net::TcpListener;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use crossfix_geometry::Camera;
use crossfix_message::CameraName;
use crossfix_transport::{Identity, Mode, NetworkConfig, address};
use crossfix_video::decoding_time;
use serde::Serialize;

use super::sources::{Tried, try_out};
use crate::commands::examples;
use crate::config::{self, CameraFile, FileKind, OnvifConfig, load_network};
#[cfg(feature = "onvif")]
use crate::onvif;
use crate::output;
use crate::parts;

/// How long a camera is watched, s: long enough for its first clock report. With half of it one
/// that reports every five seconds might seem to report nothing.
const WATCHED_S: f64 = 8.0;
/// Share of the image interval that decoding may take: the rest is for detecting and tracking. With
/// twice as much only half of the interval would be left for that.
const DECODING_SHARE: f64 = 0.25;
/// Images more than this many intervals apart have been delayed on the way. With half of it a
/// single lost image would count as a delay.
const HELD_UP: f64 = 4.0;
/// Share of images whose loss is acceptable. With half of it the same: of 240 images in eight
/// seconds one is four times as much.
const BEARABLE_LOSS: f64 = 0.001;
/// An image that arrives later than this after its stated capture time has a wrong capture time, s.
/// With half of it a camera that takes 0.3 s for an image would be suspected.
const LATEST_S: f64 = 0.5;

/// Find out what keeps a camera host or a site from working, and how to fix it.
///
/// Of a camera's file: the camera and what it sends, its clock and this host's, the decoder, the
/// port. Of the network's or the fusion centre's: who can be reached.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix doctor -c configs/site/north.toml",
    "crossfix doctor -c configs/site/network.toml",
]))]
pub struct Args {
    /// A file of the site (TOML): a camera's, the fusion centre's, the network's.
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Verdict on one finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum CheckResult {
    Pass,
    Warn,
    Fail,
}

impl fmt::Display for CheckResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Pass => "pass",
            Self::Warn => "WARN",
            Self::Fail => "FAIL",
        })
    }
}

/// The result of one check.
#[derive(Clone, Debug, Serialize)]
struct Finding {
    what: String,
    verdict: CheckResult,
    found: String,
    /// What to do about it; nothing for what passes.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[serde(rename = "mend")]
    remedy: Option<String>,
}

impl Finding {
    fn new(what: impl Into<String>, verdict: CheckResult, found: impl Into<String>) -> Self {
        Self { what: what.into(), verdict, found: found.into(), remedy: None }
    }

    fn remedy(self, how: impl Into<String>) -> Self {
        let remedy = (self.verdict != CheckResult::Pass).then(|| how.into());
        Self { remedy, ..self }
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let keys: toml::Table = config::load(&args.config, &[], FileKind::Camera)?;
    let findings = match FileKind::of(&keys) {
        Some(FileKind::Camera) => of_camera(&args.config)?,
        Some(FileKind::Network) => of_network(&load_network(&args.config)?, &Identity::Viewer),
        Some(FileKind::Fusion) => {
            let network = keys.get("network").and_then(toml::Value::as_str);
            let network = network
                .with_context(|| format!("{}: key `network` is missing", args.config.display()))?;
            let folder = args.config.parent().unwrap_or(Path::new("."));
            let area = keys.get("area").and_then(toml::Value::as_str);
            let area = area.map(str::parse).transpose().context("key `area`")?;
            of_network(&load_network(&folder.join(network))?, &Identity::Fusion(area))
        }
        _ => anyhow::bail!(
            "{} is no file of a camera, a fusion centre or a network",
            args.config.display()
        ),
    };
    if args.json {
        output::json(&findings)?;
    } else {
        findings.iter().for_each(print);
    }
    let failed: Vec<&str> = findings
        .iter()
        .filter(|finding| finding.verdict == CheckResult::Fail)
        .map(|finding| finding.what.as_str())
        .collect();
    ensure!(failed.is_empty(), "not ready: {}", failed.join(", "));
    Ok(())
}

fn print(finding: &Finding) {
    let Finding { what, verdict, found, remedy } = finding;
    output::line(format!("{verdict:4}  {what:14} {found}"));
    if let Some(remedy) = remedy {
        output::line(format!("      {:14} -> {remedy}", ""));
    }
}

fn of_camera(path: &Path) -> anyhow::Result<Vec<Finding>> {
    let file = CameraFile::load(path, &[])?;
    let camera = file.camera(path)?;
    let mut findings = vec![Finding::new("files", CheckResult::Pass, path.display().to_string())];
    match file.live(Some(camera.model().intrinsics().size))? {
        Some(live) => {
            let (tried, _) = try_out(live, WATCHED_S);
            findings.extend(of_stream(&tried, &camera, file.clock.offset_s));
        }
        None => findings.push(match file.check_pictures(&camera) {
            Ok(()) => Finding::new("pictures", CheckResult::Pass, "can be read"),
            Err(error) => Finding::new("pictures", CheckResult::Fail, format!("{error:#}")),
        }),
    }
    if let Some(onvif) = file.mount.as_ref().and_then(|mount| mount.onvif.as_ref()) {
        findings.push(of_mount(onvif));
    }
    findings.push(clock::host_clock());
    let network = load_network(&file.network)?;
    findings.push(match network.cameras.get(&file.name) {
        Some(_) if network.mode == Mode::Client => {
            Finding::new("endpoint", CheckResult::Pass, "none: it connects to a router")
        }
        Some(endpoint) => of_own_endpoint(endpoint),
        None => {
            let found = format!("camera `{}` has no endpoint in the network's file", file.name);
            Finding::new("endpoint", CheckResult::Fail, found).remedy("give it a line in [cameras]")
        }
    });
    let identity = Identity::Camera(file.name);
    findings.extend(security::of_own(&network, &identity));
    let others = security::OtherComponents::seen_by(&network, &identity);
    findings.extend(routers(&network, &others));
    Ok(findings)
}

/// Whether the camera's mount reports where it points.
#[cfg(feature = "onvif")]
fn of_mount(mount: &OnvifConfig) -> Finding {
    let asked = mount.login().and_then(|login| onvif::describe(&mount.url, login.as_ref()));
    match asked {
        Ok(onvif::Described { name, position: Some([pan, tilt]), .. }) => {
            let found = format!("{name} says pan {pan}, tilt {tilt}");
            Finding::new("mount", CheckResult::Pass, found)
        }
        Ok(_) => Finding::new("mount", CheckResult::Fail, "it does not say where it points")
            .remedy("bearings need its angles: another mount, or none"),
        Err(error) => Finding::new("mount", CheckResult::Fail, format!("{error:#}"))
            .remedy(format!("try it by `crossfix sources {}`", mount.url)),
    }
}

/// The finding of a build without ONVIF, which cannot ask the mount.
#[cfg(not(feature = "onvif"))]
fn of_mount(_: &OnvifConfig) -> Finding {
    Finding::new("mount", CheckResult::Fail, "this build leaves out mounts by ONVIF")
        .remedy("build it with `--features onvif`")
}

/// Findings on a watched stream; the camera's clock is declared to be `ahead_s` ahead.
fn of_stream(tried: &Tried, camera: &Camera, ahead_s: f64) -> Vec<Finding> {
    if tried.frames == 0 {
        let found = tried.troubles.first().cloned().unwrap_or_else(|| "sends nothing".to_owned());
        let remedy = "try it by `crossfix sources`, or any player: ffplay, vlc";
        return vec![Finding::new("camera", CheckResult::Fail, found).remedy(remedy)];
    }
    let sends = format!("{}x{}, {:.2} a second", tried.width, tried.height, tried.rate_hz);
    let size = camera.model().intrinsics().size;
    let fits = (tried.width, tried.height) == (size.width as usize, size.height as usize);
    let lens = Finding::new(
        "lens",
        if fits { CheckResult::Pass } else { CheckResult::Fail },
        format!("the intrinsics are for {}x{}", size.width, size.height),
    );
    vec![
        Finding::new("camera", CheckResult::Pass, sends),
        lens.remedy(
            "calibrate at the size of the video, or set the camera to that of the intrinsics",
        ),
        of_way(tried),
        of_camera_clock(tried, ahead_s),
        of_decoder(tried),
    ]
}

/// Whether images are lost or delayed on the way.
fn of_way(tried: &Tried) -> Finding {
    let lost = tried.bad_frames + tried.left_out;
    let share = lost as f64 / (tried.frames + lost) as f64;
    let held_up = tried.longest_interval_s * tried.rate_hz > HELD_UP;
    let is_good = share <= BEARABLE_LOSS && !held_up && tried.troubles.is_empty();
    let verdict = if is_good { CheckResult::Pass } else { CheckResult::Warn };
    let trouble = tried.troubles.first().map(|trouble| format!("{trouble}; "));
    let found = trouble.unwrap_or_default()
        + &format!(
            "{} could not be decoded, {} came too fast, never more than {:.0} ms apart",
            tried.bad_frames,
            tried.left_out,
            tried.longest_interval_s * 1e3
        );
    Finding::new("way", verdict, found)
        .remedy("a cable in the place of radio; fewer bits a second; transport = \"tcp\"")
}

fn of_camera_clock(tried: &Tried, declared_s: f64) -> Finding {
    let server = "set the camera to a time server, the same for all";
    match (tried.camera_ahead_s, tried.arrival_after_capture_s) {
        (Some(ahead_s), _) => {
            let found = format!("{ahead_s:+.1} s from this host's: it is not believed");
            Finding::new("camera clock", CheckResult::Warn, found).remedy(server)
        }
        (None, Some(delay_s)) => {
            let delay_s = delay_s + declared_s;
            let mut found =
                format!("images are here {:.0} ms after the time it says", delay_s * 1e3);
            if declared_s != 0.0 {
                found += ", clock.offset_s taken off";
            }
            let is_possible = (0.0..LATEST_S).contains(&delay_s);
            let verdict = if is_possible { CheckResult::Pass } else { CheckResult::Warn };
            Finding::new("camera clock", verdict, found)
                .remedy(format!("{server}; or declare what it is ahead: clock.offset_s"))
        }
        (None, None) => Finding::new(
            "camera clock",
            CheckResult::Warn,
            "the camera does not say what it shows: images are timed by their arrival",
        )
        .remedy(format!("{server}, and have it send RTCP sender reports")),
    }
}

fn of_decoder(tried: &Tried) -> Finding {
    let (width, height) = (tried.width & !1, tried.height & !1);
    let time_s = match decoding_time(width, height) {
        Ok(time) => time.as_secs_f64(),
        Err(what) => return Finding::new("decoder", CheckResult::Warn, what),
    };
    let share = time_s * tried.rate_hz;
    let verdict = if share < DECODING_SHARE {
        CheckResult::Pass
    } else if share < 1.0 {
        CheckResult::Warn
    } else {
        CheckResult::Fail
    };
    let found = format!(
        "{:.1} ms an image of {width}x{height}, {:.0} % of a core",
        time_s * 1e3,
        share * 100.0
    );
    Finding::new("decoder", verdict, found).remedy(parts::WITH_NASM)
}

/// Whether this host can listen at its own endpoint.
fn of_own_endpoint(endpoint: &str) -> Finding {
    match TcpListener::bind(address(endpoint)) {
        Ok(_) => Finding::new("endpoint", CheckResult::Pass, format!("{endpoint} is free")),
        Err(error) if error.kind() == std::io::ErrorKind::AddrInUse => {
            let found = format!("{endpoint} is in use: the agent runs already, or another program");
            Finding::new("endpoint", CheckResult::Warn, found)
                .remedy("stop it, or give another port")
        }
        Err(error) => Finding::new("endpoint", CheckResult::Fail, format!("{endpoint}: {error}"))
            .remedy("it must be an address of this host, with a port above 1023"),
    }
}

/// Which components of the network can be reached by one of them.
fn of_network(network: &NetworkConfig, identity: &Identity) -> Vec<Finding> {
    let mut findings = security::of_own(network, identity);
    let others = security::OtherComponents::seen_by(network, identity);
    // In a network with a router only the router listens.
    if network.mode == Mode::Peer {
        // An area's fusion centre connects only to its own cameras.
        let own_cameras = match identity {
            Identity::Fusion(area) => network.cameras_of(area.as_ref()).ok(),
            _ => None,
        };
        let concerns =
            |name: &CameraName| own_cameras.as_ref().is_none_or(|own| own.contains(name));
        let cameras = network.cameras.iter().filter(|(name, _)| concerns(name));
        findings.extend(cameras.map(|(name, endpoint)| {
            others.of(name.as_str(), endpoint, &Identity::Camera(name.clone()))
        }));
        findings.extend(network.centres().map(|(area, endpoint)| {
            let who = area.as_ref().map_or("fusion centre".to_owned(), |a| format!("fusion {a}"));
            others.of(&who, endpoint, &Identity::Fusion(area))
        }));
    }
    findings.extend(routers(network, &others));
    findings.push(clock::host_clock());
    findings
}

/// Which of the network's routers can be reached.
fn routers(network: &NetworkConfig, others: &security::OtherComponents<'_>) -> Vec<Finding> {
    let routers = network.routers.iter();
    routers.map(|router| others.of("router", router, &Identity::Router)).collect()
}
