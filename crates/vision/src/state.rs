//! What is believed of one target: its appearance, its motion, and how well it can be seen.
//!
//! The stages of a step read and change it: the gate (`gate.rs`), the fit (`fit.rs`), learning
//! (`learning.rs`), and where the target is lost the search (`search.rs`).
//! [`crate::followed_target`] puts them together.

use crossfix_correlation::Plane;
use crossfix_filter::AxisMeasurement;

use crate::appearance::Appearance;
use crate::crop::crop;
use crate::features::FeatureMeter;
use crate::frame::FrameInput;
use crate::likelihood::Expectation;
use crate::motion::ImageMotion;
use crate::scratch::Scratch;
use crate::surroundings::Surroundings;
use crate::tracker_part::TrackerPart;
use crate::{ImagePoint, PixelBox, TrackerConfig};

/// Images without the target after which it is searched for: noise hides it in one image and not in
/// the next. With one, each blurred image begins a search; with six a lost target runs on with its
/// prediction for 0.1 s longer, at thirty images a second. (A limit of 0.09 s, which is one image
/// at ten a second, loses a fifth more frames there.) With half of it every second blurred image
/// begins one.
const SEARCH_AFTER_IMAGES: u32 = 3;
/// Time constant of the running estimate of an image's noise, s. With half of it the noise in front
/// of another background is known after 0.05 s, and a single image's counts 1.7 times as much.
const NOISE_S: f64 = 0.0935;
/// Certainty above which a target counts as seen. With half of it a target is measured where it is
/// likelier not to be.
pub(crate) const SEEN: f64 = 0.5;
/// Random walk of the log scale and of the turn (rad), standard deviations per root second. With
/// half of it a size is followed within 0.6 s instead of 0.3.
const SHAPE_WALK: [f64; 2] = [0.0329, 0.1095];
/// Largest variances of the log scale and of the turn, rad^2. With half of them the gain after a
/// long loss is 0.95 instead of 0.97.
const MOST_SHAPE_VARIANCE: [f64; 2] = [0.09, 0.25];
/// Variances of both of a reference that has just been cut out: it has the target's size and
/// direction by definition, but for what keeps a variance from being zero. With half of them the
/// same.
pub(crate) const CUT_OUT_SHAPE: [f64; 2] = [1e-6; 2];

/// State of the belief about one target.
#[derive(Clone, Debug)]
pub(crate) struct TargetBelief {
    pub(crate) appearance: Appearance,
    pub(crate) motion: ImageMotion,
    /// Probability that the target was hidden in the last image.
    pub(crate) hidden: f64,
    /// Variance of the image's noise.
    pub(crate) noise: f32,
    pub(crate) contrast: f64,
    pub(crate) contrast_variance: f64,
    /// Mean contrast over seconds in which the target is seen.
    pub(crate) usual_contrast: f64,
    /// Mean correlation over about a second, as a share of that which noise leaves.
    pub(crate) usual_match: f64,
    pub(crate) features: FeatureMeter,
    /// Variances of the log scale and of the turn.
    pub(crate) shape_variances: [f64; 2],
    /// Number of images without it since it was last seen, ...
    pub(crate) missed: u32,
    /// ... and the time since then, s.
    pub(crate) unseen_s: f64,
    pub(crate) last_seen: ImagePoint,
    /// Whether it has not been seen yet but where it was given.
    pub(crate) is_new: bool,
    /// The mean of what is about it, as long as its first appearance is not clear of noise.
    pub(crate) surroundings: Option<Box<Surroundings>>,
    /// Whether it was seen in the tracker's snapshot picture.
    pub(crate) is_in_snapshot: bool,
}

