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
    /// How many bearings it has; not needed to read it.
    #[serde(default)]
    pub n: usize,
}

/// A bearing.
#[derive(Debug, Serialize, Deserialize)]
pub struct DetectionRow {
    /// Capture time, s; that of its exposure counts.
    #[serde(default)]
    pub t: f64,
    pub cam: u32,
    pub scan: u64,
    /// Its number in the exposure.
    pub det: u64,
    /// Unit vector in the format's camera axes.
    pub ux: f64,
    pub uy: f64,
    pub uz: f64,
    /// Standard deviation along each tangent.
    pub sigma_rad: f64,
    /// The target; -1 is clutter. Whoever fuses must not look at it.
    #[serde(default)]
    pub truth_id: i64,
}

/// Where a target is (m) and how fast (m/s).
#[derive(Debug, Serialize, Deserialize)]
pub struct TruthRow {
    /// s
    pub t: f64,
    pub id: u64,
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub vx: f64,
    pub vy: f64,
    pub vz: f64,
}

/// From the format's camera axes, x left, y up, z forward, to ours, x right, y down, z forward; and
/// back.
pub fn turned(v: Vector3<f64>) -> Vector3<f64> {
    Vector3::new(-v.x, -v.y, v.z)
}
