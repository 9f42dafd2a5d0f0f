//! Search for a lost target: in the image, where a map keeps what all images so far say of every
//! place, and in what has changed, where no cloud is.

use std::ops::Range;

use crossfix_correlation::Plane;

use crate::TrackerConfig;
use crate::coarse::{CoarseReference, PictureLikeness, coarsened};
use crate::crop::{crop, replace_invalid};
use crate::fit::TargetFit;
use crate::frame::FrameInput;
use crate::identity::Identity;
use crate::lanes::greatest;
use crate::likelihood::log_ratios;
use crate::place_map::PlaceMap;
use crate::scratch::Scratch;
use crate::search_memory::{Background, SearchMap, SearchMemory};
use crate::state::TargetBelief;

/// Probability in one place from which on the map has found the target. With 0.9 one drawn sequence
/// in forty is lost for good, as something else is found and followed; with 0.999 an eighth more of
/// the frames of small targets in noise are lost.
const SURE_PLACE: f32 = 0.99;
/// The best place of a single picture (and a find of the detector, by the first of these) is accepted
/// if its log likelihood ratio, less the scene's own there, is at least `LEAST_RATIO` and at least
/// `MARGIN` above that of the next best place, and if its contrast is by `ABOVE_CHANCE` nats likelier
/// the target's than the best one's of all places searched. On the shared and drawn cases half of the
/// places that such a search takes for the target are others' without the last condition, and with 4 a
/// third; with twice as much an eighth of the right ones is refused.
pub(crate) const LEAST_RATIO: f32 = 3.0;
const MARGIN: f32 = 1.0;
const ABOVE_CHANCE: f64 = 4.0;
/// Variance of the noise in the picture of what has changed, over that in the image: the image's
/// own noise, and what interpolation leaves of the older picture's.
const NOISE_OF_CHANGE: f32 = 1.6;

/// A picture that is searched, the image or what has changed.
#[derive(Clone, Copy)]
struct Searched<'a> {
    picture: &'a Plane,
    /// Variance of its noise.
    noise: f32,
    likeness: PictureLikeness,
}

/// A lost target, with what is kept for its search.
pub(crate) struct Sought<'a> {
    pub(crate) state: &'a mut TargetBelief,
    pub(crate) identity: &'a Identity,
    pub(crate) memory: &'a mut SearchMemory,
}

