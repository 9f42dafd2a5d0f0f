//! Replay into the fusion, as fast as possible.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{bail, ensure};
use crossfix_fusion::Output;
use crossfix_message::{Channel, Key, Payload, SiteName, Timestamp, TrackEventKind};
use crossfix_recording::{Entry, RecordingWriter, Source};

use super::{Args, TimeRange, calibrations};
use crate::centre::Centre;
use crate::config::FusionFile;
use crate::output::{self, Draft};
use crate::recalibration::{Recalibration, Reordered};
use crate::recorded::{self, Lacks};
use crate::shutdown::Shutdown;

/// Interval at which the fusion's health is recorded, s of data time. With twice as much a camera
/// that is left out for a second may not show.
const HEALTH_PERIOD_S: f64 = 1.0;

/// State of an offline fusion, with its output.
struct OfflineFusion {
    centre: Centre,
    writer: RecordingWriter<std::io::BufWriter<std::fs::File>>,
    /// What of the recording is fused.
    range: TimeRange,
    /// Data time of the first entry used, and of the latest.
    first: Option<Timestamp>,
    until: Timestamp,
    frames: u64,
    /// Number of tracks that were confirmed.
    targets: u64,
    /// Whether smoothed tracks are written.
    is_smoothed: bool,
    site: Option<SiteName>,
    healthy_at: Option<Timestamp>,
    /// Time spent in the fusion itself, in total and at most for one frame.
    busy: Duration,
    longest: Duration,
}

/// Fuses a recording's bearings, and writes all that was recorded, with new tracks.
pub fn fuse(
    args: &Args,
    output: &Path,
    range: TimeRange,
    recalibration: Option<Recalibration>,
) -> anyhow::Result<()> {
    let shutdown = Shutdown::listen();
    let file = FusionFile::load(args.config.as_deref(), &args.sets)?;
    let draft = Draft::new(output, &[&args.recording])?;
    let mut run = OfflineFusion::begin(args, file, range, draft.path())?;
    for entry in calibrations(&args.recording, range)? {
        let entry = match &recalibration {
            Some(recalibration) => recalibration.applied(entry),
            None => entry,
        };
        run.centre.take(&entry.key.channel, &entry.data, "");
        if !range.is_whole {
            run.writer.write(&Entry { data_time: range.from.max(entry.data_time), ..entry })?;
        }
    }
    let mut lacks = Lacks::default();
    let mut reordered = recalibration.map(Reordered::new);
    recorded::for_each_until(
        &args.recording,
        &mut lacks,
        &shutdown,
        |_, entry| match &mut reordered {
            Some(reordered) => reordered.take(entry).try_for_each(|entry| run.take(&entry)),
            None => run.take(&entry),
        },
    )?;
    if let Some(reordered) = &mut reordered {
        reordered.finish().try_for_each(|entry| run.take(&entry))?;
    }
    lacks.say(&args.recording);
    lacks.ensure_found(run.frames > 0, "bearings in that range", &args.recording)?;
    let found = run.finish(args, output)?;
    draft.keep()?;
    if shutdown.requested() {
        bail!(
            "stopped {:.1} s after the beginning: {} ends there",
            found.lasts_s,
            output.display()
        );
    }
    found.ensure_any()
}

/// What was found in a recording.
struct ReplaySummary {
    frames: u64,
    /// Number of tracks that were confirmed.
    targets: u64,
    /// From the first entry to the last, s.
    lasts_s: f64,
    /// Why it is nothing, if that is known.
    why_nothing: Option<String>,
}

impl ReplaySummary {
    fn ensure_any(&self) -> anyhow::Result<()> {
        let why = self.why_nothing.as_ref().map_or_else(String::new, |why| format!(": {why}"));
        ensure!(self.targets > 0, "no target found in {} bearing frames{why}", self.frames);
        Ok(())
    }
}

impl OfflineFusion {
    fn begin(args: &Args, file: FusionFile, range: TimeRange, path: &Path) -> anyhow::Result<Self> {
        let config = file.fusion().smoothed(args.smooth);
        let is_smoothed = config.tracking.smoothing_s > 0.0;
        let centre = Centre::new(config, file.cameras)?;
        let mut writer = RecordingWriter::create(path)?;
        writer.sign(&Source::of("replay --fuse"))?;
        Ok(Self {
            centre,
            writer,
            range,
            first: None,
            until: Timestamp::MIN,
            frames: 0,
            targets: 0,
            is_smoothed,
            site: None,
            healthy_at: None,
            busy: Duration::ZERO,
            longest: Duration::ZERO,
        })
    }

