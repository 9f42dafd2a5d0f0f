//! How the images lie against that in which the background was begun, and how fast the scene turns.

use std::collections::VecDeque;

use super::WARM_UP_S;
use super::straight::Straightening;
use crate::ImagePoint;
use crate::scene_turn::SceneTurn;

/// Averaging time of the registered turn, s: a jerk of one image is no turn. With half of it a jerk
/// of 20 px makes all that is in view move at 200 px/s instead of 100.
const TURN_S: f64 = 0.2;
/// Most roll (rad) and zoom (a share) of an image against that in which the background was begun:
/// corners are out of its view by then, and an image that is larger is blurred. With half of it a
/// camera that zooms in to twice the size begins five times anew instead of two, and finds nothing
/// for a quarter of a second each time.
const MOST_BENT: f64 = 0.25;
/// Most zoom out, a share: what has come into view on all sides has no place in the background.
/// With half of it a camera that zooms out by two begins fourteen times anew instead of seven.
const MOST_WIDER: f64 = 0.1;
/// What has come into view less than this ago is not found, s: twice the warm-up, so that a
/// candidate is begun by what is seen whole. With half of it what comes into a panning camera's
/// view is found (reasoned, not measured).
const COMES_S: f64 = 2.0 * WARM_UP_S;

/// Time and camera direction of an image, for the background.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment {
    /// How the image lies against that in which the background was begun.
    pub(super) view: Straightening,
    /// How fast it turns, in the mean, px/s.
    pub(super) turning_px_s: f64,
    /// Time since the image before, s.
    pub(super) interval: f64,
    /// Weight of this image in the background.
    pub(super) share: f32,
    pub(super) is_first: bool,
}

/// The images' views of the background.
#[derive(Debug)]
pub(super) struct Views {
    sides: [usize; 2],
    /// Where what was in the image in which the background was begun, and in the last one, was at
    /// the tracker's first image.
    begun: SceneTurn,
    last: Option<SceneTurn>,
    /// A running mean of how fast the middle of the image turns, px/s.
    turning: [f64; 2],
    /// Those of the last [`COMES_S`] and the one before, the oldest first, with their ages, s.
    recent: VecDeque<(f64, Straightening)>,
}

impl Views {
    pub(super) fn new(sides: [usize; 2]) -> Self {
        let begun = SceneTurn::none();
        Self { sides, begun, last: None, turning: [0.0; 2], recent: VecDeque::new() }
    }

    /// Notes where what is in the next image was at the tracker's first one.
    pub(super) fn note_turn(&mut self, turned: SceneTurn, interval: f64) {
        let share = 1.0 - (-interval / TURN_S).exp();
        // Before the first image of this detector the camera may have turned anywhere.
        let step = turned.and_then(self.last.unwrap_or(turned).inverse());
        let [x, y] = self.sides.map(|side| (side as f64 - 1.0) / 2.0);
        for (turning, moved) in self.turning.iter_mut().zip(step.moves(ImagePoint { x, y })) {
            *turning += share * (moved / interval - *turning);
        }
        self.last = Some(turned);
        self.recent.iter_mut().for_each(|(age_s, _)| *age_s += interval);
    }

    /// Whether the last image is rolled or zoomed too far to be compared with the background.
    pub(super) fn is_bent_too_far(&self) -> bool {
        let turn = self.since_begun();
        turn.bend() > MOST_BENT || turn.scale() > 1.0 + MOST_WIDER
    }

    /// Begins the background with the last image.
    pub(super) fn begin(&mut self) {
        self.begun = self.last.unwrap_or_default();
        self.recent.clear();
    }

    /// The view of the last image.
    pub(super) fn take(&mut self) -> Straightening {
        let view = Straightening::new(self.since_begun(), self.sides);
        while self.recent.get(1).is_some_and(|(age_s, _)| *age_s > COMES_S) {
            self.recent.pop_front();
        }
        self.recent.push_back((0.0, view));
        view
    }

    /// Where what is in the last image was when the background was begun.
    fn since_begun(&self) -> SceneTurn {
        self.last.unwrap_or(self.begun).and_then(self.begun.inverse())
    }

    /// Whether a place of the background has been in view for [`COMES_S`], or for as long as it has
    /// been learnt: what has just come into view has no known background, and what is cut by the
    /// border seems to move as it comes in.
    pub(super) fn have_shown(&self, in_scene: [f64; 2]) -> bool {
        self.recent.iter().all(|(_, view)| view.shows(in_scene))
    }

    /// The velocity in the image of what moves over the background, px/s: as far as the scene is
    /// registered as turning.
    pub(super) fn velocity_in_image(&self, over_background: [f64; 2]) -> [f64; 2] {
        let latest = self.recent.back();
        let bent =
            latest.map_or(over_background, |(_, view)| view.velocity_in_image(over_background));
        [0, 1].map(|i| bent[i] - self.turning[i])
    }

    /// How fast the middle of the image turns in the mean, px/s.
    pub(super) fn turning_px_s(&self) -> f64 {
        self.turning[0].hypot(self.turning[1])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDES: [usize; 2] = [320, 240];

    #[test]
    fn where_the_camera_looked_before_the_first_image_is_no_turn() {
        let mut views = Views::new(SIDES);
        views.note_turn(SceneTurn::shift([1000.0, 0.0]), 1.0 / 30.0);
        assert!(views.turning_px_s() < 1e-9, "{}", views.turning_px_s());
        for image in 1..60 {
            let turned = SceneTurn::shift([1000.0 + 2.0 * f64::from(image), 0.0]);
            views.note_turn(turned, 1.0 / 30.0);
        }
        assert!((views.turning_px_s() - 60.0).abs() < 0.1, "{}", views.turning_px_s());
    }

    /// At 30 images a second and at one.
    #[test]
    fn what_has_come_into_view_is_new_for_half_a_second_and_two_images() {
        for (interval, images) in [(1.0 / 30.0, 17), (1.0, 2)] {
            let mut views = Views::new(SIDES);
            let mut look = |shift: f64| {
                views.note_turn(SceneTurn::shift([shift, 0.0]), interval);
                if views.recent.is_empty() {
                    views.begin();
                }
                views.take();
                views.have_shown([350.0, 100.0])
            };
            assert!(!look(0.0));
            let new = (0..60).take_while(|_| !look(100.0)).count();
            assert_eq!(new, images - 1, "every {interval} s");
        }
    }

    #[test]
    fn a_camera_that_rolls_or_zooms_far_begins_anew() {
        let middle = ImagePoint { x: 159.5, y: 119.5 };
        for (zoom, roll, is_far) in
            [(-0.2, 0.0, false), (-0.3, 0.0, true), (0.12, 0.0, true), (0.0, 0.2, false)]
        {
            let mut views = Views::new(SIDES);
            views.note_turn(SceneTurn::shift([500.0, 3.0]), 0.1);
            views.begin();
            let turn = SceneTurn::about(middle, [0.0; 2], zoom, roll);
            views.note_turn(turn.and_then(SceneTurn::shift([500.0, 3.0])), 0.1);
            assert_eq!(views.is_bent_too_far(), is_far, "zoom {zoom}, roll {roll}");
            views.begin();
            assert!(!views.is_bent_too_far());
        }
    }
}
