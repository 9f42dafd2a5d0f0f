//! Search for a lost target: in the image, where a map keeps what all images so far say of every
//! place, and in what has changed, where no cloud is.
//!
//! The search in the image goes through the stages of a step ([`crate::followed_target`]) in their
//! order, but only two are the same code: the likelihood ratios (`likelihood.rs`) and the fit
//! (`fit.rs`). The others would fail over a gate as wide as the image:
//!
//! - *Gate*: the whole image, in cells of several pixels (`coarse.rs`). At full resolution it would
//!   have a hundred times as many placements as a gate, for every lost target.
//! - *Likelihood*: less what the scene itself has there, and with the noise of all the picture's
//!   contrasts: of a hundred thousand cells some look like the target, of a gate's few hundred
//!   none.
//! - *Posterior*: over a grid, and over all images since the loss (`place_map.rs`), not over one
//!   image with the motion filter's prediction as its prior. No single image shows a small target
//!   in noise, and the filter's Gaussian cannot describe many far places between two images.
//! - *Fit*: the best cell is first refined to the best placement at full resolution.
//! - *Update*: the motion filters begin at the fit, as their prediction is worth little by then,
//!   and on probation (`followed_target/lost.rs`, `identity.rs`); nothing is learnt.
//!
//! In what has changed there is one picture and no map: pictures of the same second's change
//! contain each other, so that their evidence must not be multiplied. A find there, or in a single
//! image, must be clear by itself ([`CLEAR_FIND`]).

use crossfix_correlation::Plane;

use crate::coarse::{CoarseReference, PictureLikeness, coarsened};
use crate::crop::{crop, replace_invalid};
use crate::empty_scene::Background;
use crate::fit::TargetFit;
use crate::frame::FrameInput;
use crate::identity::TargetIdentity;
use crate::likelihood::log_ratios;
use crate::place_map::PlaceMap;
use crate::scratch::Scratch;
use crate::search_area::{BestCell, SearchArea};
use crate::search_memory::{SearchMap, SearchMemory};
use crate::state::TargetBelief;
use crate::tracker_part::TrackerPart;
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// Probability in one place from which on the map has found the target. With 0.9 one drawn sequence
/// in forty is lost for good, as something else is found and followed; with 0.999 an eighth more of
/// the frames of small targets in noise are lost.
const SURE_PLACE: f32 = 0.99;
/// What the best place of a single picture must show to be accepted; of a find of the detector,
/// the first of these. On the shared and drawn cases half of the places that such a search takes
/// for the target are others' without the last condition.
pub(crate) struct ClearFind {
    /// Its log likelihood ratio, less the scene's own there. With half of it 4.5 times likelier
    /// than background would do.
    pub(crate) least_ratio: f32,
    /// By how much that is above the next best place's. With half of it 1.6 times likelier than
    /// that would do.
    least_margin: f32,
    /// By how many nats its contrast is likelier the target's than the best one's of all places
    /// searched. With half of it a third of the places are others'; with twice as much an eighth of
    /// the right ones is refused.
    above_chance: f64,
}

/// The conditions in use; what half of each does is said at its field.
pub(crate) const CLEAR_FIND: ClearFind =
    ClearFind { least_ratio: 3.0, least_margin: 1.0, above_chance: 4.0 };
/// Variance of the noise in the picture of what has changed, over that in the image: the image's
/// own noise, and what interpolation leaves of the older picture's. With half of it noise looks
/// like the target by up to twice the log likelihood ratio.
const NOISE_OF_CHANGE: f32 = 1.6;

/// Least share of a target's box that is in view where it is found again: a search continues the
/// image beyond its border by what is at it, and so makes the tip of a tree there as large as a
/// target. With half of it what a corner of the image shows of one is enough; without it a zoomed
/// clip has a tree for its drone for 28 images in a row. As it is, a large drone that comes in
/// slowly is found up to half a second later.
const LEAST_IN_VIEW: f64 = 0.5;

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
    pub(crate) identity: &'a TargetIdentity,
    pub(crate) memory: &'a mut SearchMemory,
}

