//! Whether the thing that a target's reference is found on has come to its place, or was there
//! before.
//!
//! A reference alone does not show it: on a cloud it becomes cloud, and finds that again with
//! certainty. The pictures of the scene ([`crate::scene`]) can: under a target that has come from
//! elsewhere one of them shows what it hides.

use std::ops::Range;

use crossfix_correlation::{Plane, Resampler, View};

use crate::ImagePoint;
use crate::crop::replace_invalid;
use crate::scene::ScenePicture;
use crate::scene_turn::SceneTurn;

/// Standard deviation of the change in contrast of an unchanged scene, in contrasts of the
/// reference: from registration and compression. With half of it textured scenes count as targets,
/// with twice as much faint targets as scene.
const UNCHANGED: f64 = 0.1;
/// Standard deviation of the contrast that the scene itself has in a target's place, as a share of
/// the target's usual contrast: often it is as much as half. With half of it such a scene lies at
/// two standard deviations, and a target that comes there is taken for it.
const SCENE_SHARE: f64 = 0.5;
/// Standard deviation of the change in contrast of something on the lens, as the scene behind it
/// changes, as a share of the target's usual contrast: two scenes, each with a quarter of it. With
/// half of it digits before clouds count as having come, with twice as much a target that comes to
/// where a cloud was counts as having been there before.
const BEHIND: f64 = 0.35;
/// Standard deviation of the registration of the pictures, px per axis. With half of it the edges
/// of an unchanged scene change by up to four times the expected variance, and count as having
/// come.
const REGISTERED_PX: f64 = 0.25;
/// Pixels per independent sample: neighbours are blurred and compressed together. With half of it a
/// small target's blurred noise counts twice.
const PIXELS_PER_SAMPLE: f64 = 4.0;
/// Most independent samples of a target, however large: its parts change together. With half of it
/// a large target's pixels must change by 5.3 times the expected variance instead of 3.6 to count
/// `MOST`.
const MOST_SAMPLES: f64 = 12.0;
/// Most that one picture counts, either way, as a log likelihood ratio: what the model leaves out
/// must remain possible. With half of it a target that was certain counts as unseen in the second
/// image instead of the first, at 30 per second.
const MOST: f64 = 8.0;
/// Range of the factor by which light or exposure may change the contrast of a scene. With no range
/// at all whatever is there counts as having come with every step of the light, where there is no
/// noise to hide the difference. With half of its width so it does with a step by two.
const LIGHTER: [f64; 2] = [0.5, 2.0];
/// Where roll and zoom move the reference's edges by less than this, px, they are left out: what is
/// sampled straight is sharper. With half of it small turns blur a picture, and what is the same
/// counts as having changed a little.
const STRAIGHT_PX: f64 = 0.2;
/// Least share of the reference's energy that must lie in view, where the target was not before.
/// With half of it contrasts are measured by an eighth of the energy, with eight times the whole's
/// noise variance; with twice as much a slow target's pictures show nothing for longer.
const LEAST_FREE: f64 = 0.25;
/// Fewest pixels from which anything follows. With half of it the two that are left are fitted
/// exactly by brightness and contrast, and never change.
const LEAST_PIXELS: f64 = 4.0;

/// Least reach within which the same thing is looked for elsewhere, px: less is within the
/// registration's error. With half of it every turn of a few pixels costs dozens of comparisons.
const LEAST_REACH_PX: f64 = 1.0;
/// Steps of that search in a shorter side of the reference: what it is the same as shows a quarter
/// of a side away. With half of it a mast is missed between two steps; with twice as much the
/// search costs four times as much.
const STEPS_IN_SIDE: f64 = 4.0;
/// Least first step, px, and the last one: as thin as the smallest target is, 4 px, and as well as
/// an edge fits. With half of the first a small target's search costs four times as much, with half
/// of the last each search 9 comparisons more.
const STEPS_PX: [f64; 2] = [2.0, 0.5];

/// The reference's place now, compared with that in a picture of the scene without the target.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ArrivalEvidence {
    /// Contrast of the reference in its place now, and in the picture, as multiples of its own.
    now: f64,
    before: f64,
    /// Variance of each contrast by the image's noise.
    variance: f64,
    /// Mean squared change of the pixels, over that which noise and registration make of an
    /// unchanged scene.
    change: f64,
    /// Number of independent samples in that mean.
    samples: f64,
}

