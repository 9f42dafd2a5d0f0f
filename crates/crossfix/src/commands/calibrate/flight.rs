use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use crossfix_calibration::{
    CalibratedCamera, CameraLabels, FlightLog, FlightResult, Label, LensFreedom, SiteCalibration,
    Survey, SurveyedLandmark, calibrate_flight,
};
use crossfix_geometry::{Intrinsics, Pixel};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, Channel, ImageTrackState, Timestamp,
};

use super::beside_survey::BesideSurvey;
use super::cost::Cost;
use super::hold_out::{HeldOut, HoldOut};
use super::log::{self, LogHeight, LogKind, LogReading, LogTime};
use super::remarks::{self, Rests};
use super::report::OfSite;
use super::survey::{self, Distance};
use super::{Lens, clicks, compare, picture, plots, report};
use crate::calibrated;
use crate::commands::anchor::AnchorArg;
use crate::commands::examples;
use crate::commands::numbers;
use crate::output::{self, Draft};
use crate::recorded::{self, Lacks};

/// From the flight of one target: with the log of its own receiver, with where cameras stand, or
/// with landmarks in their pictures.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix calibrate flight REC.mcap --log drone.csv --log-kind rtk -o my-site/calibration.toml",
    "crossfix calibrate flight REC.mcap --positions survey.csv -o my-site/calibration.toml",
    "crossfix calibrate flight REC.mcap --landmarks points.csv -o my-site/calibration.toml",
]))]
pub struct Args {
    /// The recording (MCAP) of what the cameras saw.
    recording: PathBuf,
    /// Where the target was by its own receiver: a CSV with time_s and east_m, north_m, up_m, or
    /// latitude_deg, longitude_deg, height_m; or GPX; or NMEA. For a log in degrees the site's
    /// origin is its first position, unless --anchor says otherwise.
    #[arg(
        long,
        value_name = "FILE",
        required_unless_present_any = ["positions", "distance", "landmarks", "prior"]
    )]
    log: Option<PathBuf>,
    #[command(flatten)]
    origin: AnchorArg,
    /// What the log's times are: as in the file, or GPS's, which are 18 s ahead of UTC.
    #[arg(long, default_value = "file", value_enum, value_name = "TIME")]
    time: LogTime,
    /// What the log's heights count from, where they are beside degrees.
    #[arg(long, default_value = "ellipsoid", value_enum, value_name = "FROM")]
    height: LogHeight,
    /// How far the sea is above the WGS84 ellipsoid there, m, where the log does not say (with
    /// --height sea).
    #[arg(
        long,
        value_name = "METRES",
        value_parser = numbers::height_difference,
        allow_hyphen_values = true
    )]
    geoid: Option<f64>,
    /// Height of the receiver above what cameras see as the target's centre, m.
    #[arg(
        long,
        default_value_t = 0.0,
        value_name = "METRES",
        value_parser = numbers::height_difference,
        allow_hyphen_values = true
    )]
    antenna: f64,
    /// Where cameras stand: a CSV with camera, east_m, north_m, up_m, sd_m. Two positions determine
    /// the size of the site, three also where it is. With them no log is needed, and anything that
    /// flew will do.
    #[arg(long, value_name = "FILE")]
    positions: Option<PathBuf>,
    /// Measured distance between two cameras, as in north,east,79.3 (m, to 5 cm). May be repeated.
    #[arg(long, value_name = "A,B,METRES")]
    distance: Vec<Distance>,
    /// What was clicked in the cameras' pictures: a CSV with camera, landmark, x_px, y_px, east_m,
    /// north_m, up_m, sd_m; or latitude_deg, longitude_deg, height_m; or azimuth_deg, elevation_deg
    /// of the sun and stars. Of the same name is the same thing.
    #[arg(long, value_name = "FILE")]
    landmarks: Option<PathBuf>,
    /// An earlier calibration (TOML) of the site: its poses and lenses, with their uncertainties,
    /// are the starting point, and the site as a whole stays where it says. Anything that flew will
    /// do. The differences are printed.
    #[arg(
        long,
        value_name = "FILE",
        conflicts_with_all = ["log", "positions", "distance", "landmarks", "lens"]
    )]
    prior: Option<PathBuf>,
    /// How good the log is.
    #[arg(long, default_value = "consumer", value_enum, value_name = "KIND")]
    log_kind: LogKind,
    /// Standard deviation of each position in the log, m per axis; by default by --log-kind.
    #[arg(long, value_name = "METRES", value_parser = numbers::sd_metres)]
    log_sd: Option<f64>,
    /// Standard deviation of the error that the log has as a whole and that drifts over minutes, m
    /// per axis; by default by --log-kind.
    #[arg(long, value_name = "METRES", value_parser = numbers::metres_or_none)]
    log_drift: Option<f64>,
    /// Use what a camera saw only from this time on, s by its own clock, as in north=151.
    #[arg(long, value_name = "CAMERA=SECONDS")]
    from: Vec<CameraTime>,
    /// Use what a camera saw only until this time, s by its own clock.
    #[arg(long, value_name = "CAMERA=SECONDS")]
    to: Vec<CameraTime>,
    /// Which parameters of the lenses may differ from their files.
    #[arg(long, default_value = "all", value_enum, value_name = "WHAT")]
    lens: Lens,
    /// The calibration (TOML) to write.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// Draw how each camera's labels lie beside the flight into this folder (SVG).
    #[arg(long, value_name = "FOLDER")]
    plots: Option<PathBuf>,
    /// Write cameras, flight, log and labels as a picture for Rerun (.rrd).
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
    /// Calibrate by one part of the recording, and fuse the other by that: what it is worth.
    #[arg(long, value_enum, value_name = "PART", conflicts_with_all = ["from", "to"])]
    hold_out: Option<HoldOut>,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let log = args.log.as_deref().map(|path| log::read(path, &args.reading())).transpose()?;
    let prior = args.prior.as_deref().map(calibrated::load).transpose()?;
    let RecordedLabels { mut cameras, is_corrected } =
        seen(&args.recording, args.lens.into(), prior.as_ref())?;
    ensure!(
        args.hold_out.is_none() || !is_corrected,
        "--hold-out needs a recording that was made without a calibration"
    );
    args.cut(&mut cameras)?;
    let names: Vec<CameraName> = cameras.iter().map(|camera| camera.name.clone()).collect();
    let landmarks = landmarks(args, &cameras)?;
    let positions = args.positions.as_deref();
    let surveyed = survey::read(positions, &args.distance, landmarks, &names, "the recording")?;
    let survey = match &prior {
        Some(prior) => surveyed.clone().with_known(prior.clone()),
        None => surveyed.clone(),
    };
    let mut result = calibrate_flight(&cameras, log.as_ref(), &survey)?;
    let held_out = args.hold_out.map(|which| HeldOut::take_out(which, &result, &mut cameras));
    if held_out.is_some() {
        result = calibrate_flight(&cameras, log.as_ref(), &survey)?;
    }
    let believed = report::without_wrong(&result);
    let worth = held_out
        .map(|part| part.fused(&args.recording, SiteCalibration::from(&believed), log.as_ref()))
        .transpose()?;
    let rests = rests(&result, log.as_ref(), &survey);
    for (camera, why) in &result.refused {
        tracing::warn!("camera `{camera}` is not calibrated: it {why}");
    }
    let beside = BesideSurvey::of(&believed, &surveyed);
    let is_contradicted = beside.contradicts();
    let of_site = OfSite {
        survey: beside,
        cost: Cost::of(&believed),
        held_out: worth,
        beside_prior: prior
            .and_then(|prior| compare::difference(&prior, &SiteCalibration::from(&believed))),
    };
    let figures = report::figures(&result, of_site, rests);
    if args.json {
        output::json(&figures)?;
    } else {
        output::line(report::render(&result, &figures));
    }
    // A picture that cannot be drawn must not prevent the calibration from being written.
    let drawn = args.draw(&result);
    ensure!(
        !is_contradicted,
        "nothing is written: most surveyed places lie beside where the flight has them"
    );
    take_out_wrong(&mut result)?;
    args.write(&result)?;
    drawn
}

