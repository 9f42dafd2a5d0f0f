//! What is kept of a target in case it is lost: the other appearance with which it is searched for,
//! and what the scene itself looks like to its reference.
//!
//! A target is searched for as it looked last, and as it looked at first (the mean of its first
//! images, as many as it takes to be clear of noise): a reference follows what a target looks like,
//! and so it also becomes like the clouds and trees before which the target is lost. In what has
//! changed both are sought by turns; in the image, from a second on, the first alone: by turns, a
//! tenth more of small targets in noise was lost. One that has changed and hovers is then left to
//! the detector.

use crate::TrackerConfig;
use crate::appearance::{Appearance, AppearanceScratch};
use crate::empty_scene::Background;
use crate::place_map::PlaceMap;
use crate::scene_turn::SceneTurn;
use crate::state::TargetBelief;
use crate::tracker_part::TrackerPart;

/// Correlation below which two appearances are different: on the real and drawn cases those of
/// targets that have not changed correlate by 0.94 or more, and 0.65 to 0.78 where the last one
/// finds nothing. With half of it the first one is not searched for.
const SAME_APPEARANCE: f32 = 0.8;
/// For this long after it was seen a target is searched for by its last appearance alone, s: before
/// that it has only been hidden, and has turned since it was first seen. With half of it one that
/// turns is found where it is not, with twice as much one that has fooled its reference is found a
/// second later.
const LAST_ALONE_S: f64 = 1.0;
/// Contrast with the first appearance: the target is as it was then; how much that may vary the
/// search knows. With half of it the first appearance is expected at half the contrast, and a
/// target as bright as at first is found later.
const FIRST_CONTRAST: f64 = 1.0;

/// Where a target may be, after the last image that was searched for it.
#[derive(Clone, Debug)]
pub(crate) struct SearchMap {
    pub(crate) places: PlaceMap,
    /// For how long the target had not been seen then, s, and `SceneMemory::turned` then.
    pub(crate) unseen_s: f64,
    pub(crate) turned: SceneTurn,
    /// How fast the target was when it was lost, px/s.
    pub(crate) speed: f64,
}

/// What is kept for a search.
#[derive(Clone, Debug, Default)]
pub(crate) struct SearchMemory {
    /// How often the target has been searched for since it was last seen.
    pub(crate) searches: u32,
    pub(crate) background: Option<Background>,
    /// Where the target may be since it was seen last.
    pub(crate) map: Option<SearchMap>,
    other: Option<Box<OtherAppearance>>,
}

/// The appearance that is not in use, of the last and the first.
#[derive(Clone, Debug)]
struct OtherAppearance {
    appearance: Appearance,
    contrast: f64,
    usual_contrast: f64,
    usual_match: f64,
    background: Option<Background>,
    /// Whether it is the last one, so that the first is in use.
    is_last: bool,
    is_like_the_first: bool,
}

impl OtherAppearance {
    /// The first appearance of a target whose last one is in use.
    fn first_of(
        last: &Appearance,
        config: &TrackerConfig,
        buffers: &mut AppearanceScratch,
    ) -> Self {
        let appearance = last.at_first(config, buffers);
        let is_like_the_first = last.likeness(&appearance) >= SAME_APPEARANCE;
        Self {
            appearance,
            contrast: FIRST_CONTRAST,
            usual_contrast: FIRST_CONTRAST,
            usual_match: 1.0,
            background: None,
            is_last: false,
            is_like_the_first,
        }
    }
}

impl SearchMemory {
    /// Forgets what belongs to one loss: the target has been seen.
    pub(crate) fn seen(&mut self) {
        (self.searches, self.background, self.map) = (0, None, None);
    }

    /// Forgets where the target may be and what the scene looks like: nobody knows what the camera
    /// has done meanwhile.
    pub(crate) fn forget_places(&mut self) {
        (self.background, self.map) = (None, None);
        if let Some(other) = &mut self.other {
            other.background = None;
        }
    }

    /// Forgets the appearance that is not in use: the target has been seen for sure.
    pub(crate) fn forget_other(&mut self) {
        self.other = None;
    }

    /// Gives the target its first appearance, unless the last one is like it or the target was seen
    /// a moment ago. Returns whether it has.
    pub(crate) fn take_first(
        &mut self,
        state: &mut TargetBelief,
        config: &TrackerConfig,
        buffers: &mut AppearanceScratch,
    ) -> bool {
        if state.unseen_s < LAST_ALONE_S || !config.has(TrackerPart::FirstAppearance) {
            return false;
        }
        let last = &state.appearance;
        let other = self
            .other
            .get_or_insert_with(|| Box::new(OtherAppearance::first_of(last, config, buffers)));
        if other.is_last || other.is_like_the_first {
            return false;
        }
        self.exchange(state);
        true
    }

    /// Gives the target its last appearance back, if the first is in use.
    pub(crate) fn take_last(&mut self, state: &mut TargetBelief) {
        if self.other.as_ref().is_some_and(|other| other.is_last) {
            self.exchange(state);
        }
    }

    fn exchange(&mut self, state: &mut TargetBelief) {
        let Some(other) = &mut self.other else { return };
        std::mem::swap(&mut state.appearance, &mut other.appearance);
        std::mem::swap(&mut state.contrast, &mut other.contrast);
        std::mem::swap(&mut state.usual_contrast, &mut other.usual_contrast);
        std::mem::swap(&mut state.usual_match, &mut other.usual_match);
        std::mem::swap(&mut self.background, &mut other.background);
        other.is_last = !other.is_last;
    }
}

#[cfg(test)]
mod tests {
    use crossfix_correlation::Plane;

    use super::*;
    use crate::scratch::Scratch;
    use crate::search_area::SearchArea;
    use crate::{ImagePoint, PixelBox};

    #[test]
    fn after_a_gap_nothing_is_known_of_the_scene_by_either_appearance() {
        let image =
            Plane::from_fn(60, 40, |x, y| if x.abs_diff(30) < 4 { 200.0 } else { y as f32 });
        let place = PixelBox::about(ImagePoint { x: 30.0, y: 20.0 }, 8.0, 8.0);
        let (mut scratch, config) = (Scratch::default(), TrackerConfig::default());
        let mut state = TargetBelief::new(&image, place, &mut scratch, &config);
        state.unseen_s = 2.0 * LAST_ALONE_S;
        let area = SearchArea::with_sides([60, 40], [8, 8], 1);
        let background = || Some(Background::new(&image, &area, &[], SceneTurn::none()));
        let mut memory = SearchMemory { background: background(), ..SearchMemory::default() };
        memory.take_first(&mut state, &config, &mut scratch.buffers);
        memory.other.as_mut().unwrap().background = background();
        memory.forget_places();
        assert!(memory.background.is_none() && memory.other.unwrap().background.is_none());
    }
}
