mod geojson;
#[cfg_attr(not(feature = "viewer"), path = "no_picture.rs")]
mod picture;
mod report;

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use crossfix_evaluation::bound::{Assumptions, PlannedCamera, TargetSize, Volume};
use crossfix_geometry::Camera;
use nalgebra::Point3;

use self::report::PlanReport;
use crate::commands::anchor::AnchorArg;
use crate::commands::examples;
use crate::commands::numbers::{self, triple};
use crate::config;
use crate::output::{self, Draft, Misuse};
use crate::planned;

/// Predict how well a site's cameras can do over a volume, and where one more would help most.
///
/// The Cramer-Rao bound of position and velocity at the end of a window in which a target flew
/// straight: no tracker is better, and a good one is near it. Only the cameras' files and their
/// intrinsics are read; neither videos nor a network need be there.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix plan configs/site --target-size 1",
    "crossfix plan configs/site --min -80,-80,10 --max 80,80,120 --save plan.rrd",
    "crossfix plan configs/site --geojson plan.geojson --anchor 48.3538,11.7861,490",
]))]
pub struct Args {
    /// The site's folder, with a file per camera (TOML).
    #[arg(value_name = "SITE_FOLDER")]
    site: PathBuf,
    /// The volume's low corner, local ENU, metres. Default: a box round where the optical axes
    /// cross.
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_parser = triple,
        allow_hyphen_values = true,
        requires = "max"
    )]
    min: Option<[f64; 3]>,
    /// The volume's high corner, local ENU, metres.
    #[arg(
        long,
        value_name = "X,Y,Z",
        value_parser = triple,
        allow_hyphen_values = true,
        requires = "min"
    )]
    max: Option<[f64; 3]>,
    /// Side of a cell, metres. Default: a twelfth of the volume's longest side, made round.
    #[arg(long, value_name = "METRES", value_parser = numbers::distance)]
    step: Option<f64>,
    /// How long a target has been seen, flying straight, seconds (at most 60).
    #[arg(long, default_value_t = 1.0, value_name = "SECONDS", value_parser = window)]
    window: f64,
    /// Standard deviation of a target's place in the image, pixels per axis. Default: what each
    /// camera's calibration has found of its labels; 0.5 without.
    #[arg(long, value_name = "PIXELS", value_parser = numbers::pixels)]
    pixel_sd: Option<f64>,
    /// Standard deviation of the cameras' rotation, degrees per axis. Default: each camera's own,
    /// from its calibration or file; a careful survey's 0.057 (1 mrad) where nobody has said.
    #[arg(long, value_name = "DEGREES", value_parser = numbers::degrees)]
    rotation_sd_deg: Option<f64>,
    /// Standard deviation of the cameras' positions, metres per axis. Default: each camera's own,
    /// or a careful survey's 0.05.
    #[arg(long, value_name = "METRES", value_parser = numbers::metres_or_none)]
    position_sd: Option<f64>,
    /// Standard deviation of the cameras' clocks, seconds. Default: each camera's own, from its
    /// file.
    #[arg(long, value_name = "SECONDS", value_parser = numbers::seconds_of_an_hour)]
    clock_sd: Option<f64>,
    /// How fast targets fly, metres per second: what an error of a clock is worth.
    #[arg(
        long,
        default_value_t = 15.0,
        value_name = "METRES_PER_SECOND",
        value_parser = numbers::metres_per_second
    )]
    speed: f64,
    /// What is known of a target's velocity beforehand: standard deviation, metres per second per
    /// axis; 0 is nothing.
    #[arg(
        long,
        default_value_t = 15.0,
        value_name = "METRES_PER_SECOND",
        value_parser = numbers::metres_per_second
    )]
    velocity_prior_sd: f64,
    /// Size of the target, metres: how far it is seen; 0 is from anywhere.
    #[arg(
        long,
        default_value_t = 0.4,
        value_name = "METRES",
        value_parser = numbers::metres_or_none
    )]
    target_size: f64,
    /// Pixels that the target must span to be seen.
    #[arg(long, default_value_t = 6.0, value_name = "PIXELS", value_parser = numbers::pixels)]
    min_pixels: f64,
    /// Farther than this nothing is seen, metres.
    #[arg(long, value_name = "METRES", value_parser = numbers::distance)]
    max_range: Option<f64>,
    /// Print JSON, with every cell and every candidate.
    #[arg(long)]
    json: bool,
    /// Write the cells, the cameras and the candidates as GeoJSON (WGS84); needs --anchor.
    #[arg(long, value_name = "FILE", requires = "anchor")]
    geojson: Option<PathBuf>,
    #[command(flatten)]
    origin: AnchorArg,
    /// Write the coloured volume as a picture for Rerun (.rrd).
    #[arg(long, value_name = "FILE")]
    save: Option<PathBuf>,
}

