use crossfix_correlation::Plane;

use crate::crop::BRIGHTEST;

/// Number of samples of the median: it is right to a tenth then, and its mean over images to a
/// twentieth. With half of it to a seventh and a fourteenth.
const SAMPLES: usize = 100;
/// Gain of the mask for white noise's standard deviation: the root of the sum of its squared
/// weights, so it follows from the mask. With half of it every noise counts twice.
const MASK_GAIN: f32 = 6.0;
/// Standard deviation of a normal distribution over its median absolute deviation, a number of
/// mathematics: `1 / Phi^-1(3/4)`.
pub(crate) const OF_MEDIAN: f32 = 1.4826;

/// The median of values, whose order is lost; 0 if there are none.
pub(crate) fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// Estimates the noise of an image from the image itself: the second difference of second
/// differences, for which a smooth scene is zero, and the median of that, for which edges are
/// outliers.
#[derive(Clone, Debug, Default)]
pub(crate) struct NoiseMeter {
    responses: Vec<f32>,
}

impl NoiseMeter {
    /// The noise's variance in an image, at least `floor^2`.
    pub(crate) fn variance(&mut self, image: &Plane, floor: f32) -> f32 {
        self.variance_within(image, [0, 0], [image.width(), image.height()], floor)
    }

    /// The noise's variance in a part of the image, as far as it lies inside, at least `floor^2`.
    /// `corner` is the part's first column and row.
    pub(crate) fn variance_within(
        &mut self,
        image: &Plane,
        corner: [isize; 2],
        sides: [usize; 2],
        floor: f32,
    ) -> f32 {
        let image_sides = [image.width(), image.height()];
        let [columns, rows] = [0, 1].map(|i| {
            let within = |at: isize| at.clamp(0, image_sides[i] as isize) as usize;
            within(corner[i])..within(corner[i].saturating_add_unsigned(sides[i]))
        });
        self.responses.clear();
        if columns.len() >= 3 && rows.len() >= 3 {
            let width = columns.len() - 2;
            let places = width * (rows.len() - 2);
            // An odd step walks over most columns.
            let step = (places / SAMPLES).max(1) | 1;
            for place in (0..places).step_by(step) {
                let (x, y) = (columns.start + place % width, rows.start + place / width);
                let [a, b, c] = [0, 1, 2].map(|k| &image.row(y + k)[x..x + 3]);
                // The mask [[1, -2, 1], [-2, 4, -2], [1, -2, 1]].
                let corners = a[0] + a[2] + c[0] + c[2];
                let sides = a[1] + b[0] + b[2] + c[1];
                let response = (corners - 2.0 * sides + 4.0 * b[1]).abs();
                // Broken samples say nothing.
                if response <= BRIGHTEST {
                    self.responses.push(response);
                }
            }
        }
        // sigma = 1.4826 median(|response|) / 6.
        let deviation = OF_MEDIAN * median(&mut self.responses) / MASK_GAIN;
        (deviation * deviation).max(floor * floor)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    use super::*;

    #[test]
    fn the_noise_of_a_ramp_with_a_spot_is_found() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let normal = Normal::new(0.0f32, 5.0).unwrap();
        let mut sum = 0.0;
        for _ in 0..50 {
            let part = Plane::from_fn(45, 27, |x, y| {
                let spot = if (18..28).contains(&x) && (10..16).contains(&y) { 80.0 } else { 0.0 };
                2.0 * x as f32 + spot + normal.sample(&mut rng)
            });
            sum += NoiseMeter::default().variance(&part, 1.0).sqrt();
        }
        assert!((sum / 50.0 - 5.0).abs() < 0.4, "{}", sum / 50.0);
    }

    #[test]
    fn a_part_without_noise_has_the_floor() {
        assert_eq!(NoiseMeter::default().variance(&Plane::from_fn(9, 9, |_, _| 3.0), 2.0), 4.0);
        assert_eq!(NoiseMeter::default().variance(&Plane::from_fn(2, 9, |_, _| 3.0), 2.0), 4.0);
    }
}
