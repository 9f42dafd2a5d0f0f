//! The image as a camera would see it that has not rolled or zoomed against the one to which the
//! background is fixed, only turned: the background is fixed to such images.

use std::ops::Range;

use crossfix_correlation::{Plane, Resampler, View};

use super::background::MARGIN;
use crate::scene_turn::SceneTurn;
use crate::{ImagePoint, PixelBox};

/// What roll and zoom move by less than this in the corners, px, a quarter of the finest cell, is
/// left as it is: a sharp image is worth more, and a third of the detector's time is spared. With
/// half of it the noise of the registration blurs the images of a camera that only pans.
const UNBENT_PX: f64 = 0.5;

/// How an image lies against that to which the background is fixed: what is at a place of it was
/// at that place rolled and zoomed about the middle, and then shifted.
#[derive(Clone, Copy, Debug)]
pub(super) struct Straightening {
    /// Where what is at a place of the image is in the straightened one.
    bent: SceneTurn,
    /// The same the other way.
    unbent: SceneTurn,
    /// From there to where it was, px.
    shift: [f64; 2],
    sides: [usize; 2],
}

impl Straightening {
    /// By where what is in an image of these sides was in that to which the background is fixed.
    pub(super) fn new(turn: SceneTurn, sides: [usize; 2]) -> Self {
        let [x, y] = sides.map(|side| (side as f64 - 1.0) / 2.0);
        let middle = ImagePoint { x, y };
        let is_bent = turn.bend() * x.hypot(y) > UNBENT_PX;
        let [zoom, roll] = turn.zoom_and_roll();
        let bent = SceneTurn::about(middle, [0.0; 2], zoom, roll);
        let bent = if is_bent { bent } else { SceneTurn::none() };
        Self { bent, unbent: bent.inverse(), shift: turn.moves(middle), sides }
    }

    /// By how much what is in the straightened image was farther, px.
    pub(super) fn shift(&self) -> [f64; 2] {
        self.shift
    }

    /// Whether the straightened image is the image itself.
    pub(super) fn is_none(&self) -> bool {
        self.bent == SceneTurn::none()
    }

    /// Where what is at a place of the image is in the straightened one.
    pub(super) fn straight(&self, place: ImagePoint) -> ImagePoint {
        self.bent.place(place)
    }

    /// Where what is in a box of the image is in the straightened one.
    pub(super) fn straight_box(&self, place: PixelBox) -> PixelBox {
        // What is about it, turned: |1 + zoom| w + |roll| h across.
        let [zoom, roll] = self.bent.zoom_and_roll();
        let about = |along: f64, across: f64| (1.0 + zoom).abs() * along + roll.abs() * across;
        let [width, height] = [about(place.width, place.height), about(place.height, place.width)];
        PixelBox::about(self.straight(place.centre()), width, height)
    }

    /// A velocity of the straightened image in the image.
    pub(super) fn velocity_in_image(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [from, to] = [[0.0; 2], [x, y]].map(|[x, y]| self.unbent.place(ImagePoint { x, y }));
        [to.x - from.x, to.y - from.y]
    }

    /// Where what is at a place of the straightened image is in the image.
    pub(super) fn in_image(&self, straight: ImagePoint) -> ImagePoint {
        self.unbent.place(straight)
    }

    /// Where what is at a place of the straightened image was in that to which the background is
    /// fixed.
    pub(super) fn in_scene(&self, straight: ImagePoint) -> [f64; 2] {
        [straight.x + self.shift[0], straight.y + self.shift[1]]
    }

    /// Fills `to` with the straightened image's means over cells of `cell` px, from the image's.
    pub(super) fn straighten(
        &self,
        from: &Plane,
        cell: usize,
        resampler: &mut Resampler,
        to: &mut Plane,
    ) {
        to.reshape(from.width(), from.height());
        let middle_of = |count: usize| (count * cell) as f64 / 2.0 - 0.5;
        let [x, y] = [middle_of(from.width()), middle_of(from.height())];
        let there = self.in_image(ImagePoint { x, y });
        let [x, y] = [there.x, there.y].map(|at| (at + 0.5) / cell as f64 - 0.5);
        let (scale, turn_rad) = (self.bent.scale().recip(), -self.bent.roll_rad());
        resampler.resample(from, View { x, y, scale, turn_rad }, to);
    }

