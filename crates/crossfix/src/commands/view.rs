use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use crossfix_message::{Key, Timestamp};
use crossfix_recording::RecordingReader;
use crossfix_transport::{Link, Role};
use crossfix_view::{Picture, ViewError};

use crate::config;
use crate::output;
use crate::pace::wall_seconds;
use crate::shutdown::Shutdown;

/// Show a site in Rerun: live, from a recording, or saved to an .rrd file.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  crossfix view recordings/two-uavs.mcap\n  crossfix view recordings/two-uavs.mcap --save two-uavs.rrd\n  crossfix view -c configs/site/network.toml"
)]
pub struct Args {
    /// The recording (MCAP) to show.
    #[arg(required_unless_present = "config", conflicts_with = "config")]
    recording: Option<PathBuf>,
    /// The network's file (TOML): show the site live.
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Write the picture to a file (.rrd) instead of a viewer.
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// A viewer that runs already, e.g. 127.0.0.1:9876; one is started without.
    #[arg(long, value_name = "ADDRESS", conflicts_with = "save")]
    connect: Option<SocketAddr>,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let stream = match (&args.save, args.connect) {
        (Some(path), _) => crossfix_view::save(path)?,
        (None, Some(address)) => crossfix_view::connect(address)?,
        (None, None) => crossfix_view::connect(crossfix_view::spawn_viewer()?)?,
    };
    let picture = Picture::new(stream)?;
    match (&args.recording, &args.config) {
        (Some(recording), _) => draw_recording(picture, recording)?,
        (None, Some(network)) => draw_live(picture, network, args.stop_with_stdin)?,
        (None, None) => bail!("give a recording, or a network file with -c"),
    }
    if let Some(path) = &args.save {
        output::line(format!(
            "picture written to {}; look at it with: rerun {}",
            path.display(),
            path.display()
        ));
    }
    Ok(())
}

/// Draws a recording into an .rrd file.
pub fn save_recording(recording: &Path, rrd: &Path) -> anyhow::Result<()> {
    draw_recording(Picture::new(crossfix_view::save(rrd)?)?, recording)
}

fn draw_recording(mut picture: Picture, recording: &Path) -> anyhow::Result<()> {
    let mut unread = 0_u64;
    let report = RecordingReader::open(recording)?.for_each(|entry| {
        unread += u64::from(picture.show(&entry.key.channel, entry.arrival, &entry.data)?.is_some());
        Ok::<_, ViewError>(())
    })?;
    if let Some(damage) = report.damage {
        tracing::warn!("{} is torn: {damage}; everything before is shown", recording.display());
    }
    if unread > 0 {
        tracing::warn!("{unread} messages could not be read and are not shown");
    }
    picture.finish().context("the picture is not complete")
}

fn draw_live(mut picture: Picture, network: &Path, stop_with_stdin: bool) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_stdin(stop_with_stdin);
    let network = config::load_network(network)?;
    let link = Link::open(&network, &Role::Observer)?;
    let subscription = link.subscribe(&[Key::everything_of(link.site())])?;
    tracing::info!("showing `{}` until Ctrl-C", link.site());
    while !shutdown.requested() {
        let Some(received) = subscription.next(Duration::from_millis(50)) else {
            continue;
        };
        let now = Timestamp::from_seconds(wall_seconds());
        picture.show(&received.key.channel, now, &received.data)?;
    }
    drop(subscription);
    link.close()?;
    picture.finish().context("the picture is not complete")
}
