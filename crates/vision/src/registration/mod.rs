//! Registration of two pictures: by how much the camera has turned, as opposed to targets that
//! move.

mod cubic;
mod equations;
mod misfits;

use crossfix_correlation::Plane;
use pulp::{Arch, Simd, WithSimd};

use self::cubic::{CubicWeights, weighted};
use self::equations::RegistrationEquations;
pub(crate) use self::misfits::Bar;
use self::misfits::{Misfits, TILES, TileMisfit, TileSums};
use crate::noise::median;

/// Step between the pixels that are used, in rows and columns: of a smoothed picture those between
/// say the same. With half of it they cost four times as much.
pub(crate) const STRIDE: usize = 2;
/// Most iterations of the registration. With half of it a shift of more than three of the longest
/// steps is not reached.
const STEPS: usize = 6;
/// The same of fine pictures, which have four times as many pixels: they say the same as one in
/// four of them. With half of it a registration costs twice as much, and is no better.
const FINE_STRIDE: usize = 3;
/// They begin where the coarse ones have led. With half of it their last step is half a pixel.
const FINE_STEPS: usize = 3;
/// Length of a step that ends the registration, pixels: a twentieth of a pixel of the image. With
/// half of it one step more is computed.
const SETTLED: f32 = 0.01;
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
/// px of the image each. The best of all is believed up to one less, 64 px: at the end of the
/// search it may be better still beyond. With half of it no faster turn than 28 px from one image
/// to the next is found over waves, and 0.1 s of a slow one.
const FARTHEST: i32 = 9;
/// Farthest that a registration may lead from the best whole shift, pixels per axis: half a pixel,
/// and half of that. With half of it a shift half-way between two pixels stays at one of them.
const NEAR_WHOLE: f32 = 0.75;
/// Two fits that differ by less than this per axis are of the same shift, pixels: like parts that
/// are nearer to each other do not show in such a picture. With half of it the errors of a fit over
/// waves count as another shift, which then needs to fit better than itself.
const SAME_SHIFT: f32 = 0.75;
/// Fewest pixels in common (sum of their weights) from which a turn is found. With half of it they
/// may all be those of one target.
pub(crate) const LEAST_COMMON: f32 = 50.0;

/// Indices of a row that, moved by `by`, are in the row together with the next index.
fn overlap(side: usize, by: isize) -> std::ops::Range<usize> {
    let side = side as isize;
    let first = (-by).clamp(0, side);
    first as usize..(side - 1 - by).clamp(first, side) as usize
}

/// How one picture lies in another: what is at `r` from the middle of the newer one is at `r +
/// shift + zoom r + roll (-r_y, r_x)` from the middle of the older one, pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct PictureTurn {
    pub(crate) shift: [f32; 2],
    pub(crate) zoom: f32,
    pub(crate) roll: f32,
}

impl PictureTurn {
    fn of_shift(shift: [f32; 2]) -> Self {
        Self { shift, ..Self::default() }
    }
}

/// Two pictures to be registered.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PicturePair<'a> {
    now: &'a Plane,
    then: &'a Plane,
    /// One over the difference of brightness beyond which a pixel counts for less, levels.
    per_outlying: f32,
    /// Step between the pixels that are used, in rows and columns, and most iterations.
    stride: usize,
    steps: usize,
    /// By how much the newer one is brighter, levels, where that is known beforehand.
    brighter: f32,
}

impl<'a> PicturePair<'a> {
    /// A picture and an older one; `None` if their sides differ.
    pub(crate) fn new(now: &'a Plane, then: &'a Plane) -> Option<Self> {
        let fit = (then.width(), then.height()) == (now.width(), now.height());
        fit.then_some(Self {
            now,
            then,
            per_outlying: OUTLYING.recip(),
            stride: STRIDE,
            steps: STEPS,
            brighter: 0.0,
        })
    }

    /// The same where a coarser pair of the same images has shown where to begin.
    pub(crate) fn fine(self) -> Self {
        Self { stride: FINE_STRIDE, steps: FINE_STEPS, ..self }
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
        // A sky that is too bright stays as bright when the light changes: the half of the pixels
        // with the greater slopes shows by how much.
        let steepness = |[gx, gy]: [f32; 2]| gx * gx + gy * gy;
        pair.each_off(PictureTurn::default(), |_, slope, _| scratch.push(steepness(slope)));
        let steep = median(scratch);
        scratch.clear();
        pair.each_off(PictureTurn::default(), |_, slope, off| {
            if steepness(slope) >= steep {
                scratch.push(off);
            }
        });
        let brighter = median(scratch);
        scratch.iter_mut().for_each(|off| *off = (*off - brighter).abs());
        let outlying = (OUTLYING_MEDIANS * median(scratch)).clamp(LEAST_OUTLYING, OUTLYING);
        Some(Self { per_outlying: outlying.recip(), brighter, ..pair })
    }

