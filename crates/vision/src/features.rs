//! How a target looks and moves: by these figures people and programs may tell a bird from a
//! drone. Nothing here does.

use crate::ImagePoint;

/// Averaging time of the flicker, s. With half of it a bird's wing beat of 2 Hz is averaged over
/// one beat, and comes and goes with it.
const FLICKER_S: f64 = 1.0;
/// Averaging time of the way, s. With half of it a bird's swing of a second counts as straight.
const WAY_S: f64 = 2.0;

/// How a target looks and moves, beside its size and speed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TargetFeatures {
    /// Its contrast: standard deviation of the brightness that it makes in its box and the margin
    /// about it, in standard deviations of the image's noise.
    pub contrast: f64,
    /// Standard deviation of the contrast from image to image over about a second, as a share of
    /// the contrast, without what the noise explains: wings beat, rotors hardly.
    pub flicker: f64,
    /// Share of the way of about two seconds that lies between its ends: 1 straight on, 0 to and
    /// fro. It is of the way in the image: of a camera that turns, with the camera's.
    pub straightness: f64,
}

/// Running means, from which the features of a target follow.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct FeatureMeter {
    /// Mean squared change of the contrast, as a share of it.
    change: f64,
    /// Mean velocity, and mean speed, px/s.
    velocity: [f64; 2],
    speed: f64,
    /// How long it has been seen, s.
    seen_s: f64,
}

/// What one image says of the features.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FeatureSample {
    /// The contrast measured, as a multiple of that expected, and the noise's variance in that.
    pub(crate) contrast: f64,
    pub(crate) variance: f64,
    /// Velocity, px/s.
    pub(crate) velocity: ImagePoint,
}

impl FeatureMeter {
    /// Takes in an image, `interval` seconds after the last, in which the target was seen.
    pub(crate) fn take(&mut self, sample: FeatureSample, interval: f64) {
        self.seen_s += interval;
        // The plain mean at first, then an exponential one: m += s (x - m).
        let share = |mean_s: f64| interval / self.seen_s.clamp(interval, mean_s.max(interval));
        let (of_change, of_way) = (share(FLICKER_S), share(WAY_S));
        let change = (sample.contrast - 1.0).powi(2) - sample.variance;
        self.change += of_change * (change - self.change);
        let ImagePoint { x, y } = sample.velocity;
        for (mean, now) in self.velocity.iter_mut().zip([x, y]) {
            *mean += of_way * (now - *mean);
        }
        self.speed += of_way * (x.hypot(y) - self.speed);
    }

    /// The features of a target with this contrast, standard deviations of the noise.
    pub(crate) fn features(&self, contrast: f64) -> TargetFeatures {
        let between_ends = self.velocity[0].hypot(self.velocity[1]);
        TargetFeatures {
            contrast,
            flicker: self.change.max(0.0).sqrt(),
            // A target that has not moved has gone no way at all.
            straightness: if self.speed > 0.0 { between_ends / self.speed } else { 0.0 },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metered(
        contrast: impl Fn(f64) -> f64,
        velocity: impl Fn(f64) -> [f64; 2],
    ) -> TargetFeatures {
        let mut meter = FeatureMeter::default();
        for image in 0..300 {
            let time = f64::from(image) / 30.0;
            let [x, y] = velocity(time);
            let sample = FeatureSample {
                contrast: contrast(time),
                variance: 0.0,
                velocity: ImagePoint { x, y },
            };
            meter.take(sample, 1.0 / 30.0);
        }
        meter.features(5.0)
    }

    #[test]
    fn wings_flicker_and_swings_are_no_straight_way() {
        let plane = metered(|_| 1.0, |_| [30.0, -10.0]);
        assert!(plane.flicker < 1e-9 && (plane.straightness - 1.0).abs() < 1e-9, "{plane:?}");
        // A contrast that swings by 0.4 at 3 Hz has a standard deviation of 0.28.
        let beats = |time: f64| 1.0 + 0.4 * (std::f64::consts::TAU * 3.0 * time).sin();
        let swings = |time: f64| [40.0 * (std::f64::consts::TAU * time).cos(), 0.0];
        let bird = metered(beats, swings);
        assert!((bird.flicker - 0.283).abs() < 0.03, "{bird:?}");
        assert!(bird.straightness < 0.25, "{bird:?}");
    }

    #[test]
    fn what_hovers_has_gone_nowhere() {
        assert_eq!(metered(|_| 1.0, |_| [0.0; 2]).straightness, 0.0);
    }
}
