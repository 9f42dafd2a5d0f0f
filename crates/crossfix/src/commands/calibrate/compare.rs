use std::fmt;
use std::path::PathBuf;

use anyhow::Context;
use crossfix_calibration::{
    CameraComparison, SiteCalibration, SiteComparison, SiteMove, compare_sites,
};
use crossfix_geometry::turn_vector;
use serde::Serialize;

use super::plots;
use crate::calibrated;
use crate::commands::examples;
use crate::output;

/// How far two calibrations of one site lie apart.
///
/// What all cameras are off by together (an error of the log) is printed separately; the cameras
/// are compared beside it, over their images.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix calibrate compare my-site/calibration.toml my-site/calibration-today.toml",
]))]
pub struct Args {
    /// A calibration (TOML).
    first: PathBuf,
    /// Another one of the same cameras.
    second: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
    /// Draw where each camera's images differ into this folder (SVG).
    #[arg(long, value_name = "FOLDER")]
    plots: Option<PathBuf>,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let (first, second) = (calibrated::load(&args.first)?, calibrated::load(&args.second)?);
    let comparison = compare_sites(&first, &second).with_context(|| {
        format!("{} and {} have no camera in common", args.first.display(), args.second.display())
    })?;
    if let Some(folder) = &args.plots {
        let sheets = plots::of_comparison(&comparison, &second, folder)?;
        tracing::info!("{sheets} sheets drawn in {}", folder.display());
    }
    let figures = Difference::from(&comparison);
    if args.json {
        output::json(&figures)
    } else {
        output::line(figures.render());
        Ok(())
    }
}

/// Difference of a calibration from an earlier one; `None` if they have no camera in common.
pub fn difference(first: &SiteCalibration, second: &SiteCalibration) -> Option<Difference> {
    compare_sites(first, second).map(|comparison| Difference::from(&comparison))
}

/// Difference of two calibrations.
#[derive(Debug, Serialize)]
pub struct Difference {
    /// Motion of the second site as a whole; absent with fewer than three cameras.
    moved: Option<MoveFigures>,
    cameras: Vec<ComparisonFigures>,
    /// Cameras that only one of the two has.
    missing: Vec<String>,
}

#[derive(Debug, Serialize)]
struct MoveFigures {
    /// Shift of the site's centre, east, north, up, m.
    shift_m: [f64; 3],
    /// Turn about east, north and up, mrad.
    turn_mrad: [f64; 3],
    /// Relative enlargement of the second site.
    larger: f64,
    /// How much later the second's common time is, s.
    later_s: Option<f64>,
}

impl From<&SiteMove> for MoveFigures {
    fn from(moved: &SiteMove) -> Self {
        Self {
            shift_m: moved.shift.into(),
            turn_mrad: (turn_vector(&moved.turn) * 1e3).into(),
            larger: moved.size - 1.0,
            later_s: moved.later_s,
        }
    }
}

impl fmt::Display for MoveFigures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [east, north, up] = self.shift_m;
        let [about_east, about_north, about_up] = self.turn_mrad;
        write!(
            f,
            "the second as a whole: shifted by {east:+.3}, {north:+.3}, {up:+.3} m, turned by \
             {about_east:+.2}, {about_north:+.2}, {about_up:+.2} mrad, {:+.3} % larger",
            100.0 * self.larger
        )?;
        self.later_s.map_or(Ok(()), |later| write!(f, ", {later:+.3} s later"))?;
        f.write_str("\nbeside that:")
    }
}

#[derive(Debug, Serialize)]
struct ComparisonFigures {
    name: String,
    centre_m: f64,
    /// Root mean square difference of directions over the image, per axis.
    apart_mrad: f64,
    most_mrad: f64,
    /// Standard deviation of that difference by both calibrations' covariances.
    said_mrad: f64,
    /// Root mean square, over the image, of the difference divided by its standard deviation.
    deviations: f64,
    /// Relative excess of the second's focal length.
    focal_longer: f64,
    /// Clock difference, less the one that all clocks have in common.
    later_ms: Option<f64>,
}

impl From<&SiteComparison> for Difference {
    fn from(comparison: &SiteComparison) -> Self {
        Self {
            moved: comparison.moved.as_ref().map(MoveFigures::from),
            cameras: comparison.cameras.iter().map(ComparisonFigures::from).collect(),
            missing: comparison.missing.iter().map(ToString::to_string).collect(),
        }
    }
}

impl From<&CameraComparison> for ComparisonFigures {
    fn from(camera: &CameraComparison) -> Self {
        Self {
            name: camera.name.to_string(),
            centre_m: camera.centre_m,
            apart_mrad: camera.apart_rad * 1e3,
            most_mrad: camera.most_rad * 1e3,
            said_mrad: camera.said_rad * 1e3,
            deviations: camera.deviations,
            focal_longer: camera.focal_ratio - 1.0,
            later_ms: camera.later_s.map(|later| later * 1e3),
        }
    }
}

impl Difference {
    /// The figures as a text for people.
    pub fn render(&self) -> String {
        let head = [
            "camera",
            "centre [m]",
            "over the image [mrad]",
            "most",
            "said",
            "deviations",
            "focal length",
            "clock [ms]",
        ];
        let mut rows = vec![head.map(str::to_owned).to_vec()];
        for camera in &self.cameras {
            rows.push(vec![
                camera.name.clone(),
                format!("{:.3}", camera.centre_m),
                format!("{:.2}", camera.apart_mrad),
                format!("{:.2}", camera.most_mrad),
                format!("{:.2}", camera.said_mrad),
                format!("{:.1}", camera.deviations),
                format!("{:+.2} %", 100.0 * camera.focal_longer),
                output::number(camera.later_ms, 1),
            ]);
        }
        let moved = self.moved.as_ref().map_or_else(
            || "of fewer than three cameras nothing is said of the site as a whole:".to_owned(),
            MoveFigures::to_string,
        );
        let missing = if self.missing.is_empty() {
            String::new()
        } else {
            format!("\n\nin one of them alone: {}", self.missing.join(", "))
        };
        format!("{moved}\n\n{}{missing}", output::table(&rows))
    }
}
