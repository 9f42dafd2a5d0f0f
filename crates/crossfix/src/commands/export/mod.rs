mod others;

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use crossfix_evaluation::{Estimate, TrackHistory};
use crossfix_message::{Channel, Timestamp, TrackFrame, TrackState};
use serde::Deserialize;

use self::others::OtherFormats;
use crate::commands::examples;
use crate::output::{self, Draft};
use crate::recorded::{self, Lacks};

/// Write the confirmed tracks of a recording as a table, or in formats of other programs.
///
/// The table's columns: t, seconds since the Unix epoch; track_id; x, y, z, metres; vx, vy, vz,
/// metres per second; state (confirmed or coasting; with --all also tentative and one-camera);
/// cameras, how many cameras have given the track a bearing within the last second; sd_m, the root
/// of the sum of the position's variances, metres; time_sd_s, the standard deviation of t, seconds:
/// the error that all clocks have in common, which sd_m does not include. With --times, the state
/// of each track at those times: that of its last frame before, extrapolated with its velocity.
#[derive(Debug, clap::Args)]
#[command(
    override_usage = "crossfix export [OPTIONS] <RECORDING> \\\n           \
        <--csv|--geojson|--kml|--cot|--sapient|--asterix|--foxglove> <FILE> ...",
    group = clap::ArgGroup::new("written").required(true).multiple(true)
        .args(["csv", "geojson", "kml", "cot", "sapient", "asterix", "foxglove"]),
    after_help = examples(&[
        "crossfix export tracks.mcap --csv tracks.csv --times times.csv",
        "crossfix export tracks.mcap --kml flights.kml --anchor 48.3538,11.7861,490",
        "crossfix export site.mcap --foxglove shown.mcap",
    ])
)]
pub struct Args {
    /// The recording (MCAP) with tracks.
    recording: PathBuf,
    /// The table to write (CSV).
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// A table (CSV) with a column `t`: the times to write, seconds since the Unix epoch.
    #[arg(long, value_name = "FILE")]
    times: Option<PathBuf>,
    /// Also write the tracks that are not confirmed, and those that only one camera sees: their
    /// range is a guess.
    #[arg(long)]
    all: bool,
    /// Use the smoothed tracks (of `fuse --lag`) instead of the live ones.
    #[arg(long)]
    smoothed: bool,
    #[command(flatten)]
    others: OtherFormats,
}

/// A track's state in one word.
fn word(status: TrackState) -> &'static str {
    match status {
        TrackState::Confirmed => "confirmed",
        TrackState::Coasting => "coasting",
        TrackState::OneCamera => "one-camera",
        TrackState::Lost => "lost",
        TrackState::Tentative | TrackState::Unspecified => "tentative",
    }
}

#[derive(Debug, Deserialize)]
struct TimeRow {
    t: f64,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    if let Some(csv) = &args.csv {
        write_table(args, csv)?;
    }
    let channel = if args.smoothed { Channel::Smoothed } else { Channel::Tracks };
    args.others.write(&args.recording, &channel)
}

fn write_table(args: &Args, csv: &Path) -> anyhow::Result<()> {
    let history = read_history(args)?;
    let inputs: Vec<&Path> =
        std::iter::once(&args.recording).chain(&args.times).map(PathBuf::as_path).collect();
    let draft = Draft::new(csv, &inputs)?;
    let cannot_write = || format!("cannot write {}", csv.display());
    let mut table = TrackTable::create(draft.path()).with_context(cannot_write)?;
    table.writer.write_record(COLUMNS).with_context(cannot_write)?;
    let at = |time| if args.all { history.all_at(time) } else { history.at(time) };
    match &args.times {
        Some(path) => {
            let mut reader = ::csv::Reader::from_path(path)
                .with_context(|| format!("cannot read {}", path.display()))?;
            for row in reader.deserialize() {
                let TimeRow { t } =
                    row.with_context(|| format!("{} needs a column `t`", path.display()))?;
                ensure!(t.is_finite(), "{}: a time is {t}", path.display());
                table.write(t, &at(Timestamp::from_seconds(t))).with_context(cannot_write)?;
            }
        }
        None => {
            for time in history.times() {
                table.write(time.seconds(), &at(time)).with_context(cannot_write)?;
            }
        }
    }
    let rows = table.finish().with_context(cannot_write)?;
    if let (0, Some(times)) = (rows, &args.times) {
        bail!("no track of {} is there at a time of {}", args.recording.display(), times.display());
    }
    ensure!(
        rows > 0,
        "no track of {} was ever sure{}",
        args.recording.display(),
        if args.all { "" } else { " (see --all)" }
    );
    draft.keep()?;
    output::line(format!("{rows} rows written to {}", csv.display()));
    Ok(())
}

fn read_history(args: &Args) -> anyhow::Result<TrackHistory> {
    let mut history = TrackHistory::default();
    let mut lacks = Lacks::default();
    let mut frames = 0_u64;
    let channel = if args.smoothed { Channel::Smoothed } else { Channel::Tracks };
    recorded::for_each(&args.recording, &mut lacks, |lacks, entry| {
        if entry.key.channel == channel
            && let Some(frame) = lacks.read::<TrackFrame>(&entry.data)
        {
            frames += 1;
            history.add(&frame);
        }
        Ok(())
    })?;
    lacks.say(&args.recording);
    let what = if args.smoothed { "smoothed tracks" } else { "tracks" };
    lacks.ensure_found(frames > 0, what, &args.recording)?;
    Ok(history)
}

/// Titles of the table's columns, in order.
const COLUMNS: [&str; 12] =
    ["t", "track_id", "x", "y", "z", "vx", "vy", "vz", "state", "cameras", "sd_m", "time_sd_s"];

/// A table of tracks that is being written.
struct TrackTable {
    writer: ::csv::Writer<File>,
    rows: u64,
}

impl TrackTable {
    fn create(path: &Path) -> ::csv::Result<Self> {
        Ok(Self { writer: ::csv::Writer::from_path(path)?, rows: 0 })
    }

    /// Writes a row for each track at a time, s.
    fn write(&mut self, time_s: f64, estimates: &[Estimate]) -> ::csv::Result<()> {
        for estimate in estimates {
            let mut record = vec![format!("{time_s:.9}"), estimate.id.to_string()];
            record.extend(estimate.state.mean.iter().map(|value| format!("{value:.6}")));
            record.push(word(estimate.status).to_owned());
            record.push(estimate.cameras.to_string());
            record.push(format!("{:.6}", estimate.position_sd_m()));
            record.push(format!("{:.6}", estimate.time_sd_s));
            self.writer.write_record(&record)?;
            self.rows += 1;
        }
        Ok(())
    }

    /// Closes the file; returns the number of rows.
    fn finish(mut self) -> std::io::Result<u64> {
        self.writer.flush()?;
        Ok(self.rows)
    }
}
