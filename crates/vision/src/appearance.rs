//! Appearance of a target: its reference in a size and direction of its own, the target's size and
//! direction in the image, and how far the reference has drifted from what it was at first.

use crossfix_correlation::{
    FitOptions, Fitter, Freedom, LowPass, LowPassMemory, Plane, Reference, Resampler, View, Window,
};

use crate::ImagePoint;
use crate::crop::replace_invalid;
use crate::reference::Adaptation;
use crate::{PixelBox, TrackerConfig};

/// Widths of the low-pass filters, px; the filter in use is the one that leaves the least noise and
/// error together. With half of each the noisiest references keep noise that the widest would take
/// away.
const LOW_PASSES: [f32; 5] = [0.0, 0.6, 0.9, 1.2, 1.6];
/// Share of noise in the reference's energy below which the reference is used unfiltered. With half
/// of it twice as many images must be averaged before the other filters are spared.
const CLEAR_NOISE_SHARE: f32 = 0.01;
/// Least width of the low-pass for the comparison with the anchor, px. With half of it the same
/// filter is the least; with twice as much small targets lose the detail that tells the drift.
const ANCHOR_LOW_PASS: f32 = 0.6;
/// Share of noise in the anchor's energy above which images are still averaged into it. Below that
/// the anchor stays as it is: with each image that is added it would drift too. With half of it
/// twice as many are added, with the errors of their places.
const ANCHOR_NOISE_SHARE: f32 = 0.02;
/// Correlation with the anchor below which the target is taken to look different by now. With half
/// of it a target that has changed is still fitted to the anchor, and its drift is chance.
const ANCHOR_LEAST_SCORE: f32 = 0.6;
/// Stiffness of scale and turn in the fit to the anchor, as a share of the reference's energy: a
/// prior that neither has changed. With half of it the turn of a round target, which noise alone
/// tells, comes out up to twice as large.
const ANCHOR_STIFFNESS: f64 = 0.02;
/// Share of new images in the reference at which the working reference is computed again: a few
/// images' worth. Reasoned: with half of it that is done, and costs, twice as often.
const MOST_CHANGED: f32 = 0.1;
/// Least amount by which an image adds to that share: its size and direction are new, even where
/// nothing is learned. With half of it a fixed reference takes a new size in every seventh image
/// instead of every fourth.
const SHAPE_SHARE: f32 = 0.03;
/// Floor of the steepness (see [`steepness`]): a reference of noise alone tells no place. With half
/// of it its places may count for a quarter, with twice as much for four times as much.
const LEAST_STEEPNESS: f64 = 0.15;
/// Bounds of a target's scale, over its first size. With half of the range, from a half to twice,
/// the reference of a target that comes to a third of its first distance stays too small.
const SCALE_RANGE: [f64; 2] = [0.25, 4.0];

/// Drift of a reference against the anchor: the displacement in its own pixels, log scale and turn.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Drift {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) log_scale: f64,
    pub(crate) turn_rad: f64,
}

/// Memory that all targets share.
#[derive(Debug, Default)]
pub(crate) struct AppearanceScratch {
    pub(crate) resampler: Resampler,
    pub(crate) fitter: Fitter,
    memory: LowPassMemory,
    filtered: Plane,
    view: Plane,
}

/// Appearance of one target.
#[derive(Clone, Debug)]
pub(crate) struct Appearance {
    /// Sides of the target's box at first, px.
    pub(crate) size: [f64; 2],
    /// Size over the first size, and turn, rad.
    pub(crate) scale: f64,
    pub(crate) turn_rad: f64,
    /// The reference, mean removed, in its own size and direction.
    own: Plane,
    adaptation: Adaptation,
    /// The mean of the first images, to which the reference is compared.
    anchor: Plane,
    anchor_noise: f32,
    anchor_images: f32,
    pub(crate) drift: Drift,
    low_passes: Vec<LowPass>,
    /// Index of the low-pass in use.
    chosen: usize,
    /// The low-passed reference, in its own size and direction.
    smooth: Plane,
    /// See [`Self::steepness`] and [`Self::filtered_out`].
    steepness: [f64; 2],
    filtered_out: f32,
    /// Share of new images in the reference that the working reference does not contain yet;
    /// whether the working reference has the target's present size and direction; and whether the
    /// reference was like the anchor when they were compared last.
    changed: f32,
    is_in_shape: bool,
    is_like_anchor: bool,
    /// The working reference, which is correlated: low-passed, in the image's size and direction.
    pub(crate) working: Reference,
    /// The low-passed anchor, and the index of its low-pass; `None` while the anchor changes.
    memory: Reference,
    remembered: Option<usize>,
}

