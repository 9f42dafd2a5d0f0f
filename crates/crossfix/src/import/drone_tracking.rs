//! The drone-tracking-datasets (ETH Zurich): labels of the drone's centre in
//! several unsynchronised cameras, with RTK truth, and poses and clocks fitted
//! to a calibration part.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use crossfix_geometry::{
    Bearing, Camera, CameraModel, Distortion, GeometryError, ImageSize, Intrinsics, Pixel, Pose,
};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, Channel, ClockSource, Key, Payload,
    SiteName, Timestamp, TrueState, TruthFrame,
};
use crossfix_recording::Entry;
use nalgebra::{Matrix2, Matrix3, Point3, Vector3};
use serde::Deserialize;

use crate::import::{imported, labelled, read_text};

/// Frame rate to which the published synchronisation refers, Hz.
const SYNC_RATE: f64 = 59.94006;
/// Rate of the RTK samples, Hz.
const RTK_RATE: f64 = 5.0;

/// Standard deviation of the fitted camera positions, m per axis: the poses' residual is declared
/// as their rotation's, and refitted centres of the same cameras agree to 3 to 7 cm (the data's
/// README). With half of it those would be up to three SDs apart.
const FITTED_POSITION_SD_M: f64 = 0.05;

/// What to read.
pub struct LabelSelection<'a> {
    pub dataset: u32,
    pub cameras: &'a [String],
    pub split: &'a str,
    pub part: SplitPart,
    /// Data as the cameras recorded them: times by their own counts of frames, lenses by their
    /// files, no poses.
    pub is_raw: bool,
}

/// A part of a split.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum SplitPart {
    /// That to which the poses of poses.json were fitted.
    Calibration,
    /// The rest.
    Test,
    /// Both.
    All,
}

/// What was read from the data set.
pub struct ImportedFlight {
    pub entries: Vec<Entry>,
    /// The drone's positions by RTK, errors included.
    pub log: Vec<RtkSample>,
}

/// Standard deviation of a raw label, pixels, as found for these cameras. It is only stated where
/// the cameras have not been calibrated. With half of it labels state half of their error.
const RAW_LABEL_SD_PX: f64 = 1.0;

/// Time over which the drone's angular rate is measured, s: with a frame's it would be the labels'
/// noise, with a second's the drone's turns would be lost.
const RATE_OVER_S: f64 = 0.2;
/// Frame rates that a camera may have, frames per second: beyond these a file is broken. With half
/// of the greatest the same.
const FRAME_RATES: std::ops::RangeInclusive<f64> = 1.0..=1000.0;
/// Largest rate of a camera's clock against true time, s/s: beyond it a file is broken. With half
/// of it the same, as real clocks are off by 1e-4 at most.
const MOST_CLOCK_RATE: f64 = 0.1;
/// Largest standard deviation of a clock, s: one of which nothing is known. With half of it such a
/// clock would seem to be known to half a second.
const MOST_CLOCK_SD_S: f64 = 1.0;

#[derive(Debug, Deserialize)]
struct Split {
    calibration_rtk_index_ranges: Vec<[f64; 2]>,
    test_rtk_index_ranges: Vec<[f64; 2]>,
    cameras: BTreeMap<String, FittedCamera>,
}

#[derive(Debug, Deserialize)]
#[allow(non_snake_case)]
struct FittedCamera {
    name: String,
    R_world_to_cam: [[f64; 3]; 3],
    centre_enu_m: [f64; 3],
    clock_offset_s: f64,
    clock_rate: f64,
    readout_fraction_of_frame: f64,
    residual_sigma_rad: f64,
    sync_alpha: Option<f64>,
    sync_beta: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct LensFile {
    #[serde(rename = "K-matrix")]
    k: [[f64; 3]; 3],
    #[serde(rename = "distCoeff")]
    distortion: Vec<f64>,
    fps: f64,
    resolution: [u32; 2],
}

/// One row of a label file: a frame, and the drone's pixel if the drone is in it.
struct ImportedLabel {
    frame: u64,
    pixel: Option<Pixel>,
}

impl FittedCamera {
    /// RTK time, s, of a frame whose target lies at a fraction of the image's height.
    fn rtk_seconds(&self, frame: u64, height_fraction: f64, fps: f64) -> f64 {
        let own = match (self.sync_alpha, self.sync_beta) {
            (Some(alpha), Some(beta)) => (frame as f64 - beta) / alpha / SYNC_RATE,
            _ => frame as f64 / fps,
        };
        let readout = self.readout_fraction_of_frame * height_fraction / fps;
        (own - self.clock_offset_s + readout) * (1.0 + self.clock_rate)
    }

