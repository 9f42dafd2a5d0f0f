//! The ground: a grid of known size under cameras and tracks, with its scale and a north arrow.

use nalgebra::Point3;
use rerun::RecordingStream;
use rerun_types::archetypes::{Arrows3D, LineStrips3D, Points3D};
use rerun_types::components::{Color, Radius};

use crate::ViewError;
use crate::extent::{BoundingBox, Bounds};

/// Approximate number of grid cells along its longer side: enough to count by, few enough not to
/// hide anything. With half of it they are of 20 m instead of 10 in a site of 100 m.
const CELLS: f64 = 8.0;

/// The largest of 1, 2 and 5 times a power of ten that is not above a length.
fn round_length(length: f64) -> f64 {
    let power = 10_f64.powf(length.max(1e-3).log10().floor());
    [5.0, 2.0, 1.0].into_iter().map(|m| m * power).find(|&m| m <= length).unwrap_or(power)
}

/// Coordinates of the grid's lines on an axis, a cell apart.
fn grid_lines(from: f64, to: f64, cell: f64) -> impl Iterator<Item = f64> {
    (0..=((to - from) / cell).round() as u32).map(move |i| from + f64::from(i) * cell)
}

/// Draws the ground under a box, at its lowest height.
pub(crate) fn draw(stream: &RecordingStream, extent: &BoundingBox) -> Result<(), ViewError> {
    let Bounds { low, high } = extent.bounds();
    let longest = (high.x - low.x).max(high.y - low.y).max(1.0);
    let cell = round_length(longest / CELLS);
    let [west, south] = [low.x, low.y].map(|v| (v / cell).floor() * cell);
    let [east, north] = [high.x, high.y].map(|v| (v / cell).ceil() * cell);
    let point = |x: f64, y: f64| [x as f32, y as f32, low.z as f32];
    let strips = grid_lines(west, east, cell)
        .map(|x| [point(x, south), point(x, north)])
        .chain(grid_lines(south, north, cell).map(|y| [point(west, y), point(east, y)]));
    let faint = Color::from_rgb(52, 58, 74);
    stream.log_static(
        "world/ground/grid",
        &LineStrips3D::new(strips).with_colors([faint]).with_radii([Radius::new_ui_points(0.6)]),
    )?;
    let bright = Color::from_rgb(170, 178, 196);
    let corner = Point3::new(west, south, low.z);
    stream.log_static(
        "world/ground/scale",
        &LineStrips3D::new([[point(west, south), point(west + cell, south)]])
            .with_colors([bright])
            .with_radii([Radius::new_ui_points(2.5)])
            .with_labels([format!("{cell} m")])
            .with_show_labels(true),
    )?;
    stream.log_static(
        "world/ground/north",
        &Arrows3D::from_vectors([[0.0, cell as f32, 0.0]])
            .with_origins([point(corner.x - 0.5 * cell, corner.y)])
            .with_colors([bright])
            .with_radii([Radius::new_ui_points(2.5)]),
    )?;
    stream.log_static(
        "world/ground/north/name",
        &Points3D::new([point(corner.x - 0.5 * cell, corner.y + 1.15 * cell)])
            .with_colors([bright])
            .with_labels(["N"])
            .with_show_labels(true)
            .with_radii([Radius::new_ui_points(0.5)]),
    )?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cells_side_is_a_length_that_one_can_count_in() {
        for (length, side) in [(1.0, 1.0), (4.9, 2.0), (5.0, 5.0), (37.0, 20.0), (250.0, 200.0)] {
            assert_eq!(round_length(length), side, "{length}");
        }
    }
}