/// The least odd number of pixels that holds a length: the middle of an odd side is a pixel.
fn odd(length: f64) -> usize {
    2 * (length / 2.0) as usize + 1
}

/// A row of the middle part of a plane; all sides are odd, so that the middles are one pixel.
fn middle(plane: &Plane, width: usize, height: usize, row: usize) -> &[f32] {
    let [left, top] = [(plane.width() - width) / 2, (plane.height() - height) / 2];
    &plane.row(top + row)[left..left + width]
}

fn without_mean(plane: &mut Plane) {
    let mean = plane.mean();
    plane.samples_mut().iter_mut().for_each(|s| *s -= mean);
}

fn energy(plane: &Plane) -> f32 {
    plane.samples().iter().map(|s| s * s).sum()
}

/// Steepness of a target under a reference, per axis: how strongly the reference's slopes respond
/// to a displacement of the target, over how strongly they would if the target were the reference.
/// That is the sum of the products of the reference's slopes G with the target's slopes T, over
/// that of G with itself, divided by the contrast.
///
/// A fit by G in white noise has the variance `sigma^2 (G'T)^-1 G'G (T'G)^-1`. The bound `sigma^2
/// (G'G)^-1` is taken at the contrast with which the reference fits best, which is as many times
/// the target's own as the target has the reference in it: hence the division. T is known with
/// noise only; the means of its products, `answers` per pixel for slopes and for values, are
/// subtracted.
fn steepness(reference: &Plane, target: &Plane, answers: [f64; 2]) -> [f64; 2] {
    let [noise_answer, value_answer] = answers;
    let product: f64 = reference
        .samples()
        .iter()
        .zip(target.samples())
        .map(|(a, b)| f64::from(a * b))
        .sum::<f64>();
    let count = target.samples().len() as f64;
    // The target's contrast: <reference, target> / E, without the noise that both have in common.
    let contrast = ((product - value_answer * count) / f64::from(energy(reference)).max(1e-12))
        .max(LEAST_STEEPNESS);
    let (width, height) = (reference.width(), reference.height());
    let (mut own, mut with) = ([0.0_f64; 2], [0.0_f64; 2]);
    for y in 1..height.saturating_sub(1) {
        let rows = |plane| [y - 1, y, y + 1].map(|row| Plane::row(plane, row));
        let ([above, row, below], [target_above, target_row, target_below]) =
            (rows(reference), rows(target));
        for x in 1..width - 1 {
            // Twice the central differences: hence the quarters below.
            let slopes = [row[x + 1] - row[x - 1], below[x] - above[x]];
            let of_target =
                [target_row[x + 1] - target_row[x - 1], target_below[x] - target_above[x]];
            for axis in 0..2 {
                own[axis] += f64::from(slopes[axis] * slopes[axis]) / 4.0;
                with[axis] += f64::from(slopes[axis] * of_target[axis]) / 4.0;
            }
        }
    }
    let pixels = (width.saturating_sub(2) * height.saturating_sub(2)) as f64;
    [0, 1].map(|axis| {
        // G'T / G'G, without what the noise that both have in common adds to it.
        let steeper = (with[axis] - noise_answer * pixels) / own[axis].max(1e-12);
        steeper.max(LEAST_STEEPNESS) / contrast
    })
}

/// Share of white noise's variance that is left when an image is sampled between its pixels.
pub(crate) fn noise_kept(place: ImagePoint) -> f32 {
    noise_kept_along(place.x) * noise_kept_along(place.y)
}

