//! Errors of labels: most are small and alike for half a second, some labels may be of anything.

use nalgebra::Vector2;

use crate::label_noise::LabelNoise;

/// Degrees of freedom of the heavy tails: at four, a label ten deviations off costs a fifth of what
/// it would under a normal distribution, and weighs a twentieth of a label one deviation off; clean
/// labels lose a tenth of their weight. With twice as much the first weighs a twelfth.
const FREEDOM: f64 = 4.0;

/// Distribution of residuals, which sets how unlikely a large one is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Tails {
    /// Normal.
    Normal,
    /// Student's t: the measurement may be of something else.
    Heavy,
    /// Normal for usual residuals, and beyond them Student's t: what was known beforehand may no
    /// longer hold, but where it does it counts once. (For residuals of zero Student's t of n
    /// numbers weights them (freedom + n) / freedom times.)
    Known,
}

impl Tails {
    /// Degrees of freedom of Student's t; `None` for a normal distribution.
    fn freedom(self) -> Option<f64> {
        match self {
            Self::Normal => None,
            Self::Heavy | Self::Known => Some(FREEDOM),
        }
    }

    /// Whether residuals are in the normal part of [`Self::Known`]: both parts join where the mean
    /// square is one.
    fn is_normal(self, squares: f64, count: usize) -> bool {
        self == Self::Known && squares <= count as f64
    }

    /// Weight of residuals with this sum of squares.
    pub(super) fn weight(self, squares: f64, count: usize) -> f64 {
        if self.is_normal(squares, count) {
            return 1.0;
        }
        self.freedom().map_or(1.0, |freedom| (freedom + count as f64) / (freedom + squares))
    }

    /// Twice their negative log likelihood.
    pub(super) fn loss(self, squares: f64, count: usize) -> f64 {
        if self.is_normal(squares, count) {
            return squares;
        }
        let Some(freedom) = self.freedom() else { return squares };
        let count = count as f64;
        let heavy = (freedom + count) * (squares / freedom).ln_1p();
        // The constant that makes both parts equal where they join, at squares = count.
        let joined = match self {
            Self::Known => count - (freedom + count) * (count / freedom).ln_1p(),
            _ => 0.0,
        };
        heavy + joined
    }
}

/// Least standard deviation of a label, pixels: without it the noise of a camera that alone
/// determines the trajectory would be found to be zero. With half of it such a camera weighs four
/// times as much.
const LEAST_SD_PX: f64 = 0.1;
/// Errors that last longer than this are ascribed to the lens or the pose, s. With half of it
/// errors that last for two seconds are stated as shorter, and the mean of many labels as better
/// than it is.
const LONGEST_S: f64 = 2.0;
/// Block over which labels are averaged to find how long errors last, s. With half of it errors of
/// one and of two seconds are harder to tell apart: 85 and 92 % of their variance are left in a
/// mean, and not 74 and 85 %.
const BLOCK_S: f64 = 1.0;
/// One label in this many may be of anything: that share of the largest is left out. With twice as
/// much, slips on more than one label in forty count as noise.
const ANYTHING: usize = 20;

/// How labels are whitened: a label's error is this share of the previous label's, ...
#[derive(Clone, Copy, Debug)]
pub(super) struct Whitening {
    pub(super) kept: f64,
    /// ... and the remainder has this deviation, pixels.
    pub(super) sd_px: f64,
}

impl LabelNoise {
    /// Whitening of a label that follows another after `before_s` seconds, where frames are
    /// `frame_s` apart.
    ///
    /// Whitening the sum of a white and a lasting part exactly would need all labels before. Using
    /// the last one alone, weighted by its correlation, leaves the difference of two labels what it
    /// is; the deviation is then enlarged until the mean of many labels is not better known than it
    /// is. Between the two it errs towards caution.
    pub(super) fn after(&self, before_s: Option<f64>, frame_s: f64) -> Whitening {
        let variance = self.sd_px().powi(2);
        let kept = before_s.map_or(0.0, |before_s| self.correlation(before_s));
        let caution = self.caution(frame_s);
        // AR(1): the remainder's variance is (1 - rho^2) times the label's.
        Whitening { kept, sd_px: (variance * (1.0 - kept * kept) * caution).sqrt() }
    }

