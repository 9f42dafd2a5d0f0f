//! Brightness between the samples. Two interpolators, both with a continuous gradient and passing
//! through the samples: cubic convolution over four samples, and a cubic spline.

use pulp::{Arch, Simd, WithSimd};

use crate::Plane;

/// Samples per axis from which an interpolated value is computed: a cubic has four coefficients.
/// With half of it the interpolation would be linear, and its gradient would jump at the samples.
const TAPS: usize = 4;

/// The weights of the four samples around a place that lies `fraction` of a sample after the second
/// of them (Keys' cubic convolution).
#[inline(always)]
fn weights(fraction: f32) -> [f32; TAPS] {
    let f = fraction;
    [
        ((-0.5 * f + 1.0) * f - 0.5) * f,
        (1.5 * f - 2.5) * f * f + 1.0,
        ((-1.5 * f + 2.0) * f + 0.5) * f,
        (0.5 * f - 0.5) * f * f,
    ]
}

/// The weights of the four coefficients of a cubic spline around a place: the uniform cubic
/// B-spline.
#[inline(always)]
fn spline_weights(fraction: f32) -> [f32; TAPS] {
    let (f, rest) = (fraction, 1.0 - fraction);
    [
        rest * rest * rest / 6.0,
        (3.0 * f - 6.0) * f * f / 6.0 + 2.0 / 3.0,
        ((-3.0 * f + 3.0) * f + 3.0) * f / 6.0 + 1.0 / 6.0,
        f * f * f / 6.0,
    ]
}

/// The derivatives of [`spline_weights`] by `fraction`.
#[inline(always)]
fn spline_slopes(fraction: f32) -> [f32; TAPS] {
    let (f, rest) = (fraction, 1.0 - fraction);
    [-0.5 * rest * rest, (1.5 * f - 2.0) * f, (-1.5 * f + 1.0) * f + 0.5, 0.5 * f * f]
}

/// Half length, in samples, of the filter that turns samples into spline coefficients. What is cut
/// off begins at 0.04 % of its middle (z^6, see `prefilter`); with half of it at 2 %, and the
/// spline misses the samples.
const REACH: usize = 5;

/// The filter that turns samples into spline coefficients: `sqrt(3) z^|k|` with `z = sqrt(3) - 2`,
/// cut off at [`REACH`] and normalised to sum to 1.
fn prefilter() -> [f32; 2 * REACH + 1] {
    let pole = 3.0_f32.sqrt() - 2.0;
    let mut taps = [0.0; 2 * REACH + 1];
    for (k, tap) in taps.iter_mut().enumerate() {
        // The pole z is the root of z^2 + 4 z + 1 inside the unit circle: (1, 4, 1) / 6 are the
        // spline's weights at a sample.
        *tap = pole.powi(k.abs_diff(REACH) as i32);
    }
    // Normalised after the cut: a constant brightness keeps its value.
    let sum: f32 = taps.iter().sum();
    taps.map(|tap| tap / sum)
}

/// The integer part (rounded down) and the fraction, from 0 to 1, of a coordinate.
fn split(place: f64) -> (isize, f32) {
    let whole = place.floor();
    (whole as isize, (place - whole) as f32)
}

/// Separable interpolation: one pass along the rows of the supporting samples, then one along the
/// columns.
struct Passes<'a> {
    part: &'a Plane,
    along: [f32; TAPS],
    across: [f32; TAPS],
    lines: &'a mut Plane,
    to: &'a mut Plane,
}

impl WithSimd for Passes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        along_rows(self.part, self.along, self.lines);
        along_columns(self.lines, self.across, self.to);
    }
}

#[inline(always)]
fn along_rows(from: &Plane, taps: [f32; TAPS], to: &mut Plane) {
    for y in 0..to.height() {
        let row = from.row(y);
        let out = to.row_mut(y);
        let count = out.len();
        let [a, b, c, d] = [0, 1, 2, 3].map(|k| &row[k..k + count]);
        combine(out, taps, [a, b, c, d]);
    }
}