fn window(text: &str) -> Result<f64, String> {
    numbers::within(text, 0.01, 60.0, " s")
}

impl Args {
    fn assumptions(&self) -> Assumptions {
        let some = |value: f64| (value > 0.0).then_some(value);
        Assumptions {
            window_s: self.window,
            speed_mps: self.speed,
            velocity_prior_sd_mps: some(self.velocity_prior_sd),
            target: some(self.target_size)
                .map(|size_m| TargetSize { size_m, least_px: self.min_pixels }),
            max_range_m: self.max_range,
        }
    }

    fn volume(&self, cameras: &[PlannedCamera]) -> anyhow::Result<Volume> {
        if let (Some(min), Some(max)) = (self.min, self.max) {
            let volume = Volume::new(Point3::from(min), Point3::from(max), self.step);
            return volume.map_err(|error| Misuse(error.to_string()).into());
        }
        let cameras: Vec<Camera> = cameras.iter().map(|planned| planned.camera.clone()).collect();
        Volume::where_axes_cross(&cameras, self.step)
            .context("there is no default volume: give --min and --max")
    }
}

impl Args {
    /// The site's cameras, with values from the options in place of those from their files.
    fn cameras(&self) -> anyhow::Result<Vec<PlannedCamera>> {
        let (turned, still): (Vec<_>, Vec<_>) = config::load_cameras(&self.site)?
            .into_iter()
            .partition(|(_, file)| file.mount.is_some());
        for (_, file) in turned {
            tracing::warn!(
                "camera `{}` is on a mount and is left out: it sees where it is told to look",
                file.name
            );
        }
        still.iter().map(|(path, file)| self.camera(path, file)).collect()
    }

    fn camera(&self, path: &Path, file: &config::CameraFile) -> anyhow::Result<PlannedCamera> {
        let rate_hz = file.rate_hz()?;
        if let Some(rate_hz) = rate_hz {
            ensure!(
                (0.01..=1000.0).contains(&rate_hz),
                "{}: {rate_hz} frames a second: it must be from 0.01 to 1000",
                path.display()
            );
        }
        let mut camera = planned::of_file(file, path, rate_hz)?;
        camera.clock_sd_s = self.clock_sd.unwrap_or(camera.clock_sd_s);
        camera.pixel_sd_px = self.pixel_sd.unwrap_or(camera.pixel_sd_px);
        let rotation_sd_rad = self.rotation_sd_deg.map(f64::to_radians);
        for (first, sd) in [(0, rotation_sd_rad), (3, self.position_sd)] {
            if let Some(sd) = sd {
                planned::hold(&mut camera.pose_covariance, first, sd);
            }
        }
        Ok(camera)
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let cameras = args.cameras()?;
    let volume = args.volume(&cameras)?;
    let report = PlanReport::new(&cameras, &volume, args.assumptions());
    if args.json {
        output::json(&report)?;
    } else {
        output::line(report::render(&report));
    }
    if let (Some(path), Some(anchor)) = (&args.geojson, args.origin.anchor) {
        let json = serde_json::to_vec(&geojson::collection(&report, &cameras, anchor))?;
        output::write_file(path, &[], &json)?;
        tracing::info!("map written to {}", path.display());
    }
    if let Some(path) = &args.save {
        let draft = Draft::new(path, &[])?;
        picture::draw(&report, &cameras, draft.path())?;
        draft.keep()?;
        tracing::info!(
            "picture written to {0}; look at it with: rerun --bind 127.0.0.1 {0}",
            path.display()
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_read_or_refused() {
        assert_eq!(triple("-80, -80,10"), Ok([-80.0, -80.0, 10.0]));
        assert!(triple("1,2").is_err() && triple("1,2,x").is_err() && triple("1,2,NaN").is_err());
        assert!(window("61").is_err());
        assert!(numbers::place("95,0,0").unwrap_err().contains("latitude"));
    }
}
