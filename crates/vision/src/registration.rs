//! Registration of two pictures: the shift by which the camera has turned, as opposed to targets
//! that move.

use crossfix_correlation::Plane;
use pulp::Arch;

use crate::noise::median;

/// Step between the pixels that are used, in rows and columns: of a smoothed picture those between
/// say the same. With half of it they cost four times as much.
pub(crate) const STRIDE: usize = 2;
/// Most iterations of the registration. With half of it a shift of more than three of the longest
/// steps is not reached.
const STEPS: usize = 6;
/// Length of a step that ends the registration, pixels: its error is then far below what the change
/// between pictures needs. With half of it one step more is computed.
const SETTLED: f32 = 0.003;
/// Longest step, pixels: a longer one is a mistake, and is cut to this. With half of it shifts of
/// more than `STEPS` pixels are not reached.
const LONGEST_STEP: f32 = 2.0;
/// Difference of brightness beyond which a pixel counts for less, levels: a target that moves is no
/// turn. With half of it the edges that show a large turn count for less, and it is not reached.
const OUTLYING: f32 = 5.0;
/// The same for two images that follow each other, in units of the median difference without a
/// shift, and at most `OUTLYING`: what is written over the picture stays in its place, and its
/// edges must not outweigh a faint scene. With half of it most of a scene that turns counts for
/// less.
const OUTLYING_MEDIANS: f32 = 2.0;
/// It is at least this, levels: where more than half of the image is without noise, as a sky that
/// is too bright, the median is 0. With half of it the noise of blocks counts as outlying.
const LEAST_OUTLYING: f32 = 0.5;
/// Differences that are summed side by side, for vector instructions. With half of it the sums wait
/// for each other, and a search costs more.
const LANES: usize = 16;
/// Farthest shift of the next image that is searched for, pixels of a coarse picture per axis, of 8
/// px of the image each: 64 px. With half of it no faster turn than 32 px from one image to the
/// next is found over waves, and 0.1 s of a slow one.
const FARTHEST: i32 = 8;
/// Least reduction of the misfit by a turn, in units of one pixel's mean misfit. Two smoothed
/// pictures of noise alone fit better by up to 60 at some shift nearby, as only one pixel in
/// eighteen is independent; with half of it a clear sky turns by chance, with twice as much a turn
/// is found a frame later.
const SIGNIFICANT: f32 = 120.0;
/// Fewest pixels in common (sum of their weights) from which a turn is found. With half of it they
/// may all be those of one target.
pub(crate) const LEAST_COMMON: f32 = 50.0;

/// Indices of a row that, moved by `by`, are in the row together with the next index.
pub(crate) fn overlap(side: usize, by: isize) -> std::ops::Range<usize> {
    let side = side as isize;
    let first = (-by).clamp(0, side);
    first as usize..(side - 1 - by).clamp(first, side) as usize
}

/// Normal equations of one step of the registration, with the change of brightness taken out.
#[derive(Clone, Copy, Debug, Default)]
struct RegistrationEquations {
    weight: f32,
    slope: [f32; 2],
    off: f32,
    slope_slope: [f32; 3],
    slope_off: [f32; 2],
}

impl RegistrationEquations {
    /// Mean difference of brightness, levels; 0 where nothing is in common.
    fn brighter(&self) -> f32 {
        self.off / self.weight.max(1.0)
    }

    fn add(&mut self, weight: f32, [gx, gy]: [f32; 2], off: f32) {
        self.weight += weight;
        self.slope[0] += weight * gx;
        self.slope[1] += weight * gy;
        self.off += weight * off;
        self.slope_slope[0] += weight * gx * gx;
        self.slope_slope[1] += weight * gx * gy;
        self.slope_slope[2] += weight * gy * gy;
        self.slope_off[0] += weight * gx * off;
        self.slope_off[1] += weight * gy * off;
    }