    fn camera(&self, intrinsics: Intrinsics) -> anyhow::Result<Camera> {
        // nalgebra's `From` takes columns, so the rows are transposed.
        let camera_from_world = Matrix3::from(self.R_world_to_cam).transpose();
        let pose = Pose::new(camera_from_world.transpose(), Point3::from(self.centre_enu_m))?;
        Ok(Camera::new(intrinsics, pose)?)
    }
}

impl LensFile {
    fn intrinsics(&self) -> anyhow::Result<Intrinsics> {
        let mut coefficients = self.distortion.clone();
        coefficients.resize(5, 0.0);
        let [k1, k2, p1, p2, k3] = coefficients[..] else {
            bail!("distCoeff has more than five coefficients");
        };
        Ok(Intrinsics {
            size: ImageSize { width: self.resolution[0], height: self.resolution[1] },
            fx: self.k[0][0],
            fy: self.k[1][1],
            cx: self.k[0][2],
            cy: self.k[1][2],
            distortion: Distortion::BrownConrady([k1, k2, p1, p2, k3]),
        })
    }
}

impl Split {
    /// Time from the first to the last instant that poses and clocks were fitted to, s.
    fn fitted_over_s(&self) -> f64 {
        let ranges = || self.calibration_rtk_index_ranges.iter().flatten().copied();
        let first = ranges().fold(f64::INFINITY, f64::min);
        let last = ranges().fold(f64::NEG_INFINITY, f64::max);
        (last - first).max(0.0) / RTK_RATE
    }
}

impl SplitPart {
    fn holds(self, split: &Split, rtk_seconds: f64) -> bool {
        let index = rtk_seconds * RTK_RATE;
        let within =
            |ranges: &[[f64; 2]]| ranges.iter().any(|[low, high]| (*low..*high).contains(&index));
        let (calibration, test) =
            (&split.calibration_rtk_index_ranges, &split.test_rtk_index_ranges);
        match self {
            Self::Calibration => within(calibration),
            Self::Test => within(test),
            Self::All => within(calibration) || within(test),
        }
    }
}

/// The lens file of a camera: two of the cameras were used with two settings.
fn lens_path(dir: &Path, name: &str, dataset: u32) -> PathBuf {
    let file = match (name, dataset) {
        ("sonyG", 1 | 2) => "sonyG_1",
        ("sonyG", _) => "sonyG_2",
        ("mate10", 3) => "mate10_1",
        ("mate10", _) => "mate10_2",
        _ => name,
    };
    dir.join("calibration").join(name).join(format!("{file}.json"))
}

fn parse_json<T: serde::de::DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    serde_json::from_str(&read_text(path)?)
        .with_context(|| format!("{} is not as expected", path.display()))
}

