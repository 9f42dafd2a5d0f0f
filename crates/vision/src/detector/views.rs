//! How the images lie against that to which the background is fixed, and how fast the scene turns.

use super::straight::Straightening;
use crate::ImagePoint;
use crate::scene_turn::SceneTurn;

/// Averaging time of the registered turn, s: a jerk of one image is no turn. With half of it a jerk
/// of 20 px makes all that is in view move at 200 px/s instead of 100.
const TURN_S: f64 = 0.2;
/// Most roll (rad) and zoom (a share) of an image against that to which the background is fixed:
/// corners are out of its view by then, and an image that is larger is blurred. With 0.1 the
/// background is fixed anew more often, and what is about to be found is forgotten each time:
/// before thermal cameras that zoom 55 % of the images have their target, not 64.
const MOST_BENT: f64 = 0.25;

/// Time and camera direction of an image, for the background.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment {
    /// How the image lies against that to which the background is fixed.
    pub(super) view: Straightening,
    /// How fast it turns, in the mean, px/s.
    pub(super) turning_px_s: f64,
    /// Time since the image before, s.
    pub(super) interval: f64,
    /// Least weight of this image in the background, and that in a plain mean of all its images.
    pub(super) share: f32,
    pub(super) young: f32,
    pub(super) is_first: bool,
}

/// The images' views of the background.
#[derive(Debug)]
pub(super) struct Views {
    sides: [usize; 2],
    /// Where what was in the image to which the background is fixed, and in the last one, was at
    /// the tracker's first image.
    fixed: SceneTurn,
    last: Option<SceneTurn>,
    /// A running mean of how fast the middle of the image turns, px/s.
    turning: [f64; 2],
}

impl Views {
    pub(super) fn new(sides: [usize; 2]) -> Self {
        let fixed = SceneTurn::none();
        Self { sides, fixed, last: None, turning: [0.0; 2] }
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
    }

    /// Whether the last image is rolled or zoomed too far to be compared with the background.
    pub(super) fn is_bent_too_far(&self) -> bool {
        self.since_fixed().bend() > MOST_BENT
    }

    /// Fixes the background to the last image.
    pub(super) fn fix(&mut self) {
        self.fixed = self.last.unwrap_or_default();
    }

    /// The view of the last image.
    pub(super) fn of_last(&self) -> Straightening {
        Straightening::new(self.since_fixed(), self.sides)
    }

    /// Where what is in the last image was in that to which the background is fixed.
    fn since_fixed(&self) -> SceneTurn {
        self.last.unwrap_or(self.fixed).and_then(self.fixed.inverse())
    }

    /// The velocity in the image of what moves over the background, px/s: as far as the scene is
    /// registered as turning.
    pub(super) fn velocity_in_image(&self, over_background: [f64; 2]) -> [f64; 2] {
        let bent = self.of_last().velocity_in_image(over_background);
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

    #[test]
    fn a_camera_that_rolls_or_zooms_far_is_noticed() {
        let middle = ImagePoint { x: 159.5, y: 119.5 };
        for (zoom, roll, is_far) in [
            (-0.2, 0.0, false),
            (-0.3, 0.0, true),
            (0.2, 0.0, false),
            (0.3, 0.0, true),
            (0.0, 0.2, false),
            (0.0, 0.3, true),
        ] {
            let mut views = Views::new(SIDES);
            views.note_turn(SceneTurn::shift([500.0, 3.0]), 0.1);
            views.fix();
            let turn = SceneTurn::about(middle, [0.0; 2], zoom, roll);
            views.note_turn(turn.and_then(SceneTurn::shift([500.0, 3.0])), 0.1);
            assert_eq!(views.is_bent_too_far(), is_far, "zoom {zoom}, roll {roll}");
            views.fix();
            assert!(!views.is_bent_too_far());
        }
    }
}