    /// The step that solves the equations, pixels; `None` where they do not determine it.
    fn step(self) -> Option<[f32; 2]> {
        let Self { weight: n, slope: [sx, sy], off, .. } = self;
        if n < LEAST_COMMON {
            return None;
        }
        let [xx, xy, yy] = self.slope_slope;
        // About the means, so that a change of light is not taken for a shift ...
        let [xx, xy, yy] = [xx - sx * sx / n, xy - sx * sy / n, yy - sy * sy / n];
        let [x, y] = [self.slope_off[0] - sx * off / n, self.slope_off[1] - sy * off / n];
        // ... and solved by Cramer's rule: (slope slope') step = slope off.
        let determinant = xx * yy - xy * xy;
        // A single straight edge shows no shift along itself: the determinant vanishes against the
        // squared trace.
        let is_known = determinant > 1e-6 * (xx + yy).powi(2) && determinant > 0.0;
        let step = [(yy * x - xy * y) / determinant, (xx * y - xy * x) / determinant];
        is_known.then(|| step.map(|s| s.clamp(-LONGEST_STEP, LONGEST_STEP)))
    }
}

/// Two pictures to be registered.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PicturePair<'a> {
    now: &'a Plane,
    then: &'a Plane,
    /// Difference of brightness beyond which a pixel counts for less, levels.
    outlying: f32,
    /// By how much the newer one is brighter, levels, where that is known beforehand.
    brighter: f32,
}

impl<'a> PicturePair<'a> {
    /// A picture and an older one; `None` if their sides differ.
    pub(crate) fn new(now: &'a Plane, then: &'a Plane) -> Option<Self> {
        let fit = (then.width(), then.height()) == (now.width(), now.height());
        fit.then_some(Self { now, then, outlying: OUTLYING, brighter: 0.0 })
    }

    /// A picture and the one before; `None` if their sides differ. `scratch` is memory for the
    /// differences.
    pub(crate) fn successive(
        now: &'a Plane,
        then: &'a Plane,
        scratch: &mut Vec<f32>,
    ) -> Option<Self> {
        let pair = Self::new(now, then)?;
        scratch.clear();
        pair.each_off([0.0; 2], |_, _, off| scratch.push(off));
        let brighter = median(scratch);
        scratch.iter_mut().for_each(|off| *off = (*off - brighter).abs());
        let outlying = (OUTLYING_MEDIANS * median(scratch)).clamp(LEAST_OUTLYING, OUTLYING);
        Some(Self { outlying, brighter, ..pair })
    }

    /// Cauchy's robust weight, 1 / (1 + (off / c)^2).
    #[inline(always)]
    fn weight(&self, off: f32) -> f32 {
        1.0 / (1.0 + (off / self.outlying).powi(2))
    }

    /// Calls `take` for each pixel in common with its place, the slope of `then`, and the
    /// difference of `now` from `then`, which is shifted by `shift` pixels.
    fn each_off(&self, shift: [f32; 2], mut take: impl FnMut([usize; 2], [f32; 2], f32)) {
        let Self { now, then, .. } = self;
        let (width, height) = (now.width(), now.height());
        let whole = shift.map(f32::floor);
        let [right, down] = [shift[0] - whole[0], shift[1] - whole[1]];
        let [left, top] = whole.map(|s| s as isize);
        for y in overlap(height, top).step_by(STRIDE) {
            let line = now.row(y);
            let [above, below] = [0, 1].map(|k| then.row((y as isize + top) as usize + k));
            for x in overlap(width, left).step_by(STRIDE) {
                let i = (x as isize + left) as usize;
                let [a, b, c, d] = [above[i], above[i + 1], below[i], below[i + 1]];
                // Linear interpolation between four pixels, and its derivatives.
                let [upper, lower] = [a + right * (b - a), c + right * (d - c)];
                let slope = [(b - a) + down * ((d - c) - (b - a)), lower - upper];
                // off = now(x) - then(x + shift).
                take([x, y], slope, line[x] - upper - down * (lower - upper));
            }
        }
    }

    /// The normal equations at a shift, pixels.
    fn equations_at(&self, shift: [f32; 2]) -> RegistrationEquations {
        let mut equations = RegistrationEquations::default();
        self.each_off(shift, |_, slope, off| {
            equations.add(self.weight(off - self.brighter), slope, off);
        });
        equations
    }

