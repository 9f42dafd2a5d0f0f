//! A site's tracks for other programs, live.

mod carrier;
mod foxglove;
mod tls;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use crossfix_message::{
    CameraCalibration, Channel, Key, SiteName, Timestamp, TrackEvent, TrackFrame, decode,
};
use crossfix_outlet::{
    Asterix, CursorOnTarget, GeoJsonLines, Outlet, Sapient, Situation, Snapshot,
};
use crossfix_transport::{Received, Role};

use self::carrier::{Carrier, Destination};
use self::tls::TlsFiles;
use crate::commands::anchor::AnchorArg;
use crate::commands::examples;
use crate::commands::numbers;
use crate::config;
use crate::network;
use crate::pace::wall_seconds;
use crate::repeats::Repeats;
use crate::shutdown::{LEAVE, Shutdown};

/// How long it waits for a message before it checks whether to stop. With twice as much what is due
/// may go out 40 ms late.
const POLL: Duration = Duration::from_millis(20);
/// Older data are useless to receivers, s: an event of Cursor on Target is valid for this long.
/// With half of it targets would be said to be left out that such receivers still show.
const STALE_S: f64 = 10.0;
/// Most events kept for a receiver that is not there; the oldest are dropped. With half as many one
/// that comes back gets only the last 500.
const MOST_EVENTS: usize = 1000;

/// Send the targets' positions to other programs, live.
///
/// cot: Cursor on Target, for TAK. sapient: BSI Flex 335 v2.0. asterix: category 062. geojson: one
/// collection per line. foxglove: a server that Foxglove connects to. How each states the
/// uncertainty is in docs/outlets.md.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix outlet cot -c my-site/network.toml --to udp://239.2.3.1:6969",
    "crossfix outlet sapient -c my-site/network.toml --to tcp://10.0.0.9:5020",
    "crossfix outlet geojson -c my-site/network.toml",
    "crossfix outlet foxglove -c my-site/network.toml --listen 127.0.0.1:8765",
]))]
pub struct Args {
    /// The format.
    format: Format,
    /// The network's file (TOML). Its `[anchor]` says where the site is, unless --anchor does.
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Where to send: udp://HOST:PORT (multicast too), tcp://HOST:PORT, tls://HOST:PORT, a file, or
    /// - for stdout.
    #[arg(long, value_name = "DESTINATION", default_value = "-")]
    to: Destination,
    /// How often to send, times per second. Default: 1; SAPIENT 2; ASTERIX 0.25.
    #[arg(long, value_name = "HERTZ", value_parser = numbers::outlet_rate)]
    rate_hz: Option<f64>,
    #[command(flatten)]
    origin: AnchorArg,
    #[command(flatten)]
    formats: FormatArgs,
    #[command(flatten)]
    tls: TlsFiles,
    /// Where Foxglove connects to.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8765")]
    listen: SocketAddr,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// What some formats need beside the tracks.
#[derive(Clone, Debug, clap::Args)]
pub struct FormatArgs {
    /// Type of the targets in Cursor on Target: a-u-A is unknown and in the air, a-u-A-M-H-Q is a
    /// rotary drone.
    #[arg(long, value_name = "TYPE", default_value = "a-u-A", value_parser = cursor_on_target)]
    pub cot_type: CursorOnTarget,
    /// The data source in ASTERIX: system area code and system identification code.
    #[arg(long, value_name = "SAC,SIC", default_value = "0,0", value_parser = asterix)]
    pub asterix_source: Asterix,
}

fn cursor_on_target(kind: &str) -> Result<CursorOnTarget, String> {
    CursorOnTarget::of_type(kind)
        .ok_or_else(|| "it is no type of Cursor on Target, e.g. a-u-A".to_owned())
}

fn asterix(codes: &str) -> Result<Asterix, String> {
    let codes = codes.split_once(',').and_then(|(area, identification)| {
        Some((area.trim().parse().ok()?, identification.trim().parse().ok()?))
    });
    let (area, identification) = codes.ok_or("it must be two numbers from 0 to 255, e.g. 25,1")?;
    Ok(Asterix::of_source(area, identification))
}

/// The formats that go out live.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Format {
    Cot,
    Sapient,
    Asterix,
    Geojson,
    Foxglove,
}

impl Format {
    /// Default interval between messages, s.
    fn period_s(self) -> f64 {
        match self {
            Self::Cot | Self::Geojson | Self::Foxglove => 1.0,
            Self::Sapient => 0.5,
            // As radars turn.
            Self::Asterix => 4.0,
        }
    }
}

