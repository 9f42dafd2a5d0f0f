//! One scale of the image: by how much each cell stands out of its surroundings, how that has been
//! over the last seconds, and how much it has changed now.

use crossfix_correlation::{Plane, Resampler};

use super::background::Background;
use super::cell_update::{CellUpdate, OUTLYING, slope_squared};
use super::cells::Cells;
use super::filter::{SURROUNDINGS, StandOutScratch, halve, stand_out};
use super::lens::OnLens;
use super::straight::Straightening;
use super::views::Moment;
use crate::ImagePoint;
use crate::noise::{OF_MEDIAN, median};

/// Least standard deviation of a cell's change, levels: video codecs change whole blocks by a
/// level, and with half of it each such step is two standard deviations.
const LEAST_SPREAD: f32 = 0.5;
/// Bounds of the sway, px: no scene is stiller than the first, and more than the second is no sway
/// but another scene. With half of the second a shake of half a pixel loses the background.
const SWAY_PX: [f32; 2] = [0.05, 1.0];
/// Largest share of the textured cells that may have changed while the background's scene is in
/// view: targets cover less, and another scene has hardly a cell in common. With half of it a flock
/// over a sixth of them counts as another scene.
const MOST_CHANGED: f32 = 0.3;
/// The sway is estimated from the cells that a sway of this size, px, changes by more than noise;
/// with half of it fewer scenes have enough of them, with twice as much noise is taken for sway.
const PROBE_PX: f32 = 0.25;
/// Sway that is assumed before any image shows it, px. With half of it only the edges of scenes too
/// bare to show it make more plots.
const FIRST_SWAY_PX: f32 = 0.5;
/// Time constant with which a scene that has swayed is believed to be still again, s: that of a
/// gust or a step. With half of it the second swing of a mast is taken for something that moves.
const STILL_AGAIN_S: f64 = 0.3;
/// Averaging length of the persistence of changes, images: a codec's key frame, one in 12 to 30,
/// must not outweigh the others. With half of it one takes away a fifth of it, not a tenth.
const PERSISTENCE_IMAGES: f32 = 10.0;
/// Least change of a plot, standard deviations. With 4 slow targets in still video are found half a
/// second later; with 3 there are so many plots of noise that more is asked of each candidate, and
/// faint targets are found later too. With half of it nearly every tenth cell of noise is a plot.
pub(super) const LEAST_CHANGE: f32 = 3.5;
/// Noise that lasts is not averaged out by looking again: what stands out is compared with the
/// noise's variance over many images, `(1 + p) / (1 - p)` times that of one image for a persistence
/// p, but at most this many times. That is a p of 0.7; compressed video has 0.9, which would ask
/// for 19 and lose birds and far drones. With half of it noise that lasts stands 1.4 times as high
/// in compressed video.
const MOST_LASTING: f32 = 6.0;
/// Number of cells from which a spread, a contrast or a persistence is known to two per cent. With
/// half of it they are known to three.
const SAMPLES: usize = 4096;
/// Fewest cells from which a contrast is estimated: fewer may be those of a target. With half of it
/// one large target can pass for a change of the light.
const LEAST_SAMPLES: usize = 100;
/// Fewest cells from which a sway is estimated, sampled twice as densely: fewer may be those of a
/// target. With half of it one target that moves can pass for a scene that sways.
const LEAST_TEXTURED: usize = 40;
/// The contrast is estimated from cells that stand out by this many spreads. With half of it each
/// ratio is off by up to a half.
const CONTRAST_SPREADS: f32 = 4.0;
/// Range of the contrast: beyond it is another scene, or none. With half of the range a step of the
/// exposure by two changes every edge.
const CONTRASTS: [f32; 2] = [0.5, 2.0];