/// The same of a row of pixels.
fn noise_kept_along(at: f64) -> f32 {
    let f = at - at.floor();
    // The squared weights of linear interpolation; the cubic one keeps about a third more.
    let linear = f * f + (1.0 - f) * (1.0 - f);
    (linear + 0.28 * (1.0 - linear)) as f32
}

impl Appearance {
    /// Appearance of what is in a box of an image, given the variance of the noise.
    pub(crate) fn new(
        image: &Plane,
        place: PixelBox,
        noise: f32,
        config: &TrackerConfig,
        buffers: &mut AppearanceScratch,
    ) -> Self {
        let side = |length: f64| odd(length + 2.0 * config.margin_px);
        let (width, height) = (side(place.width), side(place.height));
        let centre = place.centre();
        let mut own = Plane::from_fn(width, height, |_, _| 0.0);
        buffers.resampler.resample(
            image,
            View { x: centre.x, y: centre.y, scale: 1.0, turn_rad: 0.0 },
            &mut own,
        );
        replace_invalid(&mut own);
        without_mean(&mut own);
        let noise = noise * noise_kept(centre);
        let plain = Reference::new(own.clone(), Window::uniform(width, height));
        let mut appearance = Self {
            size: [place.width, place.height],
            scale: 1.0,
            turn_rad: 0.0,
            adaptation: Adaptation::new(config.reference, &own, noise, config.noise_floor as f32),
            anchor: own.clone(),
            anchor_noise: noise,
            anchor_images: 1.0,
            drift: Drift::default(),
            low_passes: LOW_PASSES.into_iter().map(LowPass::new).collect(),
            chosen: 0,
            smooth: own.clone(),
            steepness: [1.0; 2],
            filtered_out: 0.0,
            changed: 0.0,
            is_in_shape: true,
            is_like_anchor: true,
            working: plain.clone(),
            memory: plain,
            remembered: None,
            own,
        };
        appearance.prepare(buffers);
        appearance
    }

    /// The same where the image that it was made of was a mean of this number of images.
    pub(crate) fn of_images(self, images: f32) -> Self {
        Self { adaptation: self.adaptation.after(images), anchor_images: images, ..self }
    }

    /// Whether the anchor is not clear of noise yet, so that images are still averaged into it.
    pub(crate) fn is_anchor_noisy(&self) -> bool {
        let pixels = self.anchor.samples().len() as f32;
        self.anchor_noise * pixels > ANCHOR_NOISE_SHARE * energy(&self.anchor)
    }

    /// Correlation coefficient of two appearances, each in its size and direction, their noise
    /// taken out.
    pub(crate) fn likeness(&self, other: &Self) -> f32 {
        let (one, two) = (self.working.image(), other.working.image());
        let (width, height) = (one.width().min(two.width()), one.height().min(two.height()));
        let rows =
            (0..height).map(|y| (middle(one, width, height, y), middle(two, width, height, y)));
        let product: f32 =
            rows.flat_map(|(one, two)| one.iter().zip(two)).map(|(a, b)| a * b).sum();
        // <a, b> / sqrt(E_a E_b), with the energies less their noise: E clear.
        let clear = self.clear_share() * other.clear_share();
        product / (self.energy() * other.energy() * clear).max(1e-12).sqrt()
    }

    /// The appearance at first (that of the anchor), to go on from.
    pub(crate) fn at_first(&self, config: &TrackerConfig, buffers: &mut AppearanceScratch) -> Self {
        let (own, noise) = (self.anchor.clone(), self.anchor_noise);
        let adaptation = Adaptation::new(config.reference, &own, noise, config.noise_floor as f32);
        let mut first = Self {
            adaptation: adaptation.after(self.anchor_images),
            scale: 1.0,
            turn_rad: 0.0,
            drift: Drift::default(),
            is_like_anchor: true,
            own,
            ..self.clone()
        };
        first.prepare(buffers);
        first
    }

    /// Sides of the target's box, px.
    pub(crate) fn sides(&self) -> [f64; 2] {
        self.size.map(|side| side * self.scale)
    }

    /// Energy of the reference in use.
    pub(crate) fn energy(&self) -> f32 {
        self.working.variance() * self.pixels()
    }

    /// Number of its pixels.
    pub(crate) fn pixels(&self) -> f32 {
        self.working.image().samples().len() as f32
    }