    /// Cauchy's robust weight, 1 / (1 + (off / c)^2).
    #[inline(always)]
    fn weight(&self, off: f32) -> f32 {
        1.0 / (1.0 + (off * self.per_outlying).powi(2))
    }

    /// The middle of the pictures, pixels.
    fn middle(&self) -> [f32; 2] {
        [self.now.width(), self.now.height()].map(|side| (side as f32 - 1.0) / 2.0)
    }

    /// Half of the longer side, pixels: as far as roll and zoom move nothing by more than one.
    fn reach(&self) -> f32 {
        self.now.width().max(self.now.height()) as f32 / 2.0
    }

    /// Calls `take` for each pixel in common with its place, the slope of `then` where it was, and
    /// the difference of `now` from that.
    #[inline(always)]
    fn each_off(&self, at: PictureTurn, mut take: impl FnMut([usize; 2], [f32; 2], f32)) {
        let Self { now, then, .. } = self;
        let [middle_x, middle_y] = self.middle();
        let PictureTurn { shift, zoom, roll } = at;
        let last = [then.width(), then.height()].map(|side| side as f32 - 2.0);
        let (width, samples) = (then.width(), then.samples());
        for y in (0..now.height()).step_by(self.stride) {
            let line = now.row(y);
            let down = y as f32 - middle_y;
            let [row_x, row_y] = [shift[0] - roll * down, y as f32 + shift[1] + zoom * down];
            for x in (0..now.width()).step_by(self.stride) {
                let right = x as f32 - middle_x;
                let was_x = x as f32 + row_x + zoom * right;
                let was_y = row_y + roll * right;
                // Four pixels about it are needed on each axis.
                if !(was_x >= 1.0 && was_y >= 1.0 && was_x < last[0] && was_y < last[1]) {
                    continue;
                }
                let (column, row) = (was_x as usize, was_y as usize);
                let across = CubicWeights::at(was_x - column as f32);
                let along = CubicWeights::at(was_y - row as f32);
                let (mut values, mut slopes) = ([0.0; 4], [0.0; 4]);
                let first = (row - 1) * width + column - 1;
                for k in 0..4 {
                    let four = &samples[first + k * width..][..4];
                    for i in 0..4 {
                        values[i] += along.values[k] * four[i];
                        slopes[i] += along.slopes[k] * four[i];
                    }
                }
                let slope = [weighted(values, across.slopes), weighted(slopes, across.values)];
                // off = now(x) - then(where it was).
                take([x, y], slope, line[x] - weighted(values, across.values));
            }
        }
    }

    /// How the pictures fit at a turn.
    fn fit_at(&self, turn: PictureTurn) -> PictureFit {
        Arch::new().dispatch(FitPass { pair: self, turn })
    }

