//! How a camera has turned between two images, by their coarse and their fine pictures.

use crossfix_correlation::Plane;

use crate::ImagePoint;
use crate::coarse_picture::{COARSENESS, CoarsePictures, FINENESS};
use crate::registration::{Bar, PictureFit, PicturePair, PictureTurn};
use crate::scene_turn::SceneTurn;

/// Standard deviation of the speed of roll, rad/s, and of zoom, 1/s: a camera that looks 30 degrees
/// up and pans by 36 degrees a second rolls by 0.3 rad/s, and one in the hand or on a jerked head
/// by twice that. With half of it as many frames of the real clips before a moved camera are right,
/// to half a percent.
const ROLL_RAD_PER_S: f64 = 0.6;

/// Most roll, rad, and zoom, a share, within the 0.6 s to a picture: by more the pictures have
/// little in common, and it is a mistake. With half of it a zoom by 0.5 per second is refused.
const MOST_BENT: f32 = 0.5;

/// A pair of coarse pictures of an image, whose pixels are blocks of `side` px.
struct PictureLevel<'a> {
    pair: PicturePair<'a>,
    side: f64,
    /// The middle of what they show, px of the image.
    middle: ImagePoint,
}

impl<'a> PictureLevel<'a> {
    /// `None` where there are none, or their sides differ.
    fn new(now: &'a Plane, then: &'a Plane, side: usize) -> Option<Self> {
        let pair = PicturePair::new(now, then).filter(|_| now.width() > 0)?;
        let [x, y] = [now.width(), now.height()].map(|n| ((n * side) as f64 - 1.0) / 2.0);
        Some(Self { pair, side: side as f64, middle: ImagePoint { x, y } })
    }

    /// The same where a coarser level has shown where to begin.
    fn fine(self) -> Self {
        Self { pair: self.pair.fine(), ..self }
    }

    fn may_be_better_near(&self, turn: SceneTurn, sd: f32, bar: Bar) -> bool {
        self.pair.may_be_better_near(self.in_pixels(turn), sd, bar)
    }

    fn in_pixels(&self, turn: SceneTurn) -> PictureTurn {
        let shift = turn.moves(self.middle).map(|px| (px / self.side) as f32);
        let [zoom, roll] = turn.zoom_and_roll().map(|part| part as f32);
        PictureTurn { shift, zoom, roll }
    }

    fn in_image(&self, turn: PictureTurn) -> SceneTurn {
        let shift = turn.shift.map(|pixels| f64::from(pixels) * self.side);
        SceneTurn::about(self.middle, shift, turn.zoom.into(), turn.roll.into())
    }

    fn fit_near(&self, start: SceneTurn, expected: SceneTurn, sd: f32) -> Option<PictureFit> {
        self.pair.fit_near(self.in_pixels(start), self.in_pixels(expected), sd)
    }

    fn fits_better(&self, turn: SceneTurn, than: SceneTurn) -> bool {
        self.pair.fits_better(self.in_pixels(turn), self.in_pixels(than), Bar::TURNING)
    }

    /// The turn of a fit that is better than another turn.
    fn if_better(&self, fit: PictureFit, than: SceneTurn, bar: Bar) -> Option<FoundTurn> {
        if fit.turn.zoom.abs().max(fit.turn.roll.abs()) > MOST_BENT {
            return None;
        }
        let gain = self.pair.better_by(&fit, self.in_pixels(than), bar)?;
        let is_significant = gain > Bar::STILL.significant;
        Some(FoundTurn { turn: self.in_image(fit.turn), is_significant })
    }
}

/// A turn that the pictures show.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FoundTurn {
    pub(crate) turn: SceneTurn,
    /// Whether it would be believed of a camera that stood still, by how much it explains.
    pub(crate) is_significant: bool,
}

/// The turn of an image against an older one, if they determine one near a first guess and better
/// than that: by its coarse pictures, and from there by the fine ones. `since_s` is the time since
/// the guess was right, s.
///
/// What neither shows to be better by the first step is not computed further, but where the camera
/// turns already.
pub(crate) fn turn_between(
    now: &CoarsePictures,
    then: &CoarsePictures,
    guess: SceneTurn,
    since_s: f64,
    is_turning: bool,
) -> Option<FoundTurn> {
    let bar = if is_turning { Bar::TURNING } else { Bar::STILL };
    let sd = (ROLL_RAD_PER_S * since_s) as f32;
    let coarse = PictureLevel::new(&now.coarse, &then.coarse, COARSENESS)?;
    let fine = PictureLevel::new(&now.fine, &then.fine, FINENESS).map(PictureLevel::fine);
    let may_be_better = |level: &PictureLevel| level.may_be_better_near(guess, sd, bar);
    if !is_turning && !may_be_better(&coarse) && !fine.as_ref().is_some_and(may_be_better) {
        return None;
    }
    let by_coarse = coarse.fit_near(guess, guess, sd);
    let start = by_coarse.map_or(guess, |fit| coarse.in_image(fit.turn));
    let turn = fine.and_then(|fine| fine.if_better(fine.fit_near(start, guess, sd)?, guess, bar));
    turn.or_else(|| coarse.if_better(by_coarse?, guess, bar))
}

/// Whether pictures of an image and of an older one fit better at one turn than at another, by what
/// is believed of a camera that turns: the fine ones, where there are any.
pub(crate) fn fits_better(
    now: &CoarsePictures,
    then: &CoarsePictures,
    turn: SceneTurn,
    than: SceneTurn,
) -> bool {
    let fine = PictureLevel::new(&now.fine, &then.fine, FINENESS).map(PictureLevel::fine);
    let level = fine.or_else(|| PictureLevel::new(&now.coarse, &then.coarse, COARSENESS));
    level.is_some_and(|level| level.fits_better(turn, than))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_is_the_same_in_pixels_and_in_the_image() {
        let picture = Plane::from_fn(40, 30, |_, _| 0.0);
        let level = PictureLevel::new(&picture, &picture, 8).unwrap();
        assert_eq!((level.middle.x, level.middle.y), (159.5, 119.5));
        let turn = PictureTurn { shift: [1.5, -2.0], zoom: 0.1, roll: 0.2 };
        let in_image = level.in_image(turn);
        // Ten pixels right of the middle: 10 + 1.5 + 0.1 * 10 right, -2 + 0.2 * 10 down.
        let was = in_image.place(ImagePoint { x: 159.5 + 80.0, y: 119.5 });
        assert!((was.x - 159.5 - 100.0).hypot(was.y - 119.5) < 1e-4, "{was:?}");
        let PictureTurn { shift: [x, y], zoom, roll } = level.in_pixels(in_image);
        let off = [x - 1.5, y + 2.0, zoom - 0.1, roll - 0.2];
        assert!(off.iter().all(|off| off.abs() < 1e-5), "{off:?}");
    }
}