    /// The misfits at a shift, pixels, about a difference of brightness, levels.
    fn misfits(&self, shift: [f32; 2], brighter: f32) -> Misfits {
        let sides = [self.now.width(), self.now.height()];
        let mut tiles = [[TileMisfit::default(); TILES[0]]; TILES[1]];
        self.each_off(shift, |[x, y], _, off| {
            let off = off - brighter;
            let weight = self.weight(off);
            let tile = &mut tiles[y * TILES[1] / sides[1]][x * TILES[0] / sides[0]];
            tile.squares += weight * off * off;
            tile.weights += weight;
        });
        Misfits(tiles)
    }

    /// The whole shift, pixels, at which the pictures fit best, of those searched for.
    fn best_whole_shift(&self) -> [f32; 2] {
        let along = || (-FARTHEST..=FARTHEST).map(|by| by as f32);
        let shifts = along().flat_map(|down| along().map(move |right| [right, down]));
        let misfits = shifts.map(|shift| (self.misfit_at(shift), shift));
        let best = misfits.min_by(|(one, _), (other, _)| one.total_cmp(other));
        best.map_or([0.0; 2], |(_, shift)| shift)
    }

    /// Weighted mean of the squared differences at a whole shift, pixels; infinite if too few
    /// pixels are in common.
    fn misfit_at(&self, shift: [f32; 2]) -> f32 {
        let Self { now, then, .. } = self;
        let [left, top] = shift.map(|s| s as isize);
        let [columns, rows] = [overlap(now.width(), left), overlap(now.height(), top)];
        if columns.is_empty() || rows.is_empty() {
            return f32::INFINITY;
        }
        let first = columns.start.wrapping_add_signed(left);
        let (mut squares, mut weights) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        // All columns, not every second one: many are computed at a time.
        Arch::new().dispatch(|| {
            for y in rows.step_by(STRIDE) {
                let line = &now.row(y)[columns.clone()];
                let older = &then.row(y.wrapping_add_signed(top))[first..first + line.len()];
                for (now, then) in line.chunks(LANES).zip(older.chunks(LANES)) {
                    let sums = squares.iter_mut().zip(&mut weights);
                    for ((squares, weights), (now, then)) in sums.zip(now.iter().zip(then)) {
                        let off = now - then - self.brighter;
                        let weight = self.weight(off);
                        *squares += weight * off * off;
                        *weights += weight;
                    }
                }
            }
        });
        let all = TileMisfit { squares: squares.iter().sum(), weights: weights.iter().sum() };
        if all.weights < LEAST_COMMON { f32::INFINITY } else { all.mean() }
    }

    /// The shift against the older picture, pixels, from a first guess. `None` where it explains no
    /// more than noise would, or than a target that moves: a clear sky shows no turn.
    pub(crate) fn shift_near(&self, first: [f32; 2]) -> Option<[f32; 2]> {
        let at_first = self.equations_at(first);
        let (shift, at_last) = self.iterated(first, at_first)?;
        let after = self.misfits(shift, at_last.brighter());
        after.are_better_than(&self.misfits(first, at_first.brighter())).then_some(shift)
    }

    /// The shift since the image before, pixels, up to `FARTHEST` per axis. `None` where most of
    /// the image does not show it.
    pub(crate) fn turn(&self) -> Option<[f32; 2]> {
        let start = self.best_whole_shift();
        let (shift, _) = self.iterated(start, self.equations_at(start))?;
        // Compared with the opposite shift: between pixels noise alone fits better than on them,
        // and this one lies between them alike. Both about one change of brightness: about one of
        // its own, a sky that is too bright to show anything would fit better by rounding.
        let [after, before] =
            [1.0, -1.0].map(|sign| self.misfits(shift.map(|by| sign * by), self.brighter));
        after.are_better_in_most(&before).then_some(shift)
    }

