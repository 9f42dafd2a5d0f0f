//! Sliding a small kernel over a gate, sample by sample, with as many columns at a time as the
//! machine has SIMD lanes. For small kernels this is faster than any transform.

use pulp::{Arch, Simd, WithSimd};

use crate::Plane;

/// Number of vectors of columns that are accumulated at once; with two rows each, all accumulators
/// fit the registers of a machine with sixteen of them. With half as many, additions wait for one
/// another.
const MOST_VECTORS: usize = 5;

/// The term that is accumulated over a kernel: the only difference between the direct measures.
pub(crate) trait KernelTerm: Copy {
    /// The accumulator after one more pair of samples.
    fn step<S: Simd>(self, simd: S, sum: S::f32s, kernel: S::f32s, gate: S::f32s) -> S::f32s;
}

/// The sum of products (Lytvynets 2020, eq. 3.1).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Product;

/// The sum of absolute differences (Lytvynets 2020, eq. 3.10).
#[derive(Clone, Copy, Debug)]
pub(crate) struct AbsoluteDifference;

/// The largest absolute difference (Lytvynets 2020, eq. 3.12).
#[derive(Clone, Copy, Debug)]
pub(crate) struct LargestDifference;

impl KernelTerm for Product {
    #[inline(always)]
    fn step<S: Simd>(self, simd: S, sum: S::f32s, kernel: S::f32s, gate: S::f32s) -> S::f32s {
        simd.mul_add_e_f32s(kernel, gate, sum)
    }
}

impl KernelTerm for AbsoluteDifference {
    #[inline(always)]
    fn step<S: Simd>(self, simd: S, sum: S::f32s, kernel: S::f32s, gate: S::f32s) -> S::f32s {
        simd.add_f32s(sum, simd.abs_f32s(simd.sub_f32s(kernel, gate)))
    }
}

impl KernelTerm for LargestDifference {
    #[inline(always)]
    fn step<S: Simd>(self, simd: S, sum: S::f32s, kernel: S::f32s, gate: S::f32s) -> S::f32s {
        simd.max_f32s(sum, simd.abs_f32s(simd.sub_f32s(kernel, gate)))
    }
}

/// A kernel slid over every placement inside a gate.
#[derive(Debug)]
pub(crate) struct Slide<'a, T> {
    pub(crate) term: T,
    pub(crate) gate: &'a Plane,
    pub(crate) kernel: &'a Plane,
    pub(crate) out: &'a mut Plane,
}

impl<T: KernelTerm> Slide<'_, T> {
    /// Fills the output, after resizing it to the number of placements, with the widest
    /// instructions of the machine it runs on. The kernel must not be larger than the gate.
    pub(crate) fn run(self) {
        self.run_on(Arch::new());
    }

    fn run_on(self, arch: Arch) {
        let width = self.gate.width() + 1 - self.kernel.width();
        let height = self.gate.height() + 1 - self.kernel.height();
        self.out.reshape(width, height);
        arch.dispatch(self);
    }
}

impl<T: KernelTerm> WithSimd for Slide<'_, T> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (width, height) = (self.out.width(), self.out.height());
        // Blocks of nearly equal size: a last block of a single vector would wait for the result of
        // each of its additions. The last block is computed first: where it extends beyond its row,
        // its values are overwritten by the row's first block or by the next row, or they lie in
        // the padding.
        let vectors = width.div_ceil(S::F32_LANES);
        let blocks = vectors.div_ceil(MOST_VECTORS);
        for row in (0..height).step_by(2) {
            for block in (0..blocks).rev() {
                let (first, end) = (block * vectors / blocks, (block + 1) * vectors / blocks);
                let column = first * S::F32_LANES;
                match end - first {
                    1 => self.block::<S, 1>(simd, column, row),
                    2 => self.block::<S, 2>(simd, column, row),
                    3 => self.block::<S, 3>(simd, column, row),
                    4 => self.block::<S, 4>(simd, column, row),
                    _ => self.block::<S, MOST_VECTORS>(simd, column, row),
                }
            }
        }
    }
}