impl Args {
    /// What writes the format.
    fn outlet(&self, site: &SiteName) -> anyhow::Result<Box<dyn Outlet>> {
        Ok(match self.format {
            Format::Cot => Box::new(self.formats.cot_type.clone()),
            Format::Sapient => Box::new(Sapient::of_site(site.clone())),
            Format::Asterix => Box::new(self.formats.asterix_source.clone()),
            Format::Geojson => Box::new(GeoJsonLines),
            Format::Foxglove => bail!("Foxglove is served"),
        })
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_stdin(args.stop_with_stdin);
    let network = config::load_network(&args.config)?;
    let anchor = args.origin.anchor.or(config::anchor_of(&network)?);
    let site = network.site.clone();
    if args.format == Format::Foxglove {
        return foxglove::serve(&network, anchor, args.listen, &shutdown);
    }
    let anchor = anchor.with_context(|| {
        format!(
            "where on Earth is the site? Give {} a section [anchor] with latitude_deg, \
             longitude_deg and height_m, or --anchor",
            args.config.display()
        )
    })?;
    ensure!(
        args.format != Format::Sapient || args.to.answers(),
        "SAPIENT waits for an answer: --to tcp://HOST:PORT or tls://HOST:PORT"
    );
    let mut outlet = args.outlet(&site)?;
    let tls = matches!(args.to, Destination::Tls(_)).then(|| args.tls.client()).transpose()?;
    let mut carrier = Carrier::new(args.to.clone(), tls);
    let Some(link) = network::open(&network, &Role::Observer, &shutdown)? else {
        return Ok(());
    };
    let channels = ["tracks", "events"].map(|kind| Key::of_all_centres(&site, kind));
    let calibrations = Key::of_all_cameras(&site, "calibration");
    let subscription = link.subscribe(&[channels.as_slice(), &[calibrations]].concat())?;
    tracing::info!("telling {} where the targets of `{site}` are", args.to);

    let mut heard = OutletNews {
        situation: Situation::new(site, anchor),
        tracks_at: Instant::now(),
        events: Vec::new(),
        repeats: Repeats::default(),
    };
    let period = Duration::from_secs_f64(
        args.rate_hz.map_or(args.format.period_s(), |rate_hz| rate_hz.recip()),
    );
    let mut said_at = Instant::now();
    while !shutdown.requested() {
        if let Some(received) = subscription.next(POLL) {
            heard.take(&received);
        }
        carrier.listen(&mut *outlet)?;
        if said_at.elapsed() >= period {
            said_at = Instant::now();
            carrier.say(&mut *outlet, &mut heard)?;
        }
    }
    carrier.finish(&mut *outlet)?;
    heard.repeats.end();
    drop(subscription);
    link.close(LEAVE)?;
    crate::output::line(format!("outlet: {} messages", carrier.messages()));
    Ok(())
}

/// What the site has published since the outlet last sent something.
struct OutletNews {
    situation: Situation,
    /// When the fusion centre last published tracks.
    tracks_at: Instant,
    events: Vec<TrackEvent>,
    repeats: Repeats,
}

impl OutletNews {
    /// Positions of all targets now.
    fn snapshot(&mut self) -> Option<Snapshot> {
        self.situation.snapshot(self.tracks_at.elapsed().as_secs_f64())
    }

    /// Warns if a site's data are of another time, as in a replay: receivers leave such tracks out
    /// without saying so.
    fn check_time(&mut self, frame: &TrackFrame, now: Instant) {
        let off_s = wall_seconds() - Timestamp::from_nanos(frame.time_ns).seconds();
        if off_s.abs() > STALE_S {
            self.repeats.warn("time", now, || {
                let direction = if off_s > 0.0 { "behind" } else { "ahead of" };
                format!(
                    "the site's time is {:.0} s {direction} this host's clock: programs that \
                     compare it with theirs leave its targets out",
                    off_s.abs(),
                )
            });
        }
    }

    /// Takes in a message. Messages of another version are ignored: viewer and recorder report
    /// them.
    fn take(&mut self, received: &Received) {
        match received.key.channel {
            Channel::Tracks => {
                if let Ok(frame) = decode::<TrackFrame>(&received.data) {
                    self.tracks_at = received.at;
                    self.check_time(&frame, received.at);
                    self.situation.add_tracks(received.key.area.as_ref(), &frame);
                }
            }
            Channel::Calibration(_) => {
                if let Ok(calibration) = decode::<CameraCalibration>(&received.data) {
                    self.situation.add_calibration(&calibration);
                }
            }
            Channel::Events => {
                self.events.extend(decode::<TrackEvent>(&received.data).ok());
                let too_many = self.events.len().saturating_sub(MOST_EVENTS);
                if self.events.drain(..too_many).next().is_some() {
                    self.repeats.warn("events", received.at, || {
                        format!("more than {MOST_EVENTS} events wait: the oldest is dropped")
                    });
                }
            }
            _ => {}
        }
    }
}
