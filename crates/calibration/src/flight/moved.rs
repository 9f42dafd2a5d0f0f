//! Whether a camera was moved in mid-flight, by its residuals over time.

use nalgebra::Vector2;

/// Residuals over this time are averaged, s: labels err alike for as long.
const BLOCK_S: f64 = 1.0;
/// Each part must have so many of them.
const LEAST_BLOCKS: usize = 8;

/// A moment before and after which a camera's labels lie beside the way by something else.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MovedAt {
    /// By the camera's own time, s.
    pub time_s: f64,
    /// By how much the mean residual changes, pixels.
    pub by_px: f64,
    /// And in deviations of the means over a second.
    pub deviations: f64,
}

/// The mean of a second's residuals.
struct Block {
    time_s: f64,
    mean: Vector2<f64>,
}

fn blocks(residuals: &[(f64, Vector2<f64>)]) -> Vec<Block> {
    let number = |time_s: f64| (time_s / BLOCK_S).floor();
    let same = |a: &(f64, Vector2<f64>), b: &(f64, Vector2<f64>)| number(a.0) == number(b.0);
    let block = |chunk: &[(f64, Vector2<f64>)]| Block {
        time_s: chunk[0].0,
        mean: chunk.iter().map(|(_, residual)| residual).sum::<Vector2<f64>>() / chunk.len() as f64,
    };
    residuals.chunk_by(same).map(block).collect()
}

/// The moment that divides residuals, in the order of their times, best into two parts of one mean
/// each; `None` of too few.
pub(super) fn likeliest(residuals: &[(f64, Vector2<f64>)]) -> Option<MovedAt> {
    let blocks = blocks(residuals);
    let all: Vector2<f64> = blocks.iter().map(|block| block.mean).sum();
    let squares: f64 = blocks.iter().map(|block| block.mean.norm_squared()).sum();
    let mut before = Vector2::zeros();
    let mut best: Option<(f64, MovedAt)> = None;
    for (k, block) in blocks.iter().enumerate() {
        let (left, right) = (k as f64, (blocks.len() - k) as f64);
        if k >= LEAST_BLOCKS && blocks.len() - k >= LEAST_BLOCKS {
            let (one, other) = (before / left, (all - before) / right);
            // What the two means leave, per axis.
            let explained = before.norm_squared() / left + (all - before).norm_squared() / right;
            let sd = ((squares - explained).max(0.0) / (2.0 * (left + right))).sqrt();
            let by_px = (other - one).norm();
            if best.as_ref().is_none_or(|(most, _)| explained > *most) {
                let deviations = by_px / sd.max(f64::MIN_POSITIVE);
                best = Some((explained, MovedAt { time_s: block.time_s, by_px, deviations }));
            }
        }
        before += block.mean;
    }
    best.map(|(_, moved)| moved)
}