    /// The shift to which the registration leads from a start and the equations there (Lucas and
    /// Kanade 1981), with the equations there; `None` where the pictures do not determine it.
    fn iterated(
        &self,
        start: [f32; 2],
        mut equations: RegistrationEquations,
    ) -> Option<([f32; 2], RegistrationEquations)> {
        let mut shift = start;
        for _ in 0..STEPS {
            let [x, y] = equations.step()?;
            shift = [shift[0] + x, shift[1] + y];
            equations = self.equations_at(shift);
            if x.abs() + y.abs() < SETTLED {
                break;
            }
        }
        Some((shift, equations))
    }
}

/// Columns and rows of the tiles into which a picture is divided, to distinguish a turn from a
/// target that moves. With half of each two targets with what is `AROUND` them cover nearly all
/// tiles.
const TILES: [usize; 2] = [12, 9];
/// Reach of a target about the tile whose misfit a turn would lessen most, tiles: 50 px of a
/// picture of 320x240, and what smoothing makes of them. With half of it the far edges of such a
/// target count as a turn.
const AROUND: usize = 2;

/// Least share of the whole gain that a turn must bring away from the tiles that gain most: the
/// edges of a large target's smoothed picture reach a twentieth that far. With half of it those
/// alone are enough.
const ELSEWHERE: f32 = 0.1;

/// Share of the tiles that must fit better, where a shift was searched for. Where many targets
/// cross a clear sky it is up to 0.71, as half of the empty tiles fit better by chance; over waves
/// in a half of the image it is 0.7 to 1. With half of it chance is a turn.
const MOST_TILES: f32 = 0.72;
/// By how many standard deviations more tiles must fit better than worse: of some hundred shifts
/// the best lies three above what chance makes of one. With half of it a clear sky turns by chance
/// where few tiles stay in view.
const MOST_TILES_SDS: f32 = 4.0;
/// Fewest tiles in view that may show a shift: a third of all. With half of it as many must agree
/// as one large target covers.
const LEAST_TILES: f32 = 36.0;

/// How badly two pictures fit in one tile, or in several together.
#[derive(Clone, Copy, Debug, Default)]
struct TileMisfit {
    /// Weighted sum of the squared differences.
    squares: f32,
    /// Sum of the weights.
    weights: f32,
}

impl TileMisfit {
    /// Reduction of the mean square from `before`, times the present sum of weights.
    fn gain(self, before: Self) -> f32 {
        // Means are compared, as the two shifts have different numbers of pixels in common.
        (before.mean() - self.mean()) * self.weights
    }

    fn mean(self) -> f32 {
        self.squares / self.weights.max(f32::MIN_POSITIVE)
    }
}

/// The misfit in each tile.
#[derive(Clone, Copy, Debug)]
struct Misfits([[TileMisfit; TILES[0]]; TILES[1]]);

impl Misfits {
    /// Whether these misfits are less than `before` by more than noise makes them, and also away
    /// from the two tiles that have gained most: a target may be in one of these, and have been in
    /// the other.
    fn are_better_than(&self, before: &Self) -> bool {
        let whole = self.gain(before, &[]);
        let all = self.sum(&[]);
        let of_pixel = all.squares / all.weights.max(LEAST_COMMON);
        if whole <= SIGNIFICANT * of_pixel {
            return false;
        }
        let first = self.most_gained(before, &[]);
        let second = self.most_gained(before, &[first]);
        self.gain(before, &[first, second]) > ELSEWHERE * whole
    }

