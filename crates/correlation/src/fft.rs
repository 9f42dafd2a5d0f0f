//! Two-dimensional real FFTs: rows by realfft, columns by rustfft; buffers are kept between calls.

use std::collections::BTreeMap;
use std::sync::Arc;

use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};

use crate::Plane;

/// Number of rows that are transposed together: their samples of one column fill a cache line. With
/// half of it each line is fetched twice.
const ROWS_AT_ONCE: usize = 8;

/// The spectrum of a real plane: `width / 2 + 1` columns of `height` (the rest is their conjugate),
/// stored column by column.
#[derive(Clone, Debug, Default)]
pub(crate) struct Spectrum(pub(crate) Vec<Complex<f32>>);

impl Spectrum {
    /// Multiplies by the conjugate of another spectrum: the spectrum of their cross-correlation.
    pub(crate) fn multiply_conjugate(&mut self, kernel: &Self) {
        for (value, kernel) in self.0.iter_mut().zip(&kernel.0) {
            *value *= kernel.conj();
        }
    }
}

/// Sides of a transform.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Size {
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Size {
    /// The size of a plane itself: correlation then wraps round at the plane's sides.
    pub(crate) fn of(plane: &Plane) -> Self {
        Self { width: plane.width(), height: plane.height() }
    }

    /// The smallest fast size that holds this many columns and rows: multiples of 16 with no prime
    /// factor above 5 are twice as fast as awkward sides.
    pub(crate) fn holding(width: usize, height: usize) -> Self {
        Self { width: fast_side(width), height: fast_side(height) }
    }

    pub(crate) fn area(self) -> usize {
        self.width * self.height
    }
}

fn fast_side(least: usize) -> usize {
    let mut side = least.next_multiple_of(16);
    while !is_smooth(side) {
        side += 16;
    }
    side
}

/// Whether a number has no prime factor above 5.
fn is_smooth(mut number: usize) -> bool {
    for prime in [2, 3, 5] {
        while number.is_multiple_of(prime) {
            number /= prime;
        }
    }
    number == 1
}

/// The transform of one size, with its plans and buffers.
pub(crate) struct Transform {
    size: Size,
    row_forward: Arc<dyn RealToComplex<f32>>,
    row_inverse: Arc<dyn ComplexToReal<f32>>,
    column_forward: Arc<dyn Fft<f32>>,
    column_inverse: Arc<dyn Fft<f32>>,
    row: Vec<f32>,
    rows: Vec<Complex<f32>>,
    scratch: Vec<Complex<f32>>,
}

impl Transform {
    fn planned(size: Size, real: &mut RealFftPlanner<f32>, complex: &mut FftPlanner<f32>) -> Self {
        let row_forward = real.plan_fft_forward(size.width);
        let row_inverse = real.plan_fft_inverse(size.width);
        let column_forward = complex.plan_fft_forward(size.height);
        let column_inverse = complex.plan_fft_inverse(size.height);
        let scratch = [
            row_forward.get_scratch_len(),
            row_inverse.get_scratch_len(),
            column_forward.get_inplace_scratch_len(),
            column_inverse.get_inplace_scratch_len(),
        ];
        Self {
            size,
            row: vec![0.0; size.width],
            rows: vec![Complex::default(); ROWS_AT_ONCE * (size.width / 2 + 1)],
            scratch: vec![Complex::default(); scratch.into_iter().max().unwrap_or(0)],
            row_forward,
            row_inverse,
            column_forward,
            column_inverse,
        }
    }

    fn half(&self) -> usize {
        self.size.width / 2 + 1
    }

    /// The spectrum of a plane, padded with zeros.
    pub(crate) fn forward(&mut self, plane: &Plane, spectrum: &mut Spectrum) {
        let (half, height) = (self.half(), self.size.height);
        spectrum.0.resize(half * height, Complex::default());
        spectrum.0.fill(Complex::default());
        // Transform some rows, then scatter them into the columns of the spectrum. Rows below the
        // plane are zero, and so are their transforms.
        for first in (0..plane.height()).step_by(ROWS_AT_ONCE) {
            let count = ROWS_AT_ONCE.min(plane.height() - first);
            for (y, out) in self.rows.chunks_exact_mut(half).take(count).enumerate() {
                let (used, rest) = self.row.split_at_mut(plane.width());
                used.copy_from_slice(plane.row(first + y));
                rest.fill(0.0);
                // Cannot fail: the buffers have the lengths that the plan asks for.
                let _ =
                    self.row_forward.process_with_scratch(&mut self.row, out, &mut self.scratch);
            }
            for x in 0..half {
                let column = &mut spectrum.0[x * height + first..x * height + first + count];
                for (y, value) in column.iter_mut().enumerate() {
                    *value = self.rows[y * half + x];
                }
            }
        }
        self.column_forward.process_with_scratch(&mut spectrum.0, &mut self.scratch);
    }

    /// The inverse transform's top left `width` by `height` samples; overwrites the spectrum.
    pub(crate) fn inverse(
        &mut self,
        spectrum: &mut Spectrum,
        width: usize,
        height: usize,
        plane: &mut Plane,
    ) {
        let (half, tall) = (self.half(), self.size.height);
        self.column_inverse.process_with_scratch(&mut spectrum.0, &mut self.scratch);
        plane.reshape(width, height);
        // Neither library scales its transforms.
        let scale = 1.0 / self.size.area() as f32;
        for first in (0..height).step_by(ROWS_AT_ONCE) {
            let count = ROWS_AT_ONCE.min(height - first);
            for x in 0..half {
                let column = &spectrum.0[x * tall + first..x * tall + first + count];
                for (y, value) in column.iter().enumerate() {
                    self.rows[y * half + x] = *value;
                }
            }
            for (y, row) in self.rows.chunks_exact_mut(half).take(count).enumerate() {
                // The first and the middle term of a real row are real but for rounding; realfft
                // wants exactly.
                row[0].im = 0.0;
                if self.size.width.is_multiple_of(2) {
                    row[half - 1].im = 0.0;
                }
                let _ =
                    self.row_inverse.process_with_scratch(row, &mut self.row, &mut self.scratch);
                for (out, value) in plane.row_mut(first + y).iter_mut().zip(&self.row) {
                    *out = value * scale;
                }
            }
        }
    }
}

/// Planned transforms, by size.
pub(crate) struct Transforms {
    real: RealFftPlanner<f32>,
    complex: FftPlanner<f32>,
    made: BTreeMap<Size, Transform>,
}

impl Default for Transforms {
    fn default() -> Self {
        Self { real: RealFftPlanner::new(), complex: FftPlanner::new(), made: BTreeMap::new() }
    }
}

impl Transforms {
    pub(crate) fn of(&mut self, size: Size) -> &mut Transform {
        let Self { real, complex, made } = self;
        made.entry(size).or_insert_with(|| Transform::planned(size, real, complex))
    }
}
