//! The two looks that a lost target is searched for in: its last one, and the one it had at first
//! (the mean of its first images, as many as it takes to be clear of noise).
//!
//! A reference follows what a target looks like, into the clouds and trees that it is lost before,
//! too.

use crate::TrackerConfig;
use crate::appearance::{Appearance, AppearanceScratch};
use crate::search::Background;
use crate::target::Target;

/// Looks that correlate less than this are different ones: on the real and drawn cases those of
/// targets that have not changed correlate by 0.94 or more, and 0.65 to 0.78 where the last look
/// finds nothing. With half of it the first look is not searched for.
const ALIKE: f32 = 0.8;
/// Until so long after it was seen only its last look is searched for, s: before that it has been
/// hidden, and has turned since it was first seen. With half of it one that turns is found where it
/// is not, with twice as much one that has fooled its reference is found a second later.
const LAST_LOOK_S: f64 = 1.0;
/// With its first look it is seen as it was then; how much that may vary the search knows.
const FIRST_CONTRAST: f64 = 1.0;

/// The look that is not in use of the two.
#[derive(Clone, Debug)]
pub(crate) struct OtherLook {
    appearance: Appearance,
    contrast: f64,
    usual_contrast: f64,
    background: Option<Background>,
    /// Whether it is the last one, as the first is in use.
    is_last: bool,
    is_like_the_first: bool,
}

impl Target {
    /// Takes its first look, unless the last is like it or it was seen a moment ago. False if it
    /// has not.
    pub(crate) fn take_first_look(
        &mut self,
        config: &TrackerConfig,
        buffers: &mut AppearanceScratch,
    ) -> bool {
        if self.unseen_s < LAST_LOOK_S {
            return false;
        }
        let last = &self.appearance;
        let other = self.other_look.get_or_insert_with(|| {
            let appearance = last.at_first(config, buffers);
            let is_like_the_first = last.likeness(&appearance) >= ALIKE;
            Box::new(OtherLook {
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
        self.exchange_looks();
        true
    }

    /// Takes its last look, if the first is in use.
    pub(crate) fn take_last_look(&mut self) {
        if self.other_look.as_ref().is_some_and(|other| other.is_last) {
            self.exchange_looks();
        }
    }

    fn exchange_looks(&mut self) {
        let Some(other) = &mut self.other_look else { return };
        std::mem::swap(&mut self.appearance, &mut other.appearance);
        std::mem::swap(&mut self.contrast, &mut other.contrast);
        std::mem::swap(&mut self.usual_contrast, &mut other.usual_contrast);
        std::mem::swap(&mut self.background, &mut other.background);
        other.is_last = !other.is_last;
    }
}