impl Sought<'_> {
    /// Searches for it: in the image, after a second by its first appearance; and every other time in
    /// what has changed, by turns by its last appearance and its first. It keeps the appearance by
    /// which it is found.
    pub(crate) fn find(
        &mut self,
        frame: FrameInput<'_>,
        scratch: &mut Scratch,
    ) -> Option<TargetFit> {
        self.memory.take_first(self.state, frame.config, &mut scratch.buffers);
        let found = self.find_in_image(frame, scratch).or_else(|| {
            self.memory.take_last(self.state);
            let searches = self.memory.searches;
            self.memory.searches += 1;
            if searches / 2 % 2 == 1 {
                self.memory.take_first(self.state, frame.config, &mut scratch.buffers);
            }
            let is_turn = searches.is_multiple_of(2);
            if is_turn { self.find_in_change(frame, scratch) } else { None }
        });
        if found.is_none() {
            self.memory.take_last(self.state);
        }
        found
    }

    /// Takes an image into the map of where the target may be; returns the target if that leaves
    /// next to no doubt, or if the image alone shows it clearly: one that comes out of a cloud is
    /// found in the first image, and not in the second.
    fn find_in_image(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> Option<TargetFit> {
        let coarse = CoarseReference::of(self.state, frame.image, scratch)?;
        self.remember_background(frame, &coarse, scratch);
        let (sides, likeness) =
            whole_ratios(self.state, frame.image, &coarse, frame.config, scratch);
        let area = SearchArea::whole(self.state, sides, coarse.coarseness);
        let turned = frame.scene.turned();
        if let Some(scene) = area.empty_scene(sides, turned, self.state, self.memory) {
            scene.subtract_from(&mut scratch.ratios);
        }
        let near = area.near();
        let map = self.predicted_map(frame, &area, sides, scratch);
        map.update(&scratch.ratios);
        let likeliest = map.likeliest(near);
        let searched = Searched { picture: frame.image, noise: self.state.noise, likeness };
        let is_sure = likeliest.probability >= SURE_PLACE;
        if !is_sure {
            let best = area.best_place(&area.prior(self.state, frame.config), scratch);
            let scene = area.empty_scene(sides, turned, self.state, self.memory);
            let background = scene.map_or(0.0, |scene| scene.at(best.cell));
            return self.clear_find(frame, searched, (&area, best, background), scratch);
        }
        let cell = [likeliest.column, likeliest.row];
        let (place, reach) = (area.place_of(cell), 2 * area.coarseness + 1);
        let (_, fit) = self.at_full_resolution(frame, searched, (place, reach), scratch);
        let has_come = self.has_come(frame, &fit, scratch);
        if let Some(map) = self.memory.map.as_mut().filter(|_| !has_come) {
            // It belongs to the scene.
            map.places.exclude(cell, near);
        }
        has_come.then_some(fit)
    }

    fn find_in_change(
        &mut self,
        frame: FrameInput<'_>,
        scratch: &mut Scratch,
    ) -> Option<TargetFit> {
        let mut change = std::mem::take(&mut scratch.search.change);
        let is_known = frame.scene.change(frame.image, &mut change);
        let found =
            if is_known { self.find_in_picture_of_change(frame, &change, scratch) } else { None };
        scratch.search.change = change;
        found
    }

    /// Searches the picture of what has changed, in which the scene has cancelled.
    fn find_in_picture_of_change(
        &mut self,
        frame: FrameInput<'_>,
        change: &Plane,
        scratch: &mut Scratch,
    ) -> Option<TargetFit> {
        let (state, config) = (&*self.state, frame.config);
        let noise = NOISE_OF_CHANGE * state.noise;
        let coarse = CoarseReference::of(state, change, scratch)?;
        let area = SearchArea::about(state, change, coarse.coarseness, config);
        let mut picture = std::mem::take(&mut scratch.search.coarse);
        coarsened(change, coarse.coarseness, &mut picture);
        replace_invalid(&mut picture);
        coarse.correlate(&picture, &area.ranges, scratch);
        scratch.search.coarse = picture;
        let expected = coarse.expectation(state, noise, config);
        log_ratios(&scratch.statistics, expected, &mut scratch.ratios);
        let searched = Searched { picture: change, noise, likeness: coarse.likeness(scratch) };
        let best = area.best_place(&area.prior(state, config), scratch);
        self.clear_find(frame, searched, (&area, best, 0.0), scratch)
    }

    /// The target at the best place of one picture, if that is clearly its place. `background` is
    /// the scene's own log likelihood ratio there.
    fn clear_find(
        &mut self,
        frame: FrameInput<'_>,
        searched: Searched<'_>,
        (area, best, background): (&SearchArea, Best, f32),
        scratch: &mut Scratch,
    ) -> Option<TargetFit> {
        let at = (area.place_of(best.cell), area.coarseness + 1);
        let (peak, fit) = self.at_full_resolution(frame, searched, at, scratch);
        let state = &*self.state;
        // A noisy reference finds the target fainter than it is, by the clear share.
        let usual = state.usual_contrast * f64::from(state.appearance.clear_share());
        let likelier = searched.likeness.log_ratio(peak.contrast, usual, frame.config.contrast_sd);
        let is_clear = peak.log_ratio - background > LEAST_RATIO
            && best.margin > MARGIN
            && likelier > ABOVE_CHANCE;
        (is_clear && self.has_come(frame, &fit, scratch)).then_some(fit)
    }

    /// The best placement within `reach` px of a place in a picture, and the fit in the image there:
    /// the image tells the place best, what has changed has the noise of two pictures.
    fn at_full_resolution(
        &mut self,
        frame: FrameInput<'_>,
        searched: Searched<'_>,
        (place, reach): ([f64; 2], usize),
        scratch: &mut Scratch,
    ) -> (BestPlacement, TargetFit) {
        let (state, config) = (&mut *self.state, frame.config);
        let Searched { picture, noise, .. } = searched;
        let peak = state.best_near(picture, noise, place, reach as f64, scratch, config);
        crop(frame.image, peak.corner, peak.sides, &mut scratch.gate);
        let fit = state.fit_at(peak.column, peak.row, peak.origin, scratch, config);
        (peak, fit)
    }

    /// Whether what is found has come to its place, and does not belong to the scene.
    fn has_come(
        &mut self,
        frame: FrameInput<'_>,
        found: &TargetFit,
        scratch: &mut Scratch,
    ) -> bool {
        self.identity.arrival_log_ratio(self.state, frame, found.place, scratch) >= 0.0
    }

    /// The map of the target's places, as expected of this image.
    fn predicted_map(
        &mut self,
        frame: FrameInput<'_>,
        area: &SearchArea,
        sides: [usize; 2],
        scratch: &mut Scratch,
    ) -> &mut PlaceMap {
        let state = &*self.state;
        let turned = frame.scene.turned();
        let known =
            self.memory.map.take().filter(|known| known.places.fits(area.coarseness, sides));
        let mut map = known.unwrap_or_else(|| {
            let prior = area.prior(state, frame.config);
            let velocity = state.velocity();
            SearchMap {
                places: PlaceMap::new(area.coarseness, sides, |x, y| {
                    prior.density([area.middle(x), area.middle(y)]) as f32
                }),
                unseen_s: state.unseen_s,
                turned,
                speed: velocity.x.hypot(velocity.y),
            }
        });
        let elapsed = (state.unseen_s - map.unseen_s).max(0.0);
        // The same thing has moved in the image by what the scene had turned before, less now.
        let moved = [0, 1].map(|i| map.turned[i] - turned[i]);
        map.places.predict(elapsed, map.speed * elapsed, moved, &mut scratch.search.spread);
        (map.unseen_s, map.turned) = (state.unseen_s, turned);
        &mut self.memory.map.insert(map).places
    }

    /// Notes the log likelihood ratios of the scene itself, from the snapshot, once per loss.
    fn remember_background(
        &mut self,
        frame: FrameInput<'_>,
        coarse: &CoarseReference,
        scratch: &mut Scratch,
    ) {
        let coarseness = coarse.coarseness;
        let background = &mut self.memory.background;
        let is_known = background.as_ref().is_some_and(|known| known.coarseness == coarseness);
        let snapshot = frame.snapshot.filter(|_| !is_known && self.state.in_snapshot.is_some());
        let Some(snapshot) = snapshot else { return };
        whole_ratios(self.state, snapshot, coarse, frame.config, scratch);
        let (ratios, turned) = (scratch.ratios.clone(), frame.scene.turned());
        *background = Some(Background { coarseness, ratios, turned });
    }
}