    /// Variance of the noise in the reference in use.
    pub(crate) fn noise(&self) -> f32 {
        self.adaptation.noise * self.low_passes[self.chosen].noise_gain()
    }

    /// Steepness of the target under the reference, per axis: see [`steepness`].
    pub(crate) fn steepness(&self) -> [f64; 2] {
        self.steepness
    }

    /// Mean square of what the low-pass has removed from the target.
    pub(crate) fn filtered_out(&self) -> f32 {
        self.filtered_out
    }

    /// Share of the reference's energy that is the target's and not noise: a noisy reference finds
    /// the target fainter than it is.
    pub(crate) fn clear_share(&self) -> f32 {
        // 1 - n v / E: the energy of a noisy reference contains that of its noise.
        let noise = self.noise() * self.pixels();
        (1.0 - noise / self.energy().max(f32::MIN_POSITIVE)).clamp(0.2, 1.0)
    }

    /// Takes the target's image in, with the probability that it shows the target (`certainty`).
    /// Returns the image's share in what measurements refer to: in the anchor, or in the reference
    /// while that is unlike the anchor.
    pub(crate) fn learn(
        &mut self,
        image: &Plane,
        place: ImagePoint,
        noise: f32,
        certainty: f32,
        interval: f64,
        buffers: &mut AppearanceScratch,
    ) -> f32 {
        let mut view = std::mem::take(&mut buffers.view);
        view.reshape(self.own.width(), self.own.height());
        let seen = View { x: place.x, y: place.y, scale: self.scale, turn_rad: self.turn_rad };
        buffers.resampler.resample(image, seen, &mut view);
        replace_invalid(&mut view);
        without_mean(&mut view);
        let noise = noise * noise_kept(place);
        let own_share =
            self.adaptation.take_in(&mut self.own, &view, noise, certainty, interval as f32);
        let mut anchor_share = 0.0;

        // The anchor learns too, until noise is a small share of its energy.
        if self.is_anchor_noisy() {
            // Running mean, each image weighted by its certainty; its noise is (1 - s)^2 v + s^2
            // v_new.
            anchor_share = certainty / (self.anchor_images + 1.0);
            for (old, new) in self.anchor.samples_mut().iter_mut().zip(view.samples()) {
                *old += anchor_share * (new - *old);
            }
            self.anchor_noise =
                (1.0 - anchor_share).powi(2) * self.anchor_noise + anchor_share.powi(2) * noise;
            self.anchor_images += certainty;
            self.remembered = None;
        }
        buffers.view = view;
        self.changed += own_share.max(SHAPE_SHARE);
        if self.changed > MOST_CHANGED || anchor_share > 0.0 {
            self.prepare(buffers);
            self.is_like_anchor = self.compare_with_anchor(buffers);
        }
        if self.is_like_anchor { anchor_share } else { own_share }
    }

    /// Whether the working reference has the size and direction that the target is believed to
    /// have.
    pub(crate) fn is_in_shape(&self) -> bool {
        self.is_in_shape
    }

    /// Changes size and direction; takes effect when enough has been [learned](Self::learn).
    pub(crate) fn reshape(&mut self, log_scale: f64, turn_rad: f64) {
        if [log_scale, turn_rad] != [0.0; 2] {
            self.scale = (self.scale * log_scale.exp()).clamp(SCALE_RANGE[0], SCALE_RANGE[1]);
            self.turn_rad += turn_rad;
            self.is_in_shape = false;
        }
    }

