use std::fmt;

use rustfft::num_complex::Complex;

use crate::direct::{AbsoluteDifference, LargestDifference, Product, Slide};
use crate::fft::{Size, Spectrum, Transforms};
use crate::moments::Moments;
use crate::{Extent, Plane, Reference, Similarity, SpectralWeight};

/// How the sums of products of a kernel with a gate are computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Route {
    /// Sample by sample.
    Direct,
    /// By Fourier transforms (Lytvynets 2020, eq. 3.6).
    Spectral,
}

/// Cost of the direct route per multiply-add, ns. Measured by `cargo bench -p
/// crossfix-correlation`; only its ratio to [`SPECTRAL_NS`] matters, and near the crossing either
/// route will do. With half of it the direct route is chosen where it costs up to twice as much as
/// the other.
const DIRECT_NS: f64 = 0.027;
/// Cost of the spectral route per `n log2 n` of a transform of `n` samples, ns, measured in the
/// same way. With half of it the spectral route is chosen where it costs up to twice as much as the
/// other.
const SPECTRAL_NS: f64 = 0.30;

/// Sides, in samples, of the pieces into which the spectral route cuts a large gate: transforms of
/// this size stay in the processor's cache. With half of each side twice the share of a piece is
/// overlap, which is computed twice.
const PIECE: Size = Size { width: 256, height: 128 };

/// Correlates references with gates. Keeps its FFT plans and its buffers, so that the statistics of
/// a second gate of the same size allocate nothing.
#[derive(Default)]
pub struct Correlator {
    route: Option<Route>,
    transforms: Transforms,
    gate_spectrum: Spectrum,
    kernel_spectrum: Spectrum,
    /// Size and kernel that `kernel_spectrum` was made from: the same kernel is not transformed
    /// twice.
    kernel: Option<(Size, Plane)>,
    moments: Moments,
    centred: Plane,
    wrapped: Plane,
    piece: Plane,
}

impl fmt::Debug for Correlator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Correlator").field("route", &self.route).finish_non_exhaustive()
    }
}

/// Covariance and variance at every placement of a reference inside a gate: the parts of the
/// zero-mean measure.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Statistics {
    /// Weighted covariance of the gate with the reference.
    pub covariance: Plane,
    /// Weighted variance of the gate.
    pub variance: Plane,
}

impl Correlator {
    /// A correlator that always takes the same route, where the measure leaves a choice.
    pub fn with_route(route: Route) -> Self {
        Self { route: Some(route), ..Self::default() }
    }

    /// The similarity of a reference with a gate at every placement; larger is more alike.
    ///
    /// `floor` is the noise's standard deviation; its square is added to both variances of the
    /// zero-mean measure, so that a flat gate correlates with nothing. A reference larger than the
    /// gate is cropped to the gate's size.
    pub fn similarity(
        &mut self,
        gate: &Plane,
        reference: &Reference,
        measure: Similarity,
        extent: Extent,
        floor: f32,
        scores: &mut Plane,
    ) {
        let fitting = fitting(gate, reference);
        let reference = fitting.as_ref().unwrap_or(reference);
        match measure {
            Similarity::CrossCorrelation => {
                self.products(gate, reference.image(), extent, scores);
            }
            Similarity::Normalised => self.normalised(gate, reference, extent, scores),
            Similarity::ZeroMeanNormalised => {
                self.zero_mean(gate, reference, extent, floor, scores);
            }
            Similarity::Phase => {
                let weight = SpectralWeight { whitening: 1.0, band: f32::INFINITY };
                self.cross_spectrum(gate, reference, weight, extent, scores);
            }
            Similarity::CrossSpectrum(weight) => {
                self.cross_spectrum(gate, reference, weight, extent, scores);
            }
            Similarity::AbsoluteDifferences => {
                self.slide(AbsoluteDifference, gate, reference.image(), extent, scores);
                scores.samples_mut().iter_mut().for_each(|s| *s = -*s);
            }
            Similarity::MaximumDifference => {
                self.slide(LargestDifference, gate, reference.image(), extent, scores);
                scores.samples_mut().iter_mut().for_each(|s| *s = -*s);
            }
            Similarity::SquaredDifferences => {
                self.squared_differences(gate, reference, extent, scores);
            }
        }
    }