/// Log likelihood ratios of every place of an image, made coarser, into `scratch.ratios`; returns
/// the sides of the coarse picture, and how much it looks like the target.
fn whole_ratios(
    state: &TargetBelief,
    image: &Plane,
    coarse: &CoarseReference,
    config: &TrackerConfig,
    scratch: &mut Scratch,
) -> ([usize; 2], PictureLikeness) {
    let mut picture = std::mem::take(&mut scratch.search.coarse);
    coarsened(image, coarse.coarseness, &mut picture);
    replace_invalid(&mut picture);
    let sides = [picture.width(), picture.height()];
    coarse.correlate(&picture, &sides.map(|side| 0..side), scratch);
    scratch.search.coarse = picture;
    // Noise is whatever the picture's places look like the target by: where there are clouds, that
    // is more than the image's own.
    let mut expected = coarse.expectation(state, state.noise, config);
    let likeness = coarse.likeness(scratch);
    let deviation = likeness.deviation as f32;
    expected.noise = expected.noise.max(deviation * deviation * expected.energy);
    log_ratios(&scratch.statistics, expected, &mut scratch.ratios);
    (sides, likeness)
}

/// The best placement of a reference near a place.
pub(crate) struct BestPlacement {
    pub(crate) column: usize,
    pub(crate) row: usize,
    pub(crate) log_ratio: f32,
    /// The target's contrast, as a multiple of the reference's.
    pub(crate) contrast: f64,
    /// Middle of the first placement, and the part of the image that the placements cover, px.
    pub(crate) origin: [f64; 2],
    pub(crate) corner: [isize; 2],
    pub(crate) sides: [usize; 2],
}