    /// Factor on the variance so that the mean of many labels, each whitened by the one before, is
    /// not better known than it is.
    pub(super) fn caution(&self, frame_s: f64) -> f64 {
        let of_frame = self.correlation(frame_s);
        // White-equivalent variance of an AR(1) process: variance (1 + rho) / (1 - rho).
        let averaged = self.sd_px().powi(2) * (1.0 + of_frame) / (1.0 - of_frame);
        (self.white_equivalent_px(frame_s).powi(2) / averaged).max(1.0)
    }

    /// Estimates the noise from residuals in order of time; `explained` is the variance (pixels^2,
    /// per axis) that the fitted trajectory has absorbed.
    pub(super) fn of(residuals: &[(f64, Vector2<f64>)], explained: f64, frame_s: f64) -> Self {
        let residuals = &without_strays(residuals);
        let variance = typical(residuals.iter().map(|(_, residual)| *residual)) + explained;
        let variance = variance.max(LEAST_SD_PX.powi(2));
        let steps = residuals.windows(2).filter(|pair| pair[1].0 - pair[0].0 < 1.5 * frame_s);
        // Var(e2 - e1) / 2 = variance - covariance of neighbours.
        let of_steps = typical(steps.map(|pair| pair[1].1 - pair[0].1)) / 2.0;
        let of_means = typical(block_means(residuals).into_iter()) + explained;
        let lasting_at = |lasting_s| lasting_variance(variance, of_steps, frame_s, lasting_s);
        // Bisection for the correlation time with which blocks' means vary as they do.
        let (mut least, mut most) = (frame_s, LONGEST_S.max(2.0 * frame_s));
        for _ in 0..40 {
            let middle = f64::midpoint(least, most);
            let lasting = lasting_at(middle);
            // Variance of blocks' means: the lasting part by its share, the white part by the
            // number of labels.
            let means = lasting * share_of_means(middle) + (variance - lasting) * frame_s / BLOCK_S;
            // A longer correlation leaves more of the variance in the means.
            if means < of_means { least = middle } else { most = middle }
        }
        let lasting = lasting_at(least);
        Self {
            white_px: (variance - lasting).max(0.0).sqrt().max(LEAST_WHITE_PX),
            lasting_px: lasting.sqrt(),
            lasting_s: least,
        }
    }
}

/// The part of the variance that lasts, for a correlation time, by the covariance of successive
/// residuals: `variance - of_steps = lasting x exp(-frame / T)`.
fn lasting_variance(variance: f64, of_steps: f64, frame_s: f64, lasting_s: f64) -> f64 {
    let kept = (-frame_s / lasting_s).exp();
    ((variance - of_steps).max(0.0) / kept).min(variance)
}

/// Least white noise of labels, pixels: they are not drawn more finely. With half of it bearings of
/// a camera whose labels happen to lie smoothly are stated twice as well.
const LEAST_WHITE_PX: f64 = 0.03;

/// Variance per axis without the largest vectors, corrected for the share of the variance that
/// these have under a normal distribution. The median would not do: labels are drawn to half a
/// pixel, and most of those next to one another differ by next to nothing.
fn typical(vectors: impl Iterator<Item = Vector2<f64>>) -> f64 {
    let mut squares: Vec<f64> = vectors.map(|vector| vector.norm_squared()).collect();
    squares.sort_unstable_by(f64::total_cmp);
    let (count, cut) = (squares.len(), squares.len() / ANYTHING);
    if count == 0 {
        return 0.0;
    }
    // Half of the squared length is an exponential deviate: its part above the quantile 1 - s
    // contributes s (1 - ln s) of its mean.
    let share = cut as f64 / count as f64;
    let left = if cut == 0 { 1.0 } else { 1.0 - share * (1.0 - share.ln()) };
    let sum: f64 = squares[..count - cut].iter().sum();
    sum / (2.0 * count as f64 * left)
}

/// Labels farther off than this many times the median are of something else, such as birds beside
/// the drone. Of normal deviates none in 10^14 is; with half of it slips of the hand are left out,
/// too.
const STRAY: f64 = 7.0;