    /// Whether these misfits are less than `before` in so many more tiles than they are larger in
    /// that chance does not make it: a scene fills most of the image, and targets do not, however
    /// many. Tiles that one of the two shifts moves out of view say nothing.
    fn are_better_in_most(&self, before: &Self) -> bool {
        let (mut better, mut worse) = (0.0_f32, 0.0_f32);
        for [x, y] in tiles() {
            let (now, before) = (self.0[y][x], before.0[y][x]);
            if now.weights > 0.0 && before.weights > 0.0 {
                better += f32::from(now.mean() < before.mean());
                worse += f32::from(now.mean() > before.mean());
            }
        }
        // By chance the difference of n votes has the variance n.
        let votes = better + worse;
        votes >= LEAST_TILES
            && better > MOST_TILES * votes
            && better - worse > MOST_TILES_SDS * votes.sqrt()
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

#[cfg(test)]
mod tests {
    use std::f32::consts::TAU;

    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, Normal};

    use super::*;

    /// Waves of three to eight pixels, seen by a camera that has turned by so many pixels.
    fn waves([width, height]: [usize; 2], [right, down]: [f32; 2]) -> Plane {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let waves: [[f32; 3]; 16] = std::array::from_fn(|_| {
            let [number, way]: [f32; 2] = [rng.random_range(0.8..2.0), rng.random_range(0.0..TAU)];
            [number * way.cos(), number * way.sin(), rng.random_range(0.0..TAU)]
        });
        Plane::from_fn(width, height, |x, y| {
            let wave = |[along, up, phase]: &[f32; 3]| {
                (along * (x as f32 + right) + up * (y as f32 + down) + phase).sin()
            };
            120.0 + waves.iter().map(wave).sum::<f32>()
        })
    }

    /// Adds a sensor's noise.
    fn noisy(mut plane: Plane, sd: f32, seed: u64) -> Plane {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let noise = Normal::new(0.0, sd).unwrap();
        plane.samples_mut().iter_mut().for_each(|sample| *sample += noise.sample(&mut rng));
        plane
    }

    fn turn(now: &Plane, then: &Plane) -> Option<[f32; 2]> {
        PicturePair::successive(now, then, &mut Vec::new()).unwrap().turn()
    }

    #[test]
    fn a_turn_is_found_wherever_it_goes() {
        let ways = [[6.0, 0.0], [-6.4, 0.3], [0.2, 5.0], [0.0, -5.5], [4.3, -4.2], [8.0, 0.0]];
        for sides in [[80, 60], [40, 30]] {
            for way in ways {
                let (then, now) = (waves(sides, [0.0; 2]), waves(sides, way));
                let found = turn(&noisy(now, 0.3, 2), &noisy(then, 0.3, 3));
                let off = found.map(|found| (found[0] - way[0]).hypot(found[1] - way[1]));
                assert!(off.is_some_and(|off| off < 0.2), "{sides:?}, {way:?}: {found:?}");
            }
        }
    }

    #[test]
    fn neither_light_nor_a_sky_that_is_too_bright_hides_a_turn() {
        // Where more than half of the rows are sky the median difference is 0.
        let sides = [80, 60];
        let changed = |way, brighter: f32, sky: usize| {
            let mut plane = noisy(waves(sides, way), 0.3, 4);
            plane.samples_mut().iter_mut().for_each(|sample| *sample += brighter);
            (0..sky).for_each(|y| plane.row_mut(y).fill(255.0));
            plane
        };
        for (brighter, sky) in [(10.0, 0), (-40.0, 0), (0.0, 31), (-10.0, 24)] {
            let (now, then) = (changed([5.0, 1.0], brighter, sky), changed([0.0; 2], 0.0, sky));
            let found = turn(&now, &then).unwrap();
            let off = (found[0] - 5.0).hypot(found[1] - 1.0);
            assert!(off < 0.3, "{brighter} levels, {sky} rows: {found:?}");
        }
    }

    #[test]
    fn neither_noise_nor_targets_however_many_are_a_turn() {
        let spots = |by: f32, seed| {
            let plane = Plane::from_fn(80, 60, |x, y| {
                let is_spot = (x as f32 - by).rem_euclid(20.0) < 2.0 && y % 15 < 2;
                if is_spot { 160.0 } else { 120.0 }
            });
            noisy(plane, 0.5, seed)
        };
        for seed in 0..100 {
            let sky = |seed| noisy(Plane::from_fn(80, 60, |_, _| 120.0), 2.0, seed);
            assert_eq!(turn(&sky(seed), &sky(seed + 1000)), None, "noise, seed {seed}");
            let by = (seed % 6) as f32;
            assert_eq!(turn(&spots(by, seed), &spots(0.0, seed + 1000)), None, "by {by}, {seed}");
        }
    }
}
