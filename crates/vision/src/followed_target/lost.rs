//! A target that is lost, and what is found in its place again.

use crossfix_filter::AxisMeasurement;

use super::ImageTarget;
use crate::frame::{FrameInput, TargetStep};
use crate::scratch::Scratch;
use crate::search::Sought;

/// A place near the prediction continues the motion if fewer images than this were missed; after
/// more the motion begins again. (A limit in seconds unseen counts doubtful images as well: tried,
/// it doubled the false boxes on a clip of birds and gained nothing on two others.) With half of it
/// a target that a cloud hides for longer than a third of a second, at 30 images per second, loses
/// its velocity.
const CONTINUES_IMAGES: u32 = 20;
/// Squared distance from the prediction up to which a place is near it, on either axis, over the
/// prediction's variance. With half of it one right place in 1200 begins the motion again by
/// chance, instead of one in a million.
const CONTINUES_WITHIN: f64 = 25.0;

impl ImageTarget {
    pub(super) fn search(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> TargetStep {
        self.state.forget_contrast(frame.interval);
        self.state.forget_surroundings();
        if !frame.may_search {
            self.state.missed += 1;
            return TargetStep::UNSEEN;
        }
        self.find_again(frame, scratch).unwrap_or_else(|| {
            self.state.missed += 1;
            TargetStep::UNSEEN
        })
    }

    /// Takes what a search finds.
    fn find_again(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> Option<TargetStep> {
        let Self { state, identity, search_memory: memory, .. } = self;
        let fit = Sought { state, identity, memory }.find(frame, scratch)?;
        self.identity.begin_probation(&self.state, frame);
        let (found, expected) = (fit.found(), self.state.motion.found());
        if self.state.missed < CONTINUES_IMAGES && are_near(found, expected) {
            self.state.motion.condition([0, 1].map(|i| AxisMeasurement {
                variance: found[i].variance.min(expected[i].variance),
                ..found[i]
            }));
        } else {
            self.state.motion.restart(found, frame.config.search_velocity_sd_px);
        }
        self.seen(fit.place);
        self.hypotheses.clear();
        let measured = self.state.measurement(&fit);
        Some(TargetStep { measured: Some(measured), score: fit.score, certainty: 1.0, nis: None })
    }

    /// Follows what a search has found. If that is lost again soon it was something else, and the
    /// search goes on from what was known before.
    pub(super) fn follow_on_probation(
        &mut self,
        frame: FrameInput<'_>,
        scratch: &mut Scratch,
    ) -> TargetStep {
        self.identity.predict_probation(frame);
        let step = self.follow(frame, scratch);
        if self.state.is_searching() && self.identity.fail_probation(&mut self.state) {
            self.search_memory.take_last(&mut self.state);
            return step;
        }
        self.identity.go_on_with_probation(step.certainty * frame.interval);
        step
    }
}

/// Whether a place is near the prediction on both axes.
fn are_near(found: [AxisMeasurement; 2], expected: [AxisMeasurement; 2]) -> bool {
    found.iter().zip(expected).all(|(found, expected)| {
        (found.position - expected.position).powi(2) < CONTINUES_WITHIN * expected.variance
    })
}
