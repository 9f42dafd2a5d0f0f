//! Into the fusion, as fast as it goes.

use std::path::Path;
use std::time::{Duration, Instant};

use crossfix_fusion::{Fusion, Output};
use crossfix_message::{
    BearingFrame, CameraCalibration, Channel, Health, Key, Payload, SiteName, Timestamp, decode,
};
use crossfix_recording::{Entry, RecordingReader, RecordingWriter};

use super::{Args, Range};
use crate::commands::rejections::{RejectionLog, report_camera};
use crate::config::FusionFile;
use crate::output;

/// What fusing a recording needs and makes.
struct OfflineFusion {
    fusion: Fusion,
    writer: RecordingWriter<std::io::BufWriter<std::fs::File>>,
    rejections: RejectionLog,
    frames: u64,
    tracks: u64,
    /// Time spent in the fusion itself, and the longest for one frame.
    busy: Duration,
    longest: Duration,
}

/// Fuses a recording's bearings and writes calibrations, bearings, truth and tracks.
pub fn fuse(args: &Args, output: &Path, range: Range) -> anyhow::Result<()> {
    let file = FusionFile::load(args.config.as_deref(), &args.sets)?;
    let mut run = OfflineFusion {
        fusion: Fusion::new(file.fusion())?,
        writer: RecordingWriter::create(output)?,
        rejections: RejectionLog::default(),
        frames: 0,
        tracks: 0,
        busy: Duration::ZERO,
        longest: Duration::ZERO,
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
            run.take(&entry)?;
        }
        Ok::<_, FuseError>(())
    })?;
    if let Some(site) = &site {
        let last = run.fusion.flush();
        run.write(site, last)?;
    }
    let OfflineFusion { writer, frames, tracks, fusion, busy, longest, .. } = run;
    writer.finish()?;
    if let Some(damage) = report.damage {
        tracing::warn!("{} is torn: {damage}; everything before was used", args.recording.display());
    }
    for (name, value) in fusion.counters().iter() {
        tracing::info!("{name} {value}");
    }
    output::line(format!(
        "{frames} bearing frames fused, {tracks} track frames written to {}",
        output.display()
    ));
    if frames > 0 {
        output::line(format!(
            "the fusion itself took {:.1} ms: {:.1} us a frame, {:.2} ms at most",
            busy.as_secs_f64() * 1e3,
            busy.as_secs_f64() * 1e6 / frames as f64,
            longest.as_secs_f64() * 1e3
        ));
    }
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
    fn take(&mut self, entry: &Entry) -> Result<(), FuseError> {
        let outputs = match &entry.key.channel {
            Channel::Calibration(_) => {
                let message: CameraCalibration = decode(&entry.data)?;
                if let Err(error) = self.fusion.calibrate(&message) {
                    tracing::warn!("a calibration was not used: {error}");
                }
                self.writer.write(entry)?;
                return Ok(());
            }
            Channel::Bearings(_) => {
                self.frames += 1;
                self.writer.write(entry)?;
                let frame: BearingFrame = decode(&entry.data)?;
                let start = Instant::now();
                let outputs = self.fusion.ingest(&frame);
                let took = start.elapsed();
                self.busy += took;
                self.longest = self.longest.max(took);
                outputs
            }
            Channel::CameraHealth(camera) => {
                let health: Health = decode(&entry.data)?;
                if health.ended { self.fusion.camera_ended(camera) } else { Vec::new() }
            }
            Channel::Truth => {
                self.writer.write(entry)?;
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
                Output::Camera(camera, standing) => {
                    report_camera(&camera, standing);
                    continue;
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
