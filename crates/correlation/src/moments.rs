//! Weighted mean and variance of a gate under every placement of a window.

use pulp::{Arch, Simd, WithSimd};

use crate::direct::{Product, Slide};
use crate::{Plane, Window};

/// Weighted first and second moments of a gate, with the buffers to compute them.
#[derive(Debug, Default)]
pub(crate) struct Moments {
    /// The weighted mean at every placement.
    pub(crate) mean: Plane,
    /// The weighted mean square at every placement.
    pub(crate) square: Plane,
    squared: Plane,
    lines: Plane,
    columns: Vec<f32>,
    rows: [Vec<f32>; 2],
}

impl Moments {
    /// Fills `mean` and `square` for the placements of a window inside a gate.
    pub(crate) fn fill(&mut self, gate: &Plane, window: &Window) {
        let Self { mean, square, squared, lines, columns, rows } = self;
        if window.is_uniform() {
            let (width, height) = (window.width(), window.height());
            BoxMeans { gate, squares: false, width, height, columns, rows, out: mean }.run();
            BoxMeans { gate, squares: true, width, height, columns, rows, out: square }.run();
            return;
        }
        // A window's weight is a column's times a row's, so each moment takes one pass along each
        // axis.
        squared.copy_from(gate);
        Arch::new().dispatch(|| squared.samples_mut().iter_mut().for_each(|s| *s *= *s));
        for (plane, out) in [(gate, mean), (&*squared, square)] {
            Slide { term: Product, gate: plane, kernel: window.columns(), out: lines }.run();
            Slide { term: Product, gate: lines, kernel: window.rows(), out }.run();
        }
    }
}

/// The mean over a box at every placement, of the samples or of their squares: running sums down
/// the columns, then along the row sums whose lengths double.
struct BoxMeans<'a> {
    gate: &'a Plane,
    squares: bool,
    width: usize,
    height: usize,
    columns: &'a mut Vec<f32>,
    rows: &'a mut [Vec<f32>; 2],
    out: &'a mut Plane,
}

impl BoxMeans<'_> {
    fn run(self) {
        self.columns.clear();
        self.columns.resize(self.gate.width(), 0.0);
        for row in self.rows.iter_mut() {
            row.resize(self.gate.width(), 0.0);
        }
        self.out.reshape(self.gate.width() + 1 - self.width, self.gate.height() + 1 - self.height);
        Arch::new().dispatch(self);
    }
}

impl WithSimd for BoxMeans<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { gate, squares, width, height, columns, rows, out } = self;
        // `columns` holds, for each column, the sum over the `height` newest rows.
        let share = 1.0 / (width * height) as f32;
        for y in 0..gate.height() {
            accumulate(columns, gate.row(y), squares, 1.0);
            let Some(top) = (y + 1).checked_sub(height) else { continue };
            let sums = row_sums(columns, rows, width);
            for (mean, sum) in out.row_mut(top).iter_mut().zip(sums) {
                *mean = sum * share;
            }
            // The oldest row goes out before the next one comes in.
            accumulate(columns, gate.row(top), squares, -1.0);
        }
    }
}

/// Adds `sign` times a row, or its squares, to the sums of the columns.
#[inline(always)]
fn accumulate(columns: &mut [f32], row: &[f32], squares: bool, sign: f32) {
    if squares {
        for (sum, value) in columns.iter_mut().zip(row) {
            *sum += sign * (value * value);
        }
    } else {
        for (sum, value) in columns.iter_mut().zip(row) {
            *sum += sign * value;
        }
    }
}

/// Sums of `width` samples starting at each place, valid where all of these samples exist. `rows`
/// are buffers.
#[inline(always)]
fn row_sums<'a>(samples: &[f32], rows: &'a mut [Vec<f32>; 2], width: usize) -> &'a [f32] {
    let [from, to] = rows;
    let (mut from, mut to) = (&mut from[..], &mut to[..]);
    from.copy_from_slice(samples);
    // Binary expansion of the width, from its second highest bit down: sums of n samples become
    // sums of 2n, s_2n[x] = s_n[x] + s_n[x + n], or of 2n + 1 with one more sample.
    let mut length = 1;
    for bit in (0..width.ilog2()).rev() {
        let doubled = to.iter_mut().zip(from.iter()).zip(&from[length..]);
        length *= 2;
        if width >> bit & 1 == 1 {
            for (((sum, first), second), sample) in doubled.zip(&samples[length..]) {
                *sum = first + second + sample;
            }
            length += 1;
        } else {
            for ((sum, first), second) in doubled {
                *sum = first + second;
            }
        }
        std::mem::swap(&mut from, &mut to);
    }
    from
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn moments_are_what_they_are_called(
            w in 1usize..40, h in 1usize..9, dx in 0usize..30, dy in 0usize..6, share in prop::option::of(0.2..0.6f64),
        ) {
            let gate = Plane::from_fn(w + dx, h + dy, |x, y| ((x * 37 + y * 91) % 101) as f32 / 50.0 - 1.0);
            let window = share.map_or(Window::uniform(w, h), |share| Window::gaussian(w, h, share));
            let mut moments = Moments::default();
            moments.fill(&gate, &window);
            for y in 0..=dy {
                for x in 0..=dx {
                    let (mut mean, mut square) = (0.0, 0.0);
                    for j in 0..h {
                        for i in 0..w {
                            let (weight, sample) = (window.weight(i, j), gate.row(y + j)[x + i]);
                            mean += weight * sample;
                            square += weight * sample * sample;
                        }
                    }
                    prop_assert!((moments.mean.row(y)[x] - mean).abs() < 1e-4);
                    prop_assert!((moments.square.row(y)[x] - square).abs() < 1e-4);
                }
            }
        }
    }
}
