//! What is learnt of a target from an image: its contrast, size, direction and appearance.

use crate::features::{FeatureSample, TargetFeatures};
use crate::fit::{ShapeChange, TargetFit};
use crate::frame::FrameInput;
use crate::scratch::Scratch;
use crate::state::{SEEN, TargetBelief};
use crate::tracker_part::TrackerPart;
use crate::{ImagePoint, PixelBox};

/// Averaging time of the usual contrast, s: longer than a cloud takes it away. With half of it one
/// second at a cloud's edge takes it half-way to the dimmed contrast, instead of 28 % of the way.
const USUAL_S: f64 = 3.0;
/// Time constant with which the contrast of a lost target returns to its usual one, s: about a
/// cloud's edge. With half of it a target that is still dimmed is expected too bright, and found
/// later.
const FADES_S: f64 = 0.5;
/// Matches, as shares of the usual one, up to which an image is hardly learned, and from which on
/// it is learned fully. A target changes its looks by little from image to image; an image that
/// suddenly matches worse has something else in it, a mast or a bird. With a first of 0.5 a
/// reference learns the mast that it passes: on drawn scenes of masts 11 % of the frames are lost
/// instead of 7 (both without what is learnt anyway). With half of both hardly an image is learned
/// less than fully, and masts are learned sooner still.
const LEARNING_MATCHES: [f64; 2] = [0.7, 0.95];
/// Share with which such an image is learned all the same: it may be the target that has changed.
/// With half of it two of 24 drawn targets that turn from bright to dark within two seconds are
/// lost; with none six.
const LEARNT_ANYWAY: f64 = 0.2;
/// Averaging time of the usual match, s. With half of it a mast is what usually matches sooner: a
/// third more of the frames of such scenes are lost; with three times as much a target that turns
/// is learnt too slowly, and on infrared video twice as many are lost.
const USUAL_MATCH_S: f64 = 1.0;
/// Certainties below which nothing is learnt from an image, before and after its correlation is
/// weighed in. With half of them hardly anything changes: the certainty is the weight of what is
/// learnt.
const LEAST_CERTAINTY: [f64; 2] = [0.05, 0.02];
/// Random walk of the contrast, as a share of it per root second. In little noise the gain is 0.73
/// at thirty images a second; with half of it the gain is 0.5, and the contrast lags an image
/// behind a cloud's edge.
const CONTRAST_WALK: f64 = 0.767;
/// Floor of the standard deviation of a measured contrast, as a multiple of the reference's: what
/// the reference does not model. With half of it the gain is 0.9, and the contrast follows every
/// misfit.
const CONTRAST_FLOOR: f64 = 0.1;
/// Floor of the standard deviation of a measured log scale or turn. With half of it the gain of the
/// scale is 0.21 instead of 0.11, and the size follows every misfit.
const SHAPE_FLOOR: f64 = 0.05;

/// 0 below the first value, 1 above the second, linear between.
fn ramp(value: f64, [low, high]: [f64; 2]) -> f64 {
    ((value - low) / (high - low)).clamp(0.0, 1.0)
}

/// Energy under the reference in an image: the target's own, `c^2 k E`, and the noise's, `n v`.
struct EnergyInReference {
    own: f64,
    noise: f64,
}

impl TargetBelief {
    /// Learns contrast, size, direction and appearance from an image, the more the surer the target
    /// was seen. Returns the probability with which the image was taken for the target's, 0 if
    /// nothing was learnt.
    pub(crate) fn learn(
        &mut self,
        frame: FrameInput<'_>,
        place: ImagePoint,
        fit: TargetFit,
        certainty: f64,
        scratch: &mut Scratch,
    ) -> f32 {
        let FrameInput { image, interval, config, .. } = frame;
        if certainty < LEAST_CERTAINTY[0] {
            return 0.0;
        }
        let seen = certainty > SEEN;
        if seen && config.has(TrackerPart::FollowedContrast) {
            self.follow_contrast(fit.contrast, certainty, interval);
        }
        let match_now = fit.score.max(0.0) / self.correlation_in_noise();
        let own_share = if config.has(TrackerPart::UsualMatch) {
            ramp(match_now / self.usual_match, LEARNING_MATCHES).max(LEARNT_ANYWAY)
        } else {
            1.0
        };
        let learnt = certainty * own_share;
        if seen {
            let share = (certainty * interval / USUAL_MATCH_S).min(1.0);
            self.usual_match += share * (match_now - self.usual_match);
        }
        if learnt < LEAST_CERTAINTY[1] {
            return 0.0;
        }
        // Size and direction take effect only with the learning; without it they would run
        // away.
        if seen && self.appearance.is_in_shape() {
            self.follow_shape(fit);
        }
        let (learnt, buffers) = (learnt as f32, &mut scratch.buffers);
        let share = self.appearance.learn(image, place, self.noise, learnt, interval, buffers);
        let variances = [fit.covariance.m11, fit.covariance.m22];
        self.motion.learn(place, f64::from(share), Some(variances));
        learnt
    }

