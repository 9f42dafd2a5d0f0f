//! What the detector finds while a target is lost, held against its looks.

use crate::PixelBox;
use crate::frame::{Frame, Step};
use crate::look::Look;
use crate::search::{LEAST_RATIO, best_near, half_sides};
use crate::target::{Scratch, Target};

/// What is found may be so many times larger or smaller than the target was, a side: outlines lose
/// what is as bright as the sky behind it. With half of it a panning camera's target is right in
/// 96.5 % of the frames in place of 97.5, and longer taken for something else.
const SIZES: f64 = 2.5;
/// Its middle may be this far off, in the larger sides.
const OFF_SIDES: f64 = 0.5;

/// What the detector has found, as a lost target.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sighting {
    look: Look,
    /// Logarithm of the likelihood ratio of the target's being there against background.
    pub(crate) log_ratio: f32,
    by_first_look: bool,
}

impl Target {
    /// Whether what the detector has found in a box may be this one, which is lost: where it can
    /// have gone to, about as large, and like what it was last or at first.
    pub(crate) fn sighting(
        &mut self,
        frame: Frame<'_>,
        found: PixelBox,
        scratch: &mut Scratch,
    ) -> Option<Sighting> {
        if !self.is_searching() || !self.may_be(frame, found) {
            return None;
        }
        let last = self.seen_as_it_looks(frame, found, scratch);
        if !self.take_first_look(frame.config, &mut scratch.buffers) {
            return last;
        }
        let first = self.seen_as_it_looks(frame, found, scratch);
        self.take_last_look();
        let first = first.map(|first| Sighting { by_first_look: true, ..first });
        [last, first]
            .into_iter()
            .flatten()
            .max_by(|one, other| one.log_ratio.total_cmp(&other.log_ratio))
    }

    /// Whether it may be where something has been found, and as large.
    fn may_be(&self, frame: Frame<'_>, found: PixelBox) -> bool {
        let working = self.appearance.working.image();
        let half = half_sides(self, frame.image, [working.width(), working.height()], frame.config);
        let (at, predicted) = (found.centre(), self.position());
        let is_near =
            (at.x - predicted.x).abs() <= half[0] && (at.y - predicted.y).abs() <= half[1];
        let [width, height] = self.appearance.sides();
        let larger = ((found.width * found.height) / (width * height)).sqrt();
        is_near && (1.0 / SIZES..=SIZES).contains(&larger)
    }

    /// The best placement of the look in use about what has been found, if it is one.
    fn seen_as_it_looks(
        &mut self,
        frame: Frame<'_>,
        found: PixelBox,
        scratch: &mut Scratch,
    ) -> Option<Sighting> {
        let [width, height] = self.appearance.sides();
        let reach = OFF_SIDES * found.width.max(found.height).max(width).max(height);
        let at = found.centre();
        let peak =
            best_near(self, frame.image, self.noise, [at.x, at.y], reach, scratch, frame.config);
        let look = self.look(peak.column, peak.row, peak.origin, scratch, frame.config);
        let has_come = peak.log_ratio > LEAST_RATIO
            && self.arrival_log_ratio(frame, look.place, scratch) >= 0.0;
        has_come.then_some(Sighting { look, log_ratio: peak.log_ratio, by_first_look: false })
    }

    /// Goes on where the detector has found it, on probation.
    pub(crate) fn go_on_at(
        &mut self,
        frame: Frame<'_>,
        sighting: Sighting,
        scratch: &mut Scratch,
    ) -> Step {
        let Sighting { look, by_first_look, .. } = sighting;
        if by_first_look {
            self.take_first_look(frame.config, &mut scratch.buffers);
        }
        self.hypotheses.clear();
        self.begin_probation(frame.scene);
        self.motion.restart(look.found(), frame.config.search_velocity_sd_px);
        self.seen(look.place);
        Step {
            measured: Some(self.measurement(&look)),
            score: look.score,
            certainty: 1.0,
            nis: None,
        }
    }
}