    /// The weighted covariance with the reference, and the weighted variance, of the gate at every
    /// placement inside it. A reference larger than the gate is cropped to the gate's size.
    pub fn statistics(&mut self, gate: &Plane, reference: &Reference, out: &mut Statistics) {
        let fitting = fitting(gate, reference);
        let reference = fitting.as_ref().unwrap_or(reference);
        self.centre(gate);
        let centred = std::mem::take(&mut self.centred);
        self.moments.fill(&centred, reference.window());
        // The kernel sums to 0, so the sum of products is the covariance: the mean of the gate
        // drops out.
        self.products(&centred, reference.kernel(), Extent::Linear, &mut out.covariance);
        self.centred = centred;
        out.variance.copy_from(&self.moments.square);
        let (mean, variance) = (self.moments.mean.samples(), out.variance.samples_mut());
        pulp::Arch::new().dispatch(|| {
            for (variance, mean) in variance.iter_mut().zip(mean) {
                // Var = E[h^2] - (E h)^2, never below 0 by rounding.
                *variance = (*variance - mean * mean).max(0.0);
            }
        });
    }

    /// Writes the gate less its mean to `centred`: the squares then lose fewer digits to rounding.
    fn centre(&mut self, gate: &Plane) {
        self.centred.copy_from(gate);
        let mean = gate.mean();
        self.centred.samples_mut().iter_mut().for_each(|s| *s -= mean);
    }

    /// The gate continued periodically, so that every placement lies inside it.
    fn wrap(&mut self, gate: &Plane, kernel: &Plane) {
        let (width, height) = (gate.width(), gate.height());
        self.wrapped.reshape(width + kernel.width() - 1, height + kernel.height() - 1);
        for y in 0..self.wrapped.height() {
            let from = gate.row(y % height);
            for (x, sample) in self.wrapped.row_mut(y).iter_mut().enumerate() {
                *sample = from[x % width];
            }
        }
    }

    fn slide<T: crate::direct::KernelTerm>(
        &mut self,
        term: T,
        gate: &Plane,
        kernel: &Plane,
        extent: Extent,
        out: &mut Plane,
    ) {
        match extent {
            Extent::Linear => Slide { term, gate, kernel, out }.run(),
            Extent::Circular => {
                self.wrap(gate, kernel);
                Slide { term, gate: &self.wrapped, kernel, out }.run();
            }
        }
    }

    /// The route that the cost model expects to be faster.
    fn route(&self, gate: &Plane, kernel: &Plane, extent: Extent) -> Route {
        if let Some(route) = self.route {
            return route;
        }
        let (placements, size) = match extent {
            Extent::Linear => (
                (gate.width() + 1 - kernel.width()) * (gate.height() + 1 - kernel.height()),
                Size::holding(gate.width(), gate.height()),
            ),
            Extent::Circular => (gate.samples().len(), Size::of(gate)),
        };
        // One multiply-add per placement and kernel sample, against n log2 n of the transforms.
        let direct = DIRECT_NS * (placements * kernel.samples().len()) as f64;
        let spectral = SPECTRAL_NS * size.area() as f64 * (size.area() as f64).log2();
        if direct <= spectral { Route::Direct } else { Route::Spectral }
    }

    /// The sums of products of a kernel with a gate at every placement, `K = sum h g`.
    fn products(&mut self, gate: &Plane, kernel: &Plane, extent: Extent, out: &mut Plane) {
        match (self.route(gate, kernel, extent), extent) {
            (Route::Direct, _) => self.slide(Product, gate, kernel, extent, out),
            (Route::Spectral, Extent::Circular) => {
                self.transform_kernel(kernel, Size::of(gate));
                let transform = self.transforms.of(Size::of(gate));
                transform.forward(gate, &mut self.gate_spectrum);
                self.gate_spectrum.multiply_conjugate(&self.kernel_spectrum);
                transform.inverse(&mut self.gate_spectrum, gate.width(), gate.height(), out);
            }
            (Route::Spectral, Extent::Linear) => self.linear_spectral(gate, kernel, out),
        }
    }

