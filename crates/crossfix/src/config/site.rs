use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use anyhow::{Context, bail, ensure};
use crossfix_geometry::{Camera, Geodetic};
use crossfix_message::CameraName;
use crossfix_transport::{Anchor, Credentials, Identity, NetworkConfig};

#[cfg(feature = "centre")]
use super::FusionFile;
use super::{CameraFile, FileKind};
use crate::calibrated;

/// Reads and checks a network file.
pub fn load_network(path: &Path) -> anyhow::Result<NetworkConfig> {
    let mut network: NetworkConfig = super::load(path, &[], FileKind::Network)?;
    if let Some(security) = &mut network.security {
        let folder = path.parent().unwrap_or(Path::new("."));
        security.certificates = folder.join(&security.certificates);
    }
    let has_error = || format!("the network file {} has an error", path.display());
    network.validate().with_context(has_error)?;
    anchor_of(&network).with_context(has_error)?;
    Ok(network)
}

/// Where on the Earth a network's site is, if its file says so.
pub fn anchor_of(network: &NetworkConfig) -> anyhow::Result<Option<Geodetic>> {
    network.anchor.map(geodetic).transpose().context("section [anchor]")
}

fn geodetic(anchor: Anchor) -> Result<Geodetic, crossfix_geometry::GeometryError> {
    Geodetic::from_degrees(anchor.latitude_deg, anchor.longitude_deg, anchor.height_m)
}

/// The TOML files of a folder with their keys, in order of name.
fn toml_files(folder: &Path) -> anyhow::Result<Vec<(PathBuf, toml::Table)>> {
    let cannot_list = || format!("cannot list {}", folder.display());
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(cannot_list)? {
        let path = entry.with_context(cannot_list)?.path();
        if path.extension().is_some_and(|extension| extension == "toml") {
            files.push(path);
        }
    }
    files.sort();
    files.into_iter().map(|path| read_keys(&path).map(|keys| (path, keys))).collect()
}

fn read_keys(path: &Path) -> anyhow::Result<toml::Table> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    super::parse(&text, &[]).with_context(|| format!("{} is no TOML", path.display()))
}

fn is_camera(keys: &toml::Table) -> bool {
    FileKind::of(keys) == Some(FileKind::Camera)
}

/// The camera files of a folder, whether or not the rest of the site exists yet.
pub fn load_cameras(folder: &Path) -> anyhow::Result<Vec<(PathBuf, CameraFile)>> {
    let files = toml_files(folder)?.into_iter().filter(|(_, keys)| is_camera(keys));
    let cameras = files
        .map(|(path, _)| CameraFile::load(&path, &[]).map(|file| (path, file)))
        .collect::<anyhow::Result<Vec<_>>>()?;
    ensure!(!cameras.is_empty(), "{} holds no camera file", folder.display());
    Ok(cameras)
}

/// A folder with the files of a site: what `check` checks as a whole.
pub struct SiteFolder {
    pub cameras: BTreeMap<CameraName, CheckedCamera>,
    pub fusion: Vec<PathBuf>,
    /// Identities whose certificates are in the network's folder, with the days each is still
    /// valid.
    pub certificates: BTreeMap<Identity, u64>,
}

/// A camera file that has passed the checks that need no other file.
pub struct CheckedCamera {
    pub path: PathBuf,
    pub camera: Camera,
    /// Whether a mount turns it.
    pub turns: bool,
    network: NetworkConfig,
}

impl SiteFolder {
    /// Reads every TOML file of a folder and checks that they fit together.
    pub fn load(folder: &Path) -> anyhow::Result<Self> {
        let mut site =
            Self { cameras: BTreeMap::new(), fusion: Vec::new(), certificates: BTreeMap::new() };
        let mut fusion = Vec::new();
        for (path, keys) in toml_files(folder)? {
            match FileKind::of(&keys) {
                Some(FileKind::Camera) => site.add_camera(&path)?,
                Some(FileKind::Network) => site.add_certificates(&load_network(&path)?)?,
                Some(FileKind::Calibration) => drop(calibrated::load(&path)?),
                // A scene of the simulator, or a tracker's settings.
                Some(FileKind::Scene | FileKind::Tracker) => {}
                Some(FileKind::Fusion) | None => fusion.push(path),
            }
        }
        ensure!(!site.cameras.is_empty(), "{} holds no camera file", folder.display());
        ensure!(
            !fusion.is_empty(),
            "{} holds no fusion centre's file: copy configs/site/fusion.toml",
            folder.display()
        );
        #[cfg(feature = "centre")]
        fusion.iter().try_for_each(|path| check_fusion(path))?;
        site.fusion = fusion;
        site.check_cameras()?;
        Ok(site)
    }

