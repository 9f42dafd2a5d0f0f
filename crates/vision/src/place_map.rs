//! Where a lost target may be: one probability of every part (cell) of the image, carried through
//! all the images of a search (track before detect by a Bayesian filter on a grid).
//!
//! A small target in noise stands out of no single image, and the likeliest of a hundred thousand
//! cells is another one. But it is in the next image too, about where it was, and chance is not.

use std::ops::Range;

use crossfix_correlation::Plane;
use pulp::Arch;

use crate::lanes;

/// Mean time for which a target that is lost cannot be seen, s. With half or twice of it the same
/// is found.
const UNSEEN_S: f64 = 1.0;
/// Mean time for which a lost target can then be seen, s. With half or twice of it the same is
/// found.
const IN_SIGHT_S: f64 = 2.0;
/// Most that one image says for a cell, nats: what looks like the target by its noise has a
/// likelihood that no model of noise foresees, but it is elsewhere in the next image. With 4 a
/// tenth more of small targets in noise is lost, with 10 as many. With half of it one place is sure
/// an image or two later.
const MOST_OF_IMAGE: f32 = 6.0;

/// The distribution over the cells of a picture's grid.
#[derive(Clone, Debug)]
pub(crate) struct PlaceMap {
    /// Side of a cell, px.
    coarseness: usize,
    /// Probability of each cell.
    cells: Plane,
    /// Probability that the target cannot be seen anywhere.
    nowhere: f32,
    /// What the scene has moved by since the last image and no whole cell makes up, px.
    left_over: [f64; 2],
}

/// Memory for [`PlaceMap::predict`], which all targets share.
#[derive(Debug, Default)]
pub(crate) struct SpreadBuffers {
    cells: Plane,
    /// Sums down the columns, of all rows above.
    columns: Vec<f64>,
    /// Sums along a row, of all columns before.
    row: Vec<f64>,
}

/// The likeliest cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LikeliestCell {
    pub(crate) column: usize,
    pub(crate) row: usize,
    /// Probability that the target is there or next to it.
    pub(crate) probability: f32,
}

impl PlaceMap {
    /// A map of cells of `coarseness` px on which nothing is known yet but a `prior`, up to a
    /// factor, of each cell: whether the target can be seen is as likely as not.
    pub(crate) fn new(
        coarseness: usize,
        [width, height]: [usize; 2],
        prior: impl FnMut(usize, usize) -> f32,
    ) -> Self {
        let mut cells = Plane::from_fn(width, height, prior);
        let share = (0.5 / sum(&cells).max(f64::MIN_POSITIVE)) as f32;
        cells.samples_mut().iter_mut().for_each(|cell| *cell *= share);
        Self { coarseness, cells, nowhere: 0.5, left_over: [0.0; 2] }
    }

    /// Whether it is one of pictures of these sides and coarseness.
    pub(crate) fn fits(&self, coarseness: usize, sides: [usize; 2]) -> bool {
        self.coarseness == coarseness && [self.cells.width(), self.cells.height()] == sides
    }

    /// Moves on to an image of `interval` s later: the target has moved by up to `reach`
    /// px on either axis, and by one cell at least, and the scene by `moved` px. What leaves the
    /// image cannot be seen.
    pub(crate) fn predict(
        &mut self,
        interval: f64,
        reach: f64,
        moved: [f64; 2],
        buffers: &mut SpreadBuffers,
    ) {
        let side = self.coarseness as f64;
        let by = [0, 1].map(|i| {
            let moved = self.left_over[i] + moved[i];
            let whole = (moved / side).round();
            self.left_over[i] = moved - whole * side;
            whole as isize
        });
        let before = sum(&self.cells);
        let half = (reach / side).ceil().max(1.0) as usize;
        spread(&self.cells, half, by, buffers);
        let stays = sum(&buffers.cells);
        // A chain of two states: of what can be seen a share no longer can, and the other way
        // round; what appears may be anywhere.
        let disappears = -(-interval / IN_SIGHT_S).exp_m1();
        let appears = -(-interval / UNSEEN_S).exp_m1();
        let nowhere = f64::from(self.nowhere);
        let anywhere = (appears * nowhere / self.cells.samples().len() as f64) as f32;
        let kept = (1.0 - disappears) as f32;
        for (cell, spread) in self.cells.samples_mut().iter_mut().zip(buffers.cells.samples()) {
            *cell = kept * spread + anywhere;
        }
        let left = (before - stays).max(0.0);
        self.nowhere = ((1.0 - appears) * nowhere + disappears * stays + left) as f32;
    }