    fn transform_kernel(&mut self, kernel: &Plane, size: Size) {
        if self.kernel.as_ref().is_some_and(|(of, known)| (*of, known) == (size, kernel)) {
            return;
        }
        self.transforms.of(size).forward(kernel, &mut self.kernel_spectrum);
        let (of, known) = self.kernel.get_or_insert_with(|| (size, Plane::default()));
        *of = size;
        known.copy_from(kernel);
    }

    /// The placements inside the gate by transforms, a large gate piece by piece (overlap-save).
    fn linear_spectral(&mut self, gate: &Plane, kernel: &Plane, out: &mut Plane) {
        let (width, height) =
            (gate.width() + 1 - kernel.width(), gate.height() + 1 - kernel.height());
        out.reshape(width, height);
        // A side of a piece is at least four times the kernel's (or all of the gate's): otherwise
        // most of the piece would be overlap.
        let side = |piece: usize, kernel: usize, gate: usize| piece.max(4 * kernel).min(gate);
        let (wide, tall) = (
            side(PIECE.width, kernel.width(), gate.width()),
            side(PIECE.height, kernel.height(), gate.height()),
        );
        let size = Size::holding(wide, tall);
        self.transform_kernel(kernel, size);
        let transform = self.transforms.of(size);
        // Placements that a piece gives, and so the distance of the pieces.
        let (step_x, step_y) = (wide + 1 - kernel.width(), tall + 1 - kernel.height());
        // Neighbouring pieces overlap by the kernel's side less 1: these placements would wrap
        // round and are computed from the next piece.
        for top in (0..height).step_by(step_y) {
            for left in (0..width).step_by(step_x) {
                let (part_x, part_y) = (step_x.min(width - left), step_y.min(height - top));
                let (from_x, from_y) = (part_x + kernel.width() - 1, part_y + kernel.height() - 1);
                if (from_x, from_y) == (gate.width(), gate.height()) {
                    transform.forward(gate, &mut self.gate_spectrum);
                } else {
                    gate.crop_into(left as isize, top as isize, from_x, from_y, &mut self.piece);
                    transform.forward(&self.piece, &mut self.gate_spectrum);
                }
                self.gate_spectrum.multiply_conjugate(&self.kernel_spectrum);
                transform.inverse(&mut self.gate_spectrum, part_x, part_y, &mut self.piece);
                for y in 0..part_y {
                    out.row_mut(top + y)[left..left + part_x].copy_from_slice(self.piece.row(y));
                }
            }
        }
    }

    fn fill_moments(&mut self, gate: &Plane, reference: &Reference, extent: Extent) {
        match extent {
            Extent::Linear => self.moments.fill(gate, reference.window()),
            Extent::Circular => {
                self.wrap(gate, reference.image());
                self.moments.fill(&self.wrapped, reference.window());
            }
        }
    }

    fn normalised(
        &mut self,
        gate: &Plane,
        reference: &Reference,
        extent: Extent,
        scores: &mut Plane,
    ) {
        let plain = Reference::new(
            reference.image().clone(),
            crate::Window::uniform(reference.image().width(), reference.image().height()),
        );
        self.fill_moments(gate, &plain, extent);
        self.products(gate, reference.image(), extent, scores);
        // R = sum h g / sqrt(sum h^2 sum g^2); `square` is the mean of h^2, hence `count`.
        let count = reference.image().samples().len() as f32;
        let energy: f32 = reference.image().samples().iter().map(|g| g * g).sum();
        for (score, square) in scores.samples_mut().iter_mut().zip(self.moments.square.samples()) {
            let both = energy * square * count;
            *score = if both > 0.0 { *score / both.sqrt() } else { 0.0 };
        }
    }

    fn zero_mean(
        &mut self,
        gate: &Plane,
        reference: &Reference,
        extent: Extent,
        floor: f32,
        scores: &mut Plane,
    ) {
        self.centre(gate);
        let centred = std::mem::take(&mut self.centred);
        self.fill_moments(&centred, reference, extent);
        self.products(&centred, reference.kernel(), extent, scores);
        self.centred = centred;
        // R = cov(h, g) / sqrt((var g + floor^2) (var h + floor^2)). The products are the
        // covariance, as the kernel sums to 0.
        let noise = floor * floor;
        let own = (reference.variance() + noise).max(f32::MIN_POSITIVE);
        let (mean, square) = (self.moments.mean.samples(), self.moments.square.samples());
        pulp::Arch::new().dispatch(|| {
            for ((score, mean), square) in scores.samples_mut().iter_mut().zip(mean).zip(square) {
                let variance = (square - mean * mean).max(0.0) + noise;
                *score /= (own * variance).sqrt().max(f32::MIN_POSITIVE);
            }
        });
    }