/// One scale.
///
/// The [`Background`]'s cells are fixed to the scene. A second mean keeps the image's cells: what
/// is on the lens, or written over the picture.
#[derive(Debug)]
pub(super) struct Level {
    /// Side of a cell, px.
    cell: usize,
    /// The image's means over the cells, and those of the straightened image, if it is another.
    pub(super) reduced: Plane,
    pub(super) straight: Plane,
    stands_out: Plane,
    stand_out_scratch: StandOutScratch,
    /// By how much the background's cells stand out in this image, levels.
    pub(super) now: Plane,
    background: Background,
    on_lens: OnLens,
    /// Change of this image from the mean, standard deviations; 0 where a known target is.
    pub(super) change: Plane,
    /// Contrast of the background in this image, as a multiple of that in the mean.
    contrast: f32,
    /// Standard deviation of this image's changes where nothing comes, levels.
    pub(super) spread: f32,
    /// Mean square of the scene's sway, cells^2.
    sway: f32,
    /// Correlation of an image's changes with the next one's, 0 to 1: 0 for a sensor's noise, 0.9
    /// for compressed video.
    pub(super) persistence: f32,
    is_textured: bool,
    /// Whether too many cells have changed, or the scene sways too far, for it to be that of the
    /// background.
    is_lost: bool,
    /// This image's changes and the last one's at some cells.
    samples: [Vec<f32>; 2],
    scratch: Vec<f32>,
}

impl Level {
    pub(super) fn new(cell: usize) -> Self {
        Self {
            cell,
            reduced: Plane::default(),
            straight: Plane::default(),
            stands_out: Plane::default(),
            stand_out_scratch: StandOutScratch::default(),
            now: Plane::default(),
            background: Background::new(cell),
            on_lens: OnLens::default(),
            change: Plane::default(),
            contrast: 1.0,
            spread: LEAST_SPREAD,
            sway: (FIRST_SWAY_PX / cell as f32).powi(2),
            is_textured: false,
            persistence: 0.0,
            is_lost: false,
            samples: [Vec::new(), Vec::new()],
            scratch: Vec::new(),
        }
    }

    /// The background.
    pub(super) fn background(&self) -> &Background {
        &self.background
    }

    /// See [`Background::fix_to`].
    pub(super) fn fix_to(&mut self, view: Straightening, usual_interval: f64) {
        self.background.fix_to(view, usual_interval);
    }

    /// Side of a cell, px.
    pub(super) fn cell(&self) -> usize {
        self.cell
    }

    /// Sway of what has texture, px (root mean square).
    pub(super) fn sway_px(&self) -> f64 {
        f64::from(self.sway.sqrt()) * self.cell as f64
    }

    /// Whether the scene in view is no longer that of the background.
    pub(super) fn has_lost_scene(&self) -> bool {
        self.is_lost
    }

    /// By how much the background is expected to stand out at a place of this image, levels.
    pub(super) fn expected(&self, place: ImagePoint) -> f32 {
        self.contrast * self.background.mean_at(place)
    }

    /// Share of what stands out at a cell that is new: 1 if the background has nothing there, 0 if
    /// it has the same.
    pub(super) fn new_share(&self, [x, y]: [usize; 2]) -> f32 {
        let now = self.now.row(y)[x];
        // (now - c mean) / now, with c the contrast of this image.
        if now == 0.0 { 0.0 } else { 1.0 - self.contrast * self.background.mean.row(y)[x] / now }
    }

    /// Whether what stands out at a cell is on the lens, or written over the picture: what has kept
    /// its place in the image explains it, and the background does not. False while the camera has
    /// never turned: the two are the same then, but for the light and the limit on outliers.
    pub(super) fn is_on_lens(&self, [x, y]: [usize; 2]) -> bool {
        if !self.background.has_turned() {
            return false;
        }
        let now = self.now.row(y)[x];
        let excess = now - self.contrast * self.background.mean.row(y)[x];
        let (place, _) = self.background.place_of([x, y].map(|at| at as f64));
        let at = [place.x, place.y].map(|at| (at + 0.5) / self.cell as f64 - 0.5);
        self.on_lens.explains(at, now, excess)
    }

    /// Least strength of something that is not noise, in spreads.
    pub(super) fn least_strength(&self) -> f32 {
        // (1 + p) / (1 - p), p the persistence: see `MOST_LASTING`.
        let lasting = (1.0 + self.persistence) / (1.0 - self.persistence).max(1e-3);
        LEAST_CHANGE * lasting.min(MOST_LASTING).sqrt()
    }

