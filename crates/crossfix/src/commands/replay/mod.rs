mod offline;
mod online;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::ensure;
use crossfix_message::{CameraName, Channel, Key, Timestamp, glance};
use crossfix_recording::{Entry, RecordingReader};

use crate::commands::examples;
use crate::commands::numbers;
use crate::output::Misuse;
use crate::recalibration::Recalibration;
use crate::recorded::{self, Lacks};

/// Play a recording again: onto the network, or with --fuse straight into the fusion.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix replay recordings/two-uavs.mcap --fuse -o tracks.mcap",
    "crossfix replay recordings/two-uavs.mcap --network configs/site/network.toml \\\n\
     --speed 2 --from 5 --to 20",
]))]
pub struct Args {
    /// The recording (MCAP).
    recording: PathBuf,
    /// Fuse the recorded bearings, as fast as possible, without a network.
    #[arg(long, requires = "output")]
    fuse: bool,
    /// The fusion's configuration (TOML); without it, the defaults.
    #[arg(short, long, value_name = "FILE", requires = "fuse")]
    config: Option<PathBuf>,
    /// Use this calibration of the site (TOML, by crossfix calibrate) instead of the recorded one:
    /// bearings are computed again from the recorded pixels, and times are corrected.
    #[arg(long, value_name = "FILE", requires = "fuse")]
    calibration: Option<PathBuf>,
    /// Override a key of the configuration, e.g. event_time.lateness_s=1.
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "fuse")]
    sets: Vec<String>,
    /// Write smoothed tracks: each state waits this long for later bearings and uses them, seconds.
    /// Velocities become about twice as good.
    #[arg(long, value_name = "SECONDS", requires = "fuse", value_parser = numbers::lag)]
    smooth: Option<f64>,
    /// The recording (MCAP) to write: everything that was recorded, with the new tracks instead of
    /// the old ones.
    #[arg(short, long, value_name = "FILE", requires = "fuse")]
    output: Option<PathBuf>,
    /// Start this long after the first bearing, seconds of data time.
    #[arg(long, default_value_t = 0.0, value_name = "SECONDS", value_parser = numbers::seconds)]
    from: f64,
    /// End this long after the first bearing, seconds of data time.
    #[arg(long, value_name = "SECONDS", value_parser = numbers::seconds)]
    to: Option<f64>,
    /// The file (TOML) of the network to publish on; the replay stands in for the site's cameras.
    #[arg(long, value_name = "FILE", conflicts_with = "fuse", required_unless_present = "fuse")]
    network: Option<PathBuf>,
    /// Playing speed on the network: 1 is real time, 2 twice as fast, 0 as fast as possible.
    #[arg(
        long,
        default_value_t = 1.0,
        value_name = "FACTOR",
        conflicts_with = "fuse",
        value_parser = numbers::speed
    )]
    speed: f64,
    /// Start again at the end, until Ctrl-C; times continue from pass to pass.
    #[arg(long = "loop", conflicts_with = "fuse")]
    again: bool,
    /// Publish the recorded tracks too, and stand in for the fusion centre.
    #[arg(long, conflicts_with = "fuse")]
    tracks: bool,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let recalibration = args.calibration.as_deref().map(Recalibration::load).transpose()?;
    let (range, contents) = TimeRange::of(args, recalibration.as_ref())?;
    match (&args.output, &args.network) {
        (Some(output), _) => offline::fuse(args, output, range, recalibration),
        (None, Some(network)) => online::publish(args, network, range, &contents),
        (None, None) => anyhow::bail!("give --fuse with an output, or --network"),
    }
}

/// What a recording holds that is to be published.
#[derive(Debug, Default)]
struct Contents {
    /// The cameras that it has bearings of.
    cameras: BTreeSet<CameraName>,
    messages: u64,
    /// Messages of a newer major version.
    newer: u64,
}

impl Contents {
    fn note(&mut self, entry: &Entry) {
        if let Channel::Bearings(camera) = &entry.key.channel
            && !self.cameras.contains(camera)
        {
            self.cameras.insert(camera.clone());
        }
        let seen = glance(&entry.key.channel, &entry.data).ok().flatten();
        self.messages += 1;
        self.newer += u64::from(seen.is_some_and(|seen| !seen.is_readable));
    }
}

/// A range of data time.
#[derive(Clone, Copy, Debug)]
struct TimeRange {
    from: Timestamp,
    to: Timestamp,
    /// Whether it is the whole recording.
    is_whole: bool,
}

impl TimeRange {
    /// The range that was asked for, counted from the recording's first bearing or track, and what
    /// the recording holds; that is not looked at where all of it is fused.
    fn of(args: &Args, recalibration: Option<&Recalibration>) -> anyhow::Result<(Self, Contents)> {
        let mut contents = Contents::default();
        let to_s = args.to.unwrap_or(f64::INFINITY);
        ensure!(
            args.from < to_s,
            Misuse(format!("--from {} is not before --to {to_s}", args.from))
        );
        let is_whole = args.from == 0.0 && args.to.is_none();
        if is_whole && args.fuse {
            // When all of it is fused, beginning and end do not matter.
            let range = Self { from: Timestamp::EPOCH, to: Timestamp::EPOCH, is_whole };
            return Ok((range, contents));
        }
        let mut first: Option<Timestamp> = None;
        let mut last: Option<Timestamp> = None;
        recorded::for_each(&args.recording, &mut Lacks::default(), |_, entry| {
            let entry = match recalibration {
                Some(recalibration) => recalibration.applied(entry),
                None => entry,
            };
            contents.note(&entry);
            if matches!(entry.key.channel, Channel::Bearings(_) | Channel::Tracks) {
                first = Some(first.map_or(entry.data_time, |first| first.min(entry.data_time)));
                last = last.max(Some(entry.data_time));
            }
            Ok(())
        })?;
        let (Some(first), Some(last)) = (first, last) else {
            anyhow::bail!("{} holds no bearings and no tracks", args.recording.display());
        };
        let (from, to) = (first.plus_seconds(args.from), first.plus_seconds(to_s));
        ensure!(
            from <= last,
            "--from {} lies behind the end of {}, which lasts {:.1} s",
            args.from,
            args.recording.display(),
            last.seconds_since(first)
        );
        Ok((Self { from, to, is_whole }, contents))
    }

    /// Whether an entry lies in the range.
    fn holds(&self, entry: &Entry) -> bool {
        self.is_whole || (self.from..=self.to).contains(&entry.data_time)
    }
}

/// The calibrations valid at a range's beginning, ordered by key: each camera's last one before it,
/// or else its first.
fn calibrations(recording: &Path, range: TimeRange) -> anyhow::Result<Vec<Entry>> {
    let is_calibration = |key: &Key| matches!(key.channel, Channel::Calibration(_));
    let cameras =
        RecordingReader::open(recording)?.keys().filter(|key| is_calibration(key)).count();
    let mut found: BTreeMap<Key, Entry> = BTreeMap::new();
    recorded::find(recording, |entry| {
        let is_past = entry.data_time > range.from;
        if is_calibration(&entry.key)
            && (!found.contains_key(&entry.key) || !range.is_whole && !is_past)
        {
            found.insert(entry.key.clone(), entry);
        }
        // The number of cameras is not known beforehand if the file is truncated.
        let is_all = cameras > 0 && found.len() == cameras && (range.is_whole || is_past);
        is_all.then_some(())
    })?;
    Ok(found.into_values().collect())
}
