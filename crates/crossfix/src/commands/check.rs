use std::path::PathBuf;

use crate::config::{self, CameraFile, FusionFile, Site, load_network};
use crate::output;

/// Check configuration files before anything starts, and print what they resolve to.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  crossfix check -c configs/site\n  crossfix check -c configs/site/north.toml"
)]
pub struct Args {
    /// A site's folder, a camera's file or the fusion centre's file (TOML).
    #[arg(short, long, value_name = "PATH")]
    config: PathBuf,
    /// Override a key of a file, e.g. tracker.margin_px=3.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    if args.config.is_dir() {
        let site = Site::load(&args.config)?;
        for (name, path) in &site.cameras {
            output::line(format!("camera `{name}`: {} is good", path.display()));
        }
        for path in &site.fusion {
            output::line(format!("fusion centre: {} is good", path.display()));
        }
        return Ok(());
    }
    let keys: toml::Table = config::load(&args.config, &[])?;
    let is_camera = keys.contains_key("source") || keys.contains_key("name");
    let resolved = if is_camera {
        let file = CameraFile::load(&args.config, &args.sets)?;
        file.camera(&args.config)?;
        load_network(&file.network)?;
        toml::to_string(&file)?
    } else {
        let file = FusionFile::load(Some(&args.config), &args.sets)?;
        if let Some(network) = &file.network {
            load_network(network)?;
        }
        toml::to_string(&file)?
    };
    output::line(resolved.trim_end());
    Ok(())
}
