//! Coarser pictures, in which a whole image can be searched, and a target's reference as coarse.

use std::ops::Range;

use crossfix_correlation::{Plane, Reference, Resampler, View, Window};

use crate::TrackerConfig;
use crate::crop::crop;
use crate::likelihood::Expectation;
use crate::noise::{OF_MEDIAN, median};
use crate::scratch::{Scratch, SearchScratch};
use crate::state::TargetBelief;

/// Least side of the reference on the coarse picture, px: a whole picture of 640x512 takes a few
/// milliseconds then; with 8 it takes three times as long and finds no more, with 3 it finds what
/// looks like the target from afar.
const COARSE_SIDE: usize = 5;
/// Most pixels per side that are averaged into one. With half of it the search for a large target
/// has four times as many places.
const MOST_COARSE: usize = 4;
/// Number of places by which the scene's contrasts are known: their median to a few hundredths.
/// With half of it a search is not noticeably quicker.
const ENOUGH_PLACES: usize = 10_000;
/// Least standard deviation of the scene's contrasts: the steps of the samples make every scene
/// look like a target by this much. With half of it the same: a contrast of a hundredth is ten of
/// these already.
const LEAST_LIKENESS: f64 = 1e-3;

/// The means of blocks of `side` by `side` pixels.
pub(crate) fn coarsened(from: &Plane, side: usize, to: &mut Plane) {
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
            // A picture lower than a block counts its last row several times.
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
pub(crate) struct CoarseReference {
    reference: Reference,
    pub(crate) coarseness: usize,
}

impl CoarseReference {
    /// The target's reference, as coarse as it may be; `None` for an image of hardly any pixels.
    pub(crate) fn of(state: &TargetBelief, image: &Plane, scratch: &mut Scratch) -> Option<Self> {
        let working = state.appearance.working.image();
        let side = working.width().min(working.height());
        let coarseness = (side / COARSE_SIDE).clamp(1, MOST_COARSE);
        let is_large = image.width() >= 2 * coarseness && image.height() >= 2 * coarseness;
        is_large.then(|| Self {
            reference: coarse_reference(state, coarseness, &mut scratch.buffers.resampler),
            coarseness,
        })
    }

    /// Correlates every placement whose middle is in the given columns and rows of a coarse
    /// picture, into `scratch.statistics`.
    pub(crate) fn correlate(
        &self,
        picture: &Plane,
        [columns, rows]: &[Range<usize>; 2],
        scratch: &mut Scratch,
    ) {
        let (width, height) = (self.reference.image().width(), self.reference.image().height());
        let left = columns.start as isize - (width as isize - 1) / 2;
        let top = rows.start as isize - (height as isize - 1) / 2;
        let sides = [columns.len() + width - 1, rows.len() + height - 1];
        crop(picture, [left, top], sides, &mut scratch.gate);
        scratch.correlator.statistics(&scratch.gate, &self.reference, &mut scratch.statistics);
    }

    /// What the likelihood expects of the target on a coarse picture of an image with this noise.
    pub(crate) fn expectation(
        &self,
        state: &TargetBelief,
        noise: f32,
        config: &TrackerConfig,
    ) -> Expectation {
        let pixels = self.reference.image().samples().len() as f32;
        // The mean of n pixels has an n-th of their noise's variance.
        let noise = noise / (self.coarseness * self.coarseness) as f32;
        let noise = noise.max((config.noise_floor * config.noise_floor) as f32);
        state.expectation(noise, self.reference.variance() * pixels, pixels, config)
    }

    /// How much the part that has been correlated last looks like the reference.
    pub(crate) fn likeness(&self, scratch: &mut Scratch) -> PictureLikeness {
        let covariances = scratch.statistics.covariance.samples();
        let SearchScratch { contrasts, .. } = &mut scratch.search;
        contrasts.clear();
        // z = cov / var is the contrast at a placement; its standard deviation about zero follows
        // from the median of |z|, which the few placements on the target do not change.
        // An odd step, so that it is not the same columns of every row.
        let step = covariances.len().div_ceil(ENOUGH_PLACES) | 1;
        contrasts.extend(covariances.iter().step_by(step).map(|covariance| covariance.abs()));
        let deviation =
            OF_MEDIAN * median(contrasts) / self.reference.variance().max(f32::MIN_POSITIVE);
        PictureLikeness {
            deviation: f64::from(deviation).max(LEAST_LIKENESS),
            places: covariances.len().max(1) as f64,
        }
    }
}

/// How much the picture that is searched looks like a target: the contrasts with which the target's
/// reference is found at its places.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PictureLikeness {
    /// Standard deviation of the contrasts about zero.
    pub(crate) deviation: f64,
    places: f64,
}

impl PictureLikeness {
    /// Log-likelihood ratio of a contrast being the target's, whose usual one is known, against it
    /// being the largest of the scene's places.
    pub(crate) fn log_ratio(self, contrast: f64, usual: f64, contrast_sd: f64) -> f64 {
        let Self { deviation, places } = self;
        let normal = |off: f64, sd: f64| -0.5 * (off / sd).powi(2) - sd.ln();
        // ln N(c; usual, (sd usual)^2) - ln (places N(c; 0, deviation^2)).
        normal(contrast - usual, contrast_sd * usual) - normal(contrast, deviation) - places.ln()
    }
}
