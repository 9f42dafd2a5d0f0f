//! What the detector does to whole images, and to parts of them.

use crossfix_correlation::Plane;
use pulp::Arch;

/// Half side of the surroundings of a cell, cells: four times a target's side, which is two or
/// three. With half of it a target of three cells is 36 % of its own surroundings instead of 11,
/// and stands out by that much less.
pub(super) const SURROUNDINGS: usize = 4;
/// Side of the surroundings, cells: the cell's own and `SURROUNDINGS` on either side.
const SIDE: usize = 2 * SURROUNDINGS + 1;

/// Means of two by two; an odd last row or column is left out.
pub(super) fn halve(from: &Plane, to: &mut Plane) {
    to.reshape(from.width() / 2, from.height() / 2);
    Arch::new().dispatch(|| {
        for y in 0..to.height() {
            let blocks = from.row(2 * y).chunks_exact(2).zip(from.row(2 * y + 1).chunks_exact(2));
            for (out, (above, below)) in to.row_mut(y).iter_mut().zip(blocks) {
                *out = 0.25 * (above[0] + above[1] + below[0] + below[1]);
            }
        }
    });
}

/// Memory for [`stand_out`].
#[derive(Debug, Default)]
pub(super) struct StandOutScratch {
    /// Sums down the columns of the surroundings.
    sums: Vec<f32>,
    /// One row, smoothed down the columns.
    smoothed: Vec<f32>,
    /// The surroundings' means along a row.
    means: Vec<f32>,
}

/// Fills `to` with how much brighter each cell, smoothed by a quarter, a half and a quarter of its
/// neighbours, is than the square about it; beyond the border the border cells are repeated.
pub(super) fn stand_out(from: &Plane, to: &mut Plane, lines: &mut StandOutScratch) {
    let (width, height) = (from.width(), from.height());
    to.reshape(width, height);
    let reach = SURROUNDINGS as isize;
    let row = |y: isize| from.row(y.clamp(0, height as isize - 1) as usize);
    let StandOutScratch { sums, smoothed, means } = lines;
    for line in [&mut *sums, &mut *smoothed, &mut *means] {
        line.clear();
        line.resize(width, 0.0);
    }
    // The square's means, by running sums: down the columns here, along the rows in `means_along`.
    for y in -reach..=reach {
        sums.iter_mut().zip(row(y)).for_each(|(sum, sample)| *sum += sample);
    }
    Arch::new().dispatch(|| {
        for y in 0..height as isize {
            smooth_across([row(y - 1), row(y), row(y + 1)], smoothed);
            means_along(sums, means);
            smooth_less_means(smoothed, means, to.row_mut(y as usize));
            // The square moves a row down: the next row comes in, the last goes out.
            let ends = row(y + reach + 1).iter().zip(row(y - reach));
            sums.iter_mut().zip(ends).for_each(|(sum, (next, last))| *sum += next - last);
        }
    });
}

/// Smooths down the columns of three rows.
#[inline(always)]
fn smooth_across([above, here, below]: [&[f32]; 3], smoothed: &mut [f32]) {
    let rows = above.iter().zip(here).zip(below);
    for (out, ((above, here), below)) in smoothed.iter_mut().zip(rows) {
        *out = 0.25 * above + 0.5 * here + 0.25 * below;
    }
}

/// Smooths along a row, and subtracts the means of the surroundings.
#[inline(always)]
fn smooth_less_means(row: &[f32], means: &[f32], out: &mut [f32]) {
    for (out, (near, mean)) in out[1..].iter_mut().zip(row.windows(3).zip(&means[1..])) {
        *out = 0.25 * near[0] + 0.5 * near[1] + 0.25 * near[2] - mean;
    }
    // At the ends the border is repeated: the missing neighbour's weight is added to the border's
    // own.
    let last = row.len() - 1;
    out[0] = 0.75 * row[0] + 0.25 * row[1.min(last)] - means[0];
    out[last] = 0.75 * row[last] + 0.25 * row[last.saturating_sub(1)] - means[last];
}

/// Means of the surroundings along a row, from the sums down the columns.
fn means_along(sums: &[f32], means: &mut [f32]) {
    let share = 1.0 / (SIDE * SIDE) as f32;
    let inner = sums.len().saturating_sub(SIDE - 1);
    // At both ends the border column is repeated; between them the windows are whole.
    for x in (0..SURROUNDINGS.min(sums.len())).chain(SURROUNDINGS + inner..sums.len()) {
        means[x] = share * sum_about(sums, x);
    }
    for (mean, window) in means.iter_mut().skip(SURROUNDINGS).zip(sums.windows(SIDE)) {
        *mean = share * window.iter().sum::<f32>();
    }
}

/// The sum over the surroundings of a column; beyond the ends the last columns are repeated.
#[inline]
fn sum_about(sums: &[f32], x: usize) -> f32 {
    let last = sums.len() - 1;
    (x..x + SIDE).map(|x| sums[x.saturating_sub(SURROUNDINGS).min(last)]).sum()
}