    /// The whole shift, pixels, at which the pictures fit best, of those searched for; `None` if
    /// that is at the end of the search: they may fit better still beyond.
    fn best_whole_shift(&self) -> Option<[f32; 2]> {
        let along = || (-FARTHEST..=FARTHEST).map(|by| by as f32);
        let shifts = along().flat_map(|down| along().map(move |right| [right, down]));
        let misfits = shifts.map(|shift| (self.misfit_at(shift), shift));
        let (_, best) = misfits.min_by(|(one, _), (other, _)| one.total_cmp(other))?;
        best.iter().all(|by| by.abs() < FARTHEST as f32).then_some(best)
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

    /// The turn to which the registration leads from a start (Lucas and Kanade 1981); `None` where
    /// the pictures do not determine it. Roll (rad) and zoom (a share) are those of `expected`, but
    /// for a standard deviation `sd`.
    pub(crate) fn fit_near(
        &self,
        start: PictureTurn,
        expected: PictureTurn,
        sd: f32,
    ) -> Option<PictureFit> {
        let reach = self.reach();
        let mut fit = self.fit_at(start);
        for _ in 0..self.steps {
            let mut turn = fit.turn;
            let off = [expected.zoom - turn.zoom, expected.roll - turn.roll].map(|off| off * reach);
            let step = fit.equations.step(off, sd * reach)?;
            turn.shift = [turn.shift[0] + step[0], turn.shift[1] + step[1]];
            turn.zoom += step[2] / reach;
            turn.roll += step[3] / reach;
            fit = self.fit_at(turn);
            if step.iter().map(|step| step.abs()).sum::<f32>() < SETTLED {
                break;
            }
        }
        Some(fit)
    }

    /// Whether a better fit than at a turn is to be expected near it: by the first step alone,
    /// which costs a fraction of all.
    pub(crate) fn may_be_better_near(&self, turn: PictureTurn, sd: f32, bar: Bar) -> bool {
        let equations = self.fit_at(turn).equations;
        equations.gain([0.0; 2], sd * self.reach()) > bar.significant
    }

    /// How much more a fit explains than another turn, in units of one pixel's mean misfit, if that
    /// is more than noise would, or a target that moves: a clear sky shows no turn.
    pub(crate) fn better_by(&self, fit: &PictureFit, than: PictureTurn, bar: Bar) -> Option<f32> {
        let of = |fit: &PictureFit| fit.misfits(fit.equations.brighter());
        of(fit).better_by(&of(&self.fit_at(than)), bar)
    }

    /// Whether the pictures fit better at a turn than at another, by so much that it shows.
    pub(crate) fn fits_better(&self, turn: PictureTurn, than: PictureTurn, bar: Bar) -> bool {
        self.better_by(&self.fit_at(turn), than, bar).is_some()
    }

    /// The shift since the image before, pixels, less than `FARTHEST` per axis. `None` where most
    /// of the image does not show it.
    ///
    /// A scene of many like parts fits as well where it has shifted by one of them, or better, if
    /// that is nearer to whole pixels: another shift than near `guess` must fit better than that.
    pub(crate) fn shift(&self, guess: [f32; 2]) -> Option<[f32; 2]> {
        let whole = self.best_whole_shift()?;
        let start = PictureTurn::of_shift(whole);
        let fit = self.fit_near(start, start, 0.0)?;
        // The best whole shift is the nearest one to the best of all; what leads farther away is
        // fixed to the image, as the edge of a sky that is too bright.
        let is_near =
            fit.turn.shift.iter().zip(whole).all(|(at, whole)| (at - whole).abs() < NEAR_WHOLE);
        let after = if is_near { fit } else { self.fit_at(start) };
        let shift = after.turn.shift;
        let guess = PictureTurn::of_shift(guess);
        let nearer = self.fit_near(guess, guess, 0.0);
        let is_other = |nearer: &PictureFit| {
            nearer.turn.shift.iter().zip(shift).any(|(at, shift)| (at - shift).abs() > SAME_SHIFT)
        };
        if let Some(nearer) = nearer.filter(is_other)
            && !after.misfits(0.0).are_better_in_most(&nearer.misfits(0.0))
        {
            return None;
        }
        // Compared with the opposite shift: between pixels noise alone fits better than on them,
        // and this one lies between them alike. Both about one change of brightness: about one of
        // its own, a sky that is too bright to show anything would fit better by rounding.
        let before = self.fit_at(PictureTurn::of_shift(shift.map(|by| -by)));
        let [after, before] = [after, before].map(|fit| fit.misfits(0.0));
        after.are_better_in_most(&before).then_some(shift)
    }
}

/// One pass over two pictures for how they fit at a turn.
struct FitPass<'a> {
    pair: &'a PicturePair<'a>,
    turn: PictureTurn,
}

impl WithSimd for FitPass<'_> {
    type Output = PictureFit;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> PictureFit {
        let Self { pair, turn } = self;
        let mut equations = RegistrationEquations::default();
        let mut tiles = [[TileSums::default(); TILES[0]]; TILES[1]];
        let ([middle_x, middle_y], per_reach) = (pair.middle(), pair.reach().recip());
        let sides = [pair.now.width(), pair.now.height()];
        let per_tile = [0, 1].map(|i| TILES[i] as f32 / sides[i] as f32);
        pair.each_off(turn, |[x, y], [gx, gy], off| {
            let (x, y) = (x as f32, y as f32);
            let [rx, ry] = [(x - middle_x) * per_reach, (y - middle_y) * per_reach];
            let off = off - pair.brighter;
            let weight = pair.weight(off);
            let slopes = [gx, gy, gx * rx + gy * ry, gy * rx - gx * ry];
            equations.add(weight, slopes, off);
            tiles[(y * per_tile[1]) as usize][(x * per_tile[0]) as usize].add(weight, off);
        });
        PictureFit { turn, equations, tiles }
    }
}

