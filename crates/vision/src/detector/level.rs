//! One scale of the image: by how much each cell stands out of its surroundings, how that has been
//! over the last seconds, and how much it has changed now.

use crossfix_correlation::{Plane, Resampler};

use super::cell_update::{BackgroundRow, CellUpdate, OUTLYING, slope_squared};
use super::cells::{Cells, CellsInView, free_of};
use super::filter::{SURROUNDINGS, StandOutScratch, between, halve, moved, resample, stand_out};
use super::lens::OnLens;
use super::straight::Straightening;
use super::views::Moment;
use crate::ImagePoint;
use crate::noise::{OF_MEDIAN, median};
use crate::scene_turn::SceneTurn;

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
/// The background's cells are fixed to the scene: when the camera turns they move over the image by
/// whole cells, and for the rest the straightened image is sampled between its own cells. A second
/// mean keeps the image's cells: what is on the lens, or written over the picture.
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
    /// Mean and variance of `now` over the last seconds.
    mean: Plane,
    variance: Plane,
    on_lens: OnLens,
    /// Change of this image from the mean, standard deviations; 0 where a known target is.
    pub(super) change: Plane,
    /// How this image lies against that in which the background was begun, and which of a row's
    /// cells are in view.
    view: Straightening,
    in_view: CellsInView,
    /// Shift of the background against the straightened image, cells: the whole ones, and the
    /// rest.
    whole: [isize; 2],
    rest: [f32; 2],
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
            view: Straightening::new(SceneTurn::none(), [0; 2]),
            in_view: CellsInView::default(),
            stands_out: Plane::default(),
            stand_out_scratch: StandOutScratch::default(),
            now: Plane::default(),
            mean: Plane::default(),
            variance: Plane::default(),
            on_lens: OnLens::default(),
            change: Plane::default(),
            whole: [0; 2],
            rest: [0.0; 2],
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

    /// Forgets the background, and keeps what is known of the image's noise and of the sway.
    pub(super) fn begin_anew(&mut self) {
        let (persistence, sway) = (self.persistence, self.sway);
        *self = Self { persistence, sway, ..Self::new(self.cell) };
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

    /// Where the middle of a background's cell is in the image, px, and where that was when the
    /// background was begun.
    pub(super) fn place_of(&self, cell: [f64; 2]) -> (ImagePoint, [f64; 2]) {
        let side = self.cell as f64;
        let [x, y] = [0, 1].map(|i| (cell[i] - f64::from(self.rest[i]) + 0.5) * side - 0.5);
        let straight = ImagePoint { x, y };
        (self.view.in_image(straight), self.view.in_scene(straight))
    }

    /// A place of the straightened image in the background's cells, whose middles are the whole
    /// numbers.
    fn cell_of(&self, ImagePoint { x, y }: ImagePoint) -> [f64; 2] {
        let place = [x, y];
        [0, 1].map(|i| (place[i] + 0.5) / self.cell as f64 - 0.5 + f64::from(self.rest[i]))
    }

    /// The background's cells in which what has its corners at these places of the straightened
    /// image is.
    pub(super) fn cells_between(&self, corners: [ImagePoint; 2]) -> Cells {
        let [first, last] = corners.map(|corner| self.cell_of(corner).map(f64::round));
        let range =
            |axis: usize| [first[axis].max(0.0) as usize, (last[axis] + 1.0).max(0.0) as usize];
        Cells { columns: range(0), rows: range(1) }
    }

    /// By how much the background is expected to stand out at a place of this image, levels.
    pub(super) fn background(&self, place: ImagePoint) -> f32 {
        self.contrast * between(&self.mean, self.cell_of(self.view.straight(place)))
    }

    /// Share of what stands out at a cell that is new: 1 if the background has nothing there, 0 if
    /// it has the same.
    pub(super) fn new_share(&self, [x, y]: [usize; 2]) -> f32 {
        let now = self.now.row(y)[x];
        // (now - c mean) / now, with c the contrast of this image.
        if now == 0.0 { 0.0 } else { 1.0 - self.contrast * self.mean.row(y)[x] / now }
    }

    /// Whether what stands out at a cell is on the lens, or written over the picture: what has kept
    /// its place in the image explains it, and the background does not. False while the camera has
    /// not turned: the two are the same then, but for the light and the limit on outliers.
    pub(super) fn is_on_lens(&self, [x, y]: [usize; 2]) -> bool {
        if (self.whole, self.rest) == ([0; 2], [0.0; 2]) && self.view.is_none() {
            return false;
        }
        let now = self.now.row(y)[x];
        let excess = now - self.contrast * self.mean.row(y)[x];
        let (place, _) = self.place_of([x, y].map(|at| at as f64));
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
    pub(super) fn reduce(
        &mut self,
        finer: Option<&Self>,
        view: Straightening,
        resampler: &mut Resampler,
    ) {
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
    }

    /// Takes in the image in `reduced` and `straight`, and learns it except where `known` covers
    /// it, and in the image itself `known_in_image`.
    pub(super) fn see(&mut self, moment: Moment, known: &[Cells], known_in_image: &[Cells]) {
        self.view = moment.view;
        stand_out(&self.reduced, &mut self.stands_out, &mut self.stand_out_scratch);
        self.on_lens.learn(&self.stands_out, moment, known_in_image);
        if !self.view.is_none() {
            stand_out(&self.straight, &mut self.stands_out, &mut self.stand_out_scratch);
        }
        self.turn(moment);
        self.in_view.see(self.view, [self.now.width(), self.now.height()], self.cell);
        if moment.is_first {
            self.mean.copy_from(&self.now);
            self.variance.reshape(self.now.width(), self.now.height());
            self.variance.samples_mut().fill(0.0);
        }
        if !moment.is_first {
            self.compare(moment.interval, known);
        }
        self.learn(moment.share, known);
        self.remember_changes();
    }

    /// Moves the background with the scene.
    fn turn(&mut self, Moment { view, is_first, .. }: Moment) {
        let cells = view.shift().map(|shift| shift / self.cell as f64);
        // The background moves by whole cells: interpolated at every turn it would be blurred more
        // and more. The image is interpolated instead, by the rest, and only once.
        let whole = cells.map(|cells| cells.round() as isize);
        self.rest = [0, 1].map(|i| (cells[i] - whole[i] as f64) as f32);
        if self.rest == [0.0; 2] {
            std::mem::swap(&mut self.now, &mut self.stands_out);
        } else {
            // The background's cell i lies at i - rest in the image's cells.
            resample(&self.stands_out, self.rest.map(|rest| -rest), &mut self.now);
        }
        let by = [0, 1].map(|i| whole[i] - self.whole[i]);
        if !is_first && by != [0, 0] {
            for plane in [&mut self.mean, &mut self.variance] {
                moved(plane, by, &mut self.change);
                std::mem::swap(plane, &mut self.change);
            }
        }
        self.whole = whole;
    }

    /// Estimates the light, the noise and the sway from this image's changes.
    fn compare(&mut self, interval: f64, known: &[Cells]) {
        let (width, height) = (self.now.width(), self.now.height());
        let step = sampling_step(width * height);
        // Contrast c: the median of now / mean over the cells that stand out.
        let cells = || {
            let cells = self.mean.samples().iter().zip(self.now.samples()).enumerate();
            let sampled = cells.step_by(step).filter(|(i, _)| self.in_view.hold(*i));
            sampled.map(|(_, cell)| cell)
        };
        self.scratch.clear();
        self.scratch.extend(
            cells()
                .filter(|(mean, _)| mean.abs() > CONTRAST_SPREADS * self.spread)
                .map(|(mean, now)| now / mean),
        );
        let is_known = self.scratch.len() >= LEAST_SAMPLES;
        self.contrast = if is_known {
            median(&mut self.scratch).clamp(CONTRASTS[0], CONTRASTS[1])
        } else {
            1.0
        };
        // Spread: standard deviation of now - c mean, by the median of its absolute values.
        self.scratch.clear();
        self.scratch.extend(cells().map(|(mean, now)| (now - self.contrast * mean).abs()));
        self.spread = (OF_MEDIAN * median(&mut self.scratch)).max(LEAST_SPREAD);
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
        let mean = self.mean.samples();
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
                && self.in_view.hold(i)
                && !known.iter().any(|cells| cells.are_near([i % width, i / width]))
            {
                let usual = self.variance.samples()[i].max(noise);
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
    fn learn(&mut self, share: f32, known: &[Cells]) {
        let (width, height) = (self.now.width(), self.now.height());
        self.change.reshape(width, height);
        let update = CellUpdate {
            share,
            noise: self.spread * self.spread,
            sway: self.sway,
            contrast: self.contrast,
        };
        for y in 0..height {
            let (above, below) =
                (self.mean.row(y.saturating_sub(1)), self.mean.row((y + 1).min(height - 1)));
            update.textures(above, self.mean.row(y), below, &mut self.scratch);
            let change = self.change.row_mut(y);
            change.fill(0.0);
            let in_view = self.in_view.of_row(y);
            for [from, to] in free_of(known, y, width) {
                let (from, to) = (from.max(in_view.start), to.min(in_view.end));
                if from >= to {
                    continue;
                }
                update.learn(BackgroundRow {
                    now: &self.now.row(y)[from..to],
                    textures: &self.scratch[from..to],
                    mean: &mut self.mean.row_mut(y)[from..to],
                    variance: &mut self.variance.row_mut(y)[from..to],
                    change: &mut change[from..to],
                });
            }
        }
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

    /// Sky above waves, seen by a camera that has turned by `turned` pixels and is shaken.
    fn see_waves(level: &mut Level, turned: [f64; 2], is_first: bool, shaken: f64) {
        let side = level.cell() as f64;
        level.reduced = Plane::from_fn(80, 60, |x, y| {
            let [right, down] = [x as f64 * side + turned[0] + shaken, y as f64 * side + turned[1]];
            let waves = 20.0 * (right / 4.0).sin() * (down / 5.0).cos();
            // Sky above: there nothing sways.
            if down < 72.0 { 0.0 } else { waves as f32 }
        });
        let view = Straightening::new(SceneTurn::shift(turned), [80, 60].map(|n| n * level.cell()));
        let moment = Moment { view, turning_px_s: 0.0, interval: 1.0 / 30.0, share: 0.1, is_first };
        level.see(moment, &[], &[]);
    }

    fn greatest_change(level: &Level) -> f32 {
        let rows = (6..54).flat_map(|y| &level.change.row(y)[6..74]);
        rows.fold(0.0, |most, change| most.max(change.abs()))
    }

    #[test]
    fn a_scene_that_turns_with_the_camera_does_not_change() {
        let mut level = Level::new(2);
        for image in 0..40 {
            let turned = [0.7 * f64::from(image), -0.4 * f64::from(image)];
            see_waves(&mut level, turned, image == 0, 0.0);
            assert!(greatest_change(&level) < 3.0, "image {image}: {}", greatest_change(&level));
        }
        assert!(level.sway_px() < 0.2, "{}", level.sway_px());
    }

    #[test]
    fn a_shaken_scene_sways_at_once_and_is_still_later() {
        let mut level = Level::new(2);
        for image in 0..60 {
            see_waves(&mut level, [0.0; 2], image == 0, 0.0);
        }
        let still = level.sway_px();
        see_waves(&mut level, [0.0; 2], false, 0.6);
        assert!(still < 0.1 && level.sway_px() > 0.4, "{still}, {}", level.sway_px());
        assert!(greatest_change(&level) < 4.0, "{}", greatest_change(&level));
    }
}
