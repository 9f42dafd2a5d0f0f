use std::path::{Path, PathBuf};

use crossfix_fusion::{Fusion, Output};
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, Health, Key, Payload, SiteName, Timestamp, decode,
};
use crossfix_recording::{Entry, RecordingReader, RecordingWriter};

use crate::commands::rejections::RejectionLog;
use crate::config::FusionFile;
use crate::output;

/// Play a recording again: onto Zenoh, or with --fuse straight into the fusion.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  crossfix replay recordings/two-uavs.mcap --fuse -o tracks.mcap\n  crossfix replay recordings/two-uavs.mcap --speed 2 --from 5 --to 20"
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
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let range = Range::of(&args.recording, args.from, args.to)?;
    match &args.output {
        Some(output) => fuse(args, output, range),
        None => anyhow::bail!("not yet"),
    }
}

/// A range of data time.
#[derive(Clone, Copy, Debug)]
pub struct Range {
    from: Timestamp,
    to: Timestamp,
}

impl Range {
    /// The range between two offsets, in seconds, from the first bearing or track of a recording.
    pub fn of(recording: &Path, from_s: f64, to_s: f64) -> anyhow::Result<Self> {
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
    pub fn holds(&self, entry: &Entry) -> bool {
        matches!(entry.key.channel, Channel::Calibration(_)) || (self.from..=self.to).contains(&entry.data_time)
    }
}

/// What fusing a recording needs and makes.
struct OfflineFusion {
    fusion: Fusion,
    writer: RecordingWriter<std::io::BufWriter<std::fs::File>>,
    rejections: RejectionLog,
    frames: u64,
    tracks: u64,
}

fn fuse(args: &Args, output: &Path, range: Range) -> anyhow::Result<()> {
    let file = FusionFile::load(args.config.as_deref(), &args.sets)?;
    let mut run = OfflineFusion {
        fusion: Fusion::new(file.fusion())?,
        writer: RecordingWriter::create(output)?,
        rejections: RejectionLog::default(),
        frames: 0,
        tracks: 0,
    };
    let mut site: Option<SiteName> = None;
    // Calibrations first: a range may begin after they were said.
    RecordingReader::open(&args.recording)?.for_each(|entry| {
        if matches!(entry.key.channel, Channel::Calibration(_)) {
            let _ = run.fusion.calibrate(&decode(&entry.data)?);
        }
        Ok::<_, crossfix_message::DecodeError>(())
    })?;
    let report = RecordingReader::open(&args.recording)?.for_each(|entry| {
        if range.holds(&entry) {
            site.get_or_insert_with(|| entry.key.site.clone());
            run.take(entry)?;
        }
        Ok::<_, FuseError>(())
    })?;
    if let Some(site) = &site {
        let last = run.fusion.flush();
        run.write(site, last)?;
    }
    let OfflineFusion { writer, frames, tracks, fusion, .. } = run;
    writer.finish()?;
    if let Some(damage) = report.damage {
        tracing::warn!("{} is torn: {damage}; everything before was used", args.recording.display());
    }
    for (name, value) in fusion.counters().iter() {
        tracing::info!("{name} {value}");
    }
    output::line(format!("{frames} bearing frames fused, {tracks} track frames written to {}", output.display()));
    Ok(())
}

/// Why fusing a recording stops.
#[derive(Debug, thiserror::Error)]
enum FuseError {
    #[error("a message is damaged or of a newer version")]
    Decode(#[from] crossfix_message::DecodeError),
    #[error("the new recording cannot be written")]
    Write(#[from] crossfix_recording::RecordingError),
}

impl OfflineFusion {
    fn take(&mut self, entry: Entry) -> Result<(), FuseError> {
        let outputs = match &entry.key.channel {
            Channel::Calibration(_) => {
                let message: CameraCalibration = decode(&entry.data)?;
                if let Err(error) = self.fusion.calibrate(&message) {
                    tracing::warn!("a calibration was not used: {error}");
                }
                self.writer.write(&entry)?;
                return Ok(());
            }
            Channel::Bearings(_) => {
                self.frames += 1;
                self.writer.write(&entry)?;
                self.fusion.ingest(&decode::<BearingFrame>(&entry.data)?)
            }
            Channel::CameraHealth(camera) => {
                let health: Health = decode(&entry.data)?;
                if health.ended { self.fusion.camera_ended(camera) } else { Vec::new() }
            }
            Channel::Truth => {
                self.writer.write(&entry)?;
                return Ok(());
            }
            _ => return Ok(()),
        };
        self.write(&entry.key.site, outputs)
    }

    fn write(&mut self, site: &SiteName, outputs: Vec<Output>) -> Result<(), FuseError> {
        for output in outputs {
            let (channel, time_ns, data) = match output {
                Output::Tracks(frame) => {
                    self.tracks += 1;
                    (Channel::Tracks, frame.time_ns, frame.encode())
                }
                Output::Event(event) => {
                    let time = Timestamp::from_nanos(event.time_ns);
                    tracing::debug!("{time}: track {} {}", event.track_id, event.kind().as_str_name());
                    (Channel::Events, event.time_ns, event.encode())
                }
                Output::Rejected(rejection) => {
                    self.rejections.report(&rejection);
                    continue;
                }
            };
            let time = Timestamp::from_nanos(time_ns);
            let key = Key::new(site.clone(), channel);
            self.writer.write(&Entry { key, data_time: time, arrival: time, data })?;
        }
        Ok(())
    }
}
