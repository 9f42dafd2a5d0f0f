//! Summary figures of a volume's cubes.

use std::collections::BTreeMap;

use nalgebra::Matrix6;
use serde::Serialize;

use super::{Accuracy, Assumptions, Cell, PlannedCamera, Volume, predict};

/// Figures of a layer of the volume, or of all of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Height of its middle, ENU, m.
    pub altitude_m: f64,
    /// Number of cubes.
    pub cells: usize,
    /// Share of the cubes with a fix.
    pub fixed: f64,
    /// Median of the position's standard deviation, m, where there is a fix.
    pub position_sd_median_m: Option<f64>,
    /// Value that 90 % of the fixes do not exceed, m: that of the position's standard deviation.
    pub position_sd_90_m: Option<f64>,
    /// Median of the velocity's standard deviation, m/s, where there is a fix.
    pub velocity_sd_median_mps: Option<f64>,
    /// Share of the fixes that are degenerate.
    pub degenerate: Option<f64>,
}

fn sorted(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values
}

/// The value that a share of the sorted values does not exceed.
fn quantile(sorted: &[f64], share: f64) -> Option<f64> {
    let index = (share * sorted.len() as f64).ceil() as usize;
    sorted.get(index.saturating_sub(1)).copied()
}

impl Summary {
    /// Figures of some cubes.
    pub fn of<'a>(cells: impl IntoIterator<Item = &'a Cell>) -> Self {
        let cells: Vec<&Cell> = cells.into_iter().collect();
        let fixes: Vec<&Accuracy> =
            cells.iter().filter_map(|cell| cell.accuracy.as_ref()).collect();
        let positions = sorted(fixes.iter().map(|fix| fix.position_sd_m));
        let velocities = sorted(fixes.iter().map(|fix| fix.velocity_sd_mps));
        let degenerate = fixes.iter().filter(|fix| fix.is_degenerate()).count();
        let heights: f64 = cells.iter().map(|Cell { centre_m: [_, _, up], .. }| up).sum();
        let share = |part: usize, whole: usize| part as f64 / whole as f64;
        Self {
            altitude_m: heights / cells.len().max(1) as f64,
            cells: cells.len(),
            fixed: share(fixes.len(), cells.len().max(1)),
            position_sd_median_m: quantile(&positions, 0.5),
            position_sd_90_m: quantile(&positions, 0.9),
            velocity_sd_median_mps: quantile(&velocities, 0.5),
            degenerate: (!fixes.is_empty()).then(|| share(degenerate, fixes.len())),
        }
    }
}

/// Figures of each layer, from below.
pub fn layers(cells: &[Cell]) -> Vec<Summary> {
    let mut layers: BTreeMap<usize, Vec<&Cell>> = BTreeMap::new();
    for cell in cells {
        layers.entry(cell.layer).or_default().push(cell);
    }
    layers.into_values().map(Summary::of).collect()
}

/// Contribution of one camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Contribution {
    /// The camera.
    pub name: String,
    /// Frames per second.
    pub rate_hz: f64,
    /// Standard deviation of its clock, s.
    pub clock_sd_s: f64,
    /// The range up to which it sees the target, m; `None`: without limit.
    pub reach_m: Option<f64>,
    /// Standard deviation of one bearing on the optical axis, rad.
    pub bearing_sd_rad: f64,
    /// Standard deviation of its rotation, rad per axis, ...
    pub rotation_sd_rad: f64,
    /// ... and its position, m per axis (root mean square).
    pub position_sd_m: f64,
    /// Share of the volume that it sees.
    pub sees: f64,
    /// Figures of the volume without it.
    pub without: Summary,
}

/// Contribution of each camera: what it sees, and what would be left without it.
pub fn contributions(
    cameras: &[PlannedCamera],
    volume: &Volume,
    assumptions: &Assumptions,
    cells: &[Cell],
) -> Vec<Contribution> {
    cameras
        .iter()
        .enumerate()
        .map(|(index, camera)| {
            let without = without(index, cameras, volume, assumptions);
            Contribution::of(camera, assumptions, share_seen(index, cells), without)
        })
        .collect()
}

/// Share of the cubes that a camera sees.
fn share_seen(camera: usize, cells: &[Cell]) -> f64 {
    let seen = cells.iter().filter(|cell| cell.cameras.contains(&camera)).count();
    seen as f64 / cells.len().max(1) as f64
}

fn without(
    index: usize,
    cameras: &[PlannedCamera],
    volume: &Volume,
    assumptions: &Assumptions,
) -> Summary {
    let mut others = cameras.to_vec();
    others.remove(index);
    Summary::of(&predict(&others, volume, assumptions))
}

impl Contribution {
    fn of(camera: &PlannedCamera, assumptions: &Assumptions, sees: f64, without: Summary) -> Self {
        let lens = camera.camera.model().intrinsics();
        let per_axis = |first| sd_per_axis(&camera.pose_covariance, first);
        Self {
            name: camera.name.clone(),
            rate_hz: camera.rate_hz,
            clock_sd_s: camera.clock_sd_s,
            reach_m: assumptions.reach_m(&camera.camera),
            bearing_sd_rad: camera.pixel_sd_px / (lens.fx * lens.fy).sqrt(),
            rotation_sd_rad: per_axis(0),
            position_sd_m: per_axis(3),
            sees,
            without,
        }
    }
}

/// Root mean variance of three components of a pose, from the first.
fn sd_per_axis(pose_covariance: &Matrix6<f64>, first: usize) -> f64 {
    (pose_covariance.fixed_view::<3, 3>(first, first).trace() / 3.0).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(layer: usize, sd: Option<f64>) -> Cell {
        let accuracy = sd.map(|sd| Accuracy {
            position_sd_m: sd,
            best_axis_sd_m: 0.05,
            worst_axis_sd_m: sd,
            worst_axis: [0.0, 0.0, 1.0],
            velocity_sd_mps: 2.0 * sd,
        });
        Cell { layer, centre_m: [0.0, 0.0, 10.0 * layer as f64], cameras: vec![], accuracy }
    }

    #[test]
    fn shares_and_quantiles_by_hand() {
        let mut cells: Vec<Cell> = (1..=10).map(|n| cell(1, Some(0.1 * f64::from(n)))).collect();
        cells.extend((0..30).map(|_| cell(2, None)));
        let all = Summary::of(&cells);
        assert_eq!((all.cells, all.fixed), (40, 0.25));
        assert_eq!(all.position_sd_median_m, Some(0.5));
        assert_eq!(all.position_sd_90_m, Some(0.9));
        assert_eq!(all.velocity_sd_median_mps, Some(1.0));
        // Worse than ten times 0.05 m: 0.6 to 1.0 m.
        assert_eq!(all.degenerate, Some(0.5));
        let layers = layers(&cells);
        assert_eq!(layers.iter().map(|layer| layer.altitude_m).collect::<Vec<_>>(), [10.0, 20.0]);
        assert_eq!(
            (layers[1].fixed, layers[1].position_sd_median_m, layers[1].degenerate),
            (0.0, None, None)
        );
    }
}