/// The plane sampled at each cell plus `by`, which is less than a cell on either axis.
pub(super) fn resample(from: &Plane, by: [f32; 2], to: &mut Plane) {
    let (width, height) = (from.width(), from.height());
    to.reshape(width, height);
    let [right, down] = by.map(|by| if by < 0.0 { -1_isize } else { 1 });
    let [along, across] = by.map(f32::abs);
    Arch::new().dispatch(|| {
        for y in 0..height {
            let other = (y as isize + down).clamp(0, height as isize - 1) as usize;
            let (here, there) = (from.row(y), from.row(other));
            let blend = |x: usize| here[x] + across * (there[x] - here[x]);
            let out = to.row_mut(y);
            for (x, out) in out.iter_mut().enumerate().take(width - 1).skip(1) {
                // Bilinear: first down the two columns, then along the row.
                let (at, next) = (blend(x), blend(x.wrapping_add_signed(right)));
                *out = at + along * (next - at);
            }
            (out[0], out[width - 1]) = (blend(0), blend(width - 1));
        }
    });
}

/// The plane moved by whole cells; beyond the border the border cells are repeated.
pub(super) fn moved(from: &Plane, [right, down]: [isize; 2], to: &mut Plane) {
    let (width, height) = (from.width() as isize, from.height() as isize);
    to.reshape(from.width(), from.height());
    for y in 0..height {
        let row = from.row((y + down).clamp(0, height - 1) as usize);
        for (x, out) in (0..width).zip(to.row_mut(y as usize)) {
            *out = row[(x + right).clamp(0, width - 1) as usize];
        }
    }
}

/// Sets the cells to 0 that have come from beyond the border when the plane was moved.
pub(super) fn clear_beyond(plane: &mut Plane, [right, down]: [isize; 2]) {
    let (width, height) = (plane.width() as isize, plane.height() as isize);
    for y in 0..height {
        let row = plane.row_mut(y as usize);
        let is_in = (0..height).contains(&(y + down));
        let from = if is_in { (-right).clamp(0, width) } else { width };
        let to = if is_in { (width - right).clamp(0, width) } else { width };
        row[..from as usize].fill(0.0);
        row[(to as usize).max(from as usize)..].fill(0.0);
    }
}

/// Sets the cells to 0 that are within `reach` cells of the border.
pub(super) fn clear_border(plane: &mut Plane, reach: usize) {
    let (width, height) = (plane.width(), plane.height());
    for y in 0..height {
        let row = plane.row_mut(y);
        if y < reach || y + reach >= height {
            row.fill(0.0);
        } else {
            row[..reach.min(width)].fill(0.0);
            row[width.saturating_sub(reach)..].fill(0.0);
        }
    }
}

/// The value at a place between the cells, linearly interpolated; beyond the border the border
/// cells are repeated.
pub(super) fn between(plane: &Plane, [x, y]: [f64; 2]) -> f32 {
    let (left, top) = (x.floor(), y.floor());
    let [right, down] = [x - left, y - top].map(|rest| rest as f32);
    let [above, below] = [0, 1].map(|k| {
        let y = top as isize + k;
        let [a, b] = [0, 1].map(|k| plane.clamped(left as isize + k, y));
        a + right * (b - a)
    });
    above + down * (below - above)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_out_is_bright_and_what_is_about_it_is_darker() {
        let from = Plane::from_fn(41, 31, |x, y| {
            if (19..=21).contains(&x) && (14..=16).contains(&y) { 81.0 } else { 0.0 }
        });
        let mut to = Plane::default();
        stand_out(&from, &mut to, &mut StandOutScratch::default());
        // The middle has 81 less nine cells of 81 of the square of 81 cells.
        assert!((to.row(15)[20] - 72.0).abs() < 1e-3, "{}", to.row(15)[20]);
        assert!((to.row(15)[23] + 9.0).abs() < 1e-3, "{}", to.row(15)[23]);
        assert!(to.row(3).iter().all(|out| out.abs() < 1e-4));
        let flat = Plane::from_fn(12, 5, |_, _| 7.0);
        stand_out(&flat, &mut to, &mut StandOutScratch::default());
        assert!(
            to.samples().iter().all(|out| out.abs() < 1e-4),
            "borders and narrow pictures stand out of nothing"
        );
    }

    #[test]
    fn a_slope_moves_by_parts_of_a_cell_and_by_whole_ones() {
        let slope = Plane::from_fn(20, 10, |x, y| 2.0 * x as f32 + 3.0 * y as f32);
        let mut to = Plane::default();
        resample(&slope, [0.25, -0.5], &mut to);
        assert!((to.row(5)[7] - (slope.row(5)[7] + 0.5 - 1.5)).abs() < 1e-4);
        moved(&slope, [2, -1], &mut to);
        assert_eq!(to.row(5)[7], slope.row(4)[9]);
        // What has come from beyond the border: two columns on the right, and a row above.
        clear_beyond(&mut to, [2, -1]);
        for (x, y, is_clear) in [(17, 5, false), (18, 5, true), (7, 0, true), (7, 1, false)] {
            assert_eq!(to.row(y)[x] == 0.0, is_clear, "({x}, {y})");
        }
        clear_beyond(&mut to, [-3, 2]);
        for (x, y, is_clear) in [(2, 5, true), (3, 5, false), (7, 8, true), (7, 7, false)] {
            assert_eq!(to.row(y)[x] == 0.0, is_clear, "({x}, {y})");
        }
        clear_beyond(&mut to, [-30, 0]);
        assert!(to.samples().iter().all(|out| *out == 0.0));
        assert!((between(&slope, [3.5, 2.25]) - 13.75).abs() < 1e-4);
    }
}