    /// How much the scene about a cell stands out by itself, in spreads: the median over the ring
    /// from the edge of the cell's surroundings to twice that.
    pub(super) fn texture_about(&mut self, [x, y]: [usize; 2]) -> f32 {
        let reach = 2 * SURROUNDINGS as isize + 1;
        self.scratch.clear();
        for down in (-reach..=reach).step_by(2) {
            for right in (-reach..=reach).step_by(2) {
                // The inner half of the square is what the cell itself is compared with.
                if right.abs().max(down.abs()) > reach / 2 {
                    self.scratch
                        .push(self.now.clamped(x as isize + right, y as isize + down).abs());
                }
            }
        }
        OF_MEDIAN * median(&mut self.scratch) / self.spread
    }

    /// Fills `reduced` from the next finer scale; of the finest it is given, and is straightened.
    /// The background's cells move to where the scene is.
    pub(super) fn take(&mut self, finer: Option<&Self>, moment: Moment, resampler: &mut Resampler) {
        let Moment { view, is_first, .. } = moment;
        match finer {
            Some(finer) => {
                halve(&finer.reduced, &mut self.reduced);
                if !view.is_none() {
                    halve(&finer.straight, &mut self.straight);
                }
            }
            None if view.is_none() => {}
            None => view.straighten(&self.reduced, self.cell, resampler, &mut self.straight),
        }
        if is_first {
            self.background.begin([self.reduced.width(), self.reduced.height()]);
        }
        self.background.turn_to(view);
    }

    /// Takes in the image in `reduced` and `straight`, and learns it except where `known` covers
    /// it, and in the image itself `known_in_image`.
    pub(super) fn see(&mut self, moment: Moment, known: &[Cells], known_in_image: &[Cells]) {
        let Moment { view, is_first, .. } = moment;
        stand_out(&self.reduced, &mut self.stands_out, &mut self.stand_out_scratch);
        self.on_lens.learn(&self.stands_out, moment, known_in_image);
        if !view.is_none() {
            stand_out(&self.straight, &mut self.stands_out, &mut self.stand_out_scratch);
        }
        self.background.sample(&mut self.stands_out, &mut self.now);
        if !is_first {
            self.compare(moment.interval, known);
        }
        self.learn(moment, known);
        self.remember_changes();
    }

    /// Estimates the light, the noise and the sway from this image's changes.
    fn compare(&mut self, interval: f64, known: &[Cells]) {
        let (width, height) = (self.now.width(), self.now.height());
        let step = sampling_step(width * height);
        // Contrast c: the median of now / mean over the cells that stand out.
        let background = &self.background;
        let cells = || {
            let cells = background.mean.samples().iter().zip(self.now.samples()).enumerate();
            cells.step_by(step).filter(|(i, _)| background.is_telling(*i)).map(|(_, cell)| cell)
        };
        self.scratch.clear();
        self.scratch.extend(
            cells()
                .filter(|(mean, _)| mean.abs() > CONTRAST_SPREADS * self.spread)
                .map(|(mean, now)| now / mean),
        );
        self.contrast = if self.scratch.len() >= LEAST_SAMPLES {
            median(&mut self.scratch).clamp(CONTRASTS[0], CONTRASTS[1])
        } else {
            1.0
        };
        // Spread: standard deviation of now - c mean, by the median of its absolute values. It is
        // as before where a turn has left hardly a cell.
        self.scratch.clear();
        self.scratch.extend(cells().map(|(mean, now)| (now - self.contrast * mean).abs()));
        if self.scratch.len() >= LEAST_SAMPLES {
            self.spread = (OF_MEDIAN * median(&mut self.scratch)).max(LEAST_SPREAD);
        }
        self.estimate_sway(interval, known);
    }

