//! Search for a lost target in an area that grows, first on a coarser picture.

use std::ops::Range;

use crossfix_correlation::{Plane, Reference, Resampler, View, Window};

use crate::TrackerConfig;
use crate::crop::{crop, replace_invalid};
use crate::fit::TargetFit;
use crate::frame::FrameInput;
use crate::identity::Identity;
use crate::likelihood::log_ratios;
use crate::noise::{OF_MEDIAN, median};
use crate::scratch::{Scratch, SearchScratch};
use crate::search_memory::{Background, SearchMemory};
use crate::state::TargetBelief;

/// Least side of the reference on the coarse picture, px: a whole picture of 640x512 takes a few
/// milliseconds then; with 8 it takes three times as long and finds no more, with 3 it finds what
/// looks like the target from afar. And the most pixels per side that are averaged into one.
const COARSE_SIDE: usize = 5;
const MOST_COARSE: usize = 4;
/// A found place is accepted if its log likelihood ratio, less the scene's own there, is at least
/// `LEAST_RATIO` and at least `MARGIN` above that of the next best place, and if its contrast is by
/// `ABOVE_CHANCE` nats likelier the target's than the best one's of all places searched. On the
/// shared and drawn cases half of the places that a search takes for the target are others' without
/// the last condition, and with 4 a third; with twice as much an eighth of the right ones is
/// refused.
pub(crate) const LEAST_RATIO: f32 = 3.0;
const MARGIN: f32 = 1.0;
const ABOVE_CHANCE: f64 = 4.0;
/// Least standard deviation of the scene's contrasts: the steps of the samples make every scene
/// look like a target by this much.
const LEAST_LIKENESS: f64 = 1e-3;
/// Variance of the noise in the picture of what has changed, over that in the image: the image's
/// own noise, and what interpolation leaves of the older picture's.
const NOISE_OF_CHANGE: f32 = 1.6;

/// The best place of a search.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SearchResult {
    pub(crate) fit: Option<TargetFit>,
    pub(crate) accepted: bool,
}

/// The means of blocks of `side` by `side` pixels.
fn coarsened(from: &Plane, side: usize, to: &mut Plane) {
    if side == 1 {
        to.copy_from(from);
        return;
    }
    to.reshape(from.width() / side, from.height() / side);
    let share = 1.0 / (side * side) as f32;
    for y in 0..to.height() {
        let out = to.row_mut(y);
        out.fill(0.0);
        for row in 0..side {
            let blocks = from.row((y * side + row).min(from.height() - 1)).chunks_exact(side);
            for (mean, block) in out.iter_mut().zip(blocks) {
                *mean += share * block.iter().sum::<f32>();
            }
        }
    }
}

/// The target's reference on the coarse picture.
fn coarse_reference(
    state: &TargetBelief,
    coarseness: usize,
    resampler: &mut Resampler,
) -> Reference {
    let working = state.appearance.working.image();
    // Odd again, so that the reference has a middle pixel on the coarse picture too.
    let side = |length: usize| 2 * (length / (2 * coarseness)) + 1;
    let (width, height) = (side(working.width()), side(working.height()));
    let mut whole = Plane::from_fn(width * coarseness, height * coarseness, |_, _| 0.0);
    let middle = |length: usize| (length as f64 - 1.0) / 2.0;
    let view =
        View { x: middle(working.width()), y: middle(working.height()), scale: 1.0, turn_rad: 0.0 };
    resampler.resample(working, view, &mut whole);
    let mut image = Plane::default();
    coarsened(&whole, coarseness, &mut image);
    let window = Window::uniform(image.width(), image.height());
    Reference::new(image, window)
}

/// A reference averaged over blocks of `coarseness` pixels per side.
struct Coarse {
    reference: Reference,
    coarseness: usize,
}

