use std::path::{Path, PathBuf};

use anyhow::Context;
use crossfix_fusion::{Bearings, Clocks, EventTime, FusionConfig, Initiation, Tracking};
use crossfix_message::{AreaName, CameraName};
use serde::{Deserialize, Serialize};

/// The fusion centre's file: its network, the cameras it listens to, and how it fuses.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FusionFile {
    /// The network's file (TOML), relative to this one. Needed by `fuse`, not by `replay --fuse`.
    pub network: Option<PathBuf>,
    /// The network's area of which this is the fusion centre. Absent where the network has no
    /// areas.
    pub area: Option<AreaName>,
    /// The cameras to listen to. Absent: all of the network's, or of its area's.
    pub cameras: Option<Vec<CameraName>>,
    /// How frames are put into the order of their times; see the fusion's documentation. Every key
    /// has a default.
    pub event_time: EventTime,
    /// How far a bearing's stated covariance is trusted.
    pub bearings: Bearings,
    /// How new tracks are found.
    pub initiation: Initiation,
    /// How tracks are maintained.
    pub tracking: Tracking,
    /// How the cameras' clocks are estimated.
    pub clocks: Clocks,
}

impl FusionFile {
    /// Reads a file, or takes the defaults, with overrides applied.
    pub fn load(path: Option<&Path>, sets: &[String]) -> anyhow::Result<Self> {
        let Some(path) = path else {
            return super::parse("", sets);
        };
        let mut file: Self = super::load(path, sets, super::FileKind::Fusion)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        file.network = file.network.map(|network| folder.join(network));
        file.fusion()
            .validate()
            .with_context(|| format!("the configuration file {} has an error", path.display()))?;
        Ok(file)
    }

    /// The part of the file that configures the fusion itself.
    pub fn fusion(&self) -> FusionConfig {
        FusionConfig {
            event_time: self.event_time.clone(),
            bearings: self.bearings.clone(),
            initiation: self.initiation.clone(),
            tracking: self.tracking.clone(),
            clocks: self.clocks.clone(),
        }
    }
}