    /// Estimates the scene's sway: solves change^2 = sway slope^2 + usual variance, over the
    /// textured cells together.
    fn estimate_sway(&mut self, interval: f64, known: &[Cells]) {
        let (width, height) = (self.now.width(), self.now.height());
        let step = sampling_step(width * height);
        let (mut slopes, mut changes, mut textured, mut changed) = (0.0_f32, 0.0_f32, 0, 0);
        // Squared, in cells: a sway of variance w changes a cell of slope g by the variance w g^2.
        let [least, most] = SWAY_PX.map(|px| (px / self.cell as f32).powi(2));
        let probe = (PROBE_PX / self.cell as f32).powi(2);
        let mean = self.background.mean.samples();
        let noise = self.spread * self.spread;
        for i in (width + 1..(width * height).saturating_sub(width + 1)).step_by(step / 2 + 1) {
            if i % width == 0 || i % width == width - 1 {
                continue;
            }
            let slope =
                slope_squared([mean[i - 1], mean[i + 1]], [mean[i - width], mean[i + width]]);
            // A cell shows the sway only if a sway of `PROBE_PX` changes it by more than noise
            // does, and if no known target can stand out there.
            if probe * slope > noise
                && [i, i - 1, i + 1, i - width, i + width]
                    .iter()
                    .all(|cell| self.background.is_telling(*cell))
                && !known.iter().any(|cells| cells.are_near([i % width, i / width]))
            {
                let usual = self.background.variance.samples()[i].max(noise);
                let expected = probe * slope + usual;
                let change = self.now.samples()[i] - self.contrast * mean[i];
                textured += 1;
                changed += usize::from(change * change > LEAST_CHANGE * LEAST_CHANGE * expected);
                // w = sum((change^2 - usual) / e) / sum(g^2 / e), e the expected squared change.
                // What exceeds the largest sway and outlying noise together is cut off.
                slopes += slope / expected;
                changes +=
                    ((change * change).min(most * slope + OUTLYING * usual) - usual) / expected;
            }
        }
        // A scene without texture shows neither its sway nor whether it is another one.
        self.is_textured = textured >= LEAST_TEXTURED;
        let sway = if self.is_textured {
            (changes / slopes).clamp(least, most)
        } else {
            (FIRST_SWAY_PX / self.cell as f32).powi(2)
        };
        // A camera that is shaken is believed at once, one that is still only later.
        let share = 1.0 - (-interval / STILL_AGAIN_S).exp() as f32;
        self.sway = sway.max(self.sway + share * (sway - self.sway));
        let sways_too_far = self.sway_px() >= 0.99 * f64::from(SWAY_PX[1]);
        self.is_lost =
            self.is_textured && (sways_too_far || changed as f32 > MOST_CHANGED * textured as f32);
    }

    /// Converts the changes to standard deviations, and learns the background.
    fn learn(&mut self, moment: Moment, known: &[Cells]) {
        let update = CellUpdate {
            share: moment.share,
            noise: self.spread * self.spread,
            sway: self.sway,
            contrast: self.contrast,
        };
        self.background.learn(&self.now, update, known, &mut self.change);
    }

    /// Updates the persistence: how much of the changes lasts from image to image.
    fn remember_changes(&mut self) {
        let changes = self.change.samples();
        let step = sampling_step(changes.len());
        self.samples.swap(0, 1);
        let [before, now] = &mut self.samples;
        now.clear();
        // Cut off, as a few changes by targets must not outweigh all of the noise.
        now.extend(
            changes.iter().step_by(step).map(|change| change.clamp(-LEAST_CHANGE, LEAST_CHANGE)),
        );
        if before.len() == now.len() {
            // Correlation of the two images' changes: 2 sum(a b) / (sum(a^2) + sum(b^2)).
            let product: f32 =
                now.iter().zip(before.iter()).map(|(now, before)| now * before).sum();
            let squares: f32 = now.iter().chain(before.iter()).map(|change| change * change).sum();
            let now = (2.0 * product / squares.max(f32::MIN_POSITIVE)).clamp(0.0, 1.0);
            self.persistence += (now - self.persistence) / PERSISTENCE_IMAGES;
        }
    }
}

