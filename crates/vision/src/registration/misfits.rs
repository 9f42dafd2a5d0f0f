//! How badly two pictures fit, tile by tile, and whether that shows a turn.

use super::LEAST_COMMON;

/// Weighted sums over the pixels of a tile.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct TileSums {
    weights: f32,
    offs: f32,
    squares: f32,
}

impl TileSums {
    #[inline(always)]
    pub(super) fn add(&mut self, weight: f32, off: f32) {
        self.weights += weight;
        self.offs += weight * off;
        self.squares += weight * off * off;
    }

    pub(super) fn about(self, brighter: f32) -> TileMisfit {
        let Self { weights, offs, squares } = self;
        let squares = squares - 2.0 * brighter * offs + brighter.powi(2) * weights;
        TileMisfit { squares: squares.max(0.0), weights }
    }
}

/// What a turn must show to be believed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bar {
    /// Least reduction of the misfit, in units of one pixel's mean misfit.
    pub(crate) significant: f32,
    /// Least share of it away from the tiles that gain most.
    elsewhere: f32,
}

impl Bar {
    /// Where the camera stood still: two smoothed pictures of noise alone fit better by up to 60
    /// (the first) at some turn nearby, as only one pixel in eighteen is independent; with half of
    /// it a clear sky turns by chance. The edges of a large target's smoothed picture reach a
    /// twentieth (of the second) away from it; with half of it those alone are enough.
    pub(crate) const STILL: Self = Self { significant: 120.0, elsewhere: 0.1 };
    /// Where it turned a moment ago, and is more likely to turn on than not: what is better is
    /// believed. With the bar of one that stood still a real picture that turns by 3.8 px from
    /// image to image is off by 2 px in each, as its edges, in a part of it, bring most of the
    /// gain; with half of the first of these the same as with it.
    pub(crate) const TURNING: Self = Self { significant: 30.0, elsewhere: 0.0 };
}

/// Columns and rows of the tiles into which a picture is divided, to distinguish a turn from a
/// target that moves. With half of each two targets with what is `AROUND` them cover nearly all
/// tiles.
pub(super) const TILES: [usize; 2] = [12, 9];
/// Reach of a target about the tile whose misfit a turn would lessen most, tiles: 50 px of a
/// picture of 320x240, and what smoothing makes of them. With half of it the far edges of such a
/// target count as a turn.
const AROUND: usize = 2;

/// Share of the tiles that must fit better, where a shift was searched for. Where many targets
/// cross a clear sky it is up to 0.71, as half of the empty tiles fit better by chance; over waves
/// in a half of the image it is 0.7 to 1. With half of it chance is a turn.
const MOST_TILES: f32 = 0.72;
/// By how many standard deviations more tiles must fit better than worse: of some hundred shifts
/// the best lies three above what chance makes of one. With half of it a clear sky turns by chance
/// where few tiles stay in view.
const MOST_TILES_SDS: f32 = 4.0;
/// Least reduction of the misfit by such a shift, in units of one pixel's mean misfit: the best of
/// all those searched for brings up to 150 in noise and 200 where targets cross a clear sky, and
/// over waves 1500. With half of it either may be a turn.
const LEAST_GAIN: f32 = 240.0;
/// Differences of mean squares by less than this are of rounding, as in a sky that is too bright,
/// levels^2. With half of it the same.
const ROUNDING: f32 = 1e-4;
/// Fewest tiles in view that may show a shift: a third of all. With half of it as many must agree
/// as one large target covers.
const LEAST_TILES: f32 = 36.0;

/// How badly two pictures fit in one tile, or in several together.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct TileMisfit {
    /// Weighted sum of the squared differences.
    pub(super) squares: f32,
    /// Sum of the weights.
    pub(super) weights: f32,
}

impl TileMisfit {
    /// Reduction of the mean square from `before`, times the present sum of weights.
    fn gain(self, before: Self) -> f32 {
        // Means are compared, as the two shifts have different numbers of pixels in common.
        (before.mean() - self.mean()) * self.weights
    }

