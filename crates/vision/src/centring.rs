//! Centring of a target that its first image does not show clearly.
//!
//! A box in which nothing stands out cannot be put right by its image ([`crate::figure`]), and as
//! long as the reference is noisy the places at which it learns wander away from the target's
//! middle. The mean of many images has a fraction of their noise, and the scene behind a moving
//! target averages out of it. (Behind one that hovers it does not: two things stand out then, and
//! the reference stays.) Until the first appearance is clear of noise, the figure is looked for
//! in that mean; where it stands beside the middle of the reference, the reference is cut out again
//! about it.

use crossfix_correlation::View;

use crate::appearance::{Appearance, noise_kept};
use crate::crop::replace_invalid;
use crate::figure::is_centred;
use crate::frame::FrameInput;
use crate::scratch::Scratch;
use crate::state::{CUT_OUT_SHAPE, TargetBelief};
use crate::surroundings::{FIRST_SEARCH_IMAGES, Surroundings};
use crate::tracker_part::TrackerPart;
use crate::{ImagePoint, PixelBox, ReferenceStrategy, TrackerConfig};

/// Standard deviation of a figure's middle about the target's own, px per axis: of eight targets
/// that were put right in noise it was 0.35. With half of it the covariance of one that has just
/// been put right promises too much (reasoned).
const FIGURE_SD_PX: f64 = 0.5;
impl TargetBelief {
    /// Begins to look for the target's figure in the mean of its images, if the first one alone
    /// does not show the target clearly.
    pub(crate) fn begin_centring(&mut self, config: &TrackerConfig) {
        let may_change = config.box_sd_px > 0.0
            && config.reference != ReferenceStrategy::Fixed
            && config.has(TrackerPart::MeanFigure);
        if may_change && self.appearance.is_anchor_noisy() {
            self.surroundings = Surroundings::new(self.appearance.sides(), config).map(Box::new);
        }
    }

    /// Begins the mean again, if there is one: what it shows was perhaps not the target.
    pub(crate) fn forget_surroundings(&mut self) {
        if let Some(surroundings) = self.surroundings.as_deref_mut() {
            (surroundings.images, surroundings.next_search_images) = (0.0, FIRST_SEARCH_IMAGES);
        }
    }

    /// Takes an image that shows the target at `place` with probability `certainty` into the mean,
    /// and looks for the figure there if it is time. Returns whether the reference has been cut out
    /// again about another middle.
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
        let is_time = is_last || surroundings.images >= surroundings.next_search_images;
        let mut has_moved = false;
        if is_time && surroundings.images >= FIRST_SEARCH_IMAGES {
            surroundings.next_search_images *= 2.0;
            let [width, height] = self.appearance.sides();
            let about = PixelBox::about(surroundings.middle(), width, height);
            if let Some(figure) = surroundings.figure(about, config) {
                let centred = PixelBox::about(figure.centre(), width, height);
                has_moved =
                    !is_centred(about, figure) && surroundings.holds(centred, config.margin_px);
                if has_moved {
                    self.cut_out(centred, &surroundings, scratch, config);
                }
                // The next search is in new images.
                surroundings.images = 0.0;
            }
        }
        self.surroundings = (!is_last).then_some(surroundings);
        has_moved
    }

    /// Cuts the reference out of the mean, in a box there.
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
        self.usual_match = 1.0;
        self.shape_variances = CUT_OUT_SHAPE;
    }
}
