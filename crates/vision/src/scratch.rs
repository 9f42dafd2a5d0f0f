//! Memory that all targets of a tracker share, so that a step allocates none.

use crossfix_correlation::{Correlator, Plane, Statistics};

use crate::appearance::AppearanceScratch;
use crate::arrival::ComparisonBuffers;
use crate::empty_scene::EmptySceneBuffers;
use crate::noise::NoiseMeter;
use crate::place_map::SpreadBuffers;
use crate::posterior::PosteriorMap;

/// Buffers of one step of one target, whose contents nobody reads after it.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    pub(crate) buffers: AppearanceScratch,
    pub(crate) correlator: Correlator,
    pub(crate) meter: NoiseMeter,
    pub(crate) gate: Plane,
    pub(crate) statistics: Statistics,
    pub(crate) ratios: Plane,
    pub(crate) search: SearchScratch,
    pub(crate) map: PosteriorMap,
    pub(crate) comparison: ComparisonBuffers,
}

/// Buffers of a search.
#[derive(Debug, Default)]
pub(crate) struct SearchScratch {
    pub(crate) coarse: Plane,
    pub(crate) fine: Plane,
    pub(crate) change: Plane,
    pub(crate) contrasts: Vec<f32>,
    pub(crate) spread: SpreadBuffers,
    pub(crate) empty_scene: EmptySceneBuffers,
}
