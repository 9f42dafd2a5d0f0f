//! Centring of a target that its first image does not show clearly.
//!
//! A box in which nothing stands out cannot be put right by its image ([`crate::figure`]), and as
//! long as the reference is noisy the places at which it learns wander away from the target's
//! middle. The mean of many images has a fraction of their noise, and the scene behind a moving
//! target averages out of it. So, until the first appearance is clear of noise, the figure is looked
//! for in that mean; where it stands beside the middle of the reference, the reference is cut out
//! anew about it.

use crossfix_correlation::{Plane, Resampler, View};

use crate::appearance::Appearance;
use crate::crop::replace_invalid;
use crate::figure::{farthest, meant};
use crate::scratch::Scratch;
use crate::state::TargetBelief;
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// Number of images in the mean when the figure is first looked for. It is looked for again each
/// time that the number has doubled: the noise falls by 3 dB, and a mean of n images wanders by
/// shares of 1/n. Reasoned: with half of it there is one look more.
const FIRST_LOOK: f32 = 4.0;

/// The mean of what is about a target in its images.
#[derive(Clone, Debug)]
pub(crate) struct Surroundings {
    mean: Plane,
    /// Number of images in it, each weighted by the certainty that it shows the target.
    images: f32,
    next_look: f32,
}

impl Surroundings {
    fn new(box_sides: [f64; 2], box_sd_px: f64) -> Self {
        let [width, height] =
            box_sides.map(|side| 2 * (side / 2.0 + farthest(box_sd_px)).ceil() as usize + 1);
        Self { mean: Plane::from_fn(width, height, |_, _| 0.0), images: 0.0, next_look: FIRST_LOOK }
    }

    /// Takes in an image that shows the target at a place with probability `certainty`.
    fn take_in(
        &mut self,
        image: &Plane,
        (place, certainty): (ImagePoint, f32),
        resampler: &mut Resampler,
        view: &mut Plane,
    ) {
        view.reshape(self.mean.width(), self.mean.height());
        resampler.resample(image, View { x: place.x, y: place.y, scale: 1.0, turn_rad: 0.0 }, view);
        replace_invalid(view);
        self.images += certainty;
        // Weighted running mean.
        let share = certainty / self.images;
        for (mean, new) in self.mean.samples_mut().iter_mut().zip(view.samples()) {
            *mean += share * (new - *mean);
        }
    }

    /// The middle of the mean, which is that of the reference.
    fn middle(&self) -> ImagePoint {
        let of = |side: usize| (side as f64 - 1.0) / 2.0;
        ImagePoint { x: of(self.mean.width()), y: of(self.mean.height()) }
    }

    /// The middle of the target's box by the mean, where something stands out there: that of the
    /// figure, or of the reference where that fits the figure.
    fn figure(&self, box_sides: [f64; 2], noise: f32, box_sd_px: f64) -> Option<ImagePoint> {
        let about = PixelBox::about(self.middle(), box_sides[0], box_sides[1]);
        let noise_sd = (noise / self.images).sqrt();
        meant(&self.mean, about, box_sd_px, noise_sd).map(|meant| meant.centre())
    }
}

impl TargetBelief {
    /// Begins to look for the target's figure in the mean of its images, if the first one alone
    /// does not show the target clearly.
    pub(crate) fn begin_centring(&mut self, config: &TrackerConfig) {
        if config.box_sd_px > 0.0 && self.appearance.is_anchor_noisy() {
            let surroundings = Surroundings::new(self.appearance.sides(), config.box_sd_px);
            self.surroundings = Some(Box::new(surroundings));
        }
    }

    /// Begins the mean anew, if there is one: what it shows was perhaps not the target.
    pub(crate) fn forget_surroundings(&mut self) {
        if let Some(surroundings) = self.surroundings.as_deref_mut() {
            (surroundings.images, surroundings.next_look) = (0.0, FIRST_LOOK);
        }
    }

    /// Takes an image that shows the target at `place` with probability `certainty` into the mean,
    /// and looks for the figure there if it is time. Returns whether the reference has been cut out
    /// anew about another middle.
    pub(crate) fn centre(
        &mut self,
        image: &Plane,
        (place, certainty): (ImagePoint, f32),
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> bool {
        let Some(mut surroundings) = self.surroundings.take() else { return false };
        let resampler = &mut scratch.buffers.resampler;
        surroundings.take_in(image, (place, certainty), resampler, &mut scratch.gate);
        let is_last = !self.appearance.is_anchor_noisy();
        let mut has_moved = false;
        if is_last || surroundings.images >= surroundings.next_look {
            surroundings.next_look *= 2.0;
            let sides = self.appearance.sides();
            if let Some(figure) = surroundings.figure(sides, self.noise, config.box_sd_px) {
                has_moved = figure != surroundings.middle();
                if has_moved {
                    self.cut_out_about(figure, &surroundings, scratch, config);
                }
                // The next look is at new images.
                surroundings.images = 0.0;
            }
        }
        self.surroundings = (!is_last).then_some(surroundings);
        has_moved
    }

    /// Cuts the reference out of the mean anew, about the figure's middle.
    fn cut_out_about(
        &mut self,
        figure: ImagePoint,
        surroundings: &Surroundings,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) {
        let [width, height] = self.appearance.sides();
        let about = PixelBox::about(figure, width, height);
        let Surroundings { mean, images, .. } = surroundings;
        let noise = self.noise / images;
        let appearance = Appearance::new(mean, about, noise, config, &mut scratch.buffers);
        self.appearance = appearance.of_images(*images);
        let middle = surroundings.middle();
        let by = [figure.x - middle.x, figure.y - middle.y];
        self.motion.move_by(by);
        self.last_seen = ImagePoint { x: self.last_seen.x + by[0], y: self.last_seen.y + by[1] };
        // The contrast is in units of the reference's own.
        (self.contrast, self.usual_contrast, self.contrast_variance) = (1.0, 1.0, 0.0);
    }
}