    /// Takes an entry, if it is in the range.
    fn take(&mut self, entry: &Entry) -> anyhow::Result<()> {
        if !self.range.holds(entry) {
            return Ok(());
        }
        self.first.get_or_insert(entry.data_time);
        self.until = self.until.max(entry.data_time);
        match &entry.key.channel {
            // Results of an earlier fusion of these bearings.
            Channel::Tracks
            | Channel::Smoothed
            | Channel::Events
            | Channel::Cues
            | Channel::FusionHealth => return Ok(()),
            Channel::Bearings(_) => self.frames += 1,
            _ => {}
        }
        let site = self.site.get_or_insert_with(|| entry.key.site.clone());
        ensure!(
            *site == entry.key.site,
            "the recording is of two sites, `{site}` and `{}`: their targets and clocks have nothing \
             in common",
            entry.key.site
        );
        self.writer.write(entry)?;
        let start = Instant::now();
        let outputs = self.centre.take(&entry.key.channel, &entry.data, "");
        let took = start.elapsed();
        self.busy += took;
        self.longest = self.longest.max(took);
        self.write(outputs)?;
        self.write_health(self.centre.now(), false)
    }

    fn write(&mut self, outputs: Vec<Output>) -> anyhow::Result<()> {
        for output in outputs {
            match output {
                Output::Tracks(frame) if !self.is_smoothed => {
                    let time = Timestamp::from_nanos(frame.time_ns);
                    self.put(Channel::Tracks, time, frame.encode())?;
                }
                Output::Smoothed(frame) => {
                    let time = Timestamp::from_nanos(frame.time_ns);
                    self.put(Channel::Tracks, time, frame.encode())?;
                }
                Output::Event(event) => {
                    self.targets += u64::from(event.kind() == TrackEventKind::Confirmed);
                    let time = Timestamp::from_nanos(event.time_ns);
                    tracing::debug!("{time}: {event}");
                    self.put(Channel::Events, time, event.encode())?;
                }
                Output::Cues(cues) => {
                    let time = Timestamp::from_nanos(cues.time_ns);
                    self.put(Channel::Cues, time, cues.encode())?;
                }
                Output::Tracks(_) | Output::Camera(..) | Output::Rejected(_) => {}
            }
        }
        Ok(())
    }

    fn write_health(&mut self, now: Timestamp, ended: bool) -> anyhow::Result<()> {
        if now == Timestamp::EPOCH && !ended {
            return Ok(());
        }
        let is_due =
            self.healthy_at.is_none_or(|then| now.seconds_since(then).abs() >= HEALTH_PERIOD_S);
        if !is_due && !ended {
            return Ok(());
        }
        self.healthy_at = Some(now);
        let mut health = self.centre.health(&[]);
        health.ended = ended;
        self.put(Channel::FusionHealth, now, health.encode())
    }

    fn put(&mut self, channel: Channel, time: Timestamp, data: Vec<u8>) -> anyhow::Result<()> {
        if let Some(site) = self.site.clone() {
            let key = Key::new(site, channel);
            self.writer.write(&Entry { key, data_time: time, arrival: time, data })?;
        }
        Ok(())
    }

    fn finish(mut self, args: &Args, path: &Path) -> anyhow::Result<ReplaySummary> {
        let last = self.centre.flush();
        self.write(last)?;
        self.write_health(self.centre.now(), true)?;
        let health = self.centre.health(&[]);
        for counter in &health.counters {
            tracing::info!("{} {}", counter.name, counter.value);
        }
        let unread = ["received_malformed", "received_newer_version", "received_too_large"];
        let unread =
            health.counters.iter().filter(|counter| unread.contains(&counter.name.as_str()));
        let unread: u64 = unread.map(|counter| counter.value).sum();
        ensure!(
            unread < self.frames,
            "none of {} messages of {} can be read: it is damaged, or of a newer version",
            unread,
            args.recording.display()
        );
        self.writer.finish()?;
        let (frames, track_frames) = (self.frames, self.centre.frames());
        output::line(format!(
            "{frames} bearing frames fused, {track_frames} track frames written to {}",
            path.display()
        ));
        output::line(format!(
            "the fusion itself took {:.1} ms: {:.1} us a frame, {:.2} ms at most",
            self.busy.as_secs_f64() * 1e3,
            self.busy.as_secs_f64() * 1e6 / frames as f64,
            self.longest.as_secs_f64() * 1e3
        ));
        Ok(ReplaySummary {
            frames,
            targets: self.targets,
            lasts_s: self.until.seconds_since(self.first.unwrap_or(self.until)),
            why_nothing: self.centre.why_nothing(),
        })
    }
}