    fn cross_spectrum(
        &mut self,
        gate: &Plane,
        reference: &Reference,
        weight: SpectralWeight,
        extent: Extent,
        scores: &mut Plane,
    ) {
        self.centre(gate);
        let size = Size::of(gate);
        self.transform_kernel(reference.kernel(), size);
        let transform = self.transforms.of(size);
        transform.forward(&self.centred, &mut self.gate_spectrum);
        self.gate_spectrum.multiply_conjugate(&self.kernel_spectrum);
        // Inverse transform of q H G* is the similarity map (Lytvynets 2020, eq. 3.7).
        weigh(&mut self.gate_spectrum, size, weight);
        let (width, height) = match extent {
            Extent::Circular => (size.width, size.height),
            Extent::Linear => (
                size.width + 1 - reference.image().width(),
                size.height + 1 - reference.image().height(),
            ),
        };
        transform.inverse(&mut self.gate_spectrum, width, height, scores);
    }

    fn squared_differences(
        &mut self,
        gate: &Plane,
        reference: &Reference,
        extent: Extent,
        scores: &mut Plane,
    ) {
        let image = reference.image();
        let (width, height) = (image.width(), image.height());
        // The same level is subtracted from gate and reference, which leaves their difference as it
        // is and costs the squares fewer digits.
        let level = gate.mean();
        self.centre(gate);
        let centred = std::mem::take(&mut self.centred);
        let lowered = Plane::from_fn(width, height, |x, y| image.row(y)[x] - level);
        let energy: f32 = lowered.samples().iter().map(|g| g * g).sum();
        let plain = Reference::new(lowered, crate::Window::uniform(width, height));
        self.fill_moments(&centred, &plain, extent);
        self.products(&centred, plain.image(), extent, scores);
        self.centred = centred;
        let count = (width * height) as f32;
        for (score, square) in scores.samples_mut().iter_mut().zip(self.moments.square.samples()) {
            // sum (h - g)^2 = sum h^2 - 2 sum h g + sum g^2; the mean square is h's, hence the
            // count.
            *score = -(square * count - 2.0 * *score + energy).max(0.0).sqrt();
        }
    }
}

/// The reference cropped to the gate's size; `None` if it fits. The cropped one has a uniform
/// window.
fn fitting(gate: &Plane, reference: &Reference) -> Option<Reference> {
    let image = reference.image();
    let (width, height) = (image.width().min(gate.width()), image.height().min(gate.height()));
    let cut = (width, height) != (image.width(), image.height());
    cut.then(|| {
        Reference::new(image.crop(0, 0, width, height), crate::Window::uniform(width, height))
    })
}

/// Multiplies a cross-spectrum by a weight (Lytvynets 2020, eq. 3.7).
fn weigh(spectrum: &mut Spectrum, size: Size, weight: SpectralWeight) {
    let largest = spectrum.0.iter().map(|value| value.norm()).fold(0.0, f32::max);
    // Below this a term is rounding of the largest one, and its phase means nothing.
    let least = largest * 1e-6;
    // Frequencies in cycles per sample; the upper half of the indices are the negative frequencies.
    let frequency = |index: usize, side: usize| index.min(side - index) as f32 / side as f32;
    for (x, column) in spectrum.0.chunks_exact_mut(size.height).enumerate() {
        for (y, value) in column.iter_mut().enumerate() {
            let square = frequency(x, size.width).powi(2) + frequency(y, size.height).powi(2);
            let band = (-0.5 * square / weight.band.powi(2)).exp();
            let norm = value.norm();
            let factor = if norm > least { band * norm.powf(-weight.whitening) } else { 0.0 };
            *value *= Complex::new(factor, 0.0);
        }
    }
}
