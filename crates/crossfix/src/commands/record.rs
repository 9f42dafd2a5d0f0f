use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::Context;
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, Health, Key, Preview, Timestamp, TrackEvent, TrackFrame,
    TruthFrame, decode,
};
use crossfix_recording::{Entry, RecordingWriter};
use crossfix_transport::{Link, Received, Role};

use crate::config;
use crate::output;
use crate::pace::wall_seconds;
use crate::shutdown::Shutdown;

/// What was flushed survives a crash of the machine's programs.
const FLUSH_PERIOD: Duration = Duration::from_secs(1);
const POLL: Duration = Duration::from_millis(50);

/// Record everything that a site publishes.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  crossfix record -c configs/site/network.toml -o today.mcap")]
pub struct Args {
    /// The network's file (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// The recording (MCAP) to write; an existing one is replaced.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Stop when stdin ends.
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen().with_stdin(args.stop_with_stdin);
    let network = config::load_network(&args.config)?;
    let mut writer = RecordingWriter::create(&args.output)?;
    let link = Link::open(&network, &Role::Observer)?;
    let subscription = link.subscribe(&[Key::everything_of(link.site())])?;
    let alive = link.declare_alive(Channel::RecorderAlive)?;
    tracing::info!("recording `{}` to {}", link.site(), args.output.display());

    let mut flushed_at = Instant::now();
    let mut unread = 0_u64;
    loop {
        let received = subscription.next(POLL);
        if received.is_none() && shutdown.requested() {
            break;
        }
        if let Some(received) = received {
            match entry(received) {
                Some(entry) => {
                    writer.write(&entry).context("recording has stopped; the rest of the site goes on")?;
                }
                None => unread += 1,
            }
        }
        if flushed_at.elapsed() >= FLUSH_PERIOD {
            flushed_at = Instant::now();
            writer.flush().context("recording has stopped; the rest of the site goes on")?;
        }
    }
    let dropped = subscription.dropped();
    drop((subscription, alive));
    let messages = writer.finish()?;
    link.close()?;
    if unread + dropped > 0 {
        tracing::warn!(
            "{unread} messages could not be read and {dropped} came too fast; they are not recorded"
        );
    }
    output::line(format!("{messages} messages recorded to {}", args.output.display()));
    Ok(())
}

/// A received message with the time that it speaks of; `None` if it cannot be read.
fn entry(received: Received) -> Option<Entry> {
    let Received { key, data } = received;
    let nanos = match &key.channel {
        Channel::Bearings(_) => decode::<BearingFrame>(&data).ok()?.capture_time_ns,
        Channel::Calibration(_) => decode::<CameraCalibration>(&data).ok()?.valid_from_ns,
        Channel::Preview(_) => decode::<Preview>(&data).ok()?.capture_time_ns,
        Channel::CameraHealth(_) | Channel::FusionHealth => decode::<Health>(&data).ok()?.time_ns,
        Channel::Tracks => decode::<TrackFrame>(&data).ok()?.time_ns,
        Channel::Events => decode::<TrackEvent>(&data).ok()?.time_ns,
        Channel::Truth => decode::<TruthFrame>(&data).ok()?.time_ns,
        Channel::Alive(_) | Channel::FusionAlive | Channel::RecorderAlive => return None,
    };
    Some(Entry {
        key,
        data_time: Timestamp::from_nanos(nanos),
        arrival: Timestamp::from_seconds(wall_seconds()),
        data,
    })
}