#[inline(always)]
fn along_columns(from: &Plane, taps: [f32; TAPS], to: &mut Plane) {
    for y in 0..to.height() {
        let rows = [0, 1, 2, 3].map(|k| from.row(y + k));
        combine(to.row_mut(y), taps, rows);
    }
}

/// Weighted sum of `N` rows, sample by sample.
#[inline(always)]
fn combine<const N: usize>(out: &mut [f32], taps: [f32; N], rows: [&[f32]; N]) {
    let count = out.len();
    let rows = rows.map(|row| &row[..count]);
    for x in 0..count {
        let mut sum = 0.0;
        for k in 0..N {
            sum += taps[k] * rows[k][x];
        }
        out[x] = sum;
    }
}

/// Interpolates planes between their samples; keeps its buffers.
#[derive(Debug, Default)]
pub struct Resampler {
    part: Plane,
    lines: Plane,
}

impl Resampler {
    /// Cuts out the part whose top left sample is at (`left`, `top`), in fractions of samples, by
    /// cubic convolution. Its size is that of `to`; beyond the plane's border the border samples
    /// are repeated.
    pub fn sample(&mut self, from: &Plane, left: f64, top: f64, to: &mut Plane) {
        let [fx, fy] = self.support(from, left, top, to);
        self.passes(weights(fx), weights(fy), to);
    }

    fn passes(&mut self, along: [f32; TAPS], across: [f32; TAPS], to: &mut Plane) {
        Arch::new().dispatch(Passes {
            part: &self.part,
            along,
            across,
            lines: &mut self.lines,
            to,
        });
    }

    /// Copies the samples that support an interpolated part to `self.part`; returns the fractions
    /// of its place along x and y.
    fn support(&mut self, from: &Plane, left: f64, top: f64, to: &Plane) -> [f32; 2] {
        let ((x, fx), (y, fy)) = (split(left), split(top));
        let (width, height) = (to.width() + TAPS - 1, to.height() + TAPS - 1);
        // One sample before and two after each place.
        from.crop_into(x - 1, y - 1, width, height, &mut self.part);
        self.lines.reshape(to.width(), height);
        [fx, fy]
    }
}

/// An interpolated part of a plane, with its gradient.
#[derive(Debug, Default)]
pub(crate) struct Sampled {
    pub(crate) value: Plane,
    pub(crate) by_x: Plane,
    pub(crate) by_y: Plane,
}

/// A plane as a cubic spline: it passes through the samples, and its gradient is accurate up to
/// higher frequencies than that of the four-sample cubic convolution.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct PlaneSpline {
    padded: Plane,
    lines: Plane,
    /// Coefficients of the samples and of `MARGIN` more on each side.
    coefficients: Plane,
}

/// Number of samples beyond the border for which there are coefficients. A fit with a border of one
/// that has moved by two samples reads as far: with half of it the spline is bent there.
const MARGIN: isize = 2;

impl PlaneSpline {
    /// Becomes the spline through a plane's samples; beyond the border the border samples are
    /// repeated.
    pub(crate) fn pass_through(&mut self, plane: &Plane) {
        let (taps, pad) = (prefilter(), MARGIN + REACH as isize);
        let wide = |side: usize, pad: isize| side + 2 * pad as usize;
        let (width, height) = (wide(plane.width(), MARGIN), wide(plane.height(), MARGIN));
        // Each pass uses up the filter's reach at both ends of its axis, and leaves the margin.
        plane.crop_into(
            -pad,
            -pad,
            wide(plane.width(), pad),
            wide(plane.height(), pad),
            &mut self.padded,
        );
        self.lines.reshape(width, self.padded.height());
        self.coefficients.reshape(width, height);
        let Self { padded, lines, coefficients } = self;
        Arch::new().dispatch(Prefilter { taps, padded, lines, coefficients });
    }

