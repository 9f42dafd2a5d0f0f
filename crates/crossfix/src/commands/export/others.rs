//! A recording's tracks in formats of other programs, as an outlet would have sent them live.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use crossfix_geometry::Geodetic;
use crossfix_message::{
    CameraCalibration, Channel, SiteName, Timestamp, TrackEvent, TrackFrame, glance,
};
use crossfix_outlet::foxglove::{FoxgloveView, Pictures};
use crossfix_outlet::{GeoJsonFlights, Kml, Outlet, Sapient, Situation};
use crossfix_recording::{Entry, RecordingWriter, Source};

use crate::commands::numbers;
use crate::commands::outlet::FormatArgs;
use crate::commands::record::foxglove;
use crate::output::{self, Draft};
use crate::recorded::{self, Lacks};

/// Files in the formats of others.
#[derive(Clone, Debug, clap::Args)]
pub struct OtherFormats {
    /// Write each track's flight as GeoJSON (WGS84); needs --anchor, as do all but --foxglove.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    geojson: Option<PathBuf>,
    /// Write each track's flight as KML, for Google Earth.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    kml: Option<PathBuf>,
    /// With --kml: how high the geoid (mean sea level) is above the ellipsoid there, metres.
    #[arg(
        long,
        value_name = "METRES",
        default_value_t = 0.0,
        value_parser = numbers::height_difference,
        allow_hyphen_values = true
    )]
    geoid: f64,
    /// Write events of Cursor on Target, one after the other.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    cot: Option<PathBuf>,
    /// Write messages of SAPIENT, each after its length.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    sapient: Option<PathBuf>,
    /// Write blocks of ASTERIX category 062.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    asterix: Option<PathBuf>,
    /// Write the recording again with Foxglove's schemas beside ours (MCAP): it opens in Foxglove
    /// and Rerun without Crossfix.
    #[arg(long, value_name = "FILE")]
    foxglove: Option<PathBuf>,
    /// How often the targets' places are said in the formats of others, a second.
    #[arg(long, value_name = "HERTZ", default_value_t = 10.0, value_parser = numbers::outlet_rate)]
    rate_hz: f64,
    /// Where on Earth the site's origin is: degrees north, degrees east, metres above the WGS84
    /// ellipsoid.
    #[arg(
        long,
        value_name = "LAT,LON,HEIGHT",
        value_parser = numbers::place,
        allow_hyphen_values = true
    )]
    anchor: Option<Geodetic>,
    #[command(flatten)]
    formats: FormatArgs,
}

impl OtherFormats {
    /// Writes the formats that are asked for.
    pub fn write(&self, recording: &Path, channel: &Channel) -> anyhow::Result<()> {
        let site = site_of(recording)?;
        if let Some(anchor) = self.anchor {
            let told = Told { recording, channel, site: &site, anchor, rate_hz: self.rate_hz };
            let formats = &self.formats;
            told.write(self.geojson.as_deref(), || Ok(Box::<GeoJsonFlights>::default()))?;
            told.write(self.kml.as_deref(), || Ok(Box::new(Kml::above_geoid(self.geoid))))?;
            told.write(self.cot.as_deref(), || Ok(Box::new(formats.cot_type.clone())))?;
            told.write(self.asterix.as_deref(), || Ok(Box::new(formats.asterix_source.clone())))?;
            let sapient = || Ok(Box::new(Sapient::of_site(site.clone())) as Box<dyn Outlet>);
            told.write(self.sapient.as_deref(), sapient)?;
        }
        match &self.foxglove {
            Some(path) => write_foxglove(recording, path, &site, self.anchor),
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

/// A recording's tracks, to be passed to an outlet.
struct Told<'a> {
    recording: &'a Path,
    channel: &'a Channel,
    site: &'a SiteName,
    anchor: Geodetic,
    rate_hz: f64,
}

impl Told<'_> {
    fn write(
        &self,
        path: Option<&Path>,
        outlet: impl FnOnce() -> anyhow::Result<Box<dyn Outlet>>,
    ) -> anyhow::Result<()> {
        let Some(path) = path else { return Ok(()) };
        let cannot_write = || format!("cannot write {}", path.display());
        let draft = Draft::new(path, &[self.recording])?;
        let file = BufWriter::new(File::create(draft.path()).with_context(cannot_write)?);
        let mut written =
            OutletFile { path, file, outlet: outlet()?, is_greeted: false, messages: 0 };
        self.tell(&mut written)?;
        let messages = written.finish()?;
        draft.keep()?;
        let count = if messages == 1 { String::new() } else { format!(": {messages} messages") };
        output::line(format!("{} written{count}", path.display()));
        Ok(())
    }

    /// Passes the tracks to an outlet at even intervals of data time.
    fn tell(&self, written: &mut OutletFile<'_>) -> anyhow::Result<()> {
        let mut situation = Situation::new(self.site.clone(), self.anchor);
        let period_s = self.rate_hz.recip();
        let mut next: Option<Timestamp> = None;
        let mut last = Timestamp::EPOCH;
        let mut lacks = Lacks::default();
        let mut frames = 0_u64;
        recorded::for_each(self.recording, &mut lacks, |lacks, entry| {
            match &entry.key.channel {
                Channel::Calibration(_) => {
                    if let Some(message) = lacks.read::<CameraCalibration>(&entry.data) {
                        situation.hear_calibration(&message);
                    }
                }
                Channel::Events => {
                    if let Some(event) = lacks.read::<TrackEvent>(&entry.data) {
                        written.greet(Timestamp::from_nanos(event.time_ns))?;
                        let messages = written.outlet.event(&event);
                        written.put(messages)?;
                    }
                }
                channel if channel == self.channel => {
                    let Some(frame) = lacks.read::<TrackFrame>(&entry.data) else { return Ok(()) };
                    frames += 1;
                    situation.hear(entry.key.area.as_ref(), &frame);
                    last = Timestamp::from_nanos(frame.time_ns);
                    // A recording may have gaps, and runs with earlier times: missed intervals are
                    // not made up for.
                    let is_due = next.is_none_or(|next| {
                        last >= next || next.seconds_since(last) > period_s + OUT_OF_ORDER_S
                    });
                    if is_due {
                        next = Some(last.plus_seconds(period_s));
                        written.greet(last)?;
                        if let Some(snapshot) = situation.snapshot(0.0) {
                            let messages = written.outlet.tracks(&snapshot);
                            written.put(messages)?;
                        }
                    }
                }
                _ => {}
            }
            Ok(())
        })?;
        lacks.say(self.recording);
        lacks.ensure_found(frames > 0, "tracks", self.recording)?;
        let messages = written.outlet.farewell(last);
        written.put(messages)
    }
}

/// A file that an outlet's messages are written to.
struct OutletFile<'a> {
    path: &'a Path,
    file: BufWriter<File>,
    outlet: Box<dyn Outlet>,
    is_greeted: bool,
    messages: u64,
}

impl OutletFile<'_> {
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
    let mut view = FoxgloveView::new(site, anchor, Pictures::Said);
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