    /// The cells of a row, of `count` cells of `cell` px, whose surroundings are in view.
    pub(super) fn cells_in_view(&self, row: usize, count: usize, cell: usize) -> Range<usize> {
        if self.is_none() {
            return 0..count;
        }
        let middle = |at: usize| (at * cell) as f64 + (cell as f64 - 1.0) / 2.0;
        let place = |column: usize| self.in_image(ImagePoint { x: middle(column), y: middle(row) });
        let (first, second) = (place(0), place(1));
        let (mut from, mut to) = (0.0_f64, count as f64 - 1.0);
        let axes = [(first.x, second.x, self.sides[0]), (first.y, second.y, self.sides[1])];
        // What a cell is compared with reaches as far in the image, turned: |1 + zoom| + |roll|.
        let [zoom, roll] = self.unbent.zoom_and_roll();
        let margin = (MARGIN * cell) as f64 * ((1.0 + zoom).abs() + roll.abs());
        // first + step column lies from the margin to as far from the other side.
        for (first, second, side) in axes {
            let step = second - first;
            let bounds = [margin - first, side as f64 - 1.0 - margin - first];
            if step.abs() < 1e-9 {
                if bounds[0] > 0.0 || bounds[1] < 0.0 {
                    return 0..0;
                }
                continue;
            }
            let [one, other] = bounds.map(|bound| bound / step);
            (from, to) = (from.max(one.min(other)), to.min(one.max(other)));
        }
        let from = (from.ceil() as usize).min(count);
        from..((to + 1.0).max(0.0) as usize).clamp(from, count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDES: [usize; 2] = [320, 240];
    const MIDDLE: ImagePoint = ImagePoint { x: 159.5, y: 119.5 };

    #[test]
    fn what_has_been_straightened_has_only_shifted() {
        let turn = SceneTurn::about(MIDDLE, [7.0, -3.0], 0.1, 0.2);
        let view = Straightening::new(turn, SIDES);
        for place in [MIDDLE, ImagePoint { x: 20.0, y: 200.0 }] {
            let [x, y] = view.in_scene(view.straight(place));
            let was = turn.place(place);
            assert!((x - was.x).hypot(y - was.y) < 1e-9, "{place:?}");
            let back = view.in_image(view.straight(place));
            assert!((back.x - place.x).hypot(back.y - place.y) < 1e-9, "{place:?}");
        }
        // Cells of the straightened image show what lies there.
        let bright = |x: f64, y: f64| ((x / 9.0).sin() * (y / 11.0).cos()) as f32;
        let middle = |cell: usize| 2.0 * cell as f64 + 0.5;
        let image = Plane::from_fn(160, 120, |x, y| bright(middle(x), middle(y)));
        let mut straight = Plane::default();
        view.straighten(&image, 2, &mut Resampler::default(), &mut straight);
        for row in (10..110).step_by(20) {
            let in_view = view.cells_in_view(row, 160, 2);
            assert!(in_view.len() > 100, "{in_view:?}");
            for column in in_view {
                let at = view.in_image(ImagePoint { x: middle(column), y: middle(row) });
                let off = straight.row(row)[column] - bright(at.x, at.y);
                assert!(off.abs() < 0.03, "({column}, {row}): {off}");
            }
        }
    }

    #[test]
    fn a_camera_that_only_turns_has_nothing_to_straighten() {
        let view = Straightening::new(SceneTurn::about(MIDDLE, [40.0, 9.0], 5e-4, 1e-3), SIDES);
        assert!(view.is_none());
        assert!((view.shift()[0] - 40.0).hypot(view.shift()[1] - 9.0) < 1e-9);
        assert_eq!(view.cells_in_view(3, 160, 2), 0..160);
    }
}