impl TargetBelief {
    /// State of a target that somebody shows: the box and a margin become the reference (Lytvynets
    /// 2020, object model).
    pub(crate) fn new(
        image: &Plane,
        place: PixelBox,
        scratch: &mut Scratch,
        config: &TrackerConfig,
    ) -> Self {
        let centre = place.centre();
        let around = [place.width, place.height].map(|side| (3.0 * side).ceil().max(9.0) as usize);
        let corner = [centre.x - around[0] as f64 / 2.0, centre.y - around[1] as f64 / 2.0];
        crop(image, corner.map(|at| at as isize), around, &mut scratch.gate);
        let noise = scratch.meter.variance(&scratch.gate, config.noise_floor as f32);
        // Error of drawing the box, and of its middle as the target's own place.
        let variance = config.given_sd_px.powi(2) + config.centre_sd_px.powi(2);
        let given = [centre.x, centre.y].map(|position| AxisMeasurement { position, variance });
        let motion =
            ImageMotion::at_rest(given, config.start_velocity_sd_px, config.acceleration_sd_px);
        let has_models = config.has(TrackerPart::MotionModels);
        Self {
            appearance: Appearance::new(image, place, noise, config, &mut scratch.buffers),
            motion: if has_models { motion } else { motion.of_the_liveliest() },
            hidden: 0.0,
            noise,
            contrast: 1.0,
            contrast_variance: 0.0,
            usual_contrast: 1.0,
            usual_match: 1.0,
            features: FeatureMeter::default(),
            shape_variances: CUT_OUT_SHAPE,
            missed: 0,
            unseen_s: 0.0,
            last_seen: centre,
            is_new: true,
            surroundings: None,
            is_in_snapshot: false,
        }
    }

    /// Where the target is believed to be.
    pub(crate) fn position(&self) -> ImagePoint {
        self.motion.position()
    }

    /// How fast it is believed to move, px/s.
    pub(crate) fn velocity(&self) -> ImagePoint {
        self.motion.velocity()
    }

    /// Whether it is searched for.
    pub(crate) fn is_searching(&self) -> bool {
        self.missed >= SEARCH_AFTER_IMAGES
    }

    /// Notes that it was seen at a place.
    pub(crate) fn seen(&mut self, place: ImagePoint) {
        (self.missed, self.unseen_s, self.hidden) = (0, 0.0, 0.0);
        self.is_new = false;
        self.last_seen = place;
    }

    /// Predicts to the time of the next image.
    pub(crate) fn predict(&mut self, frame: FrameInput<'_>) {
        self.motion.predict(frame.interval, frame.sides());
        self.unseen_s += frame.interval;
        for (i, variance) in self.shape_variances.iter_mut().enumerate() {
            *variance =
                (*variance + SHAPE_WALK[i].powi(2) * frame.interval).min(MOST_SHAPE_VARIANCE[i]);
        }
    }

    /// Takes the noise of an image into the running estimate.
    pub(crate) fn note_noise(&mut self, noise: f32, interval: f64) {
        // A low pass with this time constant, and the first image as it is.
        let share = if self.is_new { 1.0 } else { (1.0 - (-interval / NOISE_S).exp()) as f32 };
        // A mean lies between both: of a difference rounding would leave 0 where one is far larger
        // than the other, and 0 has no logarithm.
        self.noise = (1.0 - share) * self.noise + share * noise;
    }

    /// What the likelihood expects of the target in the image.
    pub(crate) fn expectation(
        &self,
        noise: f32,
        energy: f32,
        pixels: f32,
        config: &TrackerConfig,
    ) -> Expectation {
        let contrast = self.contrast * f64::from(self.appearance.clear_share());
        // Change from image to image, and the error of the estimate so far.
        let variance = (config.contrast_sd * contrast).powi(2) + self.contrast_variance;
        Expectation {
            // The floor makes sure that a reference of nothing is found nowhere.
            energy: energy.max(1e-3 * pixels * noise),
            pixels,
            noise: noise.max(f32::MIN_POSITIVE),
            contrast: contrast as f32,
            contrast_variance: variance as f32,
            mismatch: config.mismatch as f32,
        }
    }
}