/// Memory for the comparison.
#[derive(Debug, Default)]
pub(crate) struct ComparisonBuffers {
    now: Plane,
    /// The columns and the rows of that which are inside the image.
    inside: [Range<usize>; 2],
    before: Plane,
}

/// Where a picture of the scene may show what is in a place now.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlaceThen<'a> {
    pub(crate) picture: &'a ScenePicture,
    pub(crate) place: ImagePoint,
    /// Where what is in the image now was in that picture.
    pub(crate) turn: SceneTurn,
    /// How far from there it may have been, px per axis.
    pub(crate) reach_px: f64,
    /// Where the target was seen in that picture.
    pub(crate) seen: Option<ImagePoint>,
}

impl PlaceThen<'_> {
    fn reaches(&self, ImagePoint { x, y }: ImagePoint) -> bool {
        (x - self.place.x).abs() <= self.reach_px && (y - self.place.y).abs() <= self.reach_px
    }
}

/// A reference in a place of an image, with the variance of the image's noise.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PlacedReference<'a> {
    pub(crate) reference: &'a Plane,
    /// Energy of the reference, its mean removed.
    pub(crate) energy: f64,
    pub(crate) place: ImagePoint,
    pub(crate) noise: f64,
    /// The contrast that the target usually has in this reference, of which noise is a part.
    pub(crate) usual: f64,
}

impl ArrivalEvidence {
    /// Log-likelihood ratio that the target has come there, against that what is there now was
    /// there before; `usual` is the contrast that the target has otherwise.
    ///
    /// If the target has come, the scene had any contrast c there before, `c ~ N(0, (usual /
    /// 2)^2)`. If not, it had the one that is there now, and no pixel has changed.
    pub(crate) fn log_ratio(self, usual: f64) -> f64 {
        let by_contrast = self.contrast_log_ratio(usual, UNCHANGED);
        (by_contrast + self.changed().min(MOST)).clamp(-MOST, MOST)
    }

    /// The same ratio without limits, by which places are compared.
    fn unlimited_log_ratio(self, usual: f64) -> f64 {
        self.contrast_log_ratio(usual, UNCHANGED) + self.changed()
    }

    /// Log-likelihood ratio of the pixels having changed: `k / 2 (r - 1 - ln r)` for k samples with
    /// r times their expected variance.
    fn changed(self) -> f64 {
        let Self { change, samples, .. } = self;
        if change > 1.0 { samples / 2.0 * (change - 1.0 - change.ln()) } else { 0.0 }
    }

    /// The same ratio against something that lies on the lens, or is written into the video: the
    /// scene behind it has changed, so that changed pixels say nothing.
    pub(crate) fn on_lens_log_ratio(self, usual: f64) -> f64 {
        self.contrast_log_ratio(usual, BEHIND * usual).clamp(-MOST, MOST)
    }

    /// The ratio by the contrasts alone; that of an unchanged scene may be off by `unchanged_sd`.
    fn contrast_log_ratio(self, usual: f64, unchanged_sd: f64) -> f64 {
        let Self { now, before, variance, .. } = self;
        let normal = |off: f64, variance: f64| -0.5 * (off * off / variance + variance.ln());
        // ln N(before; 0, v + (usual / 2)^2) - ln N(before - now; 0, 2 v + unchanged_sd^2).
        let arrived = normal(before, variance + (SCENE_SHARE * usual).powi(2));
        arrived - normal(before - now, 2.0 * variance + unchanged_sd.powi(2))
    }
}

impl ComparisonBuffers {
    /// Samples the image at the reference's place, for the comparisons to come.
    pub(crate) fn take(
        &mut self,
        image: &Plane,
        placed: PlacedReference<'_>,
        resampler: &mut Resampler,
    ) {
        self.now.reshape(placed.reference.width(), placed.reference.height());
        let ImagePoint { x, y } = placed.place;
        self.inside = [
            inside(x, self.now.width(), image.width()),
            inside(y, self.now.height(), image.height()),
        ];
        resampler.resample(image, View { x, y, scale: 1.0, turn_rad: 0.0 }, &mut self.now);
        replace_invalid(&mut self.now);
    }