/// Step between the cells that are sampled, of a number of cells: odd, so that not all of them come
/// from the same few columns.
fn sampling_step(cells: usize) -> usize {
    (cells / SAMPLES) | 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_turn::SceneTurn;

    const SIDES: [usize; 2] = [160, 120];
    const INTERVAL_S: f64 = 1.0 / 30.0;

    /// Sky above waves, before a camera that has turned since the beginning, and since the
    /// background was fixed, and is shaken by so much beside that.
    fn see_waves(level: &mut Level, turned: [SceneTurn; 2], image: u32, shaken: f64) {
        let side = level.cell() as f64;
        let [since_begun, since_fixed] = turned;
        let middle = |at: usize| (at as f64 + 0.5) * side - 0.5;
        let [width, height] = SIDES.map(|n| n / level.cell());
        level.reduced = Plane::from_fn(width, height, |x, y| {
            let ImagePoint { x, y } = since_begun.place(ImagePoint { x: middle(x), y: middle(y) });
            let waves = 20.0 * ((x + shaken) / 4.0).sin() * (y / 5.0).cos();
            // Sky above: there nothing sways.
            if y < 72.0 { 0.0 } else { waves as f32 }
        });
        let view = Straightening::new(since_fixed, SIDES);
        let moment = Moment {
            view,
            turning_px_s: 0.0,
            interval: INTERVAL_S,
            share: 0.1,
            young: 1.0 / (f64::from(image) + 1.0) as f32,
            is_first: image == 0,
        };
        level.take(None, moment, &mut Resampler::default());
        level.see(moment, &[], &[]);
    }

    fn greatest_change(level: &Level) -> f32 {
        level.change.samples().iter().fold(0.0, |most, change| most.max(change.abs()))
    }

    #[test]
    fn a_scene_that_turns_with_the_camera_does_not_change() {
        let mut level = Level::new(2);
        for image in 0..40 {
            let turned = SceneTurn::shift([0.7 * f64::from(image), -0.4 * f64::from(image)]);
            see_waves(&mut level, [turned; 2], image, 0.0);
            assert!(greatest_change(&level) < 3.0, "image {image}: {}", greatest_change(&level));
        }
        assert!(level.sway_px() < 0.2, "{}", level.sway_px());
    }

    #[test]
    fn what_comes_into_view_is_known_by_the_images_that_show_it_whole() {
        let mut level = Level::new(2);
        for image in 0..40 {
            let turned = SceneTurn::shift([f64::from(image), 0.0]);
            see_waves(&mut level, [turned; 2], image, 0.0);
        }
        // The scene moves left by a cell every second image, by 20 of 80 in all. What ends at 60 is
        // four cells from the border from image 9 on, what ends at 74 from image 37.
        let learnt = |x: usize| {
            (0..=40).rev().find(|images| level.background().has_learnt([x, 30], *images as f32))
        };
        let found = [10, 50, 60, 74, 78].map(learnt);
        assert_eq!(found, [Some(40), Some(40), Some(31), Some(3), Some(0)]);
    }

    /// Before a camera that has rolled, and zoomed in or out.
    #[test]
    fn a_background_that_is_fixed_to_another_image_is_the_same_scene() {
        for zoom in [-0.2, 0.2] {
            let mut level = Level::new(2);
            for image in 0..40 {
                see_waves(&mut level, [SceneTurn::none(); 2], image, 0.0);
            }
            let [x, y] = SIDES.map(|side| (side as f64 - 1.0) / 2.0);
            let turned = SceneTurn::about(ImagePoint { x, y }, [3.0, -2.0], zoom, 0.1);
            level.fix_to(Straightening::new(turned, SIDES), INTERVAL_S);
            see_waves(&mut level, [turned, SceneTurn::none()], 40, 0.0);
            let least = level.background().least_known(INTERVAL_S);
            let (mut squares, mut known) = ([0.0; 2], 0);
            for y in 0..60 {
                for x in (0..80).filter(|x| level.background().has_learnt([*x, y], least)) {
                    let now = level.now.row(y)[x];
                    let off = now * level.new_share([x, y]);
                    squares = [squares[0] + now * now, squares[1] + off * off];
                    known += 1;
                }
            }
            let [all, off] = squares;
            assert!(known > 2200 && off < 0.03 * all, "zoom {zoom}: {known}, {all}, {off}");
        }
    }

    #[test]
    fn a_shaken_scene_sways_at_once_and_is_still_later() {
        let mut level = Level::new(2);
        for image in 0..60 {
            see_waves(&mut level, [SceneTurn::none(); 2], image, 0.0);
        }
        let still = level.sway_px();
        see_waves(&mut level, [SceneTurn::none(); 2], 60, 0.6);
        assert!(still < 0.1 && level.sway_px() > 0.4, "{still}, {}", level.sway_px());
        assert!(greatest_change(&level) < 4.0, "{}", greatest_change(&level));
    }
}
