mod earth;

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use crossfix_message::{CameraName, Key, Timestamp};
use crossfix_transport::{NetworkConfig, Received, Reception, Role, Subscription};
use crossfix_view::{RecordingStream, SitePicture};

use crate::commands::examples;
use crate::config;
use crate::lookout::Lookout;
use crate::network;
use crate::output::{self, Draft};
use crate::pace::wall_seconds;
use crate::recorded::{self, Lacks};
use crate::repeats::Repeats;
use crate::shutdown::{LEAVE, Shutdown};

pub use earth::EarthArgs;

/// Show a site in Rerun: live, from a recording, or saved to an .rrd file.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix view recordings/two-uavs.mcap",
    "crossfix view recordings/two-uavs.mcap --save two-uavs.rrd",
    "crossfix view -c configs/site/network.toml",
    "crossfix view today.mcap --anchor 48.3538,11.7861,490 --map site.png \\\n\
     --map-edges 48.352,11.783,48.356,11.789",
]))]
pub struct Args {
    /// The recording (MCAP) to show.
    #[arg(required_unless_present = "config", conflicts_with = "config")]
    recording: Option<PathBuf>,
    /// The network's file (TOML): show the site live.
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Write the picture to a file (.rrd) instead of a viewer. An existing file of a live view is
    /// kept, and the new one gets another name.
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// A viewer that is running already, e.g. 127.0.0.1:9876; without it, one is started.
    #[arg(long, value_name = "ADDRESS", conflicts_with = "save")]
    connect: Option<SocketAddr>,
    #[command(flatten)]
    earth: EarthArgs,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    match (&args.recording, &args.config) {
        (Some(recording), _) => match &args.save {
            Some(rrd) => {
                save_recording(recording, rrd, &args.earth)?;
                say_saved(rrd);
                Ok(())
            }
            None => {
                let earth = args.earth.read(None)?;
                draw_recording(earth.picture(viewer(args)?)?, recording)
            }
        },
        (None, Some(network)) => draw_live(args, network),
        (None, None) => bail!("give a recording, or a network file with -c"),
    }
}

fn viewer(args: &Args) -> anyhow::Result<RecordingStream> {
    let address = match args.connect {
        Some(address) => address,
        None => crossfix_view::spawn_viewer()?,
    };
    Ok(crossfix_view::connect(address)?)
}

fn say_saved(rrd: &Path) {
    let rrd = rrd.display();
    output::line(format!(
        "picture written to {rrd}; look at it with: rerun --bind 127.0.0.1 {rrd}"
    ));
}

/// Draws a recording into an .rrd file.
pub fn save_recording(recording: &Path, rrd: &Path, earth: &EarthArgs) -> anyhow::Result<()> {
    let earth = earth.read(None)?;
    let draft = Draft::new(rrd, &[recording])?;
    draw_recording(earth.picture(crossfix_view::save(draft.path())?)?, recording)?;
    draft.keep()
}

fn draw_recording(mut picture: SitePicture, recording: &Path) -> anyhow::Result<()> {
    let mut lacks = Lacks::default();
    let mut shown = 0_u64;
    recorded::for_each(recording, &mut lacks, |lacks, entry| {
        match picture.show(&entry.key.channel, entry.arrival, &entry.data)? {
            None => shown += 1,
            Some(error) => lacks.note(&error),
        }
        Ok(())
    })?;
    lacks.say(recording);
    lacks.ensure_found(shown > 0, "message that can be shown", recording)?;
    picture.finish().context("the picture is not complete")
}

/// How often it is checked which components are present, and whether the viewer still is. With
/// twice as much a viewer that was closed is noticed two seconds later.
const LOOK_PERIOD: Duration = Duration::from_secs(1);
/// A viewer that takes longer than this for one message cannot keep up. With half of it one that
/// pauses for a second, and then catches up, would be warned about.
const STALL: Duration = Duration::from_secs(2);
/// How long a viewer gets to receive what was drawn last. With half of it a slow one may lack the
/// end.
const LAST_LOOK: Duration = Duration::from_secs(1);

