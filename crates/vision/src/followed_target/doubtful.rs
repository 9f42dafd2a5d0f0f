//! A target that may be in several places.

use super::ImageTarget;
use crate::TrackerConfig;
use crate::config::GateRule;
use crate::frame::{FrameInput, TargetStep};
use crate::gate::Region;
use crate::hypotheses::ONE_PLACE;
use crate::motion::ImageMotion;
use crate::posterior::Posterior;
use crate::scratch::Scratch;
use crate::state::SEEN;
use crate::tracker_part::TrackerPart;

/// Turns of the camera by less than this are within the uncertainty of a target's motion anyway,
/// px. With half of it small errors of the registration fork the hypotheses too, each at the cost
/// of a posterior.
pub(crate) const LEAST_MOVE_PX: f64 = 2.0;

impl ImageTarget {
    /// Forks the hypotheses if the camera may have turned: then everything in its image has moved,
    /// the target too. But light that changes may be taken for a turn, so the target may have
    /// stayed as well.
    pub(super) fn may_move_with_scene(&mut self, frame: FrameInput<'_>) {
        let by = frame.scene_moved.moves(self.state.position());
        let is_followed = !self.state.is_searching() && !self.identity.is_on_probation();
        if is_followed
            && by[0].hypot(by[1]) >= LEAST_MOVE_PX
            && frame.config.has(TrackerPart::SeveralPlaces)
            && matches!(frame.config.gate, GateRule::Innovation { .. })
        {
            self.hypotheses.begin(&self.state);
            self.hypotheses.fork(by);
        }
    }

    /// Whether a posterior leaves more than one place to be followed.
    pub(super) fn has_several_places(&self, posterior: &Posterior, config: &TrackerConfig) -> bool {
        let is_unsure = !self.hypotheses.is_empty() || posterior.near.mass < ONE_PLACE;
        is_unsure
            && config.has(TrackerPart::SeveralPlaces)
            && matches!(config.gate, GateRule::Innovation { .. })
            && !self.identity.is_on_probation()
    }

    /// Follows all places where the target may be into the image whose log likelihood ratios are in
    /// `scratch.ratios`.
    pub(super) fn follow_hypotheses(
        &mut self,
        frame: FrameInput<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> TargetStep {
        self.hypotheses.begin(&self.state);
        if let Some((motion, posterior)) =
            self.hypotheses.one_place(&self.state, frame, region, scratch)
        {
            return self.settle_on(motion, &posterior, frame, region, scratch);
        }
        self.hypotheses.advance(&self.state, frame, region, scratch);
        let Some(best) = self.hypotheses.best().cloned() else {
            self.hypotheses.clear();
            self.state.missed += 1;
            return TargetStep::UNSEEN;
        };
        // The likeliest hypothesis is reported; its covariance gets the spread of the others
        // (`covariances`).
        (self.state.motion, self.state.hidden) = (best.motion, best.hidden);
        self.hypotheses.note_unsure(frame.interval);
        let is_unseen =
            self.hypotheses.seen_share() < 1.0 - ONE_PLACE || self.hypotheses.are_hopeless();
        let Some([column, row]) = best.peak else {
            self.state.missed += u32::from(is_unseen);
            self.settle(0.0);
            return TargetStep::UNSEEN;
        };
        let sure = self.hypotheses.share_near([column, row], self.state.peak_half());
        let fit = self.state.fit_at(column, row, region.origin, scratch, frame.config);
        let is_there = self.identity.measurement_update(&self.state, frame, fit, scratch);
        // P(at this place) P(the thing there is the target).
        let certainty = sure * is_there;
        if certainty > SEEN {
            self.state.motion.add_noise_of_learned(fit.found().map(|at| at.variance));
            self.seen(fit.place);
        } else if is_unseen || is_there < SEEN {
            self.state.missed += 1;
        }
        self.learn(frame, fit.place, fit, certainty, scratch);
        self.settle(best.weight);
        let measured = (certainty > SEEN).then(|| self.state.measurement(&fit));
        TargetStep { measured, score: fit.score, certainty, nis: None }
    }

    /// Forgets the other hypotheses if one place is left, or none.
    fn settle(&mut self, weight: f64) {
        if weight > ONE_PLACE || self.state.is_searching() {
            self.hypotheses.clear();
        }
    }

    /// Settles on the likeliest hypothesis: the target is sure to have been where that was.
    fn settle_on(
        &mut self,
        motion: ImageMotion,
        posterior: &Posterior,
        frame: FrameInput<'_>,
        region: Region,
        scratch: &mut Scratch,
    ) -> TargetStep {
        self.state.motion = motion;
        self.hypotheses.clear();
        let [column, row] = posterior.peak;
        let fit = self.state.fit_at(column, row, region.origin, scratch, frame.config);
        self.update(frame, posterior, fit, region.origin, scratch)
    }
}
