//! What the detector finds while a target is lost, compared with the target's appearance.

use crate::PixelBox;
use crate::fit::TargetFit;
use crate::followed_target::ImageTarget;
use crate::frame::{FrameInput, TargetStep};
use crate::scratch::Scratch;
use crate::search::CLEAR_FIND;

/// Largest ratio of the sides of what is found to the target's, either way: outlines lose what is
/// as bright as the sky behind it. With half of it a panning camera's target is right in 96.5 % of
/// the frames instead of 97.5, and longer taken for something else.
const SIZES: f64 = 2.5;
/// Least share of the reference's energy that is the target's: one with much noise in it finds
/// itself in anything, and what moves there is then not followed as what it is. From 0.6 to 0.9 the
/// same is found; with half of it one sequence of 228, whose target no image shows at first, is
/// lost for good.
const LEAST_CLEAR: f32 = 0.7;
/// How far its middle may be off, in the larger sides. With half of it a target of which the
/// outline shows one end is not looked for at its middle.
const OFF_SIDES: f64 = 0.5;

/// A find of the detector that may be a lost target.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SightingOfLost {
    fit: TargetFit,
    /// Log likelihood ratio of the target being there, against background.
    pub(crate) log_ratio: f32,
    as_at_first: bool,
}

impl ImageTarget {
    /// The sighting of this target in a box that the detector has found, if it may be the target:
    /// that is lost, can have gone there, is about as large, and looked like it last or at first.
    pub(crate) fn sighting(
        &mut self,
        frame: FrameInput<'_>,
        found: PixelBox,
        scratch: &mut Scratch,
    ) -> Option<SightingOfLost> {
        if !self.state.is_searching() || !self.may_be(frame, found) {
            return None;
        }
        let last = self.seen_as_it_looks(frame, found, scratch);
        if !self.search_memory.take_first(&mut self.state, frame.config, &mut scratch.buffers) {
            return last;
        }
        let first = self.seen_as_it_looks(frame, found, scratch);
        self.search_memory.take_last(&mut self.state);
        let first = first.map(|first| SightingOfLost { as_at_first: true, ..first });
        [last, first]
            .into_iter()
            .flatten()
            .max_by(|one, other| one.log_ratio.total_cmp(&other.log_ratio))
    }

    /// Whether the target may be where something has been found, and as large.
    fn may_be(&self, frame: FrameInput<'_>, found: PixelBox) -> bool {
        let half = self.state.search_half_sides(frame.image, frame.config);
        let (at, predicted) = (found.centre(), self.state.position());
        let is_near =
            (at.x - predicted.x).abs() <= half[0] && (at.y - predicted.y).abs() <= half[1];
        let [width, height] = self.state.appearance.sides();
        let larger = ((found.width * found.height) / (width * height)).sqrt();
        is_near && (1.0 / SIZES..=SIZES).contains(&larger)
    }

    /// The best placement of the appearance in use near what has been found, if that may be the
    /// target.
    fn seen_as_it_looks(
        &mut self,
        frame: FrameInput<'_>,
        found: PixelBox,
        scratch: &mut Scratch,
    ) -> Option<SightingOfLost> {
        let [width, height] = self.state.appearance.sides();
        let reach = OFF_SIDES * found.width.max(found.height).max(width).max(height);
        let at = found.centre();
        let peak = self.state.best_near(
            frame.image,
            self.state.noise,
            [at.x, at.y],
            reach,
            scratch,
            frame.config,
        );
        let fit = self.state.fit_at(peak.column, peak.row, peak.origin, scratch, frame.config);
        let has_come = self.state.appearance.clear_share() > LEAST_CLEAR
            && peak.log_ratio > CLEAR_FIND.least_ratio
            && self.state.is_in_view(frame.image, fit.place)
            && self.identity.arrival_log_ratio(&self.state, frame, fit.place, scratch) >= 0.0;
        has_come.then_some(SightingOfLost { fit, log_ratio: peak.log_ratio, as_at_first: false })
    }

    /// Goes on, on probation, where the detector has found the target.
    pub(crate) fn go_on_at(
        &mut self,
        frame: FrameInput<'_>,
        sighting: SightingOfLost,
        scratch: &mut Scratch,
    ) -> TargetStep {
        let SightingOfLost { fit, as_at_first, .. } = sighting;
        if as_at_first {
            self.search_memory.take_first(&mut self.state, frame.config, &mut scratch.buffers);
        }
        self.hypotheses.clear();
        self.state.forget_surroundings();
        self.identity.begin_probation(&self.state, frame);
        self.state.motion.restart(fit.found(), frame.config.search_velocity_sd_px);
        self.seen(fit.place);
        TargetStep {
            measured: Some(self.state.measurement(&fit)),
            score: fit.score,
            certainty: 1.0,
            nis: None,
        }
    }
}
