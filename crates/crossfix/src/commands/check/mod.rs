mod views;

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Context;
use crossfix_geometry::Camera;
use crossfix_message::CameraName;
use crossfix_vision::TrackerConfig;
use nalgebra::Vector3;

use crate::calibrated;
use crate::commands::examples;
use crate::config::{self, CameraFile, FileKind, SiteFolder, load_network};
use crate::output;
use crate::parts;
use views::View;

/// Check configuration files before anything starts, and print what they resolve to.
///
/// Videos are opened and compared with the intrinsics; of a folder, all files must fit together,
/// and certificates that are there must be believed. A camera that sees nothing that another one
/// sees is named.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix check -c configs/site",
    "crossfix check -c configs/site/north.toml",
]))]
pub struct Args {
    /// A site's folder, or one of its files (TOML): a camera's, the fusion centre's, the network's.
    #[arg(short, long, value_name = "PATH")]
    config: PathBuf,
    /// Override a key of a file, e.g. tracker.margin_px=3.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    if args.config.is_dir() {
        let site = SiteFolder::load(&args.config)?;
        for (name, checked) in &site.cameras {
            output::line(format!(
                "camera `{name}`: {} is good; {}",
                checked.path.display(),
                view_of(&checked.camera)
            ));
        }
        compare_views(&site);
        for path in &site.fusion {
            let verdict = if cfg!(feature = "centre") {
                "is good"
            } else {
                "is for the fusion centre to check"
            };
            output::line(format!("fusion centre: {} {verdict}", path.display()));
        }
        for (identity, days) in &site.certificates {
            output::line(format!("certificate of {identity}: is good for {days} more days"));
        }
        return Ok(());
    }
    let keys: toml::Table = config::load(&args.config, &[], FileKind::Fusion)?;
    let resolved = match FileKind::of(&keys) {
        Some(FileKind::Camera) => check_camera(args)?,
        Some(FileKind::Network) => toml::to_string(&load_network(&args.config)?)?,
        Some(FileKind::Tracker) => {
            let tracker: TrackerConfig = config::load(&args.config, &args.sets, FileKind::Tracker)?;
            tracker
                .validate()
                .with_context(|| format!("{} has an error", args.config.display()))?;
            toml::to_string(&tracker)?
        }
        Some(FileKind::Calibration) => {
            let site = calibrated::load(&args.config)?;
            let names: Vec<&str> = site.cameras().iter().map(|c| c.name.as_str()).collect();
            output::line(format!(
                "{} is a calibration of {}",
                args.config.display(),
                names.join(", ")
            ));
            return Ok(());
        }
        #[cfg(feature = "centre")]
        Some(FileKind::Scene) => check_scene(args)?,
        #[cfg(feature = "centre")]
        Some(FileKind::Fusion) | None => check_fusion(args)?,
        #[cfg(not(feature = "centre"))]
        kind => {
            let kind =
                kind.map_or("a file that is no camera's".to_owned(), |kind| kind.to_string());
            return Err(parts::is_left_out(&format!("what checks {kind}"), "centre"));
        }
    };
    output::line(resolved.trim_end());
    Ok(())
}

#[cfg(feature = "centre")]
fn check_scene(args: &Args) -> anyhow::Result<String> {
    let scene: crossfix_simulation::Scene =
        config::load(&args.config, &args.sets, FileKind::Scene)?;
    scene.build().with_context(|| format!("the scene {} has an error", args.config.display()))?;
    Ok(toml::to_string(&scene)?)
}

#[cfg(feature = "centre")]
fn check_fusion(args: &Args) -> anyhow::Result<String> {
    let file = config::FusionFile::load(Some(&args.config), &args.sets)?;
    if let Some(network) = &file.network {
        load_network(network).context("key `network`")?;
    }
    Ok(toml::to_string(&file)?)
}

fn check_camera(args: &Args) -> anyhow::Result<String> {
    let file = CameraFile::load(&args.config, &args.sets)?;
    let camera = file.camera(&args.config)?;
    file.check_pictures(&camera).with_context(|| args.config.display().to_string())?;
    load_network(&file.network).context("key `network`")?;
    tracing::info!("camera `{}`: {}", file.name, view_of(&camera));
    if parts::DECODES_SLOWLY && file.source.has_video() {
        tracing::info!("{}", parts::WITH_NASM);
    }
    Ok(toml::to_string(&file)?)
}

/// Prints how far apart the cameras stand, and warns of those that see nothing that another one
/// sees.
fn compare_views(site: &SiteFolder) {
    let views: BTreeMap<&CameraName, View<'_>> = site
        .cameras
        .iter()
        .map(|(name, checked)| (name, View { camera: &checked.camera, turns: checked.turns }))
        .collect();
    if let Some([least, most]) = views::distances_m(&views) {
        output::line(format!("the cameras stand {least:.0} to {most:.0} m from one another"));
    }
    for name in views::alone(&views) {
        tracing::warn!("camera `{name}` sees nothing that another camera sees: is its pose right?");
    }
}

/// Where a camera stands and its direction of view, in words that let a person see whether the pose
/// is the intended one.
fn view_of(camera: &Camera) -> String {
    let place = camera.pose().position();
    let axis = camera.pose().rotation() * Vector3::z();
    let azimuth = axis.x.atan2(axis.y).to_degrees().rem_euclid(360.0);
    let elevation = axis.z.clamp(-1.0, 1.0).asin().to_degrees();
    let lens = camera.model().intrinsics();
    let width = 2.0 * (f64::from(lens.size.width) / (2.0 * lens.fx)).atan().to_degrees();
    format!(
        "stands at ({:.1}, {:.1}, {:.1}) m, looks to azimuth {azimuth:.0} degrees (north 0, east \
         90), {elevation:.0} degrees above the horizon, and sees about {width:.0} degrees across",
        place.x, place.y, place.z
    )
}