impl<T: KernelTerm> Slide<'_, T> {
    /// Computes two rows of `V` vectors of placements.
    #[inline(always)]
    fn block<S: Simd, const V: usize>(&mut self, simd: S, column: usize, row: usize) {
        let tall = self.kernel.height();
        let none = [simd.splat_f32s(0.0); V];
        // Each row of the gate meets row `y` of the kernel for the upper row of placements, and row
        // `y - 1` for the lower one.
        let mut upper = self.line(simd, column, row, 0, none);
        if row + 1 == self.out.height() {
            for y in 1..tall {
                upper = self.line(simd, column, row + y, y, upper);
            }
            self.store::<S, V>(column, row, upper);
            return;
        }
        let mut lower = none;
        for y in 1..tall {
            (upper, lower) = self.two_lines(simd, column, row + y, y, upper, lower);
        }
        // The last row of the gate that only the lower placements reach.
        lower = self.line(simd, column, row + tall, tall - 1, lower);
        self.store::<S, V>(column, row, upper);
        self.store::<S, V>(column, row + 1, lower);
    }

    /// Accumulates one row of the gate with row `y` of the kernel.
    #[inline(always)]
    fn line<S: Simd, const V: usize>(
        &self,
        simd: S,
        column: usize,
        gate_row: usize,
        y: usize,
        mut sums: [S::f32s; V],
    ) -> [S::f32s; V] {
        let gate = self.gate.padded_from(column, gate_row);
        // One kernel sample meets V vectors of neighbouring placements, each one sample further on.
        for (&k, samples) in self.kernel.row(y).iter().zip(gate.windows(V * S::F32_LANES)) {
            let k = simd.splat_f32s(k);
            let (samples, _) = S::as_simd_f32s(samples);
            for (sum, sample) in sums.iter_mut().zip(samples) {
                *sum = self.term.step(simd, *sum, k, *sample);
            }
        }
        sums
    }

    /// Accumulates one row of the gate with row `y` of the kernel for the upper row of placements,
    /// and with row `y - 1` for the lower one.
    #[inline(always)]
    fn two_lines<S: Simd, const V: usize>(
        &self,
        simd: S,
        column: usize,
        gate_row: usize,
        y: usize,
        mut upper: [S::f32s; V],
        mut lower: [S::f32s; V],
    ) -> ([S::f32s; V], [S::f32s; V]) {
        let gate = self.gate.padded_from(column, gate_row);
        let kernels = self.kernel.row(y).iter().zip(self.kernel.row(y - 1));
        // Samples of the gate that are loaded once serve both rows of placements.
        for ((&k, &l), samples) in kernels.zip(gate.windows(V * S::F32_LANES)) {
            let (k, l) = (simd.splat_f32s(k), simd.splat_f32s(l));
            let (samples, _) = S::as_simd_f32s(samples);
            for ((upper, lower), sample) in upper.iter_mut().zip(&mut lower).zip(samples) {
                *upper = self.term.step(simd, *upper, k, *sample);
                *lower = self.term.step(simd, *lower, l, *sample);
            }
        }
        (upper, lower)
    }

    #[inline(always)]
    fn store<S: Simd, const V: usize>(&mut self, column: usize, row: usize, sums: [S::f32s; V]) {
        let out = &mut self.out.padded_from_mut(column, row)[..V * S::F32_LANES];
        let (out, _) = S::as_mut_simd_f32s(out);
        out.copy_from_slice(&sums);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn texture(width: usize, height: usize, seed: usize) -> Plane {
        Plane::from_fn(width, height, |x, y| ((x * 31 + y * 17 + seed * 101) % 97) as f32 / 10.0)
    }

    fn slid<T: KernelTerm>(term: T, gate: &Plane, kernel: &Plane, arch: Arch) -> Plane {
        let mut out = Plane::default();
        Slide { term, gate, kernel, out: &mut out }.run_on(arch);
        out
    }

    proptest! {
        #[test]
        fn every_machine_gives_what_the_definition_gives(
            w in 1usize..12, h in 1usize..8, dx in 0usize..70, dy in 0usize..6, seed in 0usize..50,
        ) {
            let (gate, kernel) = (texture(w + dx, h + dy, seed), texture(w, h, seed + 1));
            let part = |x: usize, y: usize| gate.crop(x as isize, y as isize, w, h);
            let pairs = |x, y| -> Vec<(f32, f32)> {
                kernel.samples().iter().copied().zip(part(x, y).samples().iter().copied()).collect()
            };
            let product = Plane::from_fn(dx + 1, dy + 1, |x, y| pairs(x, y).iter().map(|(a, b)| a * b).sum());
            let absolute = Plane::from_fn(dx + 1, dy + 1, |x, y| pairs(x, y).iter().map(|(a, b)| (a - b).abs()).sum());
            let largest = Plane::from_fn(dx + 1, dy + 1, |x, y| {
                pairs(x, y).iter().map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
            });
            for arch in [Arch::new(), Arch::Scalar] {
                for (fast, slow) in [
                    (slid(Product, &gate, &kernel, arch), &product),
                    (slid(AbsoluteDifference, &gate, &kernel, arch), &absolute),
                    (slid(LargestDifference, &gate, &kernel, arch), &largest),
                ] {
                    for (a, b) in fast.samples().iter().zip(slow.samples()) {
                        prop_assert!((a - b).abs() <= 1e-4 * (1.0 + b.abs()), "{a} {b}");
                    }
                }
            }
        }
    }
}