    /// Compares that sample with what a picture has: in the place where it should be, and where
    /// that says that it has come, in the place within reach where it is likeliest the same. Pixels
    /// where the target was seen in that picture do not count, nor those beyond a border; `None` if
    /// these are nearly all, or the place where it should be was outside the picture.
    pub(crate) fn with(
        &mut self,
        then: PlaceThen<'_>,
        placed: PlacedReference<'_>,
        resampler: &mut Resampler,
    ) -> Option<ArrivalEvidence> {
        let exact = self.at(then, placed, resampler)?;
        let may_be_elsewhere = then.reach_px >= LEAST_REACH_PX;
        if may_be_elsewhere && exact.unlimited_log_ratio(placed.usual) >= 0.0 {
            return Some(self.likeliest_the_same(then, exact, placed, resampler));
        }
        Some(exact)
    }

    /// The comparison with the place within reach that is likeliest the same; `exact` is that with
    /// the middle of these.
    fn likeliest_the_same(
        &mut self,
        then: PlaceThen<'_>,
        exact: ArrivalEvidence,
        placed: PlacedReference<'_>,
        resampler: &mut Resampler,
    ) -> ArrivalEvidence {
        let [least_step, last_step] = STEPS_PX;
        let side = placed.reference.width().min(placed.reference.height()) as f64;
        let mut step = (side / STEPS_IN_SIDE).max(least_step);
        let mut steps = (then.reach_px / step).ceil() as i32;
        let (mut middle, mut best) = (then.place, exact);
        let mut least = exact.unlimited_log_ratio(placed.usual);
        while step >= last_step {
            let about = middle;
            let along = || (-steps..=steps).map(|by| step * f64::from(by));
            for [right, down] in along().flat_map(|down| along().map(move |right| [right, down])) {
                let place = ImagePoint { x: about.x + right, y: about.y + down };
                if !then.reaches(place) {
                    continue;
                }
                if let Some(there) = self.at(PlaceThen { place, ..then }, placed, resampler)
                    && there.unlimited_log_ratio(placed.usual) < least
                {
                    (middle, best) = (place, there);
                    least = there.unlimited_log_ratio(placed.usual);
                }
            }
            (step, steps) = (step / 2.0, 1);
        }
        best
    }

    /// Compares that sample with what a picture has in one place.
    fn at(
        &mut self,
        then: PlaceThen<'_>,
        placed: PlacedReference<'_>,
        resampler: &mut Resampler,
    ) -> Option<ArrivalEvidence> {
        let PlaceThen { picture, place: then, turn, seen, .. } = then;
        let PlacedReference { reference, energy, noise, .. } = placed;
        if !picture.holds(then) {
            return None;
        }
        let (width, height) = (reference.width(), reference.height());
        self.before.reshape(width, height);
        let bent_px = turn.bend() * width.max(height) as f64 / 2.0;
        // A pixel, and what roll and zoom move the edges by.
        let margin_px = 1.0 + bent_px;
        let is_straight = bent_px < STRAIGHT_PX;
        let (scale, turn_rad) =
            if is_straight { (1.0, 0.0) } else { (turn.scale(), turn.roll_rad()) };
        let view = View { x: then.x, y: then.y, scale, turn_rad };
        resampler.resample(picture.image(), view, &mut self.before);
        // Beyond its border a picture shows nothing.
        let (sin, cos) = turn_rad.sin_cos();
        let [along, across] = [scale * cos, scale * sin];
        let was_in_picture = |x: usize, y: usize| {
            let [right, down] = [(x, width), (y, height)].map(|(at, side)| from_middle(at, side));
            let [x, y] = [along * right - across * down, across * right + along * down];
            picture.holds(ImagePoint { x: then.x + x, y: then.y + y })
        };
        let mut sums = PixelSums::default();
        for y in 0..height {
            let row_covered =
                seen.is_some_and(|seen| covered(y, height, then.y, seen.y, margin_px));
            let above = self.before.row(y.saturating_sub(1));
            let rows =
                reference.row(y).iter().zip(self.now.row(y)).zip(self.before.row(y)).zip(above);
            let mut left = self.before.row(y)[0];
            for (x, (((reference, now), before), above)) in rows.enumerate() {
                // Squared slope, by the differences from the left and the upper neighbour.
                let slope = (before - left).powi(2) + (before - above).powi(2);
                left = *before;
                let is_covered = row_covered
                    && seen.is_some_and(|seen| covered(x, width, then.x, seen.x, margin_px));
                let is_in_image = self.inside[0].contains(&x) && self.inside[1].contains(&y);
                if !is_covered && is_in_image && was_in_picture(x, y) {
                    sums.add(*reference, *now, *before, slope);
                }
            }
        }
        sums.arrival(energy, noise)
    }
}