impl Coarse {
    /// Log likelihood ratios of every placement whose middle is in the given part of a coarse
    /// picture, into `scratch.ratios`.
    fn ratios(
        &self,
        state: &TargetBelief,
        noise: f32,
        picture: &Plane,
        [columns, rows]: &[Range<usize>; 2],
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) {
        let (width, height) = (self.reference.image().width(), self.reference.image().height());
        let left = columns.start as isize - (width as isize - 1) / 2;
        let top = rows.start as isize - (height as isize - 1) / 2;
        let sides = [columns.len() + width - 1, rows.len() + height - 1];
        crop(picture, [left, top], sides, &mut scratch.gate);
        scratch.correlator.statistics(&scratch.gate, &self.reference, &mut scratch.statistics);
        let pixels = (width * height) as f32;
        // The mean of n pixels has an n-th of their noise's variance.
        let noise = noise / (self.coarseness * self.coarseness) as f32;
        let noise = noise.max((config.noise_floor * config.noise_floor) as f32);
        let expected = state.expectation(noise, self.reference.variance() * pixels, pixels, config);
        log_ratios(&scratch.statistics, expected, &mut scratch.ratios);
    }

    /// How much the part that has been correlated last looks like the reference.
    fn likeness(&self, scratch: &mut Scratch) -> PictureLikeness {
        let covariances = scratch.statistics.covariance.samples();
        let SearchScratch { contrasts, .. } = &mut scratch.search;
        contrasts.clear();
        // z = cov / var is the contrast at a placement; its standard deviation about zero follows
        // from the median of |z|, which the few placements on the target do not change.
        contrasts.extend(covariances.iter().map(|covariance| covariance.abs()));
        let deviation =
            OF_MEDIAN * median(contrasts) / self.reference.variance().max(f32::MIN_POSITIVE);
        PictureLikeness {
            deviation: f64::from(deviation).max(LEAST_LIKENESS),
            places: contrasts.len().max(1) as f64,
        }
    }
}

/// How much the picture that is searched looks like a target: the contrasts with which the target's
/// reference is found at its places.
#[derive(Clone, Copy, Debug)]
struct PictureLikeness {
    /// Standard deviation of the contrasts about zero.
    deviation: f64,
    places: f64,
}

impl PictureLikeness {
    /// Log-likelihood ratio of a contrast being the target's, whose usual one is known, against it
    /// being the largest of the scene's places.
    fn log_ratio(self, contrast: f64, usual: f64, contrast_sd: f64) -> f64 {
        let Self { deviation, places } = self;
        let normal = |off: f64, sd: f64| -0.5 * (off / sd).powi(2) - sd.ln();
        // ln N(c; usual, (sd usual)^2) - ln (places N(c; 0, deviation^2)).
        normal(contrast - usual, contrast_sd * usual) - normal(contrast, deviation) - places.ln()
    }
}

/// The picture that is searched.
#[derive(Clone, Copy, Debug)]
struct Searched<'a> {
    picture: &'a Plane,
    /// Variance of its noise.
    noise: f32,
    /// Whether it is the picture of what has changed, and not the image.
    is_change: bool,
}

/// A lost target, with what is kept for its search.
pub(crate) struct Sought<'a> {
    pub(crate) state: &'a mut TargetBelief,
    pub(crate) identity: &'a Identity,
    pub(crate) memory: &'a mut SearchMemory,
}

