//! A recording's tracks in formats of other programs, as an outlet would have sent them live.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use crossfix_geometry::Geodetic;
use crossfix_message::{
    AreaName, CameraCalibration, Channel, SiteName, Timestamp, TrackEvent, TrackFrame, glance,
};
use crossfix_outlet::foxglove::{FoxgloveView, PictureExport};
use crossfix_outlet::{GeoJsonFlights, Kml, Outlet, Sapient, Situation};
use crossfix_recording::{Entry, RecordingWriter, Source};

use crate::commands::anchor::AnchorArg;
use crate::commands::numbers;
use crate::commands::outlet::FormatArgs;
use crate::commands::record::foxglove;
use crate::output::{self, Draft};
use crate::recorded::{self, Lacks};

/// Files in formats of other programs.
#[derive(Clone, Debug, clap::Args)]
pub struct OtherFormats {
    /// Write each track's flight as GeoJSON (WGS84). This and the other formats except --foxglove
    /// need --anchor.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    geojson: Option<PathBuf>,
    /// Write each track's flight as KML, for Google Earth.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    kml: Option<PathBuf>,
    /// With --kml: height of the geoid (mean sea level) above the WGS84 ellipsoid at the site,
    /// metres.
    #[arg(
        long,
        value_name = "METRES",
        default_value_t = 0.0,
        value_parser = numbers::height_difference,
        allow_hyphen_values = true
    )]
    geoid: f64,
    /// Write Cursor-on-Target events, one after the other.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    cot: Option<PathBuf>,
    /// Write SAPIENT messages, each preceded by its length.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    sapient: Option<PathBuf>,
    /// Write ASTERIX blocks of category 062.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    asterix: Option<PathBuf>,
    /// Write the recording again (MCAP) with its contents also in Foxglove's schemas: it opens in
    /// Foxglove and Rerun without Crossfix.
    #[arg(long, value_name = "FILE")]
    foxglove: Option<PathBuf>,
    /// How often each target's position is written to GeoJSON, KML, CoT, SAPIENT and ASTERIX, times
    /// per second of data.
    #[arg(long, value_name = "HERTZ", default_value_t = 10.0, value_parser = numbers::outlet_rate)]
    rate_hz: f64,
    #[command(flatten)]
    origin: AnchorArg,
    #[command(flatten)]
    formats: FormatArgs,
}

impl OtherFormats {
    /// Writes the formats that are asked for.
    pub fn write(&self, recording: &Path, channel: &Channel) -> anyhow::Result<()> {
        let site = site_of(recording)?;
        if let Some(anchor) = self.origin.anchor {
            let tracks =
                RecordedTracks { recording, channel, site: &site, anchor, rate_hz: self.rate_hz };
            let formats = &self.formats;
            tracks.write(self.geojson.as_deref(), || Ok(Box::<GeoJsonFlights>::default()))?;
            tracks.write(self.kml.as_deref(), || Ok(Box::new(Kml::above_geoid(self.geoid))))?;
            tracks.write(self.cot.as_deref(), || Ok(Box::new(formats.cot_type.clone())))?;
            tracks
                .write(self.asterix.as_deref(), || Ok(Box::new(formats.asterix_source.clone())))?;
            let sapient = || Ok(Box::new(Sapient::of_site(site.clone())) as Box<dyn Outlet>);
            tracks.write(self.sapient.as_deref(), sapient)?;
        }
        match &self.foxglove {
            Some(path) => write_foxglove(recording, path, &site, self.origin.anchor),
            None => Ok(()),
        }
    }
}

/// The site of a recording: that of its first message.
fn site_of(recording: &Path) -> anyhow::Result<SiteName> {
    let mut site = None;
    let mut lacks = Lacks::default();
    recorded::for_each(recording, &mut lacks, |_, entry| {
        site.get_or_insert_with(|| entry.key.site.clone());
        Ok(())
    })?;
    site.with_context(|| format!("{} holds no message of a site", recording.display()))
}

/// Tracks earlier than the last by more than this, s, belong to another run and are not merely out
/// of order. With half of it a frame that is a second late causes messages that are not due; with
/// twice as much the beginning of a run that is three seconds earlier is left out.
const OUT_OF_ORDER_S: f64 = 2.0;

/// A recording's tracks, to be written by outlets.
struct RecordedTracks<'a> {
    recording: &'a Path,
    channel: &'a Channel,
    site: &'a SiteName,
    anchor: Geodetic,
    rate_hz: f64,
}

