//! Centring of a target that its first image does not show clearly.
//!
//! A box in which nothing stands out cannot be put right by its image ([`crate::figure`]), and as
//! long as the reference is noisy the places at which it learns wander away from the target's
//! middle. The mean of many images has a fraction of their noise, and the scene behind a moving
//! target averages out of it. (Behind one that hovers it does not: two things stand out then, and
//! the reference stays.) So, until the first appearance is clear of noise, the figure is looked for
//! in that mean; where it stands beside the middle of the reference, the reference is cut out anew
//! about it.

use crossfix_correlation::{Plane, View};

use crate::appearance::{Appearance, noise_kept};
use crate::crop::replace_invalid;
use crate::figure::{SIDES, farthest, is_centred, meant};
use crate::frame::FrameInput;
use crate::scratch::Scratch;
use crate::state::{CUT_OUT_SHAPE, TargetBelief};
use crate::{ImagePoint, PixelBox, ReferenceStrategy, TrackerConfig};

/// Least number of images in the mean for the figure to be looked for; it is looked for again each
/// time that the number has doubled. Reasoned: with half of it there is one look more, and the
/// first is at 3 dB more noise.
const FIRST_LOOK: f32 = 4.0;
/// Standard deviation of a figure's middle about the target's own, px per axis: of eight targets
/// that were put right in noise it was 0.35. With half of it the covariance of one that has just
/// been put right promises too much (reasoned).
const FIGURE_SD_PX: f64 = 0.5;
/// The mean of what is about a target in its images.
#[derive(Clone, Debug)]
pub(crate) struct Surroundings {
    mean: Plane,
    /// Variance of its noise.
    noise: f32,
    /// Number of images in it, each weighted by the certainty that it shows the target.
    images: f32,
    next_look: f32,
}

impl Surroundings {
    /// For a box of these sides; `None` where no figure is looked for in as large a window.
    fn new(box_sides: [f64; 2], config: &TrackerConfig) -> Option<Self> {
        let beyond = farthest(config.box_sd_px) + config.margin_px;
        let [width, height] = box_sides.map(|side| 2 * (side / 2.0 + beyond).ceil() as usize + 1);
        let is_searched = [width, height].iter().all(|side| SIDES.contains(side));
        is_searched.then(|| Self {
            mean: Plane::from_fn(width, height, |_, _| 0.0),
            noise: 0.0,
            images: 0.0,
            next_look: FIRST_LOOK,
        })
    }

    /// Takes in what is about the target in an image (`view`, with the mean's sides) with this
    /// variance of its noise, which shows the target with probability `certainty`.
    fn take_in(&mut self, view: &Plane, noise: f32, certainty: f32) {
        self.images += certainty;
        // Weighted running mean; its noise is (1 - s)^2 v + s^2 v_new.
        let share = certainty / self.images;
        for (mean, new) in self.mean.samples_mut().iter_mut().zip(view.samples()) {
            *mean += share * (new - *mean);
        }
        self.noise = (1.0 - share).powi(2) * self.noise + share.powi(2) * noise;
    }

    /// The middle of the mean, which is that of the reference.
    fn middle(&self) -> ImagePoint {
        let of = |side: usize| (side as f64 - 1.0) / 2.0;
        ImagePoint { x: of(self.mean.width()), y: of(self.mean.height()) }
    }

    /// The figure's box, where one thing stands out in the mean.
    fn figure(&self, about: PixelBox, config: &TrackerConfig) -> Option<PixelBox> {
        meant(&self.mean, about, config.box_sd_px, self.noise.sqrt())
    }

    /// Whether a reference of a box lies within the mean.
    fn holds(&self, about: PixelBox, margin_px: f64) -> bool {
        let (middle, centre) = (self.middle(), about.centre());
        let within = |off: f64, side: f64, reach: f64| off.abs() + side / 2.0 + margin_px <= reach;
        within(centre.x - middle.x, about.width, middle.x)
            && within(centre.y - middle.y, about.height, middle.y)
    }
}

impl TargetBelief {
    /// Begins to look for the target's figure in the mean of its images, if the first one alone
    /// does not show the target clearly.
    pub(crate) fn begin_centring(&mut self, config: &TrackerConfig) {
        let may_change = config.box_sd_px > 0.0 && config.reference != ReferenceStrategy::Fixed;
        if may_change && self.appearance.is_anchor_noisy() {
            self.surroundings = Surroundings::new(self.appearance.sides(), config).map(Box::new);
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
        frame: FrameInput<'_>,
        place: ImagePoint,
        certainty: f32,
        scratch: &mut Scratch,
    ) -> bool {
        let Some(mut surroundings) = self.surroundings.take() else { return false };
        let FrameInput { image, config, .. } = frame;
        let view = &mut scratch.gate;
        view.reshape(surroundings.mean.width(), surroundings.mean.height());
        let about = View { x: place.x, y: place.y, scale: 1.0, turn_rad: 0.0 };
        scratch.buffers.resampler.resample(image, about, view);
        replace_invalid(view);
        surroundings.take_in(view, self.noise * noise_kept(place), certainty);
        let is_last = !self.appearance.is_anchor_noisy();
        let is_time = is_last || surroundings.images >= surroundings.next_look;
        let mut has_moved = false;
        if is_time && surroundings.images >= FIRST_LOOK {
            surroundings.next_look *= 2.0;
            let [width, height] = self.appearance.sides();
            let about = PixelBox::about(surroundings.middle(), width, height);
            if let Some(figure) = surroundings.figure(about, config) {
                let anew = PixelBox::about(figure.centre(), width, height);
                has_moved =
                    !is_centred(about, figure) && surroundings.holds(anew, config.margin_px);
                if has_moved {
                    self.cut_out(anew, &surroundings, scratch, config);
                }
                // The next look is at new images.
                surroundings.images = 0.0;
            }
        }
        self.surroundings = (!is_last).then_some(surroundings);
        has_moved
    }

    /// Cuts the reference out of the mean anew, in a box there.
    fn cut_out(
        &mut self,
        about: PixelBox,
        surroundings: &Surroundings,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) {
        let (middle, figure) = (surroundings.middle(), about.centre());
        let Surroundings { mean, noise, images, .. } = surroundings;
        // The mean's noise is smooth already: sampling between its pixels hardly takes from it.
        let noise = noise / noise_kept(figure);
        let appearance = Appearance::new(mean, about, noise, config, &mut scratch.buffers);
        self.appearance = appearance.of_images(*images);
        let by = [figure.x - middle.x, figure.y - middle.y];
        self.motion.recentre(by, FIGURE_SD_PX.powi(2));
        self.last_seen = ImagePoint { x: self.last_seen.x + by[0], y: self.last_seen.y + by[1] };
        // The contrast is in units of the reference's own, which has the target's size and
        // direction.
        (self.contrast, self.usual_contrast, self.contrast_variance) = (1.0, 1.0, 0.0);
        self.shape_variances = CUT_OUT_SHAPE;
    }
}
