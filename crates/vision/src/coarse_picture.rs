//! Coarse pictures of the scene, on which the turn of the camera is found.

use crossfix_correlation::Plane;
use pulp::{Arch, Simd, WithSimd};

/// Side of the blocks that make one pixel of the coarse picture, px; the camera's turn is found in
/// that. In single pixels the noise has more slope than clouds have, and no turn is noticed; with
/// half of it the noise of a block is twice as large, and faint clouds show no turn.
pub(crate) const COARSENESS: usize = 8;
/// How often the coarse picture is smoothed, each time with weights of a quarter, a half and a
/// quarter for neighbours. With half of it noise keeps more of its slope, against the scene's.
const SMOOTHED: usize = 3;

/// The means of blocks. `sums` is memory for a row of them.
pub(crate) fn coarsened(from: &Plane, to: &mut Plane, sums: &mut Vec<f32>) {
    to.reshape(from.width() / COARSENESS, from.height() / COARSENESS);
    let share = 1.0 / (COARSENESS * COARSENESS) as f32;
    for y in 0..to.height() {
        // Down the columns first: that is many at a time. A picture lower than a block counts its
        // last row several times.
        let rows: [&[f32]; COARSENESS] =
            std::array::from_fn(|k| from.row((y * COARSENESS + k).min(from.height() - 1)));
        sums.clear();
        sums.resize(from.width(), 0.0);
        Arch::new().dispatch(ColumnSums { rows, sums });
        let (blocks, _) = sums.as_chunks::<COARSENESS>();
        for (mean, [a, b, c, d, e, f, g, h]) in to.row_mut(y).iter_mut().zip(blocks) {
            *mean = share * (((a + e) + (b + f)) + ((c + g) + (d + h)));
        }
    }
}

/// The sums of rows, column by column.
struct ColumnSums<'a> {
    rows: [&'a [f32]; COARSENESS],
    sums: &'a mut [f32],
}

impl WithSimd for ColumnSums<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let [a, b, c, d, e, f, g, h] = self.rows.map(|row| &row[..self.sums.len()]);
        for (x, sum) in self.sums.iter_mut().enumerate() {
            *sum = ((a[x] + b[x]) + (c[x] + d[x])) + ((e[x] + f[x]) + (g[x] + h[x]));
        }
    }
}

/// Smooths a picture along rows and columns.
pub(crate) fn smooth(plane: &mut Plane, between: &mut Plane) {
    let (width, height) = (plane.width(), plane.height());
    if width < 2 {
        return;
    }
    between.reshape(width, height);
    let mean = |before: f32, at: f32, after: f32| 0.25 * before + 0.5 * at + 0.25 * after;
    for _ in 0..SMOOTHED {
        for y in 0..height {
            let (row, out) = (plane.row(y), between.row_mut(y));
            for (out, three) in out[1..].iter_mut().zip(row.windows(3)) {
                *out = mean(three[0], three[1], three[2]);
            }
            // Beyond the border the border pixel is repeated.
            out[0] = mean(row[0], row[0], row[1]);
            out[width - 1] = mean(row[width - 2], row[width - 1], row[width - 1]);
        }
        for y in 0..height {
            let (up, down) = (y.saturating_sub(1), (y + 1).min(height - 1));
            let rows = between.row(up).iter().zip(between.row(y)).zip(between.row(down));
            for (out, ((up, at), down)) in plane.row_mut(y).iter_mut().zip(rows) {
                *out = mean(*up, *at, *down);
            }
        }
    }
}