/// Whether the reference's row or column `at`, with its middle at `then`, is under the target where
/// it was `seen` in the picture, or within `margin_px` of that.
fn covered(at: usize, side: usize, then: f64, seen: f64, margin_px: f64) -> bool {
    (then + from_middle(at, side) - seen).abs() <= side as f64 / 2.0 + margin_px
}

/// How far a column or row lies from the middle of all.
fn from_middle(at: usize, side: usize) -> f64 {
    at as f64 - (side as f64 - 1.0) / 2.0
}

/// The columns (or rows) of a reference with its middle at a place that lie inside an image.
fn inside(place: f64, side: usize, of_image: usize) -> Range<usize> {
    let first = place + from_middle(0, side);
    let [start, end] = [-first, of_image as f64 - 1.0 - first];
    let start = start.max(0.0).ceil() as usize;
    start..((end + 1.0).clamp(0.0, side as f64) as usize).max(start)
}

/// Sums over the pixels that count.
#[derive(Clone, Copy, Debug, Default)]
struct PixelSums {
    pixels: f64,
    reference: f64,
    now: f64,
    before: f64,
    reference_squared: f64,
    reference_now: f64,
    reference_before: f64,
    now_squared: f64,
    before_squared: f64,
    now_before: f64,
    slope_squared: f64,
}

impl PixelSums {
    fn add(&mut self, reference: f32, now: f32, before: f32, slope_squared: f32) {
        let [reference, now, before] = [reference, now, before].map(f64::from);
        self.pixels += 1.0;
        self.reference += reference;
        self.now += now;
        self.before += before;
        self.reference_squared += reference * reference;
        self.reference_now += reference * now;
        self.reference_before += reference * before;
        self.now_squared += now * now;
        self.before_squared += before * before;
        self.now_before += now * before;
        self.slope_squared += f64::from(slope_squared);
    }

    /// Sum of the squared changes, without those that light can make: of brightness and of
    /// contrast.
    fn change_squared(&self) -> f64 {
        let n = self.pixels;
        // Sums of squares and products about the means, so that a change of brightness drops out.
        let now = (self.now_squared - self.now * self.now / n).max(0.0);
        let before = (self.before_squared - self.before * self.before / n).max(0.0);
        let both = self.now_before - self.now * self.before / n;
        let [least, most] = LIGHTER;
        // The factor of contrast f that fits best, within its range; what remains is |now - f
        // before|^2.
        let lighter = if before > 0.0 { (both / before).clamp(least, most) } else { 1.0 };
        (now - 2.0 * lighter * both + lighter * lighter * before).max(0.0)
    }

    fn arrival(self, whole: f64, noise: f64) -> Option<ArrivalEvidence> {
        let n = self.pixels;
        if n < LEAST_PIXELS {
            return None;
        }
        // Over the pixels that count the reference has a mean and an energy of its own.
        let energy = self.reference_squared - self.reference * self.reference / n;
        if energy <= (LEAST_FREE * whole).max(f64::from(f32::MIN_POSITIVE)) {
            return None;
        }
        // Contrast that fits best: sum of (reference - mean) (image), over the reference's energy.
        let contrast = |product: f64, sum: f64| (product - self.reference * sum / n) / energy;
        // Each squared slope has two differences of noisy pixels in it, each with twice their
        // variance.
        let slope = (self.slope_squared / n - 4.0 * noise).max(0.0);
        let unchanged =
            (2.0 * noise + slope * REGISTERED_PX.powi(2)).max(f64::from(f32::MIN_POSITIVE));
        Some(ArrivalEvidence {
            now: contrast(self.reference_now, self.now),
            before: contrast(self.reference_before, self.before),
            // Var(a / E) = v E / E^2.
            variance: noise / energy,
            change: self.change_squared() / n / unchanged,
            samples: (n / PIXELS_PER_SAMPLE).min(MOST_SAMPLES),
        })
    }
}