impl RecordedTracks<'_> {
    /// Writes the file of one format, if it is asked for.
    fn write(
        &self,
        path: Option<&Path>,
        outlet: impl FnOnce() -> anyhow::Result<Box<dyn Outlet>>,
    ) -> anyhow::Result<()> {
        let Some(path) = path else { return Ok(()) };
        let cannot_write = || format!("cannot write {}", path.display());
        let draft = Draft::new(path, &[self.recording])?;
        let file = BufWriter::new(File::create(draft.path()).with_context(cannot_write)?);
        let mut written = OutletFile {
            path,
            file,
            outlet: outlet()?,
            situation: Situation::new(self.site.clone(), self.anchor),
            period_s: self.rate_hz.recip(),
            next: None,
            last: Timestamp::EPOCH,
            frames: 0,
            is_greeted: false,
            messages: 0,
        };
        self.send_to(&mut written)?;
        let messages = written.finish()?;
        draft.keep()?;
        let count = if messages == 1 { String::new() } else { format!(": {messages} messages") };
        output::line(format!("{} written{count}", path.display()));
        Ok(())
    }

    /// Passes the whole recording to an outlet.
    fn send_to(&self, written: &mut OutletFile<'_>) -> anyhow::Result<()> {
        let mut lacks = Lacks::default();
        recorded::for_each(self.recording, &mut lacks, |lacks, entry| {
            written.take(&entry, self.channel, lacks)
        })?;
        lacks.say(self.recording);
        lacks.ensure_found(written.frames > 0, "tracks", self.recording)?;
        let messages = written.outlet.farewell(written.last);
        written.put(messages)
    }
}

/// A file that an outlet's messages are written to, at even intervals of data time.
struct OutletFile<'a> {
    path: &'a Path,
    file: BufWriter<File>,
    outlet: Box<dyn Outlet>,
    situation: Situation,
    /// Data time between two messages on the targets, s.
    period_s: f64,
    /// When the targets are due next; `None` before the first tracks.
    next: Option<Timestamp>,
    /// Time of the newest tracks.
    last: Timestamp,
    /// Number of messages with tracks so far.
    frames: u64,
    is_greeted: bool,
    messages: u64,
}

impl OutletFile<'_> {
    /// Takes a message of the recording; its tracks are those on `channel`.
    fn take(&mut self, entry: &Entry, channel: &Channel, lacks: &mut Lacks) -> anyhow::Result<()> {
        match &entry.key.channel {
            Channel::Calibration(_) => {
                if let Some(message) = lacks.read::<CameraCalibration>(&entry.data) {
                    self.situation.add_calibration(&message);
                }
            }
            Channel::Events => {
                if let Some(event) = lacks.read::<TrackEvent>(&entry.data) {
                    self.greet(Timestamp::from_nanos(event.time_ns))?;
                    let messages = self.outlet.event(&event);
                    self.put(messages)?;
                }
            }
            of_tracks if of_tracks == channel => {
                if let Some(frame) = lacks.read::<TrackFrame>(&entry.data) {
                    self.take_tracks(entry.key.area.as_ref(), &frame)?;
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Takes an area's tracks, and writes where the targets are if that is due.
    fn take_tracks(&mut self, area: Option<&AreaName>, frame: &TrackFrame) -> anyhow::Result<()> {
        self.frames += 1;
        self.situation.add_tracks(area, frame);
        let now = Timestamp::from_nanos(frame.time_ns);
        self.last = now;
        // A recording may have gaps, and runs with earlier times: missed intervals are not made up
        // for.
        let is_due = self.next.is_none_or(|next| {
            now >= next || next.seconds_since(now) > self.period_s + OUT_OF_ORDER_S
        });
        if !is_due {
            return Ok(());
        }
        self.next = Some(now.plus_seconds(self.period_s));
        self.greet(now)?;
        match self.situation.snapshot(0.0) {
            Some(snapshot) => {
                let messages = self.outlet.tracks(&snapshot);
                self.put(messages)
            }
            None => Ok(()),
        }
    }

    /// Writes the outlet's greeting, the first time.
    fn greet(&mut self, now: Timestamp) -> anyhow::Result<()> {
        if std::mem::replace(&mut self.is_greeted, true) {
            return Ok(());
        }
        let messages = self.outlet.greeting(now);
        self.put(messages)
    }

    fn put(&mut self, messages: Vec<Vec<u8>>) -> anyhow::Result<()> {
        for message in messages {
            self.messages += 1;
            self.file
                .write_all(&message)
                .with_context(|| format!("cannot write {}", self.path.display()))?;
        }
        Ok(())
    }

    /// Closes the file; returns the number of messages.
    fn finish(mut self) -> anyhow::Result<u64> {
        self.file.flush().with_context(|| format!("cannot write {}", self.path.display()))?;
        Ok(self.messages)
    }
}

/// Writes a copy of a recording with Foxglove's schemas added to ours.
fn write_foxglove(
    recording: &Path,
    path: &Path,
    site: &SiteName,
    anchor: Option<Geodetic>,
) -> anyhow::Result<()> {
    let draft = Draft::new(path, &[recording])?;
    let mut writer = RecordingWriter::create(draft.path())?;
    writer.sign(&Source::of("export --foxglove"))?;
    let mut view = FoxgloveView::new(site, anchor, PictureExport::Said);
    let mut lacks = Lacks::default();
    let (mut read, mut newer) = (0, 0);
    recorded::for_each(recording, &mut lacks, |_, entry: Entry| {
        read += 1;
        let seen = glance(&entry.key.channel, &entry.data).ok().flatten();
        newer += u64::from(seen.is_some_and(|seen| !seen.is_readable));
        writer.write(&entry)?;
        Ok(foxglove::write(&mut writer, &mut view, &entry)?)
    })?;
    lacks.say(recording);
    recorded::ensure_readable(recording, read, newer)?;
    let messages = writer.finish()?;
    draft.keep()?;
    output::line(format!(
        "{messages} messages and what Foxglove reads of them written to {}",
        path.display()
    ));
    Ok(())
}