impl TargetBelief {
    /// The best placement of the target's reference within `reach` of a place, px, at full
    /// resolution. Leaves the part of the image that the placements cover in `scratch.gate`.
    pub(crate) fn best_near(
        &self,
        image: &Plane,
        noise: f32,
        place: [f64; 2],
        reach: f64,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> BestPlacement {
        let working = self.appearance.working.image();
        let reference = [working.width(), working.height()];
        let origin = place.map(|at| at.round() - reach.ceil());
        let corner = [0, 1].map(|i| origin[i] as isize - (reference[i] as isize - 1) / 2);
        let sides = reference.map(|side| 2 * reach.ceil() as usize + side);
        crop(image, corner, sides, &mut scratch.gate);
        scratch.correlator.statistics(
            &scratch.gate,
            &self.appearance.working,
            &mut scratch.statistics,
        );
        let (energy, pixels) = (self.appearance.energy(), self.appearance.pixels());
        let fine = &mut scratch.search.fine;
        log_ratios(&scratch.statistics, self.expectation(noise, energy, pixels, config), fine);
        let peak = fine.peak();
        let covariance = scratch.statistics.covariance.row(peak.row)[peak.column];
        // z = a / E, with a = n cov.
        let contrast = f64::from(covariance * pixels / energy.max(1e-12)).max(0.0);
        BestPlacement {
            column: peak.column,
            row: peak.row,
            log_ratio: peak.score,
            contrast,
            origin,
            corner,
            sides,
        }
    }

    /// Half sides of the search area, px: they grow with the time since the target was seen.
    pub(crate) fn search_half_sides(&self, image: &Plane, config: &TrackerConfig) -> [f64; 2] {
        let working = self.appearance.working.image();
        let sides = [working.width(), working.height()];
        let grown = config.search_growth_px * self.unseen_s;
        let gate = self.half_gate(image, config);
        let most = [image.width(), image.height()];
        [0, 1].map(|i| (gate[i] as f64).max(sides[i] as f64 + grown).min(most[i] as f64))
    }
}

/// The best placement on the coarse picture.
struct Best {
    /// Its column and row.
    cell: [usize; 2],
    /// Its log likelihood ratio, less that of the next best place.
    margin: f32,
}

/// Prior of a lost target's place, per px^2: `(1 - a) N(place; predicted, variances) + a / area`,
/// with a the share that is anywhere.
struct AreaPrior {
    predicted: [f64; 2],
    variances: [f64; 2],
    /// Greatest density of the first part, and the density of the second.
    near: f64,
    anywhere: f64,
}

impl AreaPrior {
    fn density(&self, place: [f64; 2]) -> f64 {
        let off = [0, 1].map(|i| (place[i] - self.predicted[i]).powi(2) / self.variances[i]);
        self.near * (-0.5 * (off[0] + off[1])).exp() + self.anywhere
    }

    /// The greatest density.
    fn most(&self) -> f64 {
        self.near + self.anywhere
    }
}

/// The scene without the target, as a search sees it.
struct EmptyScene<'a> {
    /// The scene's own log likelihood ratios, in the picture that was taken of it.
    ratios: &'a Plane,
    /// By how many cells it has moved since.
    by: [isize; 2],
    /// Columns and rows of the cells that the target hid then.
    hidden: [Range<usize>; 2],
}

impl EmptyScene<'_> {
    /// The scene's own ratio in a cell; 0 where the target hid it, and where it is unlike the
    /// target.
    fn at(&self, [column, row]: [usize; 2]) -> f32 {
        if self.hidden[0].contains(&column) && self.hidden[1].contains(&row) {
            return 0.0;
        }
        let [column, row] = [column as isize + self.by[0], row as isize + self.by[1]];
        self.ratios.clamped(column, row).max(0.0)
    }

    /// Subtracts the scene's own ratios: the reference found this much of the target in the empty
    /// scene already.
    fn subtract_from(&self, ratios: &mut Plane) {
        let last = [self.ratios.width(), self.ratios.height()].map(|side| side as isize - 1);
        let width = ratios.width();
        for y in 0..ratios.height() {
            let scene = self.ratios.row((y as isize + self.by[1]).clamp(0, last[1]) as usize);
            let hidden = if self.hidden[1].contains(&y) { self.hidden[0].clone() } else { 0..0 };
            let row = ratios.row_mut(y);
            for columns in [0..hidden.start, hidden.end..width] {
                for (x, ratio) in columns.clone().zip(&mut row[columns]) {
                    let column = (x as isize + self.by[0]).clamp(0, last[0]) as usize;
                    *ratio -= scene[column].max(0.0);
                }
            }
        }
    }
}

/// The area in which a target is searched for.
struct SearchArea {
    /// Columns and rows of the coarse picture.
    ranges: [Range<usize>; 2],
    /// The predicted place, and the half sides of the area about it, px of the full picture.
    predicted: [f64; 2],
    half: [f64; 2],
    /// Sides of the reference, px.
    sides: [usize; 2],
    coarseness: usize,
}

impl SearchArea {
    /// All of a coarse picture of these sides.
    fn whole(state: &TargetBelief, picture: [usize; 2], coarseness: usize) -> Self {
        let working = state.appearance.working.image();
        let position = state.position();
        Self {
            ranges: picture.map(|side| 0..side),
            predicted: [position.x, position.y],
            half: picture.map(|side| (side * coarseness) as f64 / 2.0),
            sides: [working.width(), working.height()],
            coarseness,
        }
    }

