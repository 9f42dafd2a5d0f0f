//! Scenario folders of the format `passive-bearings/1`: time-stamped bearings
//! of many cameras with clutter and missed detections, with truth.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pose};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, Channel, ClockSource,
    ImageTrackState, Key, Payload, SiteName, Timestamp, TrueState, TruthFrame,
    Vector3 as WireVector,
};
use crossfix_recording::Entry;
use nalgebra::{Matrix3, Point3, Vector3};
use serde::Deserialize;

use crate::import::{imported, read_text};
use crate::scenario::{DetectionRow, ExposureRow, FORMAT, TruthRow, turned};

#[derive(Debug, Deserialize)]
struct Scenario {
    format: String,
    /// When to score; with none, whenever there is truth.
    #[serde(default)]
    epochs_s: Vec<f64>,
    cameras: Vec<ScenarioCamera>,
}

#[derive(Debug, Deserialize)]
#[allow(non_snake_case)]
struct ScenarioCamera {
    id: u32,
    pos: [f64; 3],
    R_world_from_cam: [[f64; 3]; 3],
}

fn read_csv<T: serde::de::DeserializeOwned>(path: &Path) -> anyhow::Result<Vec<T>> {
    csv::Reader::from_path(path)
        .and_then(|mut reader| reader.deserialize().collect())
        .with_context(|| format!("cannot read {}", path.display()))
}

fn name_of(id: u32) -> anyhow::Result<CameraName> {
    Ok(format!("cam{id}").parse()?)
}

/// Reads a scenario: calibrations, bearings of every exposure, truth at the scoring times.
pub fn read(dir: &Path) -> anyhow::Result<Vec<Entry>> {
    let description = dir.join("scenario.json");
    let scenario: Scenario = serde_json::from_str(&read_text(&description)?)
        .with_context(|| format!("{} is no scenario", description.display()))?;
    ensure!(
        scenario.format == FORMAT,
        "{}: format `{}` is not `{FORMAT}`",
        description.display(),
        scenario.format
    );
    let site: SiteName = "scenario".parse()?;
    let (mut entries, mut cameras) = (Vec::new(), BTreeSet::new());
    for camera in &scenario.cameras {
        ensure!(
            cameras.insert(camera.id),
            "{}: two cameras have the id {}",
            description.display(),
            camera.id
        );
        entries.push(calibration(&site, camera)?);
    }
    entries.extend(
        bearings(dir, &site, &cameras)
            .with_context(|| format!("the tables of {} do not agree", dir.display()))?,
    );
    entries.extend(truth(dir, &site, &scenario)?);
    Ok(entries)
}

/// A calibration with a substitute lens, as the format has none: one that sees everything the
/// camera reports, 1000 pixels per radian.
fn calibration(site: &SiteName, camera: &ScenarioCamera) -> anyhow::Result<Entry> {
    let name = name_of(camera.id)?;
    let rows = Matrix3::from(camera.R_world_from_cam).transpose();
    // The format's x and y axes point left and up, an image's right and down.
    let axes = rows * Matrix3::from_diagonal(&Vector3::new(-1.0, -1.0, 1.0));
    let pose = Pose::new(axes, Point3::from(camera.pos))
        .with_context(|| format!("camera {}", camera.id))?;
    let intrinsics = Intrinsics {
        size: ImageSize { width: 4000, height: 3000 },
        fx: 1000.0,
        fy: 1000.0,
        cx: 1999.5,
        cy: 1499.5,
        distortion: Distortion::None,
    };
    // The format's poses are exact, so their deviations are zero.
    let message = CameraCalibration::new(&name, &Camera::new(intrinsics, pose)?, Timestamp::EPOCH)
        .with_pose_sd(0.0, 0.0);
    Ok(imported(
        Key::new(site.clone(), Channel::Calibration(name)),
        Timestamp::EPOCH,
        message.encode(),
    ))
}