    /// Takes in the log likelihood ratios of an image, of the target being in each cell against
    /// being nowhere.
    pub(crate) fn update(&mut self, ratios: &Plane) {
        let cells = self.cells.samples_mut();
        Arch::new().dispatch(|| {
            for (cell, ratio) in cells.iter_mut().zip(ratios.samples()) {
                // Broken samples say nothing.
                let ratio = if ratio.is_nan() { 0.0 } else { ratio.min(MOST_OF_IMAGE) };
                *cell *= lanes::exp(ratio);
            }
        });
        let total = sum(&self.cells) + f64::from(self.nowhere);
        let share = total.max(f64::MIN_POSITIVE).recip() as f32;
        self.cells.samples_mut().iter_mut().for_each(|cell| *cell *= share);
        self.nowhere *= share;
    }

    /// The likeliest cell, with what is within `near` cells of it.
    pub(crate) fn likeliest(&self, near: [usize; 2]) -> LikeliestCell {
        let peak = self.cells.peak();
        let [columns, rows] = self.about([peak.column, peak.row], near);
        let of_row = |y: usize| self.cells.row(y)[columns.clone()].iter().sum::<f32>();
        LikeliestCell { column: peak.column, row: peak.row, probability: rows.map(of_row).sum() }
    }

    /// Takes the target for being neither in a cell nor within `near` cells of it: what is there is
    /// something else.
    pub(crate) fn exclude(&mut self, cell: [usize; 2], near: [usize; 2]) {
        let [columns, rows] = self.about(cell, near);
        for y in rows {
            for cell in &mut self.cells.row_mut(y)[columns.clone()] {
                self.nowhere += std::mem::take(cell);
            }
        }
    }

    /// Columns and rows within `near` cells of a cell.
    fn about(&self, cell: [usize; 2], near: [usize; 2]) -> [Range<usize>; 2] {
        let sides = [self.cells.width(), self.cells.height()];
        [0, 1].map(|i| cell[i].saturating_sub(near[i])..(cell[i] + near[i] + 1).min(sides[i]))
    }
}

/// The sum of all samples: millions of them, in single precision, would be off by a percent.
fn sum(cells: &Plane) -> f64 {
    (0..cells.height()).map(|y| f64::from(lanes::sum(cells.row(y)))).sum()
}

/// The means of squares of `2 half + 1` cells, moved by whole cells; nothing comes from beyond the
/// border. By running sums, so that it takes as long for any `half`.
fn spread(from: &Plane, half: usize, [right, down]: [isize; 2], buffers: &mut SpreadBuffers) {
    let (width, height) = (from.width() as isize, from.height() as isize);
    let half = half.min(from.width().max(from.height())) as isize;
    let share = ((2 * half + 1) as f64).powi(-2);
    let SpreadBuffers { cells: to, columns, row: before } = buffers;
    to.reshape(from.width(), from.height());
    columns.clear();
    columns.resize(from.width(), 0.0);
    // Rows that are in the square of the first row, then those that come in and go out.
    let mut inside = 0..0;
    for y in 0..height {
        let next = within(y.saturating_sub(down), half, height);
        for row in inside.end.max(next.start)..next.end {
            add_row(columns, from.row(row as usize), 1.0);
        }
        for row in inside.start..next.start.min(inside.end) {
            add_row(columns, from.row(row as usize), -1.0);
        }
        inside = next;
        before.clear();
        before.push(0.0);
        let mut sum = 0.0;
        before.extend(columns.iter().map(|column| {
            sum += column;
            sum
        }));
        let out = to.row_mut(y as usize);
        // What is left of differences of sums may be a rounding error below 0.
        let mean = |square: f64| (share * square.max(0.0)) as f32;
        // Columns whose square is cut by no border take both sums from slices, ...
        let first = right.saturating_add(half).clamp(0, width);
        let end = right.saturating_add(width - half).clamp(first, width);
        if first < end {
            let low = &before[(first - right - half) as usize..];
            let sums = low.iter().zip(&low[2 * half as usize + 1..]);
            let columns = &mut out[first as usize..end as usize];
            columns.iter_mut().zip(sums).for_each(|(out, (low, high))| *out = mean(high - low));
        }
        // ... and the others at clamped places.
        for x in (0..first).chain(end..width) {
            let square = within(x.saturating_sub(right), half, width);
            out[x as usize] = mean(before[square.end as usize] - before[square.start as usize]);
        }
    }
}