    /// Makes the working reference: the reference with the low-pass of least risk (Stein's
    /// estimate), scaled and turned.
    fn prepare(&mut self, buffers: &mut AppearanceScratch) {
        (self.changed, self.is_in_shape) = (0.0, true);
        let noise = self.adaptation.noise;
        let pixels = self.own.samples().len() as f32;
        let clear = pixels * noise < CLEAR_NOISE_SHARE * energy(&self.own);
        let mut least = f32::INFINITY;
        let AppearanceScratch { memory, filtered, .. } = buffers;
        for (index, filter) in self.low_passes.iter().enumerate() {
            filter.apply(&self.own, memory, filtered);
            let removed: f32 = self
                .own
                .samples()
                .iter()
                .zip(filtered.samples())
                .map(|(a, b)| (a - b) * (a - b))
                .sum();
            // Stein's unbiased estimate of the squared error, as if the truth were known: |own -
            // filtered|^2 + 2 sigma^2 tr(filter) - n sigma^2.
            let risk = removed + pixels * noise * (2.0 * filter.own_weight() - 1.0);
            if risk < least {
                (least, self.chosen) = (risk, index);
                // White noise makes sigma^2 |1 - filter|^2 per pixel of what the filter removes.
                let of_noise = noise * (1.0 - 2.0 * filter.own_weight() + filter.noise_gain());
                self.filtered_out = (removed / pixels - of_noise).max(0.0);
                self.smooth.copy_from(filtered);
            }
            if clear {
                break;
            }
        }
        let filter = &self.low_passes[self.chosen];
        // What the noise itself adds per pixel to the products of slopes, and of values.
        let answers =
            [filter.cross_gradient_gain(), filter.own_weight()].map(|gain| f64::from(noise * gain));
        self.steepness = steepness(&self.smooth, &self.own, answers);
        let (width, height) = (self.own.width() as f64, self.own.height() as f64);
        let Self { smooth, working, scale, turn_rad, .. } = self;
        let [x, y] = [width, height].map(|side| (side - 1.0) / 2.0);
        // The working reference samples the own one, so the inverse scale and turn are used.
        let view = View { x, y, scale: 1.0 / *scale, turn_rad: -*turn_rad };
        let sides = [width, height].map(|side| odd(*scale * side + 0.5));
        working.update(|image| {
            image.reshape(sides[0], sides[1]);
            buffers.resampler.resample(smooth, view, image);
            without_mean(image);
        });
    }

    /// Fits the reference to the anchor and notes its drift: each image was learned at an estimated
    /// place, and these errors add up; the anchor, to which almost nothing is added any more,
    /// stays. Returns whether the two are similar at all.
    fn compare_with_anchor(&mut self, buffers: &mut AppearanceScratch) -> bool {
        let index = self
            .low_passes
            .iter()
            .position(|f| f.deviation() >= ANCHOR_LOW_PASS)
            .unwrap_or(0)
            .max(self.chosen);
        let AppearanceScratch { memory, filtered, fitter, .. } = buffers;
        let filter = &self.low_passes[index];
        if self.remembered != Some(index) {
            self.memory.update(|image| filter.apply(&self.anchor, memory, image));
            self.remembered = Some(index);
        }
        filter.apply(&self.own, memory, filtered);
        self.drift = Drift::default();
        // Correlation coefficient of anchor and reference, both through the same low-pass.
        let product: f32 =
            self.memory.image().samples().iter().zip(filtered.samples()).map(|(a, b)| a * b).sum();
        let score = product / (energy(self.memory.image()) * energy(filtered)).max(1e-12).sqrt();
        if score < ANCHOR_LEAST_SCORE {
            return false;
        }
        let options = FitOptions {
            border: 0,
            steps: 1,
            freedom: Freedom::ShiftScaleTurn,
            stiffness: ANCHOR_STIFFNESS,
            contrast: None,
        };
        let fit = fitter.fit(filtered, &self.memory, 0.0, 0.0, options);
        self.drift = Drift {
            // One Gauss-Newton step is trusted for a pixel, and for a tenth in log scale and turn.
            x: fit.x.clamp(-1.0, 1.0),
            y: fit.y.clamp(-1.0, 1.0),
            log_scale: fit.log_scale.clamp(-0.1, 0.1),
            turn_rad: fit.turn_rad.clamp(-0.1, 0.1),
        };
        true
    }

    /// Converts a displacement in the reference's own pixels to one in the image.
    pub(crate) fn in_image(&self, drift: Drift) -> [f64; 2] {
        // d_image = s R(turn) d.
        let (cos, sin) = (self.scale * self.turn_rad.cos(), self.scale * self.turn_rad.sin());
        [cos * drift.x - sin * drift.y, sin * drift.x + cos * drift.y]
    }
}
