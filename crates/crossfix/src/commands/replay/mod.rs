mod offline;
mod online;

use std::path::{Path, PathBuf};

use crossfix_message::{Channel, Timestamp};
use crossfix_recording::{Entry, RecordingReader};

/// Play a recording again: onto Zenoh, or with --fuse straight into the fusion.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  crossfix replay recordings/two-uavs.mcap --fuse -o tracks.mcap\n  crossfix replay recordings/two-uavs.mcap --network configs/site/network.toml --speed 2 --from 5 --to 20"
)]
pub struct Args {
    /// The recording (MCAP).
    recording: PathBuf,
    /// Fuse the recorded bearings, as fast as it goes, without a network.
    #[arg(long, requires = "output")]
    fuse: bool,
    /// The fusion's configuration (TOML); its defaults without.
    #[arg(short, long, value_name = "FILE", requires = "fuse")]
    config: Option<PathBuf>,
    /// Override a key of the configuration, e.g. tracking.acceleration_density=2.
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "fuse")]
    sets: Vec<String>,
    /// The recording (MCAP) to write: calibrations, truth and the new tracks.
    #[arg(short, long, value_name = "FILE", requires = "fuse")]
    output: Option<PathBuf>,
    /// Start this long after the first message, seconds of data time.
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS")]
    from: f64,
    /// End this long after the first message, seconds of data time.
    #[arg(long, default_value_t = f64::INFINITY, value_name = "SECONDS", hide_default_value = true)]
    to: f64,
    /// The network's file (TOML) to publish on; the replay stands in for the site's cameras.
    #[arg(long, value_name = "FILE", conflicts_with = "fuse", required_unless_present = "fuse")]
    network: Option<PathBuf>,
    /// How much faster than in life it is played onto the network; 0 is as fast as it goes.
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR", conflicts_with = "fuse")]
    speed: f64,
    /// Begin again at the end, until Ctrl-C; times go on.
    #[arg(long = "loop", conflicts_with = "fuse")]
    again: bool,
    /// Publish the recorded tracks too, and stand in for the fusion centre.
    #[arg(long, conflicts_with = "fuse")]
    tracks: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let range = Range::of(&args.recording, args.from, args.to)?;
    match (&args.output, &args.network) {
        (Some(output), _) => offline::fuse(args, output, range),
        (None, Some(network)) => online::publish(args, network, range),
        (None, None) => anyhow::bail!("give --fuse with an output, or --network"),
    }
}

/// A range of data time.
#[derive(Clone, Copy, Debug)]
struct Range {
    from: Timestamp,
    to: Timestamp,
}

impl Range {
    /// The range between two offsets, in seconds, from the first bearing or track of a recording.
    fn of(recording: &Path, from_s: f64, to_s: f64) -> anyhow::Result<Self> {
        let mut start: Option<Timestamp> = None;
        RecordingReader::open(recording)?.for_each(|entry| {
            if matches!(entry.key.channel, Channel::Bearings(_) | Channel::Tracks) {
                start = Some(start.map_or(entry.data_time, |s| s.min(entry.data_time)));
            }
            Ok::<_, std::convert::Infallible>(())
        })?;
        let start = start.unwrap_or_default();
        Ok(Self { from: start.plus_seconds(from_s), to: start.plus_seconds(to_s) })
    }

    /// Whether an entry is to be played: calibrations always are.
    fn holds(&self, entry: &Entry) -> bool {
        matches!(entry.key.channel, Channel::Calibration(_))
            || (self.from..=self.to).contains(&entry.data_time)
    }
}
