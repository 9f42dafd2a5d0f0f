//! Detects whether a camera was moved in mid-flight, from its residuals over time.

use nalgebra::Vector2;

use super::fitted::FittedLabel;
use super::linear::median;

/// Block over which residuals are averaged, s: labels err alike for as long. With half of it
/// neighbouring blocks share their errors, and chance looks like a knock.
const BLOCK_S: f64 = 1.0;
/// Least number of blocks in each part. With half of it a bird of three seconds at an end outvotes
/// the median of a part; with twice as much a knock in the first or last quarter of a minute is put
/// later or earlier.
const LEAST_BLOCKS: usize = 8;

/// A moment at which a camera's mean residual changes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MovedAt {
    /// By the camera's own time, s.
    pub time_s: f64,
    /// By how much the mean residual changes, pixels.
    pub by_px: f64,
    /// The same in standard deviations of a second's mean.
    pub deviations: f64,
}

/// The mean of a second's residuals.
struct OneSecondMean {
    time_s: f64,
    mean: Vector2<f64>,
}

fn blocks(labels: &[FittedLabel]) -> Vec<OneSecondMean> {
    let number = |label: &FittedLabel| (label.own_time_s / BLOCK_S).floor();
    labels.chunk_by(|a, b| number(a) == number(b)).map(OneSecondMean::of).collect()
}

impl OneSecondMean {
    fn of(labels: &[FittedLabel]) -> Self {
        let sum: Vector2<f64> = labels.iter().map(|label| label.beside_px).sum();
        Self { time_s: labels[0].own_time_s, mean: sum / labels.len() as f64 }
    }
}

/// The medians of some blocks' means, axis by axis, and the sum of the absolute deviations from
/// them, mean of both axes, pixels.
fn middle(blocks: &[OneSecondMean]) -> (Vector2<f64>, f64) {
    let axis = |axis: usize| median(blocks.iter().map(|block| block.mean[axis]));
    let middle = Vector2::new(axis(0), axis(1));
    let away: f64 = blocks.iter().map(|block| (block.mean - middle).lp_norm(1)).sum();
    (middle, away / 2.0)
}

/// The moment that best divides residuals, in order of time, into two parts of one median each, so
/// that a bird at the beginning or the end does not make a part; `None` with too few blocks.
pub(super) fn likeliest(labels: &[FittedLabel]) -> Option<MovedAt> {
    let blocks = blocks(labels);
    let last = blocks.len().checked_sub(LEAST_BLOCKS)?;
    let divided = (LEAST_BLOCKS..=last).map(|k| divided_at(&blocks, k));
    // The division that leaves the least sum of absolute deviations.
    divided.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, moved)| moved)
}

/// The sum of the absolute deviations from the medians of the blocks before the `k`-th and from it
/// on, and a move at its time.
fn divided_at(blocks: &[OneSecondMean], k: usize) -> (f64, MovedAt) {
    /// Ratio of a normal deviate's standard deviation to its mean absolute value, sqrt(pi / 2).
    /// With half of it moves would be stated with twice as many deviations.
    const BY_MEAN: f64 = 1.253;
    let ((one, left), (other, right)) = (middle(&blocks[..k]), middle(&blocks[k..]));
    // sd = 1.253 mean |x - median| of normal deviates.
    let sd = BY_MEAN * (left + right) / blocks.len() as f64;
    let by_px = (other - one).norm();
    let deviations = by_px / sd.max(f64::MIN_POSITIVE);
    (left + right, MovedAt { time_s: blocks[k].time_s, by_px, deviations })
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::Pixel;
    use nalgebra::Point3;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// Two minutes of labels with errors of half a pixel, and something added that depends on the
    /// time.
    fn labels(added: impl Fn(f64) -> f64) -> Vec<FittedLabel> {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
        let label = |k: u32| {
            let time_s = f64::from(k) * 0.04;
            FittedLabel {
                own_time_s: time_s,
                time_s,
                pixel: Pixel::new(0.0, 0.0),
                beside_px: Vector2::new(0.5 * normal() + added(time_s), 0.5 * normal()),
                motion_px_per_s: Vector2::zeros(),
                place: Point3::origin(),
            }
        };
        (0..3000).map(label).collect()
    }

    #[test]
    fn a_knock_is_found_wherever_it_is() {
        for at_s in [15.0, 60.0, 100.0] {
            let moved = likeliest(&labels(|t| if t > at_s { 6.0 } else { 0.0 })).unwrap();
            assert!((moved.time_s - at_s).abs() < 1.5, "{moved:?}");
            assert!(moved.by_px > 2.0 && moved.deviations > 2.5, "{at_s}: {moved:?}");
        }
    }

    #[test]
    fn a_bird_at_either_end_is_no_knock() {
        for from_s in [0.0, 3.0, 117.0] {
            let bird = (from_s..from_s + 2.5, 200.0);
            let moved = likeliest(&labels(|t| if bird.0.contains(&t) { bird.1 } else { 0.0 }));
            let moved = moved.unwrap();
            assert!(moved.by_px < 2.0 && moved.deviations < 2.5, "{from_s}: {moved:?}");
        }
    }
}