impl Sought<'_> {
    /// Searches for it: by turns in what has changed, where no cloud is, and in the image, where it
    /// may hover; and by turns with its last appearance and its first, which it keeps if it is
    /// found by that.
    pub(crate) fn find(&mut self, frame: FrameInput<'_>, scratch: &mut Scratch) -> SearchResult {
        let mut change = std::mem::take(&mut scratch.search.change);
        let searches = self.memory.searches;
        let is_change = searches.is_multiple_of(2) && frame.scene.change(frame.image, &mut change);
        // A cycle of four searches: change and image by the last appearance, then both by the
        // first.
        if searches / 2 % 2 == 1 {
            self.memory.take_first(self.state, frame.config, &mut scratch.buffers);
        }
        self.memory.searches += 1;
        let noise = self.state.noise;
        let searched = if is_change {
            Searched { picture: &change, noise: NOISE_OF_CHANGE * noise, is_change }
        } else {
            Searched { picture: frame.image, noise, is_change }
        };
        let found = self.find_in(frame, searched, scratch);
        scratch.search.change = change;
        if !found.accepted {
            self.memory.take_last(self.state);
        }
        found
    }

    fn find_in(
        &mut self,
        frame: FrameInput<'_>,
        searched: Searched<'_>,
        scratch: &mut Scratch,
    ) -> SearchResult {
        let config = frame.config;
        let Searched { picture: image, noise, is_change } = searched;
        let state = &mut *self.state;
        let working = state.appearance.working.image();
        let sides = [working.width(), working.height()];
        let coarseness = (sides[0].min(sides[1]) / COARSE_SIDE).clamp(1, MOST_COARSE);
        if image.width() < 2 * coarseness || image.height() < 2 * coarseness {
            return SearchResult { fit: None, accepted: false };
        }
        let coarse = Coarse {
            reference: coarse_reference(state, coarseness, &mut scratch.buffers.resampler),
            coarseness,
        };
        let area = SearchArea::new(state, image, &coarse, is_change, config);
        // The scene of a moment ago is the background of the image; in the change it has cancelled.
        if !is_change {
            remember_background(self.memory, state, frame, &coarse, scratch);
        }

        let mut picture = std::mem::take(&mut scratch.search.coarse);
        coarsened(image, coarseness, &mut picture);
        replace_invalid(&mut picture);
        coarse.ratios(state, noise, &picture, &area.ranges, scratch, config);
        scratch.search.coarse = picture;
        let likeness = coarse.likeness(scratch);
        let best = area.best_place(state, self.memory, scratch, config);

        // Once more at full resolution, about the place of the coarse search.
        let reach = (coarseness + 1) as f64;
        let peak = state.best_near(image, noise, best.place, reach, scratch, config);
        if is_change {
            // The image itself tells the place best: the change has the noise of two pictures.
            crop(frame.image, peak.corner, peak.sides, &mut scratch.gate);
        }
        let fit = state.fit_at(peak.column, peak.row, peak.origin, scratch, config);
        // A noisy reference finds the target fainter than it is, by the clear share.
        let usual = state.usual_contrast * f64::from(state.appearance.clear_share());
        let accepted = peak.log_ratio - best.background > LEAST_RATIO
            && best.margin > MARGIN
            && likeness.log_ratio(peak.contrast, usual, config.contrast_sd) > ABOVE_CHANCE
            && self.identity.arrival_log_ratio(state, frame, fit.place, scratch) >= 0.0;
        SearchResult { fit: Some(fit), accepted }
    }
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

/// Notes the log likelihood ratios of the scene itself, from the snapshot, once per loss.
fn remember_background(
    memory: &mut SearchMemory,
    state: &TargetBelief,
    frame: FrameInput<'_>,
    coarse: &Coarse,
    scratch: &mut Scratch,
) {
    let coarseness = coarse.coarseness;
    let known =
        memory.background.as_ref().is_some_and(|background| background.coarseness == coarseness);
    let Some(snapshot) = frame.snapshot.filter(|_| !known && state.in_snapshot.is_some()) else {
        return;
    };
    let mut picture = std::mem::take(&mut scratch.search.coarse);
    coarsened(snapshot, coarseness, &mut picture);
    replace_invalid(&mut picture);
    let whole = [0..picture.width(), 0..picture.height()];
    coarse.ratios(state, state.noise, &picture, &whole, scratch, frame.config);
    scratch.search.coarse = picture;
    memory.background = Some(Background { coarseness, ratios: scratch.ratios.clone() });
}

/// The best placement on the coarse picture.
struct Best {
    /// Its middle, px of the full picture.
    place: [f64; 2],
    /// Its log likelihood ratio, less that of the next best place.
    margin: f32,
    /// Log likelihood ratio that the scene itself had there.
    background: f32,
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
    /// Whether it is searched for in what has changed.
    is_change: bool,
}