/// What determines the size and position of the calibrated site.
fn rests(result: &FlightResult, log: Option<&FlightLog>, survey: &Survey) -> Rests {
    let calibrated: Vec<&CameraName> = result.cameras.iter().map(|camera| &camera.name).collect();
    if log.is_none() || survey.determines_size(&calibrated) {
        Rests::OnSurvey
    } else {
        Rests::OnLogAlone
    }
}

/// Removes wrong cameras from a calibration, and refuses one that is wrong as a whole.
fn take_out_wrong(result: &mut FlightResult) -> anyhow::Result<()> {
    ensure!(
        !remarks::most_lie_beside(&result.landmarks),
        "nothing is written: most landmarks lie beside where the flight has them"
    );
    let wrong = report::take_out_wrong(result);
    for wrong in &wrong {
        tracing::warn!("camera `{wrong}` is wrong and is not written");
    }
    ensure!(!result.cameras.is_empty(), "nothing is written: each camera is wrong");
    // The wrong cameras share the log and the fitted trajectory with the others.
    ensure!(
        wrong.len() <= result.cameras.len(),
        "nothing is written: most cameras are wrong, so the log or the survey is hardly of this \
         flight"
    );
    Ok(())
}

impl Args {
    /// How the log is to be read.
    fn reading(&self) -> LogReading {
        let mut errors = self.log_kind.errors();
        errors.sd_m = self.log_sd.unwrap_or(errors.sd_m);
        errors.drift_sd_m = self.log_drift.unwrap_or(errors.drift_sd_m);
        LogReading {
            errors,
            anchor: self.origin.anchor,
            is_gps_time: self.time == LogTime::Gps,
            height: self.height,
            geoid_m: self.geoid,
            antenna_m: self.antenna,
        }
    }

