//! Writes simulated sites as scenario folders of the format `passive-bearings/1`.

use std::path::Path;

use anyhow::{Context, ensure};
use crossfix_simulation::{SimulatedSite, Site, SiteCamera};
use nalgebra::{Matrix3, Vector3};
use serde_json::json;

use crate::commands::numbers;
use crate::output::{self, Draft};
use crate::scenario::{DetectionRow, ExposureRow, FORMAT, TruthRow, turned};
use crate::shutdown::Shutdown;

/// What a generated site is made of.
#[derive(Debug, clap::Args)]
pub struct SiteArgs {
    /// How many targets fly.
    #[arg(long, default_value_t = 10, value_name = "N", requires = "scenario")]
    targets: usize,
    /// How many cameras stand about them.
    #[arg(long, default_value_t = 4, value_name = "N", requires = "scenario")]
    cameras: usize,
    /// How long it lasts, seconds.
    #[arg(
        long,
        default_value_t = 20.0,
        value_name = "S",
        requires = "scenario",
        value_parser = numbers::seconds
    )]
    seconds: f64,
    /// Exposures a second of each camera.
    #[arg(
        long,
        default_value_t = 10.0,
        value_name = "HZ",
        requires = "scenario",
        value_parser = numbers::rate
    )]
    rate_hz: f64,
    /// False bearings that an exposure brings in the mean.
    #[arg(
        long,
        default_value_t = 1.0,
        value_name = "N",
        requires = "scenario",
        value_parser = numbers::mean_count
    )]
    clutter: f64,
    /// Probability that a camera reports a target in its image.
    #[arg(
        long,
        default_value_t = 0.95,
        value_name = "P",
        requires = "scenario",
        value_parser = numbers::probability
    )]
    detection_probability: f64,
    /// Greatest rate of turn of the targets, radians a second; 0 is straight.
    #[arg(
        long,
        default_value_t = 0.0,
        value_name = "RAD_PER_S",
        requires = "scenario",
        value_parser = numbers::radians_per_second
    )]
    turn: f64,
    /// Seed of everything random.
    #[arg(long, default_value_t = 1, value_name = "N", requires = "scenario")]
    seed: u64,
}

impl SiteArgs {
    /// The site that the options describe.
    pub fn site(&self) -> Site {
        Site {
            seed: self.seed,
            duration_s: self.seconds,
            targets: self.targets,
            turn_rps: self.turn,
            cameras: self.cameras,
            rate_hz: self.rate_hz,
            detection_probability: self.detection_probability,
            false_bearings: self.clutter,
            ..Site::default()
        }
    }
}

/// A table of the scenario's folder that is complete once it is closed.
struct DraftTable {
    rows: csv::Writer<std::fs::File>,
    draft: Draft,
}

impl DraftTable {
    fn new(dir: &Path, name: &str) -> anyhow::Result<Self> {
        let draft = Draft::new(&dir.join(name), &[])?;
        let rows = csv::Writer::from_path(draft.path())
            .with_context(|| format!("cannot write {}", draft.path().display()))?;
        Ok(Self { rows, draft })
    }

    fn close(mut self) -> anyhow::Result<()> {
        self.rows.flush()?;
        self.draft.keep()
    }
}

/// Writes `detections.csv`, `exposures.csv` and `truth.csv`, each when it is whole, and at last
/// `scenario.json`; returns the number of exposures. Scoring times are those of the last camera's
/// exposures.
pub fn write(site: &SimulatedSite, dir: &Path, shutdown: &Shutdown) -> anyhow::Result<u64> {
    std::fs::create_dir_all(dir).with_context(|| format!("cannot make {}", dir.display()))?;
    let [mut detections, mut exposures, mut truth] = [
        DraftTable::new(dir, "detections.csv")?,
        DraftTable::new(dir, "exposures.csv")?,
        DraftTable::new(dir, "truth.csv")?,
    ];
    let mut epochs = Vec::new();
    for exposure in site.bearings() {
        ensure!(!shutdown.requested(), super::STOPPED);
        let (cam, scan) = (exposure.camera as u32, exposure.frame.sequence);
        // The frame's own time, rounded to a nanosecond.
        let t = exposure.frame.capture_time_ns as f64 / 1e9;
        for (det, (track, source)) in
            exposure.frame.tracks.iter().zip(&exposure.sources).enumerate()
        {
            let u = turned(track.bearing.unwrap_or_default().into());
            let truth_id = source.map_or(-1, |id| id as i64);
            let sigma_rad = track.covariance_xx.sqrt();
            detections.rows.serialize(DetectionRow {
                t: Some(t),
                cam,
                scan,
                det: det as u64,
                ux: u.x,
                uy: u.y,
                uz: u.z,
                sigma_rad,
                truth_id,
            })?;
        }
        let n = Some(exposure.frame.tracks.len());
        exposures.rows.serialize(ExposureRow { t, cam, scan, n })?;
        for target in site.truth(exposure.time_s) {
            let (p, v) = (target.position, target.velocity);
            truth.rows.serialize(TruthRow {
                t,
                id: target.id,
                x: p.x,
                y: p.y,
                z: p.z,
                vx: v.x,
                vy: v.y,
                vz: v.z,
            })?;
        }
        if exposure.camera + 1 == site.cameras().len() {
            epochs.push(t);
        }
    }
    for table in [detections, exposures, truth] {
        table.close()?;
    }
    let text = serde_json::to_string_pretty(&description(site, &epochs))?;
    output::write_file(&dir.join("scenario.json"), &[], text.as_bytes())?;
    Ok(site.exposures())
}