    /// Cuts out the part whose top left sample is at (`left`, `top`), with its gradient; the size
    /// is that of `to.value`.
    pub(crate) fn sample_with_gradient(
        &self,
        left: f64,
        top: f64,
        resampler: &mut Resampler,
        to: &mut Sampled,
    ) {
        let (width, height) = (to.value.width(), to.value.height());
        to.by_x.reshape(width, height);
        to.by_y.reshape(width, height);
        // The coefficients begin MARGIN samples before the image.
        let margin = MARGIN as f64;
        let [fx, fy] =
            resampler.support(&self.coefficients, left + margin, top + margin, &to.value);
        let Resampler { part, lines } = resampler;
        Arch::new().dispatch(GradientPasses { part, fx, fy, lines, to });
    }
}

/// The separable passes that give a spline's value and its gradient.
struct GradientPasses<'a> {
    part: &'a Plane,
    fx: f32,
    fy: f32,
    lines: &'a mut Plane,
    to: &'a mut Sampled,
}

impl WithSimd for GradientPasses<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { part, fx, fy, lines, to } = self;
        // With B the spline weights along an axis and B' their slopes: value = B(x) B(y),
        // by_y = B(x) B'(y), by_x = B'(x) B(y).
        along_rows(part, spline_weights(fx), lines);
        along_columns(lines, spline_weights(fy), &mut to.value);
        along_columns(lines, spline_slopes(fy), &mut to.by_y);
        along_rows(part, spline_slopes(fx), lines);
        along_columns(lines, spline_weights(fy), &mut to.by_x);
    }
}

/// Turns samples into spline coefficients: the filter along the rows, then along the columns.
struct Prefilter<'a> {
    taps: [f32; 2 * REACH + 1],
    padded: &'a Plane,
    lines: &'a mut Plane,
    coefficients: &'a mut Plane,
}

impl WithSimd for Prefilter<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { taps, padded, lines, coefficients } = self;
        for y in 0..lines.height() {
            let row = padded.row(y);
            combine(lines.row_mut(y), taps, std::array::from_fn(|k| &row[k..]));
        }
        for y in 0..coefficients.height() {
            combine(coefficients.row_mut(y), taps, std::array::from_fn(|k| lines.row(y + k)));
        }
    }
}

/// Where another plane is seen in a plane: `scale` times as large, turned by `turn_rad` (x towards
/// y), and with its middle at (`x`, `y`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Column of the middle.
    pub x: f64,
    /// Row of the middle.
    pub y: f64,
    /// Distance of neighbouring samples of the view, in samples of the plane.
    pub scale: f64,
    /// Direction of the rows.
    pub turn_rad: f64,
}

impl Resampler {
    /// A plane as it is seen in a view: `to` keeps its size, and its middle lies at the view's
    /// (`x`, `y`). Cubic convolution where the view is only shifted, linear interpolation where it
    /// is scaled or turned.
    pub fn resample(&mut self, from: &Plane, view: View, to: &mut Plane) {
        let half = [to.width(), to.height()].map(|side| (side as f64 - 1.0) / 2.0);
        if view.scale == 1.0 && view.turn_rad == 0.0 {
            self.sample(from, view.x - half[0], view.y - half[1], to);
            return;
        }
        let (cos, sin) = (view.scale * view.turn_rad.cos(), view.scale * view.turn_rad.sin());
        // Bounding box of the turned view with a margin of 2 samples, so that every sample of the
        // view lies inside the crop.
        let reach = [0, 1].map(|i| cos.abs() * half[i] + sin.abs() * half[1 - i] + 2.0);
        let corner = [(view.x - reach[0]).floor(), (view.y - reach[1]).floor()];
        let sides = reach.map(|reach| (2.0 * reach).ceil() as usize + 2);
        from.crop_into(corner[0] as isize, corner[1] as isize, sides[0], sides[1], &mut self.part);
        // Where sample (0, 0) of the view lies in the crop: middle - scale R(turn) half.
        let start = [
            view.x - corner[0] - cos * half[0] + sin * half[1],
            view.y - corner[1] - sin * half[0] - cos * half[1],
        ];
        let step = [cos as f32, sin as f32];
        Arch::new().dispatch(TurnedRows {
            part: &self.part,
            start: start.map(|s| s as f32),
            step,
            to,
        });
    }
}