/// Reads a part of a split: calibrations, bearings of every frame, truth.
pub fn read(dir: &Path, selection: &LabelSelection<'_>) -> anyhow::Result<ImportedFlight> {
    let site: SiteName = format!("drone-tracking-{}", selection.dataset).parse()?;
    let poses = dir.join("poses.json");
    let mut all: BTreeMap<String, serde_json::Value> = parse_json(&poses)?;
    let mut dataset = all
        .remove(&selection.dataset.to_string())
        .with_context(|| format!("{} has no data set {}", poses.display(), selection.dataset))?;
    let masked: Vec<f64> = serde_json::from_value(dataset["rtk_masked_indices"].take())?;
    let split: Split =
        serde_json::from_value(dataset[selection.split].take()).with_context(|| {
            format!("{} has no split `{}` of the expected form", poses.display(), selection.split)
        })?;

    let folder = dir.join(format!("dataset{}", selection.dataset));
    let is_wanted = |rtk_seconds: f64| selection.part.holds(&split, rtk_seconds);
    let rtk = rtk_samples(&folder.join("trajectory").join("rtk.txt"))?;
    let log = rtk.iter().copied().filter(|sample| is_wanted(sample.time_s)).collect();
    let mut entries = truth(&rtk, &masked, &site, is_wanted);
    let mut seen = BTreeSet::new();
    for wanted in selection.cameras {
        ensure!(seen.insert(wanted), "camera `{wanted}` is named twice");
        let found = split.cameras.iter().find(|(_, camera)| camera.name == *wanted);
        let Some((key, fitted)) = found else {
            let known: Vec<&str> = split.cameras.values().map(|c| c.name.as_str()).collect();
            bail!(
                "no camera `{wanted}` in data set {}: there are {}",
                selection.dataset,
                known.join(", ")
            );
        };
        let lens_path = lens_path(dir, wanted, selection.dataset);
        let lens: LensFile = parse_json(&lens_path)?;
        let is_possible =
            FRAME_RATES.contains(&lens.fps) && fitted.clock_rate.abs() < MOST_CLOCK_RATE;
        ensure!(
            is_possible,
            "camera `{wanted}`: {} frames a second ({}), or a clock that gains {} s a second, are \
             none",
            lens.fps,
            lens_path.display(),
            fitted.clock_rate
        );
        let labels = read_labels(&folder.join("detections").join(format!("{key}.txt")))?;
        let (fitted_over_s, is_raw) = (split.fitted_over_s(), selection.is_raw);
        let source = CameraSource { site: &site, fitted, fitted_over_s, lens: &lens, is_raw };
        entries.extend(source.entries(&labels, is_wanted)?);
    }
    Ok(ImportedFlight { entries, log })
}

fn read_labels(path: &Path) -> anyhow::Result<Vec<ImportedLabel>> {
    let text = read_text(path)?;
    let starts_with_digit = |line: &&str| line.starts_with(|c: char| c.is_ascii_digit());
    let rows = text.lines().map(str::trim).filter(starts_with_digit);
    rows.map(|row| {
        label(row).with_context(|| format!("{}: `{row}` is not `frame x y`", path.display()))
    })
    .collect()
}

/// A row of the labels, `frame x y ...`; (0, 0) says that the drone is not visible.
fn label(row: &str) -> Option<ImportedLabel> {
    let numbers: Vec<f64> = row.split_whitespace().map_while(|word| word.parse().ok()).collect();
    let [frame, x, y, ..] = numbers[..] else { return None };
    let visible = x != 0.0 || y != 0.0;
    Some(ImportedLabel { frame: frame as u64, pixel: visible.then(|| Pixel::new(x, y)) })
}

/// What is needed to read the labels of one camera.
struct CameraSource<'a> {
    site: &'a SiteName,
    fitted: &'a FittedCamera,
    /// Time over which the clock was fitted, s.
    fitted_over_s: f64,
    lens: &'a LensFile,
    is_raw: bool,
}