/// The cells of a line of `side` that lie within `half` of a place, which may be outside.
#[inline]
fn within(middle: isize, half: isize, side: isize) -> Range<isize> {
    let first = middle.saturating_sub(half).clamp(0, side);
    first..middle.saturating_add(half + 1).clamp(first, side)
}

/// Adds a row, times a sign, to sums down the columns.
#[inline]
fn add_row(columns: &mut [f64], row: &[f32], sign: f64) {
    columns.iter_mut().zip(row).for_each(|(sum, cell)| *sum += sign * f64::from(*cell));
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    const SIDES: [usize; 2] = [160, 120];
    /// Contrast of a target over the noise, as a matched filter finds it in one image: the largest
    /// of 19 200 cells of noise alone is 4.1.
    const STANDS_OUT: f32 = 3.0;

    /// Log likelihood ratios of an image of noise, with a target in a cell: `c s - s^2 / 2`, where
    /// the filter finds c.
    fn image(rng: &mut ChaCha8Rng, target: Option<[usize; 2]>) -> Plane {
        let mut found = Plane::from_fn(SIDES[0], SIDES[1], |_, _| StandardNormal.sample(&mut *rng));
        if let Some([column, row]) = target {
            found.row_mut(row)[column] += STANDS_OUT;
        }
        found
            .samples_mut()
            .iter_mut()
            .for_each(|c| *c = *c * STANDS_OUT - STANDS_OUT.powi(2) / 2.0);
        found
    }

    fn map() -> PlaceMap {
        PlaceMap::new(2, SIDES, |_, _| 1.0)
    }

    fn total(map: &PlaceMap) -> f64 {
        f64::from(map.nowhere) + sum(&map.cells)
    }

    #[test]
    fn a_target_that_stands_out_of_no_image_is_found_in_a_few() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut images = Vec::new();
        for _ in 0..50 {
            let mut map = map();
            let mut found = None;
            for k in 0..40 {
                // It flies along a row of the map by a cell in two images.
                let at = [40 + k / 2, 60];
                map.predict(0.04, 0.0, [0.0; 2], &mut SpreadBuffers::default());
                map.update(&image(&mut rng, Some(at)));
                let likeliest = map.likeliest([2, 2]);
                if likeliest.probability > 0.99 {
                    assert!(
                        likeliest.column.abs_diff(at[0]) <= 2 && likeliest.row.abs_diff(60) <= 2
                    );
                    found = Some(k);
                    break;
                }
            }
            images.push(found.unwrap_or(40));
        }
        // An image gives 4.5 nats, less the 2.2 by which nine cells are chosen from, and 9.9 + 4.6
        // are needed: about seven images.
        images.sort_unstable();
        assert!((4..=9).contains(&images[25]) && images[45] < 20, "{images:?}");
    }

    #[test]
    fn in_noise_alone_nothing_is_found() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut map = map();
        let found = (0..1500).filter(|_| {
            map.predict(0.04, 0.0, [0.0; 2], &mut SpreadBuffers::default());
            map.update(&image(&mut rng, None));
            map.likeliest([2, 2]).probability > 0.99
        });
        assert_eq!(found.count(), 0);
        assert!(map.nowhere > 0.5, "{}", map.nowhere);
    }

    #[test]
    fn what_is_known_moves_with_the_scene() {
        let mut map = map();
        let mut flat = Plane::from_fn(SIDES[0], SIDES[1], |_, _| 0.0);
        flat.row_mut(60)[40] = 6.0;
        for _ in 0..3 {
            map.predict(0.04, 0.0, [0.0; 2], &mut SpreadBuffers::default());
            map.update(&flat);
        }
        // Ten images that have turned by 1.4 px to the right and 0.6 up: by seven cells and three.
        for _ in 0..10 {
            map.predict(0.001, 0.0, [1.4, -0.6], &mut SpreadBuffers::default());
        }
        let likeliest = map.likeliest([2, 2]);
        assert!(
            likeliest.column.abs_diff(47) <= 1 && likeliest.row.abs_diff(57) <= 1,
            "{likeliest:?}"
        );
    }

    #[test]
    fn what_is_excluded_is_elsewhere_or_nowhere() {
        let mut map = map();
        let mut flat = Plane::from_fn(SIDES[0], SIDES[1], |_, _| 0.0);
        (flat.row_mut(60)[40], flat.row_mut(20)[100]) = (6.0, 4.0);
        for _ in 0..4 {
            map.update(&flat);
        }
        assert_eq!((map.likeliest([2, 2]).column, map.likeliest([2, 2]).row), (40, 60));
        map.exclude([40, 60], [2, 2]);
        assert_eq!((map.likeliest([2, 2]).column, map.likeliest([2, 2]).row), (100, 20));
        assert!((total(&map) - 1.0).abs() < 1e-4, "{}", total(&map));
    }

    #[test]
    fn a_square_spreads_evenly_and_what_leaves_the_image_is_nowhere() {
        let mut map = PlaceMap::new(1, [20, 20], |x, y| f32::from(u8::from((x, y) == (3, 10))));
        map.nowhere = 0.0;
        map.cells.row_mut(10)[3] = 1.0;
        let mut buffers = SpreadBuffers::default();
        // Two cells to the left, and spread over five by five: two columns of these have left.
        map.predict(0.0, 2.0, [-2.0, 0.0], &mut buffers);
        let at = |x: usize, y: usize| map.cells.row(y)[x];
        for (x, y) in [(0, 8), (3, 12), (1, 10)] {
            assert!((at(x, y) - 0.04).abs() < 1e-6, "{x} {y}: {}", at(x, y));
        }
        assert!(at(4, 10).abs() < 1e-6 && at(1, 7).abs() < 1e-6 && at(1, 13).abs() < 1e-6);
        assert!((map.nowhere - 0.2).abs() < 1e-6, "{}", map.nowhere);
    }

    proptest! {
        #[test]
        fn whatever_it_is_told_its_probabilities_add_up(
            seed in 0_u64..1000,
            interval in 0.0..1.0_f64,
            reach in prop_oneof![0.0..500.0_f64, Just(f64::INFINITY)],
            moved in prop::array::uniform2(prop_oneof![-400.0..400.0_f64, Just(1e300)]),
            scale in prop_oneof![0.0..100.0_f32, Just(f32::NAN), Just(f32::INFINITY)],
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (mut map, mut buffers) = (map(), SpreadBuffers::default());
            for _ in 0..3 {
                map.predict(interval, reach, moved, &mut buffers);
                prop_assert!((total(&map) - 1.0).abs() < 1e-3, "predicted: {}", total(&map));
                let mut ratios = image(&mut rng, None);
                ratios.samples_mut().iter_mut().for_each(|ratio| *ratio *= scale);
                map.update(&ratios);
                prop_assert!((total(&map) - 1.0).abs() < 1e-3, "after the update: {}", total(&map));
                prop_assert!(map.cells.samples().iter().all(|cell| *cell >= 0.0));
            }
        }
    }
}