    /// Restricts what cameras saw to the times that were asked for.
    fn cut(&self, cameras: &mut [CameraLabels]) -> anyhow::Result<()> {
        for CameraTime { camera, time_s } in &self.from {
            cut(cameras, camera, |label| label.time_s >= *time_s)?;
        }
        for CameraTime { camera, time_s } in &self.to {
            cut(cameras, camera, |label| label.time_s < *time_s)?;
        }
        Ok(())
    }

    fn inputs(&self) -> Vec<&Path> {
        let files = [
            Some(&self.recording),
            self.log.as_ref(),
            self.positions.as_ref(),
            self.landmarks.as_ref(),
            self.prior.as_ref(),
        ];
        files.into_iter().flatten().map(PathBuf::as_path).collect()
    }

    fn draw(&self, result: &FlightResult) -> anyhow::Result<()> {
        if let Some(folder) = &self.plots {
            let sheets = plots::of_flight(result, folder)?;
            tracing::info!("{sheets} sheets drawn in {}", folder.display());
        }
        if let Some(path) = &self.save {
            let draft = Draft::new(path, &self.inputs())?;
            picture::draw(result, draft.path())?;
            draft.keep()?;
            tracing::info!(
                "picture written to {0}; look at it with: rerun --bind 127.0.0.1 {0}",
                path.display()
            );
        }
        Ok(())
    }

    fn write(&self, result: &FlightResult) -> anyhow::Result<()> {
        let inputs = self.inputs();
        let from: Vec<String> = inputs.iter().map(|path| path.display().to_string()).collect();
        let text = format!(
            "# Written by crossfix calibrate flight from {}.\n{}",
            from.join(" and "),
            SiteCalibration::from(result).to_toml()
        );
        output::write_file(&self.output, &inputs, text.as_bytes())?;
        if !self.json {
            output::line(format!("\nwritten to {}", self.output.display()));
        }
        Ok(())
    }
}

/// Landmarks clicked in the pictures of the recording's cameras.
fn landmarks(args: &Args, cameras: &[CameraLabels]) -> anyhow::Result<Vec<SurveyedLandmark>> {
    let Some(path) = &args.landmarks else { return Ok(Vec::new()) };
    let clicked = clicks::read(path, None, args.origin.anchor)?;
    for (name, landmarks) in &clicked {
        if let Some(camera) = cameras.iter().find(|camera| camera.name == *name) {
            clicks::check(landmarks, camera.intrinsics.size)
                .with_context(|| format!("camera `{name}`"))?;
        }
    }
    clicks::together(clicked)
}

/// A time by a camera's own clock, s.
#[derive(Clone, Debug)]
struct CameraTime {
    camera: CameraName,
    time_s: f64,
}

impl std::str::FromStr for CameraTime {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (camera, time_s) =
            text.split_once('=').ok_or("a camera and a time are wanted, as in north=151")?;
        let camera = camera.parse().map_err(|error| format!("{error}"))?;
        let time_s = time_s.parse::<f64>().ok().filter(|time_s| time_s.is_finite());
        Ok(Self { camera, time_s: time_s.ok_or("the time is no number of seconds")? })
    }
}

/// Keeps the labels of a camera that satisfy `fits`.
fn cut(
    cameras: &mut [CameraLabels],
    name: &CameraName,
    fits: impl Fn(&Label) -> bool,
) -> anyhow::Result<()> {
    let camera = cameras.iter_mut().find(|camera| camera.name == *name);
    let camera = camera.with_context(|| format!("the recording has no camera `{name}`"))?;
    camera.labels.retain(fits);
    ensure!(!camera.labels.is_empty(), "of camera `{name}` nothing is left between those times");
    Ok(())
}

/// Labels from a recording.
struct RecordedLabels {
    cameras: Vec<CameraLabels>,
    /// Whether its times are common times, corrected by a calibration.
    is_corrected: bool,
}

