//! Scenario folders of the format `passive-bearings/1`, as `simulate` writes and `import` reads
//! them: `scenario.json`, `exposures.csv`, `detections.csv` and `truth.csv`.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// The format's name in `scenario.json`.
pub const FORMAT: &str = "passive-bearings/1";

/// An exposure of a camera, with bearings or without.
#[derive(Debug, Serialize, Deserialize)]
pub struct ExposureRow {
    /// Capture time, s.
    pub t: f64,
    pub cam: u32,
    pub scan: u64,
    /// Number of its bearings; need not be there.
    pub n: Option<usize>,
}

/// A bearing of one exposure.
#[derive(Debug, Serialize, Deserialize)]
pub struct DetectionRow {
    /// Capture time of the exposure, s; need not be there.
    pub t: Option<f64>,
    pub cam: u32,
    pub scan: u64,
    /// The bearing's number within the exposure.
    pub det: u64,
    /// Unit vector in the format's camera axes.
    pub ux: f64,
    pub uy: f64,
    pub uz: f64,
    /// Standard deviation along each tangent, rad.
    pub sigma_rad: f64,
    /// The target's number; -1 is clutter. A fusion must not use it.
    #[serde(default)]
    pub truth_id: i64,
}

/// Position (m) and velocity (m/s) of a target.
#[derive(Debug, Serialize, Deserialize)]
pub struct TruthRow {
    /// Time, s.
    pub t: f64,
    pub id: u64,
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub vx: f64,
    pub vy: f64,
    pub vz: f64,
}

/// Converts between the format's camera axes (x left, y up, z forward) and ours (x right, y down, z
/// forward); its own inverse.
pub fn turned(v: Vector3<f64>) -> Vector3<f64> {
    Vector3::new(-v.x, -v.y, v.z)
}
