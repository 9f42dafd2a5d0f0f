use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{bail, ensure};
use crossfix_fusion::{Output, Standing};
use crossfix_message::{CameraCalibration, CameraName, Channel, Timestamp};
use crossfix_recording::Entry;
use serde::Serialize;

use crate::centre::Centre;
use crate::commands::examples;
use crate::config::FusionFile;
use crate::output;
use crate::pose_watch::{CameraWatch, TurnText};
use crate::recalibration::{Recalibration, Reordered};
use crate::recorded::{self, Lacks};

/// Name of the calibration file in a site's folder.
const CALIBRATION: &str = "calibration.toml";
/// A camera watched together with others for less time than this counts as not checked, s: by then
/// a turn of some milliradians is not certain. With half of it a camera that is turned by more than
/// that might be said to fit.
const LEAST_WATCHED_S: f64 = 20.0;
/// A camera of which no more is known than that it is not turned by this counts as not checked,
/// rad: it is next to what is assumed before anything flies. With half of it cameras are said to be
/// unchecked that are known to a degree.
const UNKNOWN_TURN_RAD: f64 = 0.02;

/// Whether cameras still stand as they were calibrated: by where the others see the targets.
///
/// A camera that has been turned by two milliradians is named after a minute of targets that it and
/// two others see. The exit code is 1 if one does not fit.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix calibrate check last-night.mcap",
    "crossfix calibrate check raw.mcap -c my-site",
]))]
pub struct Args {
    /// A recording (MCAP) of targets that several cameras see.
    recording: PathBuf,
    /// The calibration, or the site's folder with `calibration.toml` in it, in the place of what
    /// was recorded: of a recording that was made without one.
    #[arg(short, long, value_name = "PATH")]
    config: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Name of the fusion centre's file in a site's folder.
const FUSION: &str = "fusion.toml";

pub fn run(args: &Args) -> anyhow::Result<()> {
    let calibration = args.config.as_deref().map(calibration_of).transpose()?;
    let fusion = args.config.as_deref().map(|path| path.join(FUSION)).filter(|file| file.is_file());
    let recalibration = calibration.as_deref().map(Recalibration::load).transpose()?;
    let seen = watched(&args.recording, recalibration, fusion.as_deref())?;
    let figures: Vec<WatchedCamera> =
        seen.iter().map(|(name, seen)| WatchedCamera::of(name, seen)).collect();
    if args.json {
        output::json(&figures)?;
    } else {
        output::line(render(&figures));
    }
    let wrong: Vec<&str> = figures
        .iter()
        .filter(|camera| matches!(camera.verdict, CameraVerdict::Moved | CameraVerdict::Apart))
        .map(|camera| camera.name.as_str())
        .collect();
    ensure!(wrong.is_empty(), "not as calibrated: {}", wrong.join(", "));
    ensure!(
        figures.iter().any(|camera| camera.verdict == CameraVerdict::Fits),
        "nothing is checked: no target was seen by three cameras for long enough"
    );
    Ok(())
}

fn calibration_of(path: &Path) -> anyhow::Result<PathBuf> {
    if !path.is_dir() {
        return Ok(path.to_owned());
    }
    let calibration = path.join(CALIBRATION);
    if !calibration.is_file() {
        bail!(
            "{} holds no {CALIBRATION}: without -c the recording's own calibration is checked",
            path.display()
        );
    }
    Ok(calibration)
}

/// A camera left out by the fusion for more than this share of a recording contradicts the others;
/// one left out for a moment only does not. With twice as much one that is left out for a third of
/// the time would be said to fit.
const LEFT_OUT: f64 = 0.2;

/// What a recording shows of one camera.
#[derive(Debug, Default)]
struct CameraRecord {
    frames: u64,
    /// Since when it has been left out, if it is, ...
    left_out_since: Option<Timestamp>,
    /// ... and the total time that it was left out before, s.
    left_out_s: f64,
    /// Times of its first and last frame.
    span: Option<(Timestamp, Timestamp)>,
    watch: Option<CameraWatch>,
    has_moved: bool,
}

impl CameraRecord {
    fn see_frame(&mut self, time: Timestamp) {
        self.frames += 1;
        let first = self.span.map_or(time, |(first, _)| first);
        self.span = Some((first, time));
    }