impl CameraSource<'_> {
    /// The camera's calibration, and its bearings of the frames whose RTK time is wanted.
    fn entries(
        &self,
        labels: &[ImportedLabel],
        is_wanted: impl Fn(f64) -> bool,
    ) -> anyhow::Result<Vec<Entry>> {
        let name: CameraName = self.fitted.name.parse()?;
        let intrinsics = self.lens.intrinsics()?;
        let model = CameraModel::new(intrinsics).with_context(|| format!("camera `{name}`"))?;
        let height = f64::from(self.lens.resolution[1]);
        let bearings = Key::new(self.site.clone(), Channel::Bearings(name.clone()));
        let clock_sd_s = if self.is_raw { 0.0 } else { self.clock_sd_s(labels, &model) };
        let mut entries = Vec::new();
        let mut without_direction = 0_u64;
        for label in labels {
            let fraction = label.pixel.map_or(0.5, |pixel| pixel.y() / height);
            let seconds = self.fitted.rtk_seconds(label.frame, fraction, self.lens.fps);
            if !is_wanted(seconds) {
                continue;
            }
            let own_s = label.frame as f64 / self.lens.fps;
            let time = Timestamp::from_seconds(if self.is_raw { own_s } else { seconds });
            let track = label.pixel.map(|pixel| bearing_track(&model, pixel, self.label_sd_rad()));
            // In the corner of a wide lens the model may have no inverse: such a label is skipped,
            // and the others are still used.
            let track = track.and_then(|track| {
                without_direction += u64::from(track.is_err());
                track.ok()
            });
            let frame = BearingFrame {
                camera: name.to_string(),
                sequence: label.frame,
                capture_time_ns: time.nanos(),
                clock_source: ClockSource::FrameCount.into(),
                capture_time_sd_s: clock_sd_s,
                tracks: track.into_iter().collect(),
                ..Default::default()
            };
            entries.push(imported(bearings.clone(), time, frame.encode()));
        }
        if without_direction > 0 {
            tracing::warn!(
                "camera `{name}`: {without_direction} labels are left out, as the lens model shows \
                 no direction at their pixels"
            );
        }
        let start = entries.iter().map(|entry| entry.data_time).min().unwrap_or_default();
        let calibration = self.calibration(&name, intrinsics, start)?;
        let key = Key::new(self.site.clone(), Channel::Calibration(name));
        entries.insert(0, imported(key, Timestamp::EPOCH, calibration.encode()));
        Ok(entries)
    }

    /// Standard deviation of the camera's times, s: the time in which the drone moves by as much as
    /// the fit's residual, as what is left there may be the clock's error as well as the pose's;
    /// and what a clock that wanders differs by from a line that is fitted to it.
    fn clock_sd_s(&self, labels: &[ImportedLabel], model: &CameraModel) -> f64 {
        let direction = |label: &ImportedLabel| model.direction(label.pixel?).ok();
        let mut squared_rates = Vec::new();
        for (index, first) in labels.iter().enumerate() {
            let seconds = |later: &ImportedLabel| {
                later.frame.saturating_sub(first.frame) as f64 / self.lens.fps
            };
            let later = labels[index..].iter().find(|later| seconds(later) >= RATE_OVER_S);
            let Some(later) = later.filter(|later| seconds(later) < 2.0 * RATE_OVER_S) else {
                continue;
            };
            if let (Some(before), Some(after)) = (direction(first), direction(later)) {
                squared_rates.push((before.angle(&after) / seconds(later)).powi(2));
            }
        }
        let rate = (squared_rates.iter().sum::<f64>() / squared_rates.len() as f64).sqrt();
        // A Brownian motion of density w differs from its regression over a time T by the variance
        // 2 w T / 15 at the ends. Beyond them the line's slope is assumed to be right, and the
        // wander goes on from there.
        let off_line_s = self.clock_wander_s() * (2.0 / 15.0 * self.fitted_over_s).sqrt();
        let clock_sd_s = (self.fitted.residual_sigma_rad / rate).hypot(off_line_s);
        // Without a rate nothing is known of the clock.
        if clock_sd_s.is_nan() { MOST_CLOCK_SD_S } else { clock_sd_s.min(MOST_CLOCK_SD_S) }
    }

    fn label_sd_rad(&self) -> f64 {
        if self.is_raw {
            RAW_LABEL_SD_PX / self.lens.k[0][0]
        } else {
            self.fitted.residual_sigma_rad
        }
    }

    fn calibration(
        &self,
        name: &CameraName,
        intrinsics: Intrinsics,
        start: Timestamp,
    ) -> anyhow::Result<CameraCalibration> {
        if self.is_raw {
            return Ok(CameraCalibration::of_lens(name, intrinsics, start)?);
        }
        let camera = self.fitted.camera(intrinsics).with_context(|| format!("camera `{name}`"))?;
        Ok(CameraCalibration::new(name, &camera, start)
            .with_pose_sd(self.fitted.residual_sigma_rad, FITTED_POSITION_SD_M)
            .with_clock_wander(self.clock_wander_s()))
    }

    /// Random wander of the camera's clock, s after one second: as if the whole rate r that was
    /// fitted came from frames that were lost, or taken twice. Each moves the clock by a frame's
    /// period p; there are r / p a second, at random (Poisson), so the variance grows by r p a
    /// second. How many of them the lens file's rate of frames contains is not known, but four
    /// times as many, or a quarter, give the same tracks to a tenth. 0.4 to 8 ms for these cameras.
    fn clock_wander_s(&self) -> f64 {
        (self.fitted.clock_rate.abs() / self.lens.fps).sqrt()
    }
}