    pub(super) fn mean(self) -> f32 {
        self.squares / self.weights.max(f32::MIN_POSITIVE)
    }
}

/// The misfit in each tile.
#[derive(Clone, Copy, Debug)]
pub(super) struct Misfits(pub(super) [[TileMisfit; TILES[0]]; TILES[1]]);

impl Misfits {
    /// By how much these misfits are less than `before`, in units of one pixel's mean misfit, if
    /// that is more than noise makes it, and also away from the two tiles that have gained most: a
    /// target may be in one of these, and have been in the other.
    pub(super) fn better_by(&self, before: &Self, bar: Bar) -> Option<f32> {
        let whole = self.gain(before, &[]);
        let gain = whole / self.of_pixel().max(f32::MIN_POSITIVE);
        if gain <= bar.significant {
            return None;
        }
        let first = self.most_gained(before, &[]);
        let second = self.most_gained(before, &[first]);
        (self.gain(before, &[first, second]) > bar.elsewhere * whole).then_some(gain)
    }

    /// Whether these misfits are less than `before` in so many more tiles than they are larger in
    /// that chance does not make it: a scene fills most of the image, and targets do not, however
    /// many. Tiles that one of the two shifts moves out of view say nothing.
    pub(super) fn are_better_in_most(&self, before: &Self) -> bool {
        let (mut better, mut worse) = (0.0_f32, 0.0_f32);
        for (now, before) in self.in_view_of_both(before) {
            let gain = before.mean() - now.mean();
            better += f32::from(gain > ROUNDING);
            worse += f32::from(gain < -ROUNDING);
        }
        // By chance the difference of n votes has the variance n.
        let votes = better + worse;
        votes >= LEAST_TILES
            && self.gain(before, &[]) > LEAST_GAIN * self.of_pixel()
            && better > MOST_TILES * votes
            && better - worse > MOST_TILES_SDS * votes.sqrt()
    }

    /// Each tile's misfit and that `before`, of those that neither moves out of view.
    fn in_view_of_both(&self, before: &Self) -> impl Iterator<Item = (TileMisfit, TileMisfit)> {
        let both = tiles().map(|[x, y]| (self.0[y][x], before.0[y][x]));
        both.filter(|(now, before)| now.weights > 0.0 && before.weights > 0.0)
    }

    /// One pixel's mean misfit.
    fn of_pixel(&self) -> f32 {
        let all = self.sum(&[]);
        all.squares / all.weights.max(LEAST_COMMON)
    }

    /// The misfit of all tiles together that are not near `others`.
    fn sum(&self, others: &[[usize; 2]]) -> TileMisfit {
        let mut sum = TileMisfit::default();
        for [x, y] in tiles_apart_from(others) {
            sum.squares += self.0[y][x].squares;
            sum.weights += self.0[y][x].weights;
        }
        sum
    }

    /// Reduction of the squares from `before`, over the tiles that are not near `others`.
    fn gain(&self, before: &Self, others: &[[usize; 2]]) -> f32 {
        self.sum(others).gain(before.sum(others))
    }

    /// The tile with the largest reduction, of those that are not near `others`.
    fn most_gained(&self, before: &Self, others: &[[usize; 2]]) -> [usize; 2] {
        let gain = |[x, y]: [usize; 2]| self.0[y][x].gain(before.0[y][x]);
        tiles_apart_from(others)
            .max_by(|one, other| gain(*one).total_cmp(&gain(*other)))
            .unwrap_or_default()
    }
}

/// All tiles, by column and row.
fn tiles() -> impl Iterator<Item = [usize; 2]> {
    (0..TILES[1]).flat_map(|y| (0..TILES[0]).map(move |x| [x, y]))
}

/// The tiles that are not near any of `others`.
fn tiles_apart_from(others: &[[usize; 2]]) -> impl Iterator<Item = [usize; 2]> {
    tiles().filter(|tile| !others.iter().any(|other| is_about(*tile, *other)))
}

fn is_about([x, y]: [usize; 2], [column, row]: [usize; 2]) -> bool {
    x.abs_diff(column) <= AROUND && y.abs_diff(row) <= AROUND
}