/// Linear interpolation along turned rows.
struct TurnedRows<'a> {
    part: &'a Plane,
    /// Where the first sample lies.
    start: [f32; 2],
    /// Step from a sample to the next in the row.
    step: [f32; 2],
    to: &'a mut Plane,
}

impl WithSimd for TurnedRows<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { part, start, step: [cos, sin], to } = self;
        let (stride, samples) = (part.width(), part.samples());
        for row in 0..to.height() {
            let v = row as f32;
            for (column, out) in to.row_mut(row).iter_mut().enumerate() {
                let u = column as f32;
                // start + scale R(turn) (u, v).
                let (x, y) = (start[0] + cos * u - sin * v, start[1] + sin * u + cos * v);
                // Between the four samples about (x, y): along the two rows first, then down.
                let (i, j) = (x as usize, y as usize);
                let (fx, fy) = (x - i as f32, y - j as f32);
                let at = j * stride + i;
                let Some([a, b]) = samples.get(at..at + 2).and_then(|pair| pair.first_chunk())
                else {
                    continue;
                };
                let below =
                    samples.get(at + stride..at + stride + 2).and_then(|pair| pair.first_chunk());
                let Some([c, d]) = below else { continue };
                let upper = a + fx * (b - a);
                let lower = c + fx * (d - c);
                *out = upper + fy * (lower - upper);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spline_is_true_in_value_and_gradient_where_the_signal_is_smooth() {
        let value = |x: f64, y: f64| (0.9 * x).sin() + 0.5 * (0.7 * y + 0.2 * x).cos();
        let plane = Plane::from_fn(30, 26, |x, y| value(x as f64, y as f64) as f32);
        let (mut spline, mut part) = (PlaneSpline::default(), Sampled::default());
        part.value.reshape(5, 4);
        spline.pass_through(&plane);
        spline.sample_with_gradient(12.3, 10.8, &mut Resampler::default(), &mut part);
        for y in 0..4 {
            for x in 0..5 {
                let (u, v) = (12.3 + x as f64, 10.8 + y as f64);
                let by_x = 0.9 * (0.9 * u).cos() - 0.1 * (0.7 * v + 0.2 * u).sin();
                let by_y = -0.35 * (0.7 * v + 0.2 * u).sin();
                assert!((f64::from(part.value.row(y)[x]) - value(u, v)).abs() < 1e-2);
                assert!((f64::from(part.by_x.row(y)[x]) - by_x).abs() < 2e-2);
                assert!((f64::from(part.by_y.row(y)[x]) - by_y).abs() < 2e-2);
            }
        }
    }

    #[test]
    fn a_quadratic_plane_is_sampled_exactly() {
        let value = |x: f64, y: f64| 0.3 * x * x - 0.2 * x * y + y - 4.0;
        let plane = Plane::from_fn(20, 16, |x, y| value(x as f64, y as f64) as f32);
        let mut part = Plane::from_fn(5, 4, |_, _| 0.0);
        Resampler::default().sample(&plane, 6.3, 5.8, &mut part);
        for y in 0..4 {
            for x in 0..5 {
                assert!(
                    (f64::from(part.row(y)[x]) - value(6.3 + x as f64, 5.8 + y as f64)).abs()
                        < 1e-4
                );
            }
        }
    }

    #[test]
    fn a_turned_view_sees_what_lies_in_its_direction() {
        let plane = Plane::from_fn(30, 30, |x, y| (2 * x + 7 * y) as f32);
        let mut seen = Plane::from_fn(5, 3, |_, _| 0.0);
        let turn_rad = std::f64::consts::FRAC_PI_2;
        Resampler::default().resample(
            &plane,
            View { x: 15.0, y: 14.0, scale: 2.0, turn_rad },
            &mut seen,
        );
        // Rows run down the plane, two samples a step; the next row lies to the left.
        assert!((seen.row(1)[4] - (2 * 15 + 7 * 18) as f32).abs() < 1e-3, "{seen:?}");
        assert!((seen.row(2)[2] - (2 * 13 + 7 * 14) as f32).abs() < 1e-3, "{seen:?}");
    }
}