/// What a recording's cameras saw, by their own clocks. If it was made with a calibration, that
/// must be `prior`, whose lenses are also the starting values.
fn seen(
    recording: &Path,
    freedom: LensFreedom,
    prior: Option<&SiteCalibration>,
) -> anyhow::Result<RecordedLabels> {
    let known = |name: &CameraName| prior.and_then(|site| site.camera(name));
    let described = described(recording)?;
    for name in described.iter().filter(|(_, camera)| camera.is_on_mount).map(|(name, _)| name) {
        tracing::warn!(
            "camera `{name}` is on a mount and is left out: a flight calibrates cameras that stand \
             still"
        );
    }
    for (name, described) in &described {
        described.check_against(known(name)).with_context(|| {
            format!("the bearings of camera `{name}` in {}", recording.display())
        })?;
    }
    let mut labels_of: BTreeMap<CameraName, Vec<Label>> = BTreeMap::new();
    let mut lacks = Lacks::default();
    recorded::for_each(recording, &mut lacks, |lacks, entry| {
        if let Channel::Bearings(name) = &entry.key.channel
            && described.get(name).is_none_or(|camera| !camera.is_on_mount)
            && let Some(frame) = lacks.read::<BearingFrame>(&entry.data)
        {
            let is_corrected = described.get(name).is_some_and(|camera| camera.is_corrected);
            let time = match known(name).filter(|_| is_corrected) {
                Some(camera) => calibrated::own_time(&frame, camera),
                None => Timestamp::from_nanos(frame.capture_time_ns),
            };
            let measured = measured(&frame, time.seconds());
            labels_of.entry(name.clone()).or_default().extend(measured);
        }
        Ok(())
    })?;
    lacks.say(recording);
    lacks.ensure_found(!labels_of.is_empty(), "bearings", recording)?;
    let mut cameras = Vec::new();
    for (name, mut labels) in labels_of {
        let of_file = described.get(&name).map(|camera| camera.lens).with_context(|| {
            format!("{} says nothing of the lens of camera `{name}`", recording.display())
        })?;
        let of_prior = known(&name).map(|camera| *camera.camera.model().intrinsics());
        let intrinsics = of_prior.unwrap_or(of_file);
        let size = intrinsics.size;
        labels.retain(|label| {
            (0.0..=f64::from(size.width)).contains(&label.pixel.x())
                && (0.0..=f64::from(size.height)).contains(&label.pixel.y())
        });
        labels.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
        cameras.push(CameraLabels { name, intrinsics, freedom, labels });
    }
    ensure!(!cameras.is_empty(), "{} holds no camera's bearings", recording.display());
    Ok(RecordedLabels {
        cameras,
        is_corrected: described.values().any(|camera| camera.is_corrected),
    })
}

/// A recording's description of one camera.
struct RecordedCamera {
    lens: Intrinsics,
    /// Whether its times are common times ([`CameraCalibration::corrects_clock`]).
    is_corrected: bool,
    /// Whether the camera is on a mount.
    is_on_mount: bool,
}

impl RecordedCamera {
    fn of(name: &CameraName, message: &CameraCalibration) -> anyhow::Result<Self> {
        Ok(Self {
            lens: message.lens(name)?,
            is_corrected: message.corrects_clock(),
            is_on_mount: message.mount.is_some(),
        })
    }

    /// Checks that an earlier calibration has the same image size, and that it is the one that the
    /// bearings were made with, if they were made with any.
    fn check_against(&self, known: Option<&CalibratedCamera>) -> anyhow::Result<()> {
        let of_prior = known.map(|camera| camera.camera.model().intrinsics());
        if let Some(lens) = of_prior {
            ensure!(
                lens.size == self.lens.size,
                "have {:?} pixels, and --prior is of {:?}",
                self.lens.size,
                lens.size
            );
        }
        ensure!(
            !self.is_corrected || of_prior.is_some_and(|lens| *lens == self.lens),
            "were made with a calibration, which is not that of --prior: \
             give that with which they were made"
        );
        Ok(())
    }
}

/// Descriptions of a recording's cameras, by the first calibration message of each.
fn described(recording: &Path) -> anyhow::Result<BTreeMap<CameraName, RecordedCamera>> {
    let mut cameras: BTreeMap<CameraName, RecordedCamera> = BTreeMap::new();
    recorded::for_each(recording, &mut Lacks::default(), |lacks, entry| {
        if let Channel::Calibration(name) = &entry.key.channel
            && !cameras.contains_key(name)
            && let Some(message) = lacks.read::<CameraCalibration>(&entry.data)
        {
            cameras.insert(name.clone(), RecordedCamera::of(name, &message)?);
        }
        Ok(())
    })?;
    Ok(cameras)
}

/// The targets that a frame measured, with its time by the camera's own clock.
fn measured(frame: &BearingFrame, time_s: f64) -> impl Iterator<Item = Label> + '_ {
    let measured = frame.tracks.iter().filter(|track| is_measured(track));
    let pixel = |track: &BearingTrack| Pixel::new(track.pixel_x, track.pixel_y);
    measured.map(move |track| Label { time_s, pixel: pixel(track) })
}

fn is_measured(track: &BearingTrack) -> bool {
    track.state() == ImageTrackState::Tracking
        && track.pixel_x.is_finite()
        && track.pixel_y.is_finite()
}
