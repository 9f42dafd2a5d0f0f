//! Coarse pictures of the scene, on which the turn of the camera is found.

use crossfix_correlation::Plane;
use pulp::{Arch, Simd, WithSimd};

use crate::crop::replace_invalid;

/// Side of the blocks that make one pixel of the coarse picture, px: in single pixels the noise has
/// more slope than clouds have, and no turn is noticed; with half of it the noise of a block is
/// twice as large, and faint clouds show no turn.
pub(crate) const COARSENESS: usize = 8;
/// Side of the blocks of the fine picture, px: trees and houses are four times as many pixels in
/// it, and tell smaller turns. With half of it a registration costs four times as much.
pub(crate) const FINENESS: usize = 4;
/// Most pixels of a fine picture: that of an image of 704x576 has 25 344. A larger image has none:
/// the coarse picture of 1280x720, 14 400 pixels, is as fine in angle as the fine one of 640x360.
/// With half of it an image of 640x512 has none; with three times as much one of 1280x720 has one,
/// and its registration costs 2 ms.
const MOST_FINE: usize = 26_000;
/// How often the coarse picture is smoothed, each time with weights of a quarter, a half and a
/// quarter for neighbours. With half of it noise keeps more of its slope, against the scene's.
const SMOOTHED: usize = 3;

/// An image as pictures of the means of its blocks.
#[derive(Clone, Debug, Default)]
pub(crate) struct CoarsePictures {
    /// The means of blocks of `COARSENESS`, smoothed.
    pub(crate) coarse: Plane,
    /// The means of blocks of `FINENESS`, smoothed; empty for a large image.
    pub(crate) fine: Plane,
}

impl CoarsePictures {
    /// Takes an image; `sharp` becomes the coarse picture before it was smoothed.
    pub(crate) fn take(&mut self, image: &Plane, sharp: &mut Plane, scratch: &mut CoarseScratch) {
        let CoarseScratch { between, sums } = scratch;
        let Self { coarse, fine } = self;
        means_of_blocks::<COARSENESS>(image, coarse, sums);
        replace_invalid(coarse);
        sharp.copy_from(coarse);
        smooth(coarse, between);
        let is_small = image.width() * image.height() <= MOST_FINE * FINENESS * FINENESS;
        if is_small {
            means_of_blocks::<FINENESS>(image, fine, sums);
            replace_invalid(fine);
            smooth(fine, between);
        } else {
            *fine = Plane::default();
        }
    }

    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.coarse.copy_from(&other.coarse);
        if other.fine.width() > 0 {
            self.fine.copy_from(&other.fine);
        } else {
            self.fine = Plane::default();
        }
    }
}

/// Memory for [`CoarsePictures::take`].
#[derive(Debug, Default)]
pub(crate) struct CoarseScratch {
    between: Plane,
    /// Sums down the columns of a row of blocks.
    sums: Vec<f32>,
}

/// The means of blocks of a side.
fn means_of_blocks<const SIDE: usize>(from: &Plane, to: &mut Plane, sums: &mut Vec<f32>) {
    to.reshape(from.width() / SIDE, from.height() / SIDE);
    let share = 1.0 / (SIDE * SIDE) as f32;
    for y in 0..to.height() {
        // Down the columns first: that is many at a time. A picture lower than a block counts its
        // last row several times.
        let rows: [&[f32]; SIDE] =
            std::array::from_fn(|k| from.row((y * SIDE + k).min(from.height() - 1)));
        sums.clear();
        sums.resize(from.width(), 0.0);
        Arch::new().dispatch(ColumnSums { rows, sums });
        let (blocks, _) = sums.as_chunks::<SIDE>();
        for (mean, block) in to.row_mut(y).iter_mut().zip(blocks) {
            *mean = share * sum_of(*block);
        }
    }
}

/// The sum by halves: its steps do not wait for each other.
#[inline(always)]
fn sum_of<const SIDE: usize>(mut values: [f32; SIDE]) -> f32 {
    let mut half = SIDE / 2;
    while half > 0 {
        for i in 0..half {
            values[i] += values[i + half];
        }
        half /= 2;
    }
    values[0]
}

/// The sums of rows, column by column.
struct ColumnSums<'a, const SIDE: usize> {
    rows: [&'a [f32]; SIDE],
    sums: &'a mut [f32],
}

impl<const SIDE: usize> WithSimd for ColumnSums<'_, SIDE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let rows = self.rows.map(|row| &row[..self.sums.len()]);
        for (x, sum) in self.sums.iter_mut().enumerate() {
            *sum = sum_of(rows.map(|row| row[x]));
        }
    }
}

/// Smooths a picture along rows and columns.
fn smooth(plane: &mut Plane, between: &mut Plane) {
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
