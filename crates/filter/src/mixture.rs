use statrs::function::erf::{erfc, erfc_inv};

use crate::AxisMeasurement;

/// What a standard normal variable would have to be to surprise as much as `value` does where a
/// mixture of normal distributions, given as weights and moments, was expected.
///
/// Of one distribution it is the normalised innovation; of several its square is chi-square with
/// one degree of freedom if the mixture holds, which the squared innovation over the mixture's
/// variance is not: a small weight on a wide part widens the variance, and hardly what is usual.
///
/// ```
/// use crossfix_filter::{AxisMeasurement, normal_score};
/// let part = |weight, variance| (weight, AxisMeasurement { position: 1.0, variance });
/// assert!((normal_score(3.0, [part(1.0, 4.0)]) - 1.0).abs() < 1e-9);
/// assert!((normal_score(-3.0, [part(1.0, 4.0)]) + 2.0).abs() < 1e-9);
/// // One in a hundred may be far off: it is the one in a hundred that is.
/// let score = normal_score(21.0, [part(0.99, 1.0), part(0.01, 400.0)]);
/// assert!((2.9..3.1).contains(&score), "{score}");
/// ```
pub fn normal_score<const N: usize>(value: f64, parts: [(f64, AxisMeasurement); N]) -> f64 {
    let total: f64 = parts.iter().map(|(weight, _)| weight).sum();
    let beyond = |sign: f64| -> f64 {
        let tail = |(weight, part): &(f64, AxisMeasurement)| {
            let off = sign * (value - part.position) / part.variance.sqrt();
            weight * 0.5 * erfc(off / std::f64::consts::SQRT_2)
        };
        parts.iter().map(tail).sum::<f64>() / total
    };
    let (above, below) = (beyond(1.0), beyond(-1.0));
    // The smaller tail is the one with the digits. Beyond the smallest number all surprises are
    // alike.
    let score =
        std::f64::consts::SQRT_2 * erfc_inv((2.0 * above.min(below)).clamp(f64::MIN_POSITIVE, 1.0));
    if above < below { score } else { -score }
}