    fn add_camera(&mut self, path: &Path) -> anyhow::Result<()> {
        let file = CameraFile::load(path, &[])?;
        let camera = file.camera(path)?;
        file.check_pictures(&camera).with_context(|| path.display().to_string())?;
        let network = load_network(&file.network)
            .with_context(|| format!("key `network` of {}", path.display()))?;
        ensure!(
            network.cameras.contains_key(&file.name),
            "{}: camera `{}` has no endpoint: add it to [cameras] of {}",
            path.display(),
            file.name,
            file.network.display()
        );
        let turns = file.mount.is_some();
        let checked = CheckedCamera { path: path.to_owned(), camera, turns, network };
        if let Some(other) = self.cameras.insert(file.name.clone(), checked) {
            bail!(
                "two cameras are called `{}`: change the key `name` of {} or of {}",
                file.name,
                other.path.display(),
                path.display()
            );
        }
        Ok(())
    }

    /// Checks the certificates that are on this host, which normally has only its own.
    fn add_certificates(&mut self, network: &NetworkConfig) -> anyhow::Result<()> {
        let Some(security) = &network.security else { return Ok(()) };
        // There are none before they have been made.
        let entries = std::fs::read_dir(&security.certificates).into_iter().flatten().flatten();
        let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
        let identities = names.filter_map(|name| name.strip_suffix(".pem")?.parse().ok());
        let now = SystemTime::now();
        // The certificate of a camera that has been removed since does no harm.
        for identity in identities.filter(|identity| !is_removed(identity, network)) {
            let credentials = Credentials::load(security, &identity, now)
                .with_context(|| format!("the certificate of {identity}"))?;
            let left = credentials.not_after().duration_since(now).unwrap_or_default();
            self.certificates.insert(identity, left.as_secs() / (24 * 3600));
        }
        Ok(())
    }

    /// Checks the cameras against each other and their networks.
    fn check_cameras(&self) -> anyhow::Result<()> {
        for checked in self.cameras.values() {
            for camera in checked.network.cameras.keys() {
                ensure!(
                    self.cameras.contains_key(camera),
                    "the network of {} names camera `{camera}`, which has no file here",
                    checked.path.display()
                );
            }
        }
        let mut places = self.cameras.values().map(|checked| checked.camera.pose().position());
        let first = places.next();
        ensure!(
            self.cameras.len() < 2 || places.any(|place| Some(place) != first),
            "all cameras stand at the same place: their sight lines cross nowhere else; see \
             `position_m`"
        );
        Ok(())
    }
}

/// Whether it is of a camera that the network does not have.
fn is_removed(identity: &Identity, network: &NetworkConfig) -> bool {
    matches!(identity, Identity::Camera(camera) if !network.cameras.contains_key(camera))
}

/// Checks a fusion centre's file, and that the network knows its cameras.
#[cfg(feature = "centre")]
fn check_fusion(path: &Path) -> anyhow::Result<()> {
    let file = FusionFile::load(Some(path), &[])?;
    let Some(network) = &file.network else {
        return Ok(());
    };
    let network =
        load_network(network).with_context(|| format!("key `network` of {}", path.display()))?;
    network
        .cameras_of(file.area.as_ref())
        .with_context(|| format!("key `area` of {}", path.display()))?;
    for camera in file.cameras.iter().flatten() {
        ensure!(
            network.cameras.contains_key(camera),
            "key `cameras` of {}: the network has no camera `{camera}`{}",
            path.display(),
            nearest(camera.as_str(), network.cameras.keys().map(CameraName::as_str))
        );
    }
    Ok(())
}

/// The known name most similar to a wrong one, as a question.
#[cfg(feature = "centre")]
fn nearest<'a>(wrong: &str, known: impl Iterator<Item = &'a str>) -> String {
    let likeness = |name: &&str| strsim::jaro_winkler(wrong, name);
    known
        .max_by(|a, b| likeness(a).total_cmp(&likeness(b)))
        .map_or_else(String::new, |name| format!("; did you mean `{name}`?"))
}
