use std::path::{Path, PathBuf};

use crossfix_recording::RecordingWriter;

use crate::commands::examples;
use crate::import::drone_tracking::{RtkSample, SplitPart};
use crate::import::{drone_tracking, scenario};
use crate::output::{self, Draft};

/// Turn published data sets into recordings.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix import drone-tracking-datasets DIR --dataset 3 \\\n\
     --cameras gopro3,sony5100,sonyG -o eth.mcap",
    "crossfix import scenario DIR -o scenario.mcap",
]))]
pub struct Args {
    #[command(subcommand)]
    source: ImportSource,
}

#[derive(Debug, clap::Subcommand)]
enum ImportSource {
    /// The drone-tracking-datasets of ETH Zurich: labels of several cameras, RTK truth.
    ///
    /// Data times are RTK seconds from the Unix epoch, or with --raw the seconds that each camera
    /// counts by its frames.
    #[command(
        override_usage = "crossfix import drone-tracking-datasets [OPTIONS] \\\n           \
            --dataset <N> --cameras <NAMES> --output <FILE> <DIR>",
        after_help = examples(&[
            "crossfix import drone-tracking-datasets DIR --dataset 3 \\\n\
             --cameras gopro3,sony5100,sonyG -o eth.mcap",
            "crossfix import drone-tracking-datasets DIR --dataset 3 --part calibration --raw \\\n\
             --cameras gopro3,sony5100,sonyG --log-out rtk.csv -o cal.mcap",
        ])
    )]
    DroneTrackingDatasets {
        /// The folder with calibration/, poses.json and datasetN/.
        dir: PathBuf,
        /// Number of the data set.
        #[arg(long, value_name = "N")]
        dataset: u32,
        /// Names of the cameras, separated by commas.
        #[arg(long, value_delimiter = ',', value_name = "NAMES", required = true)]
        cameras: Vec<String>,
        /// Which poses and which test part of poses.json.
        #[arg(long, default_value = "half", value_name = "NAME")]
        split: String,
        /// Which part of the split.
        #[arg(long, default_value = "test", value_enum, value_name = "PART")]
        part: SplitPart,
        /// As the cameras recorded it: times counted by frames, the lenses of their files, and no
        /// poses.
        #[arg(long)]
        raw: bool,
        /// Write the drone's RTK places of that part beside it, as a log (CSV).
        #[arg(long, value_name = "FILE")]
        log_out: Option<PathBuf>,
        /// The recording to write (MCAP).
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// A scenario folder of the format passive-bearings/1: bearings of many cameras, with truth.
    #[command(after_help = examples(&["crossfix import scenario DIR -o scenario.mcap"]))]
    Scenario {
        /// The folder with scenario.json, exposures.csv, detections.csv and truth.csv.
        dir: PathBuf,
        /// The recording to write (MCAP).
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let (mut entries, path) = match &args.source {
        ImportSource::DroneTrackingDatasets {
            dir,
            dataset,
            cameras,
            split,
            part,
            raw,
            log_out,
            output,
        } => {
            let (dataset, part, is_raw) = (*dataset, *part, *raw);
            let selection =
                drone_tracking::LabelSelection { dataset, cameras, split, part, is_raw };
            let flight = drone_tracking::read(dir, &selection)?;
            if let Some(path) = log_out {
                write_log(path, &flight.log)?;
            }
            (flight.entries, output)
        }
        ImportSource::Scenario { dir, output } => (scenario::read(dir)?, output),
    };
    entries.sort_by_key(|entry| entry.data_time);
    let draft = Draft::new(path, &[])?;
    let mut writer = RecordingWriter::create(draft.path())?;
    writer.sign(&crossfix_recording::Source::of("import"))?;
    for entry in &entries {
        writer.write(entry)?;
    }
    let messages = writer.finish()?;
    draft.keep()?;
    output::line(format!("{messages} messages written to {}", path.display()));
    Ok(())
}

/// Writes positions as a log that `calibrate flight --log` reads.
fn write_log(path: &Path, samples: &[RtkSample]) -> anyhow::Result<()> {
    let mut text = String::from("time_s,east_m,north_m,up_m\n");
    for RtkSample { time_s, place } in samples {
        text += &format!("{time_s:.3},{:.4},{:.4},{:.4}\n", place.x, place.y, place.z);
    }
    output::write_file(path, &[], text.as_bytes())
}
