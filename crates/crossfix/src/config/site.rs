use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use crossfix_message::CameraName;
use crossfix_transport::NetworkConfig;

use super::{CameraFile, FusionFile};

/// Reads and checks a network file.
pub fn load_network(path: &Path) -> anyhow::Result<NetworkConfig> {
    let network: NetworkConfig = super::load(path, &[])?;
    network.validate().with_context(|| format!("the network file {} has an error", path.display()))?;
    Ok(network)
}

/// The TOML files of a folder by name, with their keys.
fn toml_files(folder: &Path) -> anyhow::Result<Vec<(PathBuf, toml::Table)>> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)
        .with_context(|| format!("cannot list {}", folder.display()))?
        .filter_map(|entry| Some(entry.ok()?.path()))
        .filter(|path| path.extension().is_some_and(|extension| extension == "toml"))
        .collect();
    files.sort();
    let read = |path: PathBuf| {
        let text =
            std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
        let keys = toml::from_str(&text).with_context(|| format!("{} is no TOML", path.display()))?;
        Ok((path, keys))
    };
    files.into_iter().map(read).collect()
}

fn is_camera(keys: &toml::Table) -> bool {
    keys.contains_key("source")
}

/// The camera files of a folder, whether or not the rest of the site is there yet.
pub fn load_cameras(folder: &Path) -> anyhow::Result<Vec<(PathBuf, CameraFile)>> {
    let files = toml_files(folder)?.into_iter().filter(|(_, keys)| is_camera(keys));
    let load = |(path, _): (PathBuf, toml::Table)| {
        let file = CameraFile::load(&path, &[])?;
        Ok((path, file))
    };
    let cameras = files.map(load).collect::<anyhow::Result<Vec<_>>>()?;
    ensure!(!cameras.is_empty(), "{} holds no camera file", folder.display());
    Ok(cameras)
}

/// A folder with the files of a site: what `check` looks at as a whole.
pub struct Site {
    pub cameras: BTreeMap<CameraName, PathBuf>,
    pub fusion: Vec<PathBuf>,
}

impl Site {
    /// Reads every TOML file of a folder and checks that they fit together.
    pub fn load(folder: &Path) -> anyhow::Result<Self> {
        let mut site = Self { cameras: BTreeMap::new(), fusion: Vec::new() };
        for (path, keys) in toml_files(folder)? {
            if is_camera(&keys) {
                site.add_camera(&path)?;
            } else if keys.contains_key("fusion") {
                load_network(&path)?;
            } else if keys.contains_key("targets") {
                // A scene of the simulator.
            } else {
                let file = FusionFile::load(Some(&path), &[])?;
                if let Some(network) = &file.network {
                    load_network(network)?;
                }
                site.fusion.push(path);
            }
        }
        ensure!(!site.cameras.is_empty(), "{} holds no camera file", folder.display());
        Ok(site)
    }

    fn add_camera(&mut self, path: &Path) -> anyhow::Result<()> {
        let file = CameraFile::load(path, &[])?;
        file.camera(path)?;
        let network = load_network(&file.network)?;
        ensure!(
            network.cameras.contains_key(&file.name),
            "{}: camera `{}` has no endpoint: add it to [cameras] of {}",
            path.display(),
            file.name,
            file.network.display()
        );
        if let Some(other) = self.cameras.insert(file.name.clone(), path.to_owned()) {
            bail!(
                "two cameras are called `{}`: change the key `name` of {} or of {}",
                file.name,
                other.display(),
                path.display()
            );
        }
        Ok(())
    }
}