/// The bearings of all exposures. The tables must agree: half a table is no scenario.
fn bearings(dir: &Path, site: &SiteName, cameras: &BTreeSet<u32>) -> anyhow::Result<Vec<Entry>> {
    let mut detections: BTreeMap<(u32, u64), Vec<DetectionRow>> = BTreeMap::new();
    for row in read_csv::<DetectionRow>(&dir.join("detections.csv"))? {
        ensure_possible(&row)
            .with_context(|| format!("detections.csv, camera {}, scan {}", row.cam, row.scan))?;
        detections.entry((row.cam, row.scan)).or_default().push(row);
    }
    let (mut entries, mut seen) = (Vec::new(), BTreeSet::new());
    for row in read_csv::<ExposureRow>(&dir.join("exposures.csv"))? {
        let ExposureRow { t, cam, scan, n } = row;
        let own = detections.remove(&(cam, scan)).unwrap_or_default();
        let of = format!("exposures.csv, camera {cam}, scan {scan}");
        ensure!(cameras.contains(&cam), "{of}: scenario.json has no such camera");
        ensure!(t.is_finite(), "{of}: t is {t}");
        ensure!(seen.insert((cam, scan)), "{of}: it is there twice");
        if let Some(n) = n {
            ensure!(n == own.len(), "{of}: n is {n}, and detections.csv has {} rows", own.len());
        }
        let other = own.iter().filter_map(|row| row.t).find(|own| (own - t).abs() > SAME_S);
        if let Some(other) = other {
            bail!("{of}: t is {t}, and {other} in detections.csv");
        }
        entries.push(exposure(site, &row, own.iter().map(track).collect())?);
    }
    if let Some((cam, scan)) = detections.keys().next() {
        bail!("detections.csv, camera {cam}, scan {scan}: exposures.csv has no such row");
    }
    Ok(entries)
}

/// Times that differ by less are the same, s: tables may hold six digits behind the point. With half
/// of it the same.
const SAME_S: f64 = 1e-5;

fn ensure_possible(row: &DetectionRow) -> anyhow::Result<()> {
    let &DetectionRow { ux, uy, uz, sigma_rad, .. } = row;
    let length = Vector3::new(ux, uy, uz).norm();
    ensure!((length - 1.0).abs() < 1e-3, "ux, uy, uz have the length {length}, and not 1");
    ensure!(
        sigma_rad > 0.0 && sigma_rad < 0.5,
        "sigma_rad is {sigma_rad}: it must be above 0 and below 0.5 rad"
    );
    Ok(())
}

fn track(row: &DetectionRow) -> BearingTrack {
    let direction: WireVector = turned(Vector3::new(row.ux, row.uy, row.uz)).into();
    BearingTrack {
        // The detections of a scan are not tracks: each gets a number that is not used again in the
        // next scan.
        track_id: row.scan.wrapping_mul(1000).wrapping_add(row.det),
        bearing: Some(direction),
        covariance_xx: row.sigma_rad.powi(2),
        covariance_yy: row.sigma_rad.powi(2),
        score: 1.0,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    }
}

/// The message of one exposure.
fn exposure(
    site: &SiteName,
    row: &ExposureRow,
    detections: Vec<BearingTrack>,
) -> anyhow::Result<Entry> {
    let name = name_of(row.cam)?;
    let time = Timestamp::from_seconds(row.t);
    let frame = BearingFrame {
        camera: name.to_string(),
        sequence: row.scan,
        capture_time_ns: time.nanos(),
        clock_source: ClockSource::Simulated.into(),
        tracks: detections,
        ..Default::default()
    };
    let key = Key::new(site.clone(), Channel::Bearings(name));
    Ok(imported(key, time, frame.encode()))
}

fn truth(dir: &Path, site: &SiteName, scenario: &Scenario) -> anyhow::Result<Vec<Entry>> {
    let epochs: BTreeSet<Timestamp> =
        scenario.epochs_s.iter().map(|&t| Timestamp::from_seconds(t)).collect();
    let mut frames: BTreeMap<Timestamp, Vec<TrueState>> = BTreeMap::new();
    let mut is_empty = true;
    for row in read_csv::<TruthRow>(&dir.join("truth.csv"))? {
        let TruthRow { t, id, x, y, z, vx, vy, vz } = row;
        ensure!(
            [t, x, y, z, vx, vy, vz].iter().all(|number| number.is_finite()),
            "truth.csv, target {id} at {t}: a number is not finite"
        );
        is_empty = false;
        let time = Timestamp::from_seconds(t);
        if epochs.is_empty() || epochs.contains(&time) {
            frames.entry(time).or_default().push(TrueState {
                id,
                position: Some(WireVector { x, y, z }),
                velocity: Some(WireVector { x: vx, y: vy, z: vz }),
            });
        }
    }
    ensure!(
        is_empty || !frames.is_empty(),
        "no row of truth.csv is at one of the times of epochs_s in scenario.json"
    );
    let key = Key::new(site.clone(), Channel::Truth);
    let entries = frames.into_iter().map(|(time, targets)| {
        let frame = TruthFrame { time_ns: time.nanos(), targets, ..Default::default() };
        imported(key.clone(), time, frame.encode())
    });
    Ok(entries.collect())
}