impl SearchArea {
    fn new(
        state: &TargetBelief,
        image: &Plane,
        coarse: &Coarse,
        is_change: bool,
        config: &TrackerConfig,
    ) -> Self {
        let coarseness = coarse.coarseness;
        let working = state.appearance.working.image();
        let sides = [working.width(), working.height()];
        let position = state.position();
        let predicted = [position.x, position.y];
        let half = state.search_half_sides(image, config);
        let image_sides = [image.width(), image.height()];
        let side = coarseness as f64;
        let ranges = [0, 1].map(|i| {
            let last = image_sides[i] / coarseness - 1;
            let first = (((predicted[i] - half[i]) / side).max(0.0) as usize).min(last);
            let end = (((predicted[i] + half[i]) / side).max(0.0) as usize + 1).min(last);
            first..end.max(first) + 1
        });
        Self { ranges, predicted, half, sides, coarseness, is_change }
    }

    fn best_place(
        &self,
        state: &TargetBelief,
        memory: &SearchMemory,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> Best {
        let Self { ranges, predicted, half, sides, coarseness, .. } = self;
        // Prior: p = (1 - a) N(place; predicted, variances) + a / area, a the share that is
        // anywhere.
        let variances = state.motion.found().map(|found| found.variance);
        let density = 1.0 / (std::f64::consts::TAU * (variances[0] * variances[1]).sqrt());
        let anywhere = state.anywhere(config);
        let flat = anywhere / ((2.0 * half[0] + 1.0) * (2.0 * half[1] + 1.0));
        let (mut best, mut most) = ([0, 0], f64::NEG_INFINITY);
        for (y, row) in ranges[1].clone().enumerate() {
            let across = (self.middle(row) - predicted[1]).powi(2) / variances[1];
            for (x, column) in ranges[0].clone().enumerate() {
                let ratio = &mut scratch.ratios.row_mut(y)[x];
                // The reference found this much of the target in the empty scene already.
                *ratio -= self.background_at(column, row, state, memory);
                // If even the largest prior does not reach the best, the logarithm is spared.
                if f64::from(*ratio) + (density + flat).ln() <= most {
                    continue;
                }
                let along = (self.middle(column) - predicted[0]).powi(2) / variances[0];
                let prior = (1.0 - anywhere) * density * (-0.5 * (along + across)).exp() + flat;
                let score = f64::from(*ratio) + prior.ln();
                if score > most {
                    (best, most) = ([x, y], score);
                }
            }
        }
        let near = sides.map(|s| ((s / coarseness) / 4).max(2));
        // The next best place, away from the best, for the margin.
        let mut rival = f32::NEG_INFINITY;
        for y in 0..scratch.ratios.height() {
            for (x, ratio) in scratch.ratios.row(y).iter().enumerate() {
                if x.abs_diff(best[0]) > near[0] || y.abs_diff(best[1]) > near[1] {
                    rival = rival.max(*ratio);
                }
            }
        }
        let (column, row) = (ranges[0].start + best[0], ranges[1].start + best[1]);
        Best {
            place: [self.middle(column), self.middle(row)],
            margin: scratch.ratios.row(best[1])[best[0]] - rival,
            background: self.background_at(column, row, state, memory),
        }
    }

    /// Log likelihood ratio that the scene itself had at a place of the coarse picture; 0 where the
    /// target hid it, and where nothing is known of it.
    fn background_at(
        &self,
        column: usize,
        row: usize,
        state: &TargetBelief,
        memory: &SearchMemory,
    ) -> f32 {
        if self.is_change {
            return 0.0;
        }
        let (Some(background), Some(seen)) = (&memory.background, state.in_snapshot) else {
            return 0.0;
        };
        let near = (self.middle(column) - seen.x).abs() <= self.sides[0] as f64
            && (self.middle(row) - seen.y).abs() <= self.sides[1] as f64;
        if near { 0.0 } else { background.ratios.clamped(column as isize, row as isize).max(0.0) }
    }

    /// The middle of a column or row of the coarse picture, px of the full picture.
    fn middle(&self, index: usize) -> f64 {
        let side = self.coarseness as f64;
        index as f64 * side + (side - 1.0) / 2.0
    }
}