fn draw_live(args: &Args, network: &Path) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_stdin(args.stop_with_stdin);
    let network = config::load_network(network)?;
    let earth = args.earth.read(config::anchor_of(&network)?)?;
    let Some(link) = network::open(&network, &Role::Observer, &shutdown)? else {
        return Ok(());
    };
    // A live picture is kept like a live recording: what was drawn stays, whatever happens later.
    let rrd =
        args.save.as_deref().and_then(|asked| output::names(asked).find(|path| !path.exists()));
    let stream = match (&rrd, &args.save) {
        (Some(rrd), Some(asked)) => {
            output::say_other_name(asked, rrd);
            crossfix_view::save_without_end(rrd)?
        }
        _ => viewer(args)?,
    };
    let mut picture = earth.picture(stream)?;
    let cameras: Vec<CameraName> = network.cameras.keys().cloned().collect();
    let mut lookout = Lookout::for_cameras(&link, &network, &cameras)?;
    let subscription = link.subscribe(&[Key::everything_of(link.site())])?;
    tracing::info!("showing `{}` until Ctrl-C", link.site());
    let mut watch =
        ViewerFeed { network, reception: Reception::default(), repeats: Repeats::default() };
    let mut looked_at = Instant::now();
    let mut is_watched = true;
    while is_watched && !shutdown.requested() {
        if let Some(received) = subscription.next(Duration::from_millis(50)) {
            watch.show(&mut picture, &received)?;
        }
        if looked_at.elapsed() >= LOOK_PERIOD {
            looked_at = Instant::now();
            lookout.check(looked_at);
            watch.check(&subscription, looked_at);
            picture.clear_silent(Timestamp::from_seconds(wall_seconds()))?;
            is_watched = !picture.has_lost_its_viewer();
        }
    }
    drop((subscription, lookout));
    link.close(LEAVE)?;
    if !is_watched {
        output::line("the viewer was closed");
        return Ok(());
    }
    picture.finish_within(LAST_LOOK).context("the picture is not complete")?;
    rrd.iter().for_each(|rrd| say_saved(rrd));
    Ok(())
}

/// Selects what the viewer is shown, and counts what it misses.
struct ViewerFeed {
    network: NetworkConfig,
    reception: Reception,
    repeats: Repeats,
}

impl ViewerFeed {
    fn show(&mut self, picture: &mut SitePicture, received: &Received) -> anyhow::Result<()> {
        let Received { key, data, origin, at } = received;
        if !self.network.names(key) {
            self.repeats.warn("foreign", *at, || {
                format!("`{key}` is of nobody in the network's file: not shown")
            });
            return Ok(());
        }
        if let Some(origin) = *origin {
            let missing = self.reception.see(key, origin, *at);
            if missing > 0 {
                self.repeats.warn(&format!("missing {key}"), *at, || {
                    format!("{missing} messages on `{key}` did not arrive and are not shown")
                });
            }
        }
        let begun = Instant::now();
        let now = Timestamp::from_seconds(wall_seconds());
        if let Some(error) = picture.show(&key.channel, now, data)? {
            self.repeats.warn(&format!("unread {key}"), *at, || {
                format!("a message on `{key}` is not shown: {error}")
            });
        }
        if begun.elapsed() > STALL {
            self.repeats.warn("stall", *at, || {
                format!(
                    "the viewer did not take the picture for {:.0} s",
                    begun.elapsed().as_secs_f64()
                )
            });
        }
        Ok(())
    }

    fn check(&mut self, subscription: &Subscription, now: Instant) {
        self.repeats.remind(now);
        let dropped = subscription.refused().dropped;
        if dropped > 0 {
            self.repeats.warn("dropped", now, || {
                format!("{dropped} messages came while the viewer was busy and are not shown")
            });
        }
    }
}
