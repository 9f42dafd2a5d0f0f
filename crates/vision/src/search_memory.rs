//! What is kept of a target for the case that it is lost: what else it is searched for as, and what
//! the scene itself looks like to its reference.
//!
//! It is searched for as it looked last, and as it looked at first (the mean of its first images, as
//! many as it takes to be clear of noise): a reference follows what a target looks like, into the
//! clouds and trees that it is lost before, too.

use crossfix_correlation::Plane;

use crate::TrackerConfig;
use crate::appearance::{Appearance, AppearanceScratch};
use crate::state::State;

/// Appearances that correlate less than this are different ones: on the real and drawn cases those of
/// targets that have not changed correlate by 0.94 or more, and 0.65 to 0.78 where the last one
/// finds nothing. With half of it the first one is not searched for.
const ALIKE: f32 = 0.8;
/// Until so long after it was seen only its last appearance is searched for, s: before that it has been
/// hidden, and has turned since it was first seen. With half of it one that turns is found where it
/// is not, with twice as much one that has fooled its reference is found a second later.
const LAST_ALONE_S: f64 = 1.0;
/// With its first appearance it is seen as it was then; how much that may vary the search knows.
const FIRST_CONTRAST: f64 = 1.0;

/// What the scene itself looks like to a target's reference: the log ratios in a picture in which
/// the target was elsewhere, made coarser by a whole number.
#[derive(Clone, Debug)]
pub(crate) struct Background {
    pub(crate) coarseness: usize,
    pub(crate) ratios: Plane,
}

/// What is kept for a search.
#[derive(Clone, Debug, Default)]
pub(crate) struct SearchMemory {
    /// How often the target has been searched for since it was last seen.
    pub(crate) searches: u32,
    pub(crate) background: Option<Background>,
    other: Option<Box<OtherAppearance>>,
}

/// Of the last and the first appearance, the one that is not in use.
#[derive(Clone, Debug)]
struct OtherAppearance {
    appearance: Appearance,
    contrast: f64,
    usual_contrast: f64,
    background: Option<Background>,
    /// Whether it is the last one, as the first is in use.
    is_last: bool,
    is_like_the_first: bool,
}

impl SearchMemory {
    /// The target has been seen.
    pub(crate) fn seen(&mut self) {
        (self.searches, self.background) = (0, None);
    }

    /// The target has been seen for sure.
    pub(crate) fn forget_other(&mut self) {
        self.other = None;
    }

    /// Gives a target its first appearance, unless the last is like it or it was seen a moment ago.
    /// False if it has not.
    pub(crate) fn take_first(
        &mut self,
        state: &mut State,
        config: &TrackerConfig,
        buffers: &mut AppearanceScratch,
    ) -> bool {
        if state.unseen_s < LAST_ALONE_S {
            return false;
        }
        let last = &state.appearance;
        let other = self.other.get_or_insert_with(|| {
            let appearance = last.at_first(config, buffers);
            let is_like_the_first = last.likeness(&appearance) >= ALIKE;
            Box::new(OtherAppearance {
                appearance,
                contrast: FIRST_CONTRAST,
                usual_contrast: FIRST_CONTRAST,
                background: None,
                is_last: false,
                is_like_the_first,
            })
        });
        if other.is_last || other.is_like_the_first {
            return false;
        }
        self.exchange(state);
        true
    }

    /// Gives it its last appearance, if the first is in use.
    pub(crate) fn take_last(&mut self, state: &mut State) {
        if self.other.as_ref().is_some_and(|other| other.is_last) {
            self.exchange(state);
        }
    }

    fn exchange(&mut self, state: &mut State) {
        let Some(other) = &mut self.other else { return };
        std::mem::swap(&mut state.appearance, &mut other.appearance);
        std::mem::swap(&mut state.contrast, &mut other.contrast);
        std::mem::swap(&mut state.usual_contrast, &mut other.usual_contrast);
        std::mem::swap(&mut self.background, &mut other.background);
        other.is_last = !other.is_last;
    }
}