    fn note(&mut self, standing: Standing, now: Timestamp) {
        if standing == Standing::Excluded {
            self.left_out_since.get_or_insert(now);
        } else if let Some(since) = self.left_out_since.take() {
            self.left_out_s += now.seconds_since(since);
        }
    }

    fn is_apart(&self) -> bool {
        self.span.is_some_and(|(first, last)| {
            let still_s = self.left_out_since.map_or(0.0, |since| last.seconds_since(since));
            self.left_out_s + still_s > LEFT_OUT * last.seconds_since(first)
        })
    }
}

/// The first calibration of each camera in a recording; it also applies to earlier bearings. If the
/// calibrations are to be replaced, the bearings must not have been made with ones that correct
/// clocks, as their times would be corrected twice.
fn calibrations(recording: &Path, are_replaced: bool) -> anyhow::Result<Vec<Entry>> {
    let mut first: BTreeMap<CameraName, Entry> = BTreeMap::new();
    recorded::for_each(recording, &mut Lacks::default(), |lacks, entry| {
        if let Channel::Calibration(name) = &entry.key.channel
            && !first.contains_key(name)
        {
            let message = lacks.read::<CameraCalibration>(&entry.data);
            let is_corrected = message.is_some_and(|message| message.corrects_clock());
            ensure!(!(are_replaced && is_corrected), corrected_already(recording));
            first.insert(name.clone(), entry);
        }
        Ok(())
    })?;
    Ok(first.into_values().collect())
}

fn corrected_already(recording: &Path) -> String {
    format!(
        "the bearings of {} were made with a flight's calibration: leave -c away to check that",
        recording.display()
    )
}

/// Fuses a recording and watches its cameras.
fn watched(
    recording: &Path,
    recalibration: Option<Recalibration>,
    fusion: Option<&Path>,
) -> anyhow::Result<BTreeMap<CameraName, CameraRecord>> {
    let centre = Centre::new(FusionFile::load(fusion, &[])?.fusion(), None)?;
    let mut run = WatchedRun { centre, cameras: BTreeMap::new() };
    for entry in calibrations(recording, recalibration.is_some())? {
        let entry =
            recalibration.as_ref().map_or_else(|| entry.clone(), |new| new.applied(entry.clone()));
        run.centre.take(&entry.key.channel, &entry.data, "");
    }
    let mut lacks = Lacks::default();
    let mut reordered = recalibration.map(Reordered::new);
    recorded::for_each(recording, &mut lacks, |_, entry| {
        match &mut reordered {
            Some(reordered) => reordered.take(entry).for_each(|entry| run.take(&entry)),
            None => run.take(&entry),
        }
        Ok(())
    })?;
    if let Some(reordered) = &mut reordered {
        reordered.finish().for_each(|entry| run.take(&entry));
    }
    let WatchedRun { mut centre, mut cameras } = run;
    centre.flush();
    lacks.say(recording);
    lacks.ensure_found(cameras.values().any(|seen| seen.frames > 0), "bearings", recording)?;
    for (name, seen) in &mut cameras {
        seen.watch = centre.poses().cameras().get(name).cloned();
        seen.has_moved = centre.poses().has_moved(name);
    }
    Ok(cameras)
}

/// State of the fusion, and what has become of each camera.
struct WatchedRun {
    centre: Centre,
    cameras: BTreeMap<CameraName, CameraRecord>,
}

impl WatchedRun {
    fn take(&mut self, entry: &Entry) {
        match &entry.key.channel {
            Channel::Bearings(name) => {
                self.cameras.entry(name.clone()).or_default().see_frame(entry.data_time);
            }
            // A camera that never saw anything gets an entry, too.
            Channel::Calibration(name) => drop(self.cameras.entry(name.clone()).or_default()),
            _ => {}
        }
        for output in self.centre.take(&entry.key.channel, &entry.data, "") {
            if let Output::Camera(name, standing) = output {
                self.cameras.entry(name).or_default().note(standing, self.centre.now());
            }
        }
    }
}

/// Verdict on a camera.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum CameraVerdict {
    Fits,
    Moved,
    Apart,
    Unchecked,
}

