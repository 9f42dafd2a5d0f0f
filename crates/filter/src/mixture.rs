use statrs::function::erf::{erfc, erfc_inv};

use crate::AxisMeasurement;

/// The value of a standard normal variable that is as surprising as `value` is where a mixture of
/// normal distributions, given as weights and moments, was expected.
///
/// For a single distribution it is the normalised innovation. For several, its square is chi-square
/// with one degree of freedom if the mixture is right. The squared innovation over the mixture's
/// variance is not: a wide part of small weight makes that variance much larger without changing
/// much what usually occurs.
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
    let (above, below) = (beyond(value, 1.0, &parts) / total, beyond(value, -1.0, &parts) / total);
    // The inverse normal distribution of the smaller tail, which has kept its digits. Tails below
    // the smallest positive number give the same score.
    let score =
        std::f64::consts::SQRT_2 * erfc_inv((2.0 * above.min(below)).clamp(f64::MIN_POSITIVE, 1.0));
    if above < below { score } else { -score }
}

/// P(X > value) for sign +1 and P(X < value) for -1, times the sum of the weights.
fn beyond(value: f64, sign: f64, parts: &[(f64, AxisMeasurement)]) -> f64 {
    // The sum of w_i erfc(z_i / sqrt 2) / 2.
    let tails = parts.iter().map(|(weight, part)| {
        let off = sign * (value - part.position) / part.variance.sqrt();
        weight * 0.5 * erfc(off / std::f64::consts::SQRT_2)
    });
    tails.sum()
}