    /// What is about the predicted place: the more, the longer the target has not been seen.
    fn about(
        state: &TargetBelief,
        image: &Plane,
        coarseness: usize,
        config: &TrackerConfig,
    ) -> Self {
        let half = state.search_half_sides(image, config);
        let picture = [image.width(), image.height()].map(|side| side / coarseness);
        let whole = Self::whole(state, picture, coarseness);
        let side = coarseness as f64;
        let ranges = [0, 1].map(|i| {
            let last = picture[i] - 1;
            let first = (((whole.predicted[i] - half[i]) / side).max(0.0) as usize).min(last);
            let end = (((whole.predicted[i] + half[i]) / side).max(0.0) as usize + 1).min(last);
            first..end.max(first) + 1
        });
        Self { ranges, half, ..whole }
    }

    /// Half sides of a peak, places of the coarse picture.
    fn near(&self) -> [usize; 2] {
        self.sides.map(|side| ((side / self.coarseness) / 4).max(2))
    }

    fn prior(&self, state: &TargetBelief, config: &TrackerConfig) -> AreaPrior {
        let variances = state.motion.found().map(|found| found.variance);
        let density = 1.0 / (std::f64::consts::TAU * (variances[0] * variances[1]).sqrt());
        let share = state.anywhere(config);
        let area = (2.0 * self.half[0] + 1.0) * (2.0 * self.half[1] + 1.0);
        AreaPrior {
            predicted: self.predicted,
            variances,
            near: (1.0 - share) * density,
            anywhere: share / area,
        }
    }

    /// The likeliest place, by the log likelihood ratios in `scratch.ratios`.
    fn best_place(&self, prior: &AreaPrior, scratch: &Scratch) -> Best {
        let Self { ranges, .. } = self;
        let (mut best, mut most) = ([0, 0], f64::NEG_INFINITY);
        let most_prior = prior.most().ln();
        for (y, row) in ranges[1].clone().enumerate() {
            let ratios = scratch.ratios.row(y);
            // If even the largest prior does not reach the best, the row and the logarithm are
            // spared.
            if f64::from(greatest(ratios)) + most_prior <= most {
                continue;
            }
            for (x, column) in ranges[0].clone().enumerate() {
                let ratio = f64::from(ratios[x]);
                if ratio + most_prior <= most {
                    continue;
                }
                let score = ratio + prior.density([self.middle(column), self.middle(row)]).ln();
                if score > most {
                    (best, most) = ([x, y], score);
                }
            }
        }
        let near = self.near();
        // The next best place, away from the best, for the margin.
        let mut rival = f32::NEG_INFINITY;
        for y in 0..scratch.ratios.height() {
            let row = scratch.ratios.row(y);
            let beside = if y.abs_diff(best[1]) > near[1] {
                greatest(row)
            } else {
                let before = &row[..best[0].saturating_sub(near[0])];
                let after = &row[(best[0] + near[0] + 1).min(row.len())..];
                greatest(before).max(greatest(after))
            };
            rival = rival.max(beside);
        }
        let (column, row) = (ranges[0].start + best[0], ranges[1].start + best[1]);
        Best { cell: [column, row], margin: scratch.ratios.row(best[1])[best[0]] - rival }
    }

    /// What the scene itself had at the places of a coarse picture with these sides, given how it
    /// has turned by now; `None` if nothing is known of it.
    fn empty_scene<'a>(
        &self,
        picture: [usize; 2],
        turned: [f64; 2],
        state: &TargetBelief,
        memory: &'a SearchMemory,
    ) -> Option<EmptyScene<'a>> {
        let (background, seen) = (memory.background.as_ref()?, state.in_snapshot?);
        let shift = [0, 1].map(|i| turned[i] - background.turned[i]);
        let hidden = [0, 1].map(|i| {
            let (reach, seen) = (self.sides[i] as f64, [seen.x, seen.y][i]);
            let off = |index: usize| self.middle(index) + shift[i] - seen;
            let first = (0..picture[i]).find(|index| off(*index) >= -reach);
            let first = first.unwrap_or(picture[i]);
            let end = (first..picture[i]).find(|index| off(*index) > reach);
            first..end.unwrap_or(picture[i])
        });
        let by = shift.map(|shift| (shift / self.coarseness as f64).round() as isize);
        Some(EmptyScene { ratios: &background.ratios, by, hidden })
    }

    /// The middle of a cell of the coarse picture, px of the full picture.
    fn place_of(&self, cell: [usize; 2]) -> [f64; 2] {
        cell.map(|index| self.middle(index))
    }

    /// The middle of a column or row of the coarse picture, px of the full picture.
    fn middle(&self, index: usize) -> f64 {
        let side = self.coarseness as f64;
        index as f64 * side + (side - 1.0) / 2.0
    }
}