    /// Follows the target's contrast, and the usual one, by what was measured in an image.
    fn follow_contrast(&mut self, measured: f64, certainty: f64, interval: f64) {
        let clear = f64::from(self.appearance.clear_share());
        // The reference's noise is taken out: z / clear, with the variance v / (E clear^2).
        let measured = measured / clear;
        let variance = self.contrast_noise(clear) + CONTRAST_FLOOR.powi(2);
        // Kalman filter of the contrast: P grows by the walk, gain = certainty P / (P + R).
        self.contrast_variance += (CONTRAST_WALK * self.contrast).powi(2) * interval;
        let gain = certainty * self.contrast_variance / (self.contrast_variance + variance);
        self.contrast = (self.contrast + gain * (measured - self.contrast)).clamp(0.2, 5.0);
        self.contrast_variance *= 1.0 - gain;
        let share = (certainty * interval / USUAL_S).min(1.0);
        self.usual_contrast += share * (self.contrast - self.usual_contrast);
    }

    /// Whether another target overlaps this one at a place.
    fn is_beside_another(&self, place: ImagePoint, frame: FrameInput<'_>) -> bool {
        let [width, height] = self.appearance.sides();
        frame.others.any_overlaps(&PixelBox::about(place, width, height))
    }

    /// Takes into the features what an image shows of the target at a place, before that is learnt.
    pub(crate) fn take_features(
        &mut self,
        contrast: f64,
        place: ImagePoint,
        frame: FrameInput<'_>,
    ) {
        if self.is_beside_another(place, frame) {
            return;
        }
        let clear = f64::from(self.appearance.clear_share());
        let sample = FeatureSample {
            contrast: contrast / (self.contrast * clear),
            variance: self.contrast_noise(clear) / self.contrast.powi(2),
            velocity: self.motion.velocity(),
        };
        self.features.take(sample, frame.interval);
    }

    /// How the target looks and moves. Its contrast is the root of its energy per noise: `sqrt(c^2
    /// k E / (n v))`, as in `correlation_in_noise`.
    pub(crate) fn features(&self) -> TargetFeatures {
        let EnergyInReference { own, noise } = self.energy_in_reference();
        self.features.features((own / noise.max(f64::MIN_POSITIVE)).sqrt())
    }

    /// Variance of a contrast that is measured with the reference, of which the share `clear` is
    /// the target's: `v / (E clear^2)`.
    fn contrast_noise(&self, clear: f64) -> f64 {
        f64::from(self.noise / self.appearance.energy().max(1e-12)) / clear.powi(2)
    }

    fn energy_in_reference(&self) -> EnergyInReference {
        let clear = f64::from(self.appearance.clear_share());
        EnergyInReference {
            own: self.contrast.powi(2) * clear * f64::from(self.appearance.energy()),
            noise: f64::from(self.appearance.pixels() * self.noise),
        }
    }

    /// The correlation of a reference with the target's next image if only noise separates them:
    /// `sqrt(k c^2 k E / (c^2 k E + n v))`, with the reference's energy E over n pixels, of which
    /// the share k is the target's, the target's contrast c and the image's noise v.
    fn correlation_in_noise(&self) -> f64 {
        let clear = f64::from(self.appearance.clear_share());
        let EnergyInReference { own, noise } = self.energy_in_reference();
        (clear * own / (own + noise)).sqrt().max(f64::MIN_POSITIVE)
    }

    fn follow_shape(&mut self, fit: TargetFit) {
        let Some(shape) = fit.shape else { return };
        let limits = [0.2, 0.5];
        let mut steps = [0.0; 2];
        for i in 0..2 {
            let ShapeChange { change, variance } = shape[i];
            // A change that is badly known or too large for one image is a misfit, not a change of
            // shape.
            if variance < 0.1 && change.abs() < limits[i] {
                let known = &mut self.shape_variances[i];
                // Kalman gain P / (P + R) of the log scale, then of the turn.
                let gain = *known / (*known + variance + SHAPE_FLOOR.powi(2));
                steps[i] = gain * change;
                *known *= 1.0 - gain;
            }
        }
        self.appearance.reshape(steps[0], steps[1]);
    }

    /// Lets a lost target's contrast fade to its usual one: nothing else is known of it any more.
    pub(crate) fn forget_contrast(&mut self, interval: f64) {
        let share = (interval / FADES_S).min(1.0);
        self.contrast += share * (self.usual_contrast - self.contrast);
        // Towards a standard deviation of half the usual contrast.
        self.contrast_variance +=
            share * ((0.5 * self.usual_contrast).powi(2) - self.contrast_variance);
    }
}