/// The residuals without those of other things, which may be nearly half of all.
fn without_strays(residuals: &[(f64, Vector2<f64>)]) -> Vec<(f64, Vector2<f64>)> {
    let mut lengths: Vec<f64> = residuals.iter().map(|(_, residual)| residual.norm()).collect();
    lengths.sort_unstable_by(f64::total_cmp);
    let most = STRAY * lengths.get(lengths.len() / 2).copied().unwrap_or(0.0);
    residuals.iter().copied().filter(|(_, residual)| residual.norm() <= most).collect()
}

fn block_means(residuals: &[(f64, Vector2<f64>)]) -> Vec<Vector2<f64>> {
    let block = |time_s: f64| (time_s / BLOCK_S).floor();
    let same = |a: &(f64, Vector2<f64>), b: &(f64, Vector2<f64>)| block(a.0) == block(b.0);
    let spans =
        |chunk: &&[(f64, Vector2<f64>)]| chunk[chunk.len() - 1].0 - chunk[0].0 > 0.6 * BLOCK_S;
    residuals.chunk_by(same).filter(spans).map(mean).collect()
}

/// The mean of residuals with their times.
fn mean(residuals: &[(f64, Vector2<f64>)]) -> Vector2<f64> {
    let sum = residuals.iter().map(|(_, residual)| residual).sum::<Vector2<f64>>();
    sum / residuals.len() as f64
}

/// Share of the variance of an error with correlation time T that is left in the mean over a block
/// of length L: the mean of `exp(-t / T)` over the block's pairs,
/// `2 T/L (1 - T/L (1 - exp(-L/T)))`.
fn share_of_means(lasting_s: f64) -> f64 {
    let ratio = lasting_s / BLOCK_S;
    2.0 * ratio * (1.0 - ratio * (1.0 - (-ratio.recip()).exp()))
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// Half a minute of labels, with a share of labels of something else.
    fn found(strays: f64) -> LabelNoise {
        const FRAME_S: f64 = 1.0 / 30.0;
        let mut random = ChaCha8Rng::seed_from_u64(9);
        let mut lasting = Vector2::zeros();
        let kept = (-FRAME_S / 1.0f64).exp();
        let residuals: Vec<(f64, Vector2<f64>)> = (0..3000)
            .map(|k| {
                let mut normal =
                    || Vector2::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut random) });
                lasting = lasting * kept + normal() * (0.5 * (1.0 - kept * kept).sqrt());
                let own = lasting + normal() * 0.2;
                let stray = random.random_bool(strays);
                (f64::from(k) * FRAME_S, if stray { own.add_scalar(150.0) } else { own })
            })
            .collect();
        LabelNoise::of(&residuals, 0.0, FRAME_S)
    }

    #[test]
    fn what_was_known_counts_once_where_it_holds_and_little_where_it_does_not() {
        for count in [3, 6, 9] {
            assert_eq!(Tails::Known.weight(0.0, count), 1.0);
            assert_eq!(Tails::Known.weight(count as f64, count), 1.0);
            assert!(Tails::Known.weight(1e4, count) < 2e-3);
            // The loss is continuous, and its slope is the weight.
            let loss = |squares: f64| Tails::Known.loss(squares, count);
            for squares in [1.0, count as f64 - 1e-6, count as f64 + 1e-3, 50.0] {
                let slope = (loss(squares + 1e-4) - loss(squares)) / 1e-4;
                let weight = Tails::Known.weight(squares, count);
                assert!((slope - weight).abs() < 1e-3, "{count}, {squares}: {slope} and {weight}");
            }
        }
    }

    #[test]
    fn labels_of_something_else_are_no_noise() {
        for strays in [0.0, 0.1, 0.3] {
            let noise = found(strays);
            assert!((0.15..0.3).contains(&noise.white_px), "{strays}: {noise:?}");
            assert!((0.35..0.65).contains(&noise.lasting_px), "{strays}: {noise:?}");
            assert!((0.5..=2.0).contains(&noise.lasting_s), "{strays}: {noise:?}");
        }
    }
}