/// How two pictures fit at a turn.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PictureFit {
    pub(crate) turn: PictureTurn,
    equations: RegistrationEquations,
    tiles: [[TileSums; TILES[0]]; TILES[1]],
}

impl PictureFit {
    /// The misfits about a difference of brightness, levels.
    fn misfits(&self, brighter: f32) -> Misfits {
        Misfits(self.tiles.map(|row| row.map(|tile| tile.about(brighter))))
    }
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
        PicturePair::successive(now, then, &mut Vec::new()).unwrap().shift([0.0; 2])
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

    /// A fence: it fits better where it has shifted by one of its posts, as that is by whole
    /// pixels.
    #[test]
    fn a_scene_of_like_parts_has_not_shifted_by_one_of_them() {
        let fence = |right: f32, seed| {
            let post = |x: usize| 8.0 * (TAU * (x as f32 + right) / 6.5).sin();
            let tree = |x: usize| if x.abs_diff(60) < 4 { 3.0 } else { 0.0 };
            let ground = |y: usize| 12.0 * (y as f32 / 5.0).sin();
            noisy(Plane::from_fn(80, 60, |x, y| 100.0 + ground(y) + post(x) + tree(x)), 0.5, seed)
        };
        let (now, then) = (fence(0.5, 1), fence(0.0, 2));
        let pair = PicturePair::successive(&now, &then, &mut Vec::new()).unwrap();
        let by_a_post = pair.best_whole_shift().unwrap();
        assert_eq!(by_a_post, [-6.0, 0.0]);
        assert_eq!(pair.shift([0.5, 0.0]), None);
        // It may as well have shifted by one where that is expected.
        assert!(pair.shift(by_a_post).is_some());
    }

    #[test]
    fn roll_and_zoom_are_found_where_there_is_texture_and_the_shift_alone_where_they_stay() {
        let truth = PictureTurn { shift: [1.3, -0.7], zoom: 0.01, roll: 0.03 };
        let sides = [120, 90];
        let middle = sides.map(|side| (side as f32 - 1.0) / 2.0);
        let smooth = |x: f32, y: f32| 20.0 * ((x / 5.0).sin() * (y / 4.0).cos() + (0.1 * x).cos());
        let then = Plane::from_fn(sides[0], sides[1], |x, y| smooth(x as f32, y as f32));
        let now = Plane::from_fn(sides[0], sides[1], |x, y| {
            let [right, down] = [x as f32 - middle[0], y as f32 - middle[1]];
            let PictureTurn { shift, zoom, roll } = truth;
            smooth(
                x as f32 + shift[0] + zoom * right - roll * down,
                y as f32 + shift[1] + zoom * down + roll * right,
            )
        });
        let pair = PicturePair::new(&now, &then).unwrap();
        let fit = pair.fit_near(PictureTurn::default(), PictureTurn::default(), 0.1).unwrap();
        let PictureTurn { shift: [x, y], zoom, roll } = fit.turn;
        assert!((x - 1.3).hypot(y + 0.7) < 0.05, "{:?}", fit.turn);
        assert!((zoom - 0.01).abs() < 1e-3 && (roll - 0.03).abs() < 1e-3, "{:?}", fit.turn);
        assert!(pair.better_by(&fit, PictureTurn::default(), Bar::STILL).is_some());
        let unmoved = pair.fit_at(PictureTurn::default());
        assert!(pair.better_by(&unmoved, fit.turn, Bar::TURNING).is_none());
        let stiff = pair.fit_near(unmoved.turn, unmoved.turn, 0.0).unwrap().turn;
        assert!(stiff.zoom.abs() < 1e-3 && stiff.roll.abs() < 1e-3, "{stiff:?}");
    }

    #[test]
    fn no_change_of_light_hides_that_a_turn_may_be_found() {
        let (then, mut now) = (waves([80, 60], [0.0; 2]), waves([80, 60], [0.6, 0.2]));
        let may_be_better = |now: &Plane| {
            let pair = PicturePair::new(now, &then).unwrap();
            pair.may_be_better_near(PictureTurn::default(), 0.01, Bar::STILL)
        };
        assert!(may_be_better(&now) && !may_be_better(&then));
        now.samples_mut().iter_mut().for_each(|sample| *sample += 4.0);
        assert!(may_be_better(&now));
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
