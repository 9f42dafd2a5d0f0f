//! The mean of what is about a target in its images: what its figure is looked for in as long as
//! its first appearance is not clear of noise (see [`crate::centring`]).

use crossfix_correlation::Plane;

use crate::figure::{SIDES, farthest, meant};
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// Least number of images in the mean for the figure to be looked for; it is looked for again each
/// time that the number has doubled. Reasoned: with half of it there is one search more, and the
/// first is at 3 dB more noise.
pub(crate) const FIRST_SEARCH_IMAGES: f32 = 4.0;

/// The mean of what is about a target in its images.
#[derive(Clone, Debug)]
pub(crate) struct Surroundings {
    pub(crate) mean: Plane,
    /// Variance of its noise.
    pub(crate) noise: f32,
    /// Number of images in it, each weighted by the certainty that it shows the target.
    pub(crate) images: f32,
    /// Number of images at which the figure is looked for next.
    pub(crate) next_search_images: f32,
}

impl Surroundings {
    /// For a box of these sides; `None` where no figure is looked for in as large a window.
    pub(crate) fn new(box_sides: [f64; 2], config: &TrackerConfig) -> Option<Self> {
        let beyond = farthest(config.box_sd_px) + config.margin_px;
        let [width, height] = box_sides.map(|side| 2 * (side / 2.0 + beyond).ceil() as usize + 1);
        let is_searched = [width, height].iter().all(|side| SIDES.contains(side));
        is_searched.then(|| Self {
            mean: Plane::from_fn(width, height, |_, _| 0.0),
            noise: 0.0,
            images: 0.0,
            next_search_images: FIRST_SEARCH_IMAGES,
        })
    }

    /// Takes in what is about the target in an image (`view`, with the mean's sides) with this
    /// variance of its noise, which shows the target with probability `certainty`.
    pub(crate) fn take_in(&mut self, view: &Plane, noise: f32, certainty: f32) {
        self.images += certainty;
        // Weighted running mean; its noise is (1 - s)^2 v + s^2 v_new.
        let share = certainty / self.images;
        for (mean, new) in self.mean.samples_mut().iter_mut().zip(view.samples()) {
            *mean += share * (new - *mean);
        }
        self.noise = (1.0 - share).powi(2) * self.noise + share.powi(2) * noise;
    }

    /// The middle of the mean, which is that of the reference.
    pub(crate) fn middle(&self) -> ImagePoint {
        let of = |side: usize| (side as f64 - 1.0) / 2.0;
        ImagePoint { x: of(self.mean.width()), y: of(self.mean.height()) }
    }

    /// The figure's box, where one thing stands out in the mean.
    pub(crate) fn figure(&self, about: PixelBox, config: &TrackerConfig) -> Option<PixelBox> {
        meant(&self.mean, about, config.box_sd_px, self.noise.sqrt())
    }

    /// Whether a reference of a box lies within the mean.
    pub(crate) fn holds(&self, about: PixelBox, margin_px: f64) -> bool {
        let (middle, centre) = (self.middle(), about.centre());
        let within = |off: f64, side: f64, reach: f64| off.abs() + side / 2.0 + margin_px <= reach;
        within(centre.x - middle.x, about.width, middle.x)
            && within(centre.y - middle.y, about.height, middle.y)
    }
}
