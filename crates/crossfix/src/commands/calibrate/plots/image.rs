//! A camera's errors in each part of its image.

use std::collections::BTreeMap;

use crossfix_calibration::{CalibratedCamera, CameraComparison, CameraResult, ShownPixel};
use crossfix_geometry::{ImageSize, Pixel};
use nalgebra::Vector2;
use plotters::prelude::*;

use super::panel::{Chart, FIRST, Failure, PanelArea, PanelText, Ranges, frame, nothing};

/// Number of cells of an image, across and down. With half as many each way, the mean of a cell
/// would hide how the lens bends within it.
const CELLS: [usize; 2] = [16, 9];
/// A cell with fewer labels than this shows nothing. With half as many the SD of a cell's mean is
/// almost half a label's, and arrows show noise.
const LEAST_LABELS: u32 = 10;
/// Length of the arrows' 90 % quantile as drawn, as a share of a cell. With twice as much they
/// would cross into other cells.
const ARROW_SHARE: f64 = 0.9;

/// A plot frame for an image, with rows counted downwards.
fn image<'a, 'b>(
    area: &'a PanelArea<'b>,
    title: String,
    size: ImageSize,
) -> Result<Chart<'a, 'b>, Failure> {
    let text = PanelText { title, x: "px", y: "px" };
    frame(area, &text, Ranges { x: 0.0..f64::from(size.width), y: f64::from(size.height)..0.0 })
}

/// The sides of a cell, pixels.
fn cell_px(size: ImageSize) -> [f64; 2] {
    [f64::from(size.width) / CELLS[0] as f64, f64::from(size.height) / CELLS[1] as f64]
}

/// Arrows, to be enlarged by a common factor so that they can be seen.
struct Arrows(Vec<(Pixel, Vector2<f64>)>);

impl Arrows {
    fn enlarged(&self, size: ImageSize) -> Option<f64> {
        let mut lengths: Vec<f64> = self.0.iter().map(|(_, arrow)| arrow.norm()).collect();
        lengths.sort_unstable_by(f64::total_cmp);
        let long = lengths.get(lengths.len().checked_sub(1)? * 9 / 10)?;
        let [across, down] = cell_px(size);
        Some((ARROW_SHARE * across.min(down) / long.max(1e-9)).max(1.0).round())
    }

    fn draw(&self, chart: &mut Chart<'_, '_>, enlarged: f64) -> Result<(), Failure> {
        for (at, arrow) in &self.0 {
            let start = (at.x(), at.y());
            let end = (at.x() + enlarged * arrow.x, at.y() + enlarged * arrow.y);
            let line = PathElement::new([start, end], FIRST.stroke_width(1));
            chart.draw_series(std::iter::once(line))?;
            chart.draw_series(std::iter::once(Circle::new(end, 2, FIRST.filled())))?;
        }
        Ok(())
    }
}

/// The mean of the labels' residuals in each cell: the remaining error of the lens.
pub fn mean_residuals(camera: &CameraResult, area: &PanelArea<'_>) -> Result<(), Failure> {
    let size = camera.camera.model().intrinsics().size;
    let [across, down] = cell_px(size);
    let mut cells: BTreeMap<(usize, usize), (Vector2<f64>, u32)> = BTreeMap::new();
    // Larger residuals belong to something else.
    let within = 5.0 * camera.noise.sd_px();
    for label in camera.fitted.iter().filter(|label| label.beside_px.amax() < within) {
        let cell = ((label.pixel.x() / across) as usize, (label.pixel.y() / down) as usize);
        let (sum, count) = cells.entry(cell).or_default();
        *sum += label.beside_px;
        *count += 1;
    }
    let middle = |(column, row): (usize, usize)| {
        Pixel::new((column as f64 + 0.5) * across, (row as f64 + 0.5) * down)
    };
    let means = cells.into_iter().filter(|(_, (_, count))| *count >= LEAST_LABELS);
    let arrows =
        Arrows(means.map(|(cell, (sum, count))| (middle(cell), sum / f64::from(count))).collect());
    let Some(enlarged) = arrows.enlarged(size) else {
        return nothing(area, "means over the image", "too few labels");
    };
    let title = format!("means over the image, {enlarged} times as long");
    arrows.draw(&mut image(area, title, size)?, enlarged)
}

/// A pixel of the first calibration, and the way from there to the second's, px.
fn to_second(ShownPixel { first, second }: &ShownPixel) -> (Pixel, Vector2<f64>) {
    (*first, Vector2::new(second.x() - first.x(), second.y() - first.y()))
}

/// Displacement, at pixels over the image, of a direction between the first and the second
/// calibration.
pub fn apart(
    comparison: &CameraComparison,
    second: &CalibratedCamera,
    area: &PanelArea<'_>,
) -> Result<(), Failure> {
    let size = second.camera.model().intrinsics().size;
    let arrows = Arrows(comparison.pixels.iter().map(to_second).collect());
    let title = format!("{}: from the first to the second", comparison.name);
    let Some(enlarged) = arrows.enlarged(size) else {
        return nothing(area, &title, "no pixel is known to both");
    };
    arrows.draw(&mut image(area, format!("{title}, {enlarged} times as long"), size)?, enlarged)
}

/// Pointing SD of the camera in each cell, mrad; grey where the lens is not known.
pub fn pointing(camera: &CalibratedCamera, area: &PanelArea<'_>) -> Result<(), Failure> {
    let size = camera.camera.model().intrinsics().size;
    let [across, down] = cell_px(size);
    let title = format!("{}: pointing known to [mrad], at {:.0} m", camera.name, camera.range_m);
    let mut chart = image(area, title, size)?;
    let cells = (0..CELLS[0] * CELLS[1]).map(|k| (k % CELLS[0], k / CELLS[0]));
    let known: Vec<((f64, f64), Option<f64>)> = cells
        .map(|(column, row)| {
            let corner = (column as f64 * across, row as f64 * down);
            let middle = Pixel::new(corner.0 + across / 2.0, corner.1 + down / 2.0);
            let is_known = camera.bearing(middle).is_ok();
            let sd = camera.pointing_sd_rad(middle, camera.range_m).filter(|_| is_known);
            (corner, sd.map(|sd| 1e3 * sd))
        })
        .collect();
    let best = known.iter().filter_map(|(_, sd)| *sd).fold(f64::INFINITY, f64::min);
    for (corner, sd) in known {
        let far = (corner.0 + across, corner.1 + down);
        // From white to red, with one step per doubling of the SD.
        let colour = sd.map_or(RGBColor(200, 200, 200), |sd| {
            let pale = 230.0 / (1.0 + (sd / best).log2());
            RGBColor(235, pale as u8, pale as u8)
        });
        chart.draw_series(std::iter::once(Rectangle::new([corner, far], colour.filled())))?;
        let text = sd.map_or_else(String::new, |sd| format!("{sd:.2}"));
        let at = (corner.0 + 0.12 * across, corner.1 + 0.35 * down);
        chart.draw_series(std::iter::once(Text::new(text, at, ("sans-serif", 10))))?;
    }
    Ok(())
}
