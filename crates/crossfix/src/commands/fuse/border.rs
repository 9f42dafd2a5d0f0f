//! Exchange between the fusion centre of an area and those of neighbouring areas.

use std::collections::BTreeMap;

use crossfix_fusion::{FusionConfig, Neighbours, Output, Share};
use crossfix_message::{
    AreaName, CameraName, Channel, DecodeError, Key, SiteName, TrackFrame, decode,
};
use crossfix_transport::NetworkConfig;

/// The neighbouring areas, and what is exchanged with them.
pub struct AreaBorder {
    neighbours: Neighbours,
    /// The neighbouring areas with their indices among all areas.
    beside: BTreeMap<AreaName, usize>,
    /// Cameras that another area's centre cues: cued by two centres, a camera would turn to and
    /// fro.
    cued_by_others: Vec<CameraName>,
}

impl AreaBorder {
    /// The border of one area of the network.
    pub fn new(network: &NetworkConfig, area: &AreaName, config: &FusionConfig) -> Self {
        let place = |area: &AreaName| network.areas.keys().take_while(|one| *one < area).count();
        let beside = network.neighbours(area).into_iter().map(|one| (one.clone(), place(&one)));
        let cued_by_others = |camera: &&CameraName| network.areas_of(camera).first() != Some(area);
        Self {
            neighbours: Neighbours::new(
                Share { index: place(area), of: network.areas.len() },
                config,
            ),
            beside: beside.collect(),
            cued_by_others: network.cameras.keys().filter(cued_by_others).cloned().collect(),
        }
    }

    /// The keys under which the neighbouring areas publish their tracks.
    pub fn tracks_beside(&self, site: &SiteName) -> impl Iterator<Item = String> {
        self.beside.keys().map(|area| {
            Key::of_centre(site.clone(), Some(area.clone()), Channel::Tracks).to_string()
        })
    }

    /// Takes in the tracks of another area.
    pub fn add_tracks(&mut self, area: &AreaName, data: &[u8]) -> Result<(), DecodeError> {
        if let Some(place) = self.beside.get(area) {
            self.neighbours.receive(*place, &decode::<TrackFrame>(data)?);
        }
        Ok(())
    }

    /// The fusion's outputs that are to be published, with the neighbours' tracks taken into
    /// account.
    pub fn published(&mut self, outputs: Vec<Output>) -> Vec<Output> {
        let mut outputs = self.neighbours.forward(outputs);
        let is_cued_here = |camera: &str| self.cued_by_others.iter().all(|c| c.as_str() != camera);
        outputs.retain(|output| match output {
            Output::Cues(cues) => is_cued_here(&cues.camera),
            _ => true,
        });
        outputs
    }
}
