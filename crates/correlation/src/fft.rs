//! Two-dimensional real FFTs: rows by realfft, columns by rustfft.

use std::collections::BTreeMap;
use std::sync::Arc;

use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::num_complex::Complex;
use rustfft::{Fft, FftPlanner};

use crate::Plane;

/// The spectrum of a real plane: `height` columns of `width / 2 + 1`, stored column by column.
#[derive(Clone, Debug)]
pub(crate) struct Spectrum(Vec<Complex<f32>>);

impl Spectrum {
    /// The product with the conjugate of another: the spectrum of the cross-correlation.
    pub(crate) fn times_conjugate(&self, other: &Self) -> Self {
        Self(self.0.iter().zip(&other.0).map(|(a, b)| a * b.conj()).collect())
    }
}

/// Sides of a transform.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Size {
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Size {
    /// The least good size that holds a plane: multiples of 16 are twice as fast as awkward sides.
    pub(crate) fn holding(plane: &Plane) -> Self {
        Self { width: plane.width().next_multiple_of(16), height: plane.height().next_multiple_of(16) }
    }
}

/// A plan for one size.
#[derive(Clone)]
pub(crate) struct Plan {
    size: Size,
    row_forward: Arc<dyn RealToComplex<f32>>,
    row_inverse: Arc<dyn ComplexToReal<f32>>,
    column_forward: Arc<dyn Fft<f32>>,
    column_inverse: Arc<dyn Fft<f32>>,
}

impl Plan {
    fn half(&self) -> usize {
        self.size.width / 2 + 1
    }

    /// The spectrum of a plane, padded with zeros.
    pub(crate) fn forward(&self, plane: &Plane) -> Spectrum {
        let Size { width, height } = self.size;
        let half = self.half();
        let mut columns = vec![Complex::default(); half * height];
        let mut row_in = vec![0.0; width];
        let mut row_out = vec![Complex::default(); half];
        for y in 0..plane.height() {
            row_in[..plane.width()].copy_from_slice(plane.row(y));
            row_in[plane.width()..].fill(0.0);
            // The lengths are the plan's own: it cannot refuse them.
            let _ = self.row_forward.process(&mut row_in, &mut row_out);
            for (x, value) in row_out.iter().enumerate() {
                columns[x * height + y] = *value;
            }
        }
        for column in columns.chunks_exact_mut(height) {
            self.column_forward.process(column);
        }
        Spectrum(columns)
    }

    /// The top left `width` by `height` of the plane of a spectrum.
    pub(crate) fn inverse(&self, mut spectrum: Spectrum, width: usize, height: usize) -> Plane {
        let (rows, half) = (self.size.height, self.half());
        for column in spectrum.0.chunks_exact_mut(rows) {
            self.column_inverse.process(column);
        }
        let scale = 1.0 / (self.size.width * self.size.height) as f32;
        let mut row_in = vec![Complex::default(); half];
        let mut row_out = vec![0.0; self.size.width];
        let mut samples = Vec::with_capacity(width * height);
        for y in 0..height {
            for (x, value) in row_in.iter_mut().enumerate() {
                *value = spectrum.0[x * rows + y];
            }
            // A real row's first and middle terms are real up to rounding; realfft wants exactly.
            row_in[0].im = 0.0;
            if self.size.width.is_multiple_of(2) {
                row_in[half - 1].im = 0.0;
            }
            let _ = self.row_inverse.process(&mut row_in, &mut row_out);
            samples.extend(row_out[..width].iter().map(|value| value * scale));
        }
        let mut samples = samples.into_iter();
        Plane::from_fn(width, height, |_, _| samples.next().unwrap_or_default())
    }
}

/// Plans that have been made, by size.
pub(crate) struct Plans {
    real: RealFftPlanner<f32>,
    complex: FftPlanner<f32>,
    made: BTreeMap<Size, Plan>,
}

impl Default for Plans {
    fn default() -> Self {
        Self { real: RealFftPlanner::new(), complex: FftPlanner::new(), made: BTreeMap::new() }
    }
}

impl Plans {
    pub(crate) fn of(&mut self, size: Size) -> Plan {
        let Self { real, complex, made } = self;
        made.entry(size)
            .or_insert_with(|| Plan {
                size,
                row_forward: real.plan_fft_forward(size.width),
                row_inverse: real.plan_fft_inverse(size.width),
                column_forward: complex.plan_fft_forward(size.height),
                column_inverse: complex.plan_fft_inverse(size.height),
            })
            .clone()
    }
}
