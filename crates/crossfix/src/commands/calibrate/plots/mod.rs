//! Plots of a calibration (SVG), one sheet per camera.

mod image;
mod panel;
mod residuals;

use std::path::Path;

use anyhow::{Context, anyhow};
use crossfix_calibration::{
    CalibratedCamera, CameraComparison, CameraResult, FlightResult, SiteCalibration, SiteComparison,
};
use crossfix_message::CameraName;
use plotters::prelude::*;

use panel::{Failure, PanelArea};

/// How many panels a sheet has.
#[derive(Clone, Copy, Debug)]
struct Grid {
    columns: usize,
    rows: usize,
}

/// Panels of a flight's sheet.
const OF_FLIGHT: Grid = Grid { columns: 3, rows: 2 };
/// Panels of a comparison's sheet.
const OF_COMPARISON: Grid = Grid { columns: 2, rows: 1 };
/// Size of a panel, px.
const PANEL_PX: (u32, u32) = (560, 400);

/// Draws the results of a flight for each camera into a folder; returns the number of sheets.
pub fn of_flight(result: &FlightResult, folder: &Path) -> anyhow::Result<usize> {
    make(folder)?;
    for camera in &result.cameras {
        draw(folder, &camera.name, OF_FLIGHT, |panels| of_camera(camera, panels))?;
    }
    Ok(result.cameras.len())
}

fn of_camera(camera: &CameraResult, panels: &[PanelArea<'_>]) -> Result<(), Failure> {
    let [over_time, over_image, motion, histogram, correlation, pointing] = panels else {
        return Err("a sheet has six panels".into());
    };
    residuals::over_time(camera, over_time)?;
    image::mean_residuals(camera, over_image)?;
    residuals::along_and_across(camera, motion)?;
    residuals::histogram(camera, histogram)?;
    residuals::autocorrelation(camera, correlation)?;
    image::pointing(&CalibratedCamera::from(camera), pointing)
}

/// Draws the differences of two calibrations, and the accuracy of the second, into a folder;
/// returns the number of sheets.
pub fn of_comparison(
    comparison: &SiteComparison,
    second: &SiteCalibration,
    folder: &Path,
) -> anyhow::Result<usize> {
    make(folder)?;
    for camera in &comparison.cameras {
        draw(folder, &camera.name, OF_COMPARISON, |panels| compared(camera, second, panels))?;
    }
    Ok(comparison.cameras.len())
}

fn compared(
    camera: &CameraComparison,
    second: &SiteCalibration,
    panels: &[PanelArea<'_>],
) -> Result<(), Failure> {
    let ([apart, pointing], Some(calibrated)) = (panels, second.camera(&camera.name)) else {
        return Err("a sheet of two panels is of a camera that both have".into());
    };
    image::apart(camera, calibrated, apart)?;
    image::pointing(calibrated, pointing)
}

fn make(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))
}

/// Draws a camera's sheet.
fn draw(
    folder: &Path,
    camera: &CameraName,
    grid: Grid,
    panels: impl FnOnce(&[PanelArea<'_>]) -> Result<(), Failure>,
) -> anyhow::Result<()> {
    let path = folder.join(format!("{camera}.svg"));
    draw_sheet(&path, grid, panels)
        .map_err(|error| anyhow!("cannot draw {}: {error}", path.display()))
}

fn draw_sheet(
    path: &Path,
    grid: Grid,
    panels: impl FnOnce(&[PanelArea<'_>]) -> Result<(), Failure>,
) -> Result<(), Failure> {
    let size = (PANEL_PX.0 * grid.columns as u32, PANEL_PX.1 * grid.rows as u32);
    let area = SVGBackend::new(path, size).into_drawing_area();
    area.fill(&WHITE)?;
    panels(&area.split_evenly((grid.rows, grid.columns)))?;
    area.present()?;
    Ok(())
}