impl Sought<'_> {
    /// Searches for it: in the image, after a second by its first appearance; and every other time
    /// in what has changed, by turns by its last appearance and its first. It keeps the appearance
    /// by which it is found.
    pub(crate) fn find(
        &mut self,
        frame: FrameInput<'_>,
        scratch: &mut Scratch,
    ) -> Option<TargetFit> {
        self.memory.take_first(self.state, frame.config, &mut scratch.buffers);
        let found =
            self.find_in_image(frame, scratch).or_else(|| self.find_by_turns(frame, scratch));
        if found.is_none() {
            self.memory.take_last(self.state);
        }
        found
    }

    /// Searches what has changed, if it is time to, by the appearance whose turn it is.
    fn find_by_turns(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> Option<TargetFit> {
        self.memory.take_last(self.state);
        // By fours: change by the last appearance, none, change by the first, none.
        let searches = self.memory.searches;
        self.memory.searches += 1;
        if searches / 2 % 2 == 1 {
            self.memory.take_first(self.state, frame.config, &mut scratch.buffers);
        }
        let is_turn = searches.is_multiple_of(2) && frame.config.has(TrackerPart::SearchInChange);
        if is_turn { self.find_in_change(frame, scratch) } else { None }
    }

    /// Takes an image into the map of where the target may be; returns the target if that is next
    /// to certain of one place, or if the image alone shows it clearly: one that comes out of a
    /// cloud is found in the first image, and not in the second.
    fn find_in_image(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> Option<TargetFit> {
        let coarse = CoarseReference::of(self.state, frame.image, scratch)?;
        if frame.config.has(TrackerPart::EmptyScene) {
            self.remember_background(frame, &coarse, scratch);
        }
        let (sides, likeness) =
            whole_ratios(self.state, frame.image, &coarse, frame.config, scratch);
        let area = SearchArea::whole(self.state, sides, coarse.coarseness);
        let turned = frame.scene.turned();
        let empty = self.memory.background.as_ref();
        let empty = empty.map(|known| known.seen_at(turned, &mut scratch.search.empty_scene));
        if let Some(empty) = &empty {
            empty.subtract_from(&mut scratch.ratios);
        }
        let best = area.best_cell(&area.prior(self.state, frame.config), &scratch.ratios);
        let of_scene = empty.map_or(0.0, |empty| empty.at(best.cell));
        let near = area.near();
        let map = self.predicted_map(frame, &area, sides, scratch);
        map.update(&scratch.ratios);
        let likeliest = map.likeliest(near);
        let searched = Searched { picture: frame.image, noise: self.state.noise, likeness };
        let is_sure = likeliest.probability >= SURE_PLACE;
        if !is_sure {
            return self.clear_find(frame, searched, &area, best, of_scene, scratch);
        }
        let cell = [likeliest.column, likeliest.row];
        let (place, reach) = (area.place_of(cell), 2 * area.coarseness + 1);
        let (_, fit) = self.at_full_resolution(frame, searched, place, reach, scratch);
        let has_come = self.has_come(frame, &fit, scratch);
        if let Some(map) = self.memory.map.as_mut().filter(|_| !has_come) {
            // It belongs to the scene, or to another target.
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
        let best = area.best_cell(&area.prior(state, config), &scratch.ratios);
        self.clear_find(frame, searched, &area, best, 0.0, scratch)
    }

    /// The target at the best place of one picture, if that is clearly its place. `background` is
    /// the scene's own log likelihood ratio there or within reach.
    fn clear_find(
        &mut self,
        frame: FrameInput<'_>,
        searched: Searched<'_>,
        area: &SearchArea,
        best: BestCell,
        background: f32,
        scratch: &mut Scratch,
    ) -> Option<TargetFit> {
        let (place, reach) = (area.place_of(best.cell), area.coarseness + 1);
        let (peak, fit) = self.at_full_resolution(frame, searched, place, reach, scratch);
        let state = &*self.state;
        // A noisy reference finds the target fainter than it is, by the clear share.
        let usual = state.usual_contrast * f64::from(state.appearance.clear_share());
        let likelier = searched.likeness.log_ratio(peak.contrast, usual, frame.config.contrast_sd);
        let is_clear = peak.log_ratio - background > CLEAR_FIND.least_ratio
            && best.margin > CLEAR_FIND.least_margin
            && likelier > CLEAR_FIND.above_chance;
        (is_clear && self.has_come(frame, &fit, scratch)).then_some(fit)
    }

    /// The best placement within `reach` px of a place in a picture, and the fit in the image
    /// there: the image shows the place best, what has changed has the noise of two pictures.
    fn at_full_resolution(
        &mut self,
        frame: FrameInput<'_>,
        searched: Searched<'_>,
        place: [f64; 2],
        reach: usize,
        scratch: &mut Scratch,
    ) -> (BestPlacement, TargetFit) {
        let (state, config) = (&mut *self.state, frame.config);
        let Searched { picture, noise, .. } = searched;
        let peak = state.best_near(picture, noise, place, reach as f64, scratch, config);
        crop(frame.image, peak.corner, peak.sides, &mut scratch.gate);
        let fit = state.fit_at(peak.column, peak.row, peak.origin, scratch, config);
        (peak, fit)
    }

    /// Whether what is found has come to its place, and belongs neither to the scene nor to another
    /// target, however alike they look.
    fn has_come(
        &mut self,
        frame: FrameInput<'_>,
        found: &TargetFit,
        scratch: &mut Scratch,
    ) -> bool {
        let is_anothers = frame.others.iter().any(|other| other.holds(found.place));
        !is_anothers
            && self.state.is_in_view(frame.image, found.place)
            && self.identity.arrival_log_ratio(self.state, frame, found.place, scratch) >= 0.0
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
        let mut map = known.unwrap_or_else(|| self.first_map(frame, area, sides));
        let elapsed = (state.unseen_s - map.unseen_s).max(0.0);
        // All of the map moves as its likeliest place does.
        let likeliest = map.places.likeliest(area.near());
        let [x, y] = area.place_of([likeliest.column, likeliest.row]);
        let moved = map.turned.and_then(turned.inverse()).moves(ImagePoint { x, y });
        map.places.predict(elapsed, map.speed * elapsed, moved, &mut scratch.search.spread);
        (map.unseen_s, map.turned) = (state.unseen_s, turned);
        &mut self.memory.map.insert(map).places
    }

    /// The map before any image is in it: the prior of the target's place.
    fn first_map(&self, frame: FrameInput<'_>, area: &SearchArea, sides: [usize; 2]) -> SearchMap {
        let state = &*self.state;
        let prior = area.prior(state, frame.config);
        let velocity = state.velocity();
        SearchMap {
            places: PlaceMap::new(area.coarseness, sides, |x, y| {
                prior.density([area.middle(x), area.middle(y)]) as f32
            }),
            unseen_s: state.unseen_s,
            turned: frame.scene.turned(),
            speed: velocity.x.hypot(velocity.y),
        }
    }

    /// Notes the log likelihood ratios of the scene itself, from the snapshot, once per loss.
    fn remember_background(
        &mut self,
        frame: FrameInput<'_>,
        coarse: &CoarseReference,
        scratch: &mut Scratch,
    ) {
        let coarseness = coarse.coarseness;
        let known = self.memory.background.as_ref();
        if known.is_some_and(|known| known.coarseness() == coarseness) {
            return;
        }
        let snapshot = frame.snapshot.filter(|_| self.state.is_in_snapshot);
        let Some(snapshot) = snapshot else { return };
        let (sides, _) = whole_ratios(self.state, &snapshot.picture, coarse, frame.config, scratch);
        let area = SearchArea::whole(self.state, sides, coarseness);
        self.memory.background =
            Some(Background::new(&scratch.ratios, &area, &snapshot.seen, snapshot.turned));
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

    /// Whether enough of the target is in view where it is at a place for it to be found again.
    pub(crate) fn is_in_view(&self, image: &Plane, at: ImagePoint) -> bool {
        let [width, height] = self.appearance.sides();
        PixelBox::about(at, width, height).share_in_view(image) >= LEAST_IN_VIEW
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
