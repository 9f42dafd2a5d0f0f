//! Registration of two pictures: the shift by which the camera has turned, as opposed to targets
//! that move.

use crossfix_correlation::Plane;

/// Step between the pixels of the smoothed picture that are used, in rows and columns: those
/// between say the same. With half of it they cost four times as much.
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
    fn add(&mut self, [gx, gy]: [f32; 2], off: f32) {
        // Cauchy's robust weight: 1 / (1 + (off / c)^2).
        let weight = 1.0 / (1.0 + (off / OUTLYING).powi(2));
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

/// Calls `take` for each pixel in common with its place, the slope of `then`, and the difference of
/// `now` from `then`, which is shifted by `shift` pixels.
fn each_off(
    now: &Plane,
    then: &Plane,
    shift: [f32; 2],
    mut take: impl FnMut([usize; 2], [f32; 2], f32),
) {
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

/// The normal equations of two pictures at a shift, pixels.
fn normal_at(now: &Plane, then: &Plane, shift: [f32; 2]) -> RegistrationEquations {
    let mut normal = RegistrationEquations::default();
    each_off(now, then, shift, |_, slope, off| normal.add(slope, off));
    normal
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
    /// The misfits of two pictures at a shift, pixels, if the newer one is brighter by `brighter`
    /// levels.
    fn at(now: &Plane, then: &Plane, shift: [f32; 2], brighter: f32) -> Self {
        let sides = [now.width(), now.height()];
        let mut tiles = [[TileMisfit::default(); TILES[0]]; TILES[1]];
        each_off(now, then, shift, |[x, y], _, off| {
            let off = off - brighter;
            let weight = 1.0 / (1.0 + (off / OUTLYING).powi(2));
            let tile = &mut tiles[y * TILES[1] / sides[1]][x * TILES[0] / sides[0]];
            tile.squares += weight * off * off;
            tile.weights += weight;
        });
        Self(tiles)
    }

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

/// Shift of a picture against an older one, px, iterated from a first guess (Lucas and Kanade
/// 1981). `None` where the shift explains no more than noise would, or than a target that moves: a
/// clear sky shows no turn.
pub(crate) fn registered(now: &Plane, then: &Plane, first: [f32; 2]) -> Option<[f32; 2]> {
    if (then.width(), then.height()) != (now.width(), now.height()) {
        return None;
    }
    let mut shift = first;
    let mut normal = normal_at(now, then, shift);
    let brighter = |normal: &RegistrationEquations| normal.off / normal.weight.max(1.0);
    // Mean difference of brightness at the first guess; the misfit there is computed without it.
    let before = brighter(&normal);
    for _ in 0..STEPS {
        let [x, y] = normal.step()?;
        shift = [shift[0] + x, shift[1] + y];
        normal = normal_at(now, then, shift);
        if x.abs() + y.abs() < SETTLED {
            break;
        }
    }
    let before = Misfits::at(now, then, first, before);
    let after = Misfits::at(now, then, shift, brighter(&normal));
    after.are_better_than(&before).then_some(shift)
}
