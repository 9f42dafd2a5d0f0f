//! How a camera has turned between two images, by their coarse and their fine pictures.

use crossfix_correlation::Plane;

use crate::ImagePoint;
use crate::coarse_picture::{COARSENESS, CoarsePictures, FINENESS};
use crate::registration::{Bar, PictureFit, PicturePair, PictureTurn};
use crate::scene_turn::SceneTurn;

/// Standard deviation of the speed of roll, rad/s, and of zoom, 1/s: a camera that looks 30 degrees
/// up and pans by 36 degrees a second rolls by 0.3 rad/s. With half of it such a roll lags behind
/// where little of the image has texture; with twice as much what little shows of a bare scene is
/// taken for roll.
const ROLL_RAD_PER_S: f64 = 0.3;

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
        let (sin, cos) = turn.roll_rad().sin_cos();
        let [zoom, roll] = [turn.scale() * cos - 1.0, turn.scale() * sin].map(|part| part as f32);
        PictureTurn { shift, zoom, roll }
    }

    fn in_image(&self, turn: PictureTurn) -> SceneTurn {
        let shift = turn.shift.map(|pixels| f64::from(pixels) * self.side);
        SceneTurn::about(self.middle, shift, turn.zoom.into(), turn.roll.into())
    }

    fn fit_near(&self, guess: SceneTurn, sd: f32) -> Option<PictureFit> {
        self.pair.fit_near(self.in_pixels(guess), sd)
    }

    /// The turn of a fit that is better than another turn.
    fn if_better(&self, fit: PictureFit, than: SceneTurn, bar: Bar) -> Option<SceneTurn> {
        let is_better = self.pair.is_better(&fit, self.in_pixels(than), bar);
        is_better.then(|| self.in_image(fit.turn))
    }
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
) -> Option<SceneTurn> {
    let (bar, sd) =
        (if is_turning { Bar::TURNING } else { Bar::STILL }, (ROLL_RAD_PER_S * since_s) as f32);
    let coarse = PictureLevel::new(&now.coarse, &then.coarse, COARSENESS)?;
    let fine = PictureLevel::new(&now.fine, &then.fine, FINENESS).map(PictureLevel::fine);
    let may_be_better = |level: &PictureLevel| level.may_be_better_near(guess, sd, bar);
    if !is_turning && !may_be_better(&coarse) && !fine.as_ref().is_some_and(may_be_better) {
        return None;
    }
    let by_coarse = coarse.fit_near(guess, sd);
    let start = by_coarse.map_or(guess, |fit| coarse.in_image(fit.turn));
    let turn = fine.and_then(|fine| fine.if_better(fine.fit_near(start, sd)?, guess, bar));
    turn.or_else(|| coarse.if_better(by_coarse?, guess, bar))
}