/// # Errors
/// The lens model shows no direction at the pixel.
fn bearing_track(
    model: &CameraModel,
    pixel: Pixel,
    sigma: f64,
) -> Result<BearingTrack, GeometryError> {
    let direction = model.direction(pixel)?;
    let bearing = Bearing::new(direction.into_inner(), Matrix2::identity() * sigma.powi(2))?;
    Ok(labelled(1, &bearing, pixel))
}

/// The truth of the wanted RTK seconds, without the masked samples.
fn truth(
    rtk: &[RtkSample],
    masked: &[f64],
    site: &SiteName,
    is_wanted: impl Fn(f64) -> bool,
) -> Vec<Entry> {
    let key = Key::new(site.clone(), Channel::Truth);
    let good: Vec<RtkSample> = rtk
        .iter()
        .enumerate()
        .filter(|(row, _)| !masked.contains(&(*row as f64)))
        .map(|(_, sample)| *sample)
        .collect();
    let mut entries = Vec::new();
    for window in good.windows(3) {
        let RtkSample { time_s, place } = window[1];
        if !is_wanted(time_s) {
            continue;
        }
        let velocity = Some(velocity_between(&window[0], &window[1], &window[2]).into());
        let time = Timestamp::from_seconds(time_s);
        let state = TrueState { id: 1, position: Some(place.into()), velocity };
        let frame =
            TruthFrame { time_ns: time.nanos(), targets: vec![state], ..Default::default() };
        entries.push(imported(key.clone(), time, frame.encode()));
    }
    entries
}

/// A time and the drone's position then.
#[derive(Clone, Copy, Debug)]
pub struct RtkSample {
    pub time_s: f64,
    pub place: Point3<f64>,
}

/// The RTK samples, one of each row, in order of time.
fn rtk_samples(path: &Path) -> anyhow::Result<Vec<RtkSample>> {
    let text = read_text(path)?;
    let rows = text
        .lines()
        .map(|line| {
            line.split_whitespace().map_while(|word| word.parse().ok()).collect::<Vec<f64>>()
        })
        .filter(|row| row.len() >= 3);
    let places = rows.map(|row| {
        // Rows of four columns begin with an index.
        let offset = usize::from(row.len() > 3);
        Point3::new(row[offset], row[offset + 1], row[offset + 2])
    });
    let samples =
        places.enumerate().map(|(row, place)| RtkSample { time_s: row as f64 / RTK_RATE, place });
    Ok(samples.collect())
}

/// Velocity at the second of three samples: that of the parabola through them. With equal spacing
/// this is the difference of the outer two over the time between them.
fn velocity_between(before: &RtkSample, at: &RtkSample, after: &RtkSample) -> Vector3<f64> {
    let (back_s, on_s) = (at.time_s - before.time_s, after.time_s - at.time_s);
    let came = (at.place - before.place) / back_s;
    let goes = (after.place - at.place) / on_s;
    // v = (v_before dt_after + v_after dt_before) / (dt_before + dt_after)
    (came * on_s + goes * back_s) / (back_s + on_s)
}

#[cfg(test)]
mod tests;
