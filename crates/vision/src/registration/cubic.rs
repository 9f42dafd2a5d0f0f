//! A picture between its pixels.

/// Weights of four pixels for the value between the two in the middle, and for its slope
/// (Catmull-Rom). Linear interpolation is off by two levels at the edge of a wood, more than all
/// else is, and its slopes have steps.
#[derive(Clone, Copy)]
pub(super) struct CubicWeights {
    pub(super) values: [f32; 4],
    pub(super) slopes: [f32; 4],
}

impl CubicWeights {
    /// At a share of the way from the second pixel to the third.
    #[inline(always)]
    pub(super) fn at(f: f32) -> Self {
        let values = [
            f * (f * (2.0 - f) - 1.0),
            f * f * (3.0 * f - 5.0) + 2.0,
            f * (f * (4.0 - 3.0 * f) + 1.0),
            f * f * (f - 1.0),
        ];
        let slopes = [
            f * (4.0 - 3.0 * f) - 1.0,
            f * (9.0 * f - 10.0),
            f * (8.0 - 9.0 * f) + 1.0,
            f * (3.0 * f - 2.0),
        ];
        Self { values: values.map(|w| 0.5 * w), slopes: slopes.map(|w| 0.5 * w) }
    }
}

/// The sum of four pixels, each times its weight.
#[inline(always)]
pub(super) fn weighted(four: [f32; 4], weights: [f32; 4]) -> f32 {
    four[0] * weights[0] + four[1] * weights[1] + four[2] * weights[2] + four[3] * weights[3]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_and_its_slope_are_exact() {
        let parabola = |x: f32| 3.0 - 2.0 * x + 0.5 * x * x;
        let four = [-1.0, 0.0, 1.0, 2.0].map(parabola);
        for f in [0.0, 0.3, 0.5, 0.9] {
            let weights = CubicWeights::at(f);
            assert!((weighted(four, weights.values) - parabola(f)).abs() < 1e-5, "{f}");
            assert!((weighted(four, weights.slopes) - (f - 2.0)).abs() < 1e-5, "{f}");
        }
    }
}