fn description(site: &SimulatedSite, epochs: &[f64]) -> serde_json::Value {
    let about = site.description();
    let [half_x, half_y] = about.area_m.map(|side| side / 2.0);
    let [low, high] = about.heights_m;
    let cameras: Vec<_> =
        site.cameras().iter().enumerate().map(|(id, c)| camera(id, c, about)).collect();
    json!({
        "format": FORMAT,
        "seed": about.seed,
        "tau_s": 1.0 / about.rate_hz,
        "scans": epochs.len(),
        "targets": about.targets,
        "frame": "ENU metres, right-handed, z up",
        "epochs_s": epochs,
        "volume": { "min": [-half_x, -half_y, low], "max": [half_x, half_y, high] },
        "cameras": cameras,
    })
}

fn camera(
    id: usize,
    SiteCamera { camera, phase_s, .. }: &SiteCamera,
    site: &Site,
) -> serde_json::Value {
    let pose = camera.pose();
    let axes = pose.rotation().matrix() * Matrix3::from_diagonal(&turned(Vector3::repeat(1.0)));
    let rows: Vec<Vec<f64>> = axes.row_iter().map(|row| row.iter().copied().collect()).collect();
    let position = pose.position();
    let [width, height] = site.size_px.map(|side| (f64::from(side) / (2.0 * site.focal_px)).atan());
    json!({
        "id": id,
        "pos": [position.x, position.y, position.z],
        "R_world_from_cam": rows,
        "sigma_rad": site.noise_rad,
        "pd": site.detection_probability,
        "clutter_mean": site.false_bearings,
        "clutter_window_rad": [-width, width, -height, height],
        "phase_s": phase_s,
    })
}

#[cfg(test)]
mod tests {
    use crossfix_message::{BearingFrame, CameraCalibration, Channel, TruthFrame, decode};

    use super::*;
    use crate::import::scenario;

    #[test]
    fn what_is_written_is_imported_as_it_was() {
        let dir = tempfile::tempdir().unwrap();
        let site = Site { duration_s: 1.0, targets: 5, false_bearings: 2.0, ..Site::default() }
            .build()
            .unwrap();
        assert_eq!(write(&site, dir.path(), &Shutdown::listen()).unwrap(), 120);
        let entries = scenario::read(dir.path()).unwrap();
        let mut frames = Vec::new();
        let mut truths = 0;
        for entry in &entries {
            match &entry.key.channel {
                Channel::Bearings(_) => frames.push(decode::<BearingFrame>(&entry.data).unwrap()),
                Channel::Calibration(name) => {
                    let read = decode::<CameraCalibration>(&entry.data).unwrap().parse().unwrap();
                    let ours = site.cameras().iter().find(|c| c.name == *name).unwrap();
                    let (a, b) = (read.camera.pose(), ours.camera.pose());
                    assert!((a.position() - b.position()).norm() < 1e-9);
                    assert!((a.rotation().matrix() - b.rotation().matrix()).amax() < 1e-9);
                }
                Channel::Truth => {
                    truths += 1;
                    assert_eq!(decode::<TruthFrame>(&entry.data).unwrap().targets.len(), 5);
                }
                _ => {}
            }
        }
        assert_eq!(truths, 30);
        let written: Vec<BearingFrame> = site.bearings().map(|exposure| exposure.frame).collect();
        assert_eq!(frames.len(), written.len());
        for (read, ours) in frames.iter().zip(&written) {
            assert_eq!((&read.camera, read.sequence), (&ours.camera, ours.sequence));
            assert_eq!(read.capture_time_ns, ours.capture_time_ns);
            assert_eq!(read.tracks.len(), ours.tracks.len());
            for (a, b) in read.tracks.iter().zip(&ours.tracks) {
                let (u, v): (Vector3<f64>, Vector3<f64>) =
                    (a.bearing.unwrap().into(), b.bearing.unwrap().into());
                assert!((u - v).norm() < 1e-8);
                assert!((a.covariance_xx / b.covariance_xx - 1.0).abs() < 1e-8);
            }
        }
    }
}