#[derive(Debug, Serialize)]
struct WatchedCamera {
    name: String,
    verdict: CameraVerdict,
    /// The longest time that it was watched together with others within about a minute, s.
    watched_s: f64,
    /// Estimated turn when the evidence for a move was strongest, mrad.
    turn_mrad: Option<f64>,
    turn_sd_mrad: Option<f64>,
    /// Likelihood ratio of the sight lines with and without that turn, as a power of ten.
    evidence: Option<f64>,
    /// When a move was first certain, s since 1970.
    moved_at_s: Option<f64>,
    why: String,
}

impl WatchedCamera {
    fn of(name: &CameraName, seen: &CameraRecord) -> Self {
        let watched_s = seen.watch.as_ref().map_or(0.0, |watch| watch.watched_s);
        let moved_at =
            seen.watch.as_ref().and_then(|watch| watch.moved_at).filter(|_| seen.has_moved);
        let (verdict, why) = match &seen.watch {
            Some(watch) if let Some(at) = watch.moved_at.filter(|_| seen.has_moved) => (
                CameraVerdict::Moved,
                format!("{}, sure at {at}: calibrate it again", TurnText(&watch.worst)),
            ),
            _ if seen.is_apart() => (
                CameraVerdict::Apart,
                "its bearings lie far beside what the others see: its pose, its clock or its name \
                 is wrong"
                    .to_owned(),
            ),
            Some(watch) if watch.least_turn_sd >= UNKNOWN_TURN_RAD => {
                (CameraVerdict::Unchecked, "what flew tells nothing of how it is turned".to_owned())
            }
            Some(watch) if watch.watched_s >= LEAST_WATCHED_S => (
                CameraVerdict::Fits,
                watch.moved_at.map_or_else(String::new, |at| {
                    format!("at {at} it might have been moved in the place of another, which was")
                }),
            ),
            _ => (
                CameraVerdict::Unchecked,
                format!("too few targets that two others see, in {} frames", seen.frames),
            ),
        };
        let worst = seen.watch.as_ref().map(|watch| &watch.worst);
        Self {
            name: name.to_string(),
            verdict,
            watched_s,
            turn_mrad: worst.map(|worst| 1e3 * worst.turn.norm()),
            turn_sd_mrad: worst.map(|worst| 1e3 * worst.turn_sd),
            evidence: worst.map(|worst| worst.log_odds / std::f64::consts::LN_10),
            moved_at_s: moved_at.map(|at| at.seconds()),
            why,
        }
    }
}

fn render(figures: &[WatchedCamera]) -> String {
    let head = ["camera", "watched [s]", "turned by [mrad]", "SD [mrad]", "evidence", "verdict"];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    for camera in figures {
        let verdict = match camera.verdict {
            CameraVerdict::Fits if camera.why.is_empty() => "fits",
            CameraVerdict::Fits => "fits: ",
            CameraVerdict::Moved => "MOVED: ",
            CameraVerdict::Apart => "APART: ",
            CameraVerdict::Unchecked => "unchecked: ",
        };
        rows.push(vec![
            camera.name.clone(),
            format!("{:.0}", camera.watched_s),
            output::number(camera.turn_mrad, 2),
            output::number(camera.turn_sd_mrad, 2),
            camera.evidence.map_or_else(|| "-".to_owned(), |power| format!("10^{power:.1}")),
            format!("{verdict}{}", camera.why),
        ]);
    }
    format!(
        "{}\n\nThe evidence is how many times more likely the lines are by a camera's having been \
         moved: 10^3 and more is sure.",
        output::table(&rows)
    )
}
