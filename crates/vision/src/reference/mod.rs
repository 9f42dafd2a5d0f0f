//! How the reference follows the target's appearance (Solonar 2023): the strategies that the papers
//! name, and the mean, which measures best in the loop.

mod imm;

use crossfix_correlation::Plane;
use serde::{Deserialize, Serialize};

pub use imm::{ImmConfig, PixelImm};

/// The interval of the frames in which Solonar 2023 counts times, s, as the paper has it.
const PAPERS_FRAME_S: f32 = 1.0 / 30.0;

/// How the reference is formed from the images of the target.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum ReferenceStrategy {
    /// It stays the first image.
    Fixed,
    /// Each image takes the place of the one before (Solonar 2023, Fig. 1).
    Replacement,
    /// Exponential smoothing, `T+ = memory T + (1 - memory) image` (Solonar 2023, Fig. 2; erratum:
    /// 0.9 to 0.95 is the weight of the old).
    Smoothing {
        /// Weight of the old reference, 0 to 1.
        memory: f32,
    },
    /// The interacting multiple model filter of each pixel (Solonar 2023, Fig. 3).
    PixelImm(ImmConfig),
    /// The mean of all images, and when they are many, exponential smoothing with a weight of
    /// `least_share` for the new one; each image counts as much as it is certain to show the
    /// target. The default.
    Mean {
        /// Least weight of a new image, 0 to 1, whatever their rate: as many images must be
        /// averaged for noise to be small. (With the mean over 1.1 s, eleven images at ten a
        /// second, a tenth more frames of small targets are lost there.) Default 0.03.
        least_share: f32,
    },
}

impl Default for ReferenceStrategy {
    fn default() -> Self {
        Self::Mean { least_share: 0.03 }
    }
}

/// A reference's image and its noise, as a strategy forms them.
#[derive(Clone, Debug)]
pub(crate) struct Adaptation {
    strategy: ReferenceStrategy,
    filter: Option<PixelImm>,
    /// Number of images taken in, each weighted by its certainty.
    images: f32,
    /// Variance of the reference's noise.
    pub(crate) noise: f32,
}

impl Adaptation {
    pub(crate) fn new(strategy: ReferenceStrategy, first: &Plane, noise: f32, level: f32) -> Self {
        let filter = match strategy {
            ReferenceStrategy::PixelImm(config) => {
                Some(PixelImm::new(scaled(config, level), first.samples(), noise))
            }
            _ => None,
        };
        Self { strategy, filter, images: 1.0, noise }
    }

    /// The same state if `first` was the mean of this number of images.
    pub(crate) fn after(self, images: f32) -> Self {
        Self { images, ..self }
    }

    /// Takes an image in, given the variance of its noise and the probability that it shows the
    /// target (0 to 1), `interval` seconds after the last one. Returns its share in the reference.
    pub(crate) fn take_in(
        &mut self,
        reference: &mut Plane,
        image: &Plane,
        noise: f32,
        certainty: f32,
        interval: f32,
    ) -> f32 {
        let share = match self.strategy {
            ReferenceStrategy::Fixed => return 0.0,
            ReferenceStrategy::Replacement => 1.0,
            ReferenceStrategy::Smoothing { memory } => (1.0 - memory) * certainty,
            ReferenceStrategy::Mean { least_share } => {
                // 1 / (n + 1) is the new image's weight in a plain mean.
                certainty * (1.0 / (self.images + 1.0)).max(least_share)
            }
            ReferenceStrategy::PixelImm(_) => {
                if let Some(filter) = &mut self.filter {
                    // An uncertain image counts as a noisier one.
                    let variance = noise / certainty.max(0.01);
                    let frames = interval / PAPERS_FRAME_S;
                    filter.step(image.samples(), frames, variance, reference.samples_mut());
                    // The noise of about four frames' mean where nothing changes, of one frame
                    // where it jumps.
                    self.noise = (0.75 * self.noise).max(noise / 4.0);
                }
                return 0.25;
            }
        };
        for (old, new) in reference.samples_mut().iter_mut().zip(image.samples()) {
            *old += share * (new - *old);
        }
        // Images' noises are independent: v = (1 - s)^2 v + s^2 v_image.
        self.noise = (1.0 - share).powi(2) * self.noise + share * share * noise;
        self.images += certainty;
        share
    }
}

/// The models' noises, for a brightness in which a level of 8 bits is `level`.
fn scaled(config: ImmConfig, level: f32) -> ImmConfig {
    ImmConfig {
        constant_sd: config.constant_sd * level,
        drift_sd: config.drift_sd * level,
        jump_sd: config.jump_sd * level,
        ..config
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(strategy: ReferenceStrategy, images: &[f32]) -> f32 {
        let plane = |value: f32| Plane::from_fn(3, 3, |_, _| value);
        let mut reference = plane(100.0);
        let mut adaptation = Adaptation::new(strategy, &reference, 4.0, 1.0);
        for image in images {
            adaptation.take_in(&mut reference, &plane(*image), 4.0, 1.0, 0.04);
        }
        reference.samples()[4]
    }

    #[test]
    fn each_strategy_does_what_it_is_called() {
        assert_eq!(after(ReferenceStrategy::Fixed, &[50.0, 60.0]), 100.0);
        assert_eq!(after(ReferenceStrategy::Replacement, &[50.0, 60.0]), 60.0);
        assert_eq!(after(ReferenceStrategy::Smoothing { memory: 0.9 }, &[50.0]), 95.0);
        assert_eq!(after(ReferenceStrategy::Mean { least_share: 0.03 }, &[50.0, 60.0]), 70.0);
        let jump = after(ReferenceStrategy::PixelImm(ImmConfig::default()), &[50.0; 6]);
        assert!((jump - 50.0).abs() < 2.0, "{jump}");
    }

    #[test]
    fn a_mean_has_the_noise_of_a_mean() {
        let plane = Plane::from_fn(2, 2, |_, _| 0.0);
        let mut adaptation =
            Adaptation::new(ReferenceStrategy::Mean { least_share: 0.0 }, &plane, 9.0, 1.0);
        for _ in 0..8 {
            adaptation.take_in(&mut plane.clone(), &plane, 9.0, 1.0, 0.04);
        }
        assert!((adaptation.noise - 1.0).abs() < 1e-5);
    }
}
