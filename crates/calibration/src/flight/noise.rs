//! How labels err: most a little and alike for half a second, some by anything.

use nalgebra::Vector2;

use crate::label_noise::LabelNoise;

/// Degrees of freedom of the heavy tails: at four, a residual of ten deviations counts a fifth of
/// one, and clean labels lose a tenth of their weight.
const FREEDOM: f64 = 4.0;

/// How unlikely a large residual is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Tails {
    /// As a normal deviate's.
    Normal,
    /// As Student's t: what is measured may be of something else.
    Heavy,
    /// As a normal deviate's as far as usual ones go, and beyond as Student's t: what was known beforehand may
    /// not hold any more, but where it does it counts once. (At its middle Student's t of n numbers weighs
    /// them (freedom + n) / freedom times.)
    Known,
}

impl Tails {
    /// Degrees of freedom of Student's t; `None` is a normal deviate's.
    fn freedom(self) -> Option<f64> {
        match self {
            Self::Normal => None,
            Self::Heavy | Self::Known => Some(FREEDOM),
        }
    }

    /// Whether residuals count as a normal deviate's: the two join where their mean square is one.
    fn is_normal(self, squares: f64, count: usize) -> bool {
        self == Self::Known && squares <= count as f64
    }

    /// What residuals with this sum of squares count.
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
        let count = count as f64;
        let heavy = |freedom: f64| (freedom + count) * (squares / freedom).ln_1p();
        let joined = |freedom: f64| match self {
            Self::Known => count - (freedom + count) * (count / freedom).ln_1p(),
            _ => 0.0,
        };
        self.freedom().map_or(squares, |freedom| heavy(freedom) + joined(freedom))
    }
}

/// No label is nearer to its target's middle than this, pixels: the noise of a camera that alone
/// holds the track would be found to be nothing.
const LEAST_SD_PX: f64 = 0.1;
/// Errors that last longer than this are the lens's or the pose's, s.
const LONGEST_S: f64 = 2.0;
/// Labels over this time are averaged to see how long errors last, s.
const BLOCK_S: f64 = 1.0;
/// One label in so many may be of anything: as much of the largest is left out.
const ANYTHING: usize = 20;

/// How labels are whitened: a label's error is this share of the one's before, ...
#[derive(Clone, Copy, Debug)]
pub(super) struct Whitening {
    pub(super) kept: f64,
    /// ... and what is new has this deviation, pixels.
    pub(super) sd_px: f64,
}

impl LabelNoise {
    /// How a label is whitened after one so many seconds before, where frames are `frame_s` apart.
    ///
    /// The sum of a white part and a lasting one would need all labels before to be whitened. The
    /// last one alone, weighed by its correlation, leaves the difference of two labels what it is;
    /// its deviation is then made so much larger that the mean of many is not better known than it
    /// is. Between the two it errs towards caution.
    pub(super) fn after(&self, before_s: Option<f64>, frame_s: f64) -> Whitening {
        let variance = self.sd_px().powi(2);
        let kept = before_s.map_or(0.0, |before_s| self.correlation(before_s));
        let caution = self.caution(frame_s);
        Whitening { kept, sd_px: (variance * (1.0 - kept * kept) * caution).sqrt() }
    }

    /// By how much the variance is made larger so that the mean of many labels, each whitened by the
    /// one before, is not better known than it is.
    pub(super) fn caution(&self, frame_s: f64) -> f64 {
        let of_frame = self.correlation(frame_s);
        let averaged = self.sd_px().powi(2) * (1.0 + of_frame) / (1.0 - of_frame);
        (self.white_equivalent_px(frame_s).powi(2) / averaged).max(1.0)
    }

    /// As residuals show it, in order of time; `explained` is the variance (pixels^2, an axis) that
    /// the fitted way has taken from them.
    pub(super) fn of(residuals: &[(f64, Vector2<f64>)], explained: f64, frame_s: f64) -> Self {
        let residuals = &without_strays(residuals);
        let variance = typical(residuals.iter().map(|(_, residual)| *residual)) + explained;
        let variance = variance.max(LEAST_SD_PX.powi(2));
        let steps = residuals.windows(2).filter(|pair| pair[1].0 - pair[0].0 < 1.5 * frame_s);
        let of_steps = typical(steps.map(|pair| pair[1].1 - pair[0].1)) / 2.0;
        let of_means = typical(block_means(residuals).into_iter()) + explained;
        // Of all that could be, the time after which blocks' means vary as they do.
        let lasting = |lasting_s: f64| {
            let kept = (-frame_s / lasting_s).exp();
            ((variance - of_steps).max(0.0) / kept).min(variance)
        };
        let means = |lasting_s: f64| {
            let lasting = lasting(lasting_s);
            lasting * share_of_means(lasting_s) + (variance - lasting) * frame_s / BLOCK_S
        };
        let (mut least, mut most) = (frame_s, LONGEST_S.max(2.0 * frame_s));
        for _ in 0..40 {
            let middle = f64::midpoint(least, most);
            if means(middle) < of_means { least = middle } else { most = middle }
        }
        let lasting = lasting(least);
        Self {
            white_px: (variance - lasting).max(0.0).sqrt().max(LEAST_WHITE_PX),
            lasting_px: lasting.sqrt(),
            lasting_s: least,
        }
    }
}

/// Labels are not drawn finer than this, pixels.
const LEAST_WHITE_PX: f64 = 0.03;

/// The variance of an axis without the largest vectors, for the share that normal deviates have in
/// those. The median would not do: labels are drawn to half a pixel, and most that lie beside one
/// another differ by next to nothing.
fn typical(vectors: impl Iterator<Item = Vector2<f64>>) -> f64 {
    let mut squares: Vec<f64> = vectors.map(|vector| vector.norm_squared()).collect();
    squares.sort_unstable_by(f64::total_cmp);
    let (count, cut) = (squares.len(), squares.len() / ANYTHING);
    if count == 0 {
        return 0.0;
    }
    // Half of the square is an exponential deviate: above its quantile of 1 - s lie s (1 - ln s) of
    // its mean.
    let share = cut as f64 / count as f64;
    let left = if cut == 0 { 1.0 } else { 1.0 - share * (1.0 - share.ln()) };
    let sum: f64 = squares[..count - cut].iter().sum();
    sum / (2.0 * count as f64 * left)
}

/// Labels of something else, birds beside the drone: farther off than so many times the median. Of
/// normal deviates none in 10^14 is; with half as many a hand's slips are left out.
const STRAY: f64 = 7.0;

/// The residuals without those of other things: as many as nearly half of them may be.
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
    let mean = |chunk: &[(f64, Vector2<f64>)]| {
        chunk.iter().map(|(_, residual)| residual).sum::<Vector2<f64>>() / chunk.len() as f64
    };
    residuals.chunk_by(same).filter(spans).map(mean).collect()
}

/// What of the variance of an error that lasts T is left in the mean over a block of length L: the
/// mean of `exp(-t / T)` over the block's pairs, `2 T/L (1 - T/L (1 - exp(-L/T)))`.
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

    /// Half a minute of labels, a share of them of something else.
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
