use nalgebra::{Matrix2, Matrix4, Matrix5, Vector5};
use pulp::{Arch, Simd, WithSimd};

use crate::interpolation::{Resampler, Sampled};
use crate::{Plane, Reference};

/// A step shorter than this ends the fit, px. With half of it some fits take a step more, and move
/// by less than this.
const SETTLED_PX: f64 = 2e-3;
/// How far a fit may move from its start along each axis, px: farther off there is another peak.
/// With half of it a fit that starts a pixel beside the target ends short of it.
const REACH_PX: f64 = 1.5;
/// Share of the normal matrix' trace that is added to its diagonal: it stays regular where the
/// image holds no information. With half of it the same.
const LEAST_SHARE: f64 = 1e-9;
/// Information on a given contrast over that which the image gives on it. With half of it the same:
/// the fitted contrast is within millionths of the given one.
const KNOWN: f64 = 1e6;
/// Number of planes in a fit: model, its derivatives by the four freedoms, image. It follows from
/// the model.
const PLANES: usize = 6;

/// Parameters that are fitted, beside contrast and brightness.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Freedom {
    /// The place.
    Shift,
    /// The place, the size and the angle.
    ShiftScaleTurn,
}

/// Where a reference lies in an image, by least squares.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Column of the reference's top left sample.
    pub x: f64,
    /// Row of the reference's top left sample.
    pub y: f64,
    /// Contrast of the image over the reference's.
    pub gain: f64,
    /// Logarithm of the image's size over the reference's; 0 with [`Freedom::Shift`].
    pub log_scale: f64,
    /// How far the image is turned from the reference, x towards y, rad; 0 with [`Freedom::Shift`].
    pub turn_rad: f64,
    /// Variance of the residual: what the fitted reference does not explain of the image.
    pub residual_variance: f64,
    /// Pixels compared.
    pub pixels: usize,
    /// Inverse of Fisher's information of (x, y, log scale, turn), for noise of variance 1, with
    /// contrast and brightness unknown.
    inverse: Option<Matrix4<f64>>,
}

impl Fit {
    /// The covariance of (x, y), px^2, for this noise variance: the Cramer-Rao bound
    /// `sigma^2 J^-1`. `None` where the image does not determine the place.
    pub fn covariance(&self, noise_variance: f64) -> Option<Matrix2<f64>> {
        self.inverse.map(|inverse| inverse.fixed_view::<2, 2>(0, 0) * noise_variance)
    }

    /// The variances of log scale and turn for this noise variance; `None` if they were not fitted.
    pub fn shape_variances(&self, noise_variance: f64) -> Option<[f64; 2]> {
        let inverse = self.inverse?;
        let variances = [inverse[(2, 2)], inverse[(3, 3)]].map(|v| v * noise_variance);
        (variances[0] > 0.0).then_some(variances)
    }
}

/// Fits a reference to an image between the pixels by Gauss-Newton steps. The image is modelled as
/// `offset + gain * reference(u - place) + white noise`; the reference is the one that is
/// interpolated, as it has the less noise. Keeps its buffers.
#[derive(Debug, Default)]
pub struct Fitter {
    resampler: Resampler,
    model: Sampled,
    by_scale: Plane,
    by_turn: Plane,
    image: Plane,
}

/// Options of a fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitOptions {
    /// Width of the reference's border that is not compared, pixels: the pixels inside are
    /// interpolated from it.
    pub border: usize,
    /// At most this many Gauss-Newton steps.
    pub steps: usize,
    /// The parameters that are fitted.
    pub freedom: Freedom,
    /// Information added on scale and turn, as a share of the reference's energy: a prior that they
    /// have not changed.
    pub stiffness: f64,
    /// The image's contrast over the reference's, where it is known; otherwise it is fitted.
    pub contrast: Option<f64>,
}

impl Default for FitOptions {
    fn default() -> Self {
        Self { border: 1, steps: 4, freedom: Freedom::Shift, stiffness: 0.0, contrast: None }
    }
}

/// Sums of the planes' samples and of their products (of the deviations from the means, once
/// centred): the normal equations of a fit.
#[derive(Clone, Copy, Debug, Default)]
struct FitEquations {
    sums: [f64; PLANES],
    products: [[f64; PLANES]; PLANES],
}

impl Fitter {
    /// Fits, starting at the placement whose top left sample is at (`column`, `row`) of the image.
    pub fn fit(
        &mut self,
        image: &Plane,
        reference: &Reference,
        column: f64,
        row: f64,
        options: FitOptions,
    ) -> Fit {
        let sides = [reference.image().width(), reference.image().height()];
        let [bx, by] = sides.map(|side| options.border.min((side - 1) / 2));
        let (width, height) = (sides[0] - 2 * bx, sides[1] - 2 * by);
        let whole = [column.round(), row.round()];
        let (left, top) = (whole[0] as isize + bx as isize, whole[1] as isize + by as isize);
        image.crop_into(left, top, width, height, &mut self.image);
        // Single-precision sums keep more digits without the mean brightness.
        let level = self.image.mean();
        self.image.samples_mut().iter_mut().for_each(|s| *s -= level);
        self.model.value.reshape(width, height);

        // The reference's place relative to the rounded start, px.
        let start = [column - whole[0], row - whole[1]];
        let mut place = start;
        let mut fit = Fit {
            x: column,
            y: row,
            gain: 0.0,
            log_scale: 0.0,
            turn_rad: 0.0,
            residual_variance: f64::INFINITY,
            pixels: width * height,
            inverse: None,
        };
        for _ in 0..options.steps {
            // Pixel u of the crop shows the reference at u + border - place.
            let (left, top) = (bx as f64 - place[0], by as f64 - place[1]);
            reference.spline().sample_with_gradient(
                left,
                top,
                &mut self.resampler,
                &mut self.model,
            );
            let normal = self.normal(options.freedom, place);
            let Some(step) = normal.solve(options, &mut fit) else { break };
            for axis in 0..2 {
                // At most a pixel per step, and never out of reach of the start.
                let reached = place[axis] + step[axis].clamp(-1.0, 1.0);
                place[axis] = reached.clamp(start[axis] - REACH_PX, start[axis] + REACH_PX);
            }
            if step[0].hypot(step[1]) < SETTLED_PX {
                break;
            }
        }
        (fit.x, fit.y) = (whole[0] + place[0], whole[1] + place[1]);
        fit
    }

    fn normal(&mut self, freedom: Freedom, place: [f64; 2]) -> FitEquations {
        let (width, height) = (self.image.width(), self.image.height());
        if freedom == Freedom::ShiftScaleTurn {
            self.by_scale.reshape(width, height);
            self.by_turn.reshape(width, height);
            // Scale and turn are about the middle of the reference at its present place.
            let centre = [(width, place[0]), (height, place[1])]
                .map(|(side, at)| ((side as f64 - 1.0) / 2.0 + at) as f32);
            for row in 0..height {
                let y = row as f32 - centre[1];
                let slopes = self.model.by_x.row(row).iter().zip(self.model.by_y.row(row));
                let changes = self.by_scale.row_mut(row).iter_mut().zip(self.by_turn.row_mut(row));
                for (column, ((scale, turn), (by_x, by_y))) in changes.zip(slopes).enumerate() {
                    let x = column as f32 - centre[0];
                    // d/ds T(s x, s y) = x T_x + y T_y and d/dphi T(R(phi) (x, y)) = x T_y - y T_x,
                    // at s = 1 and phi = 0.
                    *scale = x * by_x + y * by_y;
                    *turn = x * by_y - y * by_x;
                }
            }
        }
        let Sampled { value, by_x, by_y } = &self.model;
        let mut normal = match freedom {
            Freedom::Shift => {
                Arch::new().dispatch(Products([value, by_x, by_y, &self.image])).spread()
            }
            Freedom::ShiftScaleTurn => {
                let planes = [value, by_x, by_y, &self.by_scale, &self.by_turn, &self.image];
                Arch::new().dispatch(Products(planes))
            }
        };
        // J'J and J'r of the planes less their means, sum(ab) - sum(a) sum(b) / n: this eliminates
        // the unknown constant brightness.
        let count = (width * height) as f64;
        for i in 0..PLANES {
            for j in i..PLANES {
                let centred = normal.products[i][j] - normal.sums[i] * normal.sums[j] / count;
                normal.products[i][j] = centred;
                normal.products[j][i] = centred;
            }
        }
        normal
    }
}

/// Sums of the planes' samples and of the products of every pair of planes.
struct Products<'a, const N: usize>([&'a Plane; N]);

impl<const N: usize> WithSimd for Products<'_, N> {
    type Output = FitEquations;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> FitEquations {
        let mut normal = FitEquations::default();
        let planes = self.0.map(Plane::samples);
        for (i, one) in planes.iter().enumerate() {
            normal.sums[i] = sum(one);
            for (j, other) in planes.iter().enumerate().skip(i) {
                normal.products[i][j] = dot(one, other);
            }
        }
        normal
    }
}

impl FitEquations {
    /// Moves the sums of four planes to their places among six: model, slopes, nothing, nothing,
    /// image.
    fn spread(self) -> Self {
        let place = [0, 1, 2, 5];
        let mut spread = Self::default();
        for (i, &to) in place.iter().enumerate() {
            spread.sums[to] = self.sums[i];
            for (j, &other) in place.iter().enumerate() {
                spread.products[to][other] = self.products[i][j];
            }
        }
        spread
    }

    /// Solves the normal equations: returns the step of the place, and writes gain, residual
    /// variance and covariance before that step to `fit`. `None` if the image determines no step.
    fn solve(&self, options: FitOptions, fit: &mut Fit) -> Option<[f64; 2]> {
        let p = &self.products;
        let energy = p[0][0];
        if energy <= 0.0 || !energy.is_finite() {
            return None;
        }
        let mut normal = Matrix5::from_fn(|i, j| SIGNS[i] * SIGNS[j] * p[i][j]);
        let mut right = self.by_image();
        // Without scale and turn their rows are empty: any information there keeps the matrix
        // regular.
        let information = normal;
        let shift_only = options.freedom == Freedom::Shift;
        let stiff = if shift_only { energy } else { options.stiffness * energy };
        for i in 0..5 {
            normal[(i, i)] += LEAST_SHARE * normal.trace() + if i > 2 { stiff } else { 0.0 };
        }
        // A given contrast enters as a prior measurement of the gain.
        if let Some(contrast) = options.contrast {
            normal[(0, 0)] += KNOWN * energy;
            right[0] += KNOWN * energy * contrast;
        }
        let solved = normal.cholesky()?;
        let solution = solved.solve(&right);
        let gain = solution[0];
        fit.gain = gain;
        fit.residual_variance =
            self.residual_variance(&solution, &information, options, fit.pixels as f64);
        if gain <= 0.0 || !gain.is_finite() {
            return None;
        }
        // The block of (J'J)^-1 without the gain's row is what is left with the contrast unknown;
        // the unknowns are gain times each parameter, hence the gain's square.
        let mut inverse = solved.inverse().fixed_view::<4, 4>(1, 1) / gain.powi(2);
        if shift_only {
            inverse.fill_with_identity();
            inverse
                .fixed_view_mut::<2, 2>(0, 0)
                .copy_from(&(solved.inverse().fixed_view::<2, 2>(1, 1) / gain.powi(2)));
            inverse.fixed_view_mut::<2, 2>(2, 2).fill(0.0);
        } else {
            (fit.log_scale, fit.turn_rad) = (solution[3] / gain, solution[4] / gain);
        }
        // A variance that only the regularisation bounds means that the place is undetermined:
        // contrast explains the gradient along that axis as well.
        let tells = |i: usize| inverse[(i, i)] * gain.powi(2) * LEAST_SHARE * energy < 1e-3;
        fit.inverse = (tells(0) && tells(1)).then_some(inverse);
        let step = [solution[1] / gain, solution[2] / gain];
        (fit.inverse.is_some() && step.iter().all(|s| s.is_finite())).then_some(step)
    }

    /// J'r with the image r.
    fn by_image(&self) -> Vector5<f64> {
        Vector5::from_fn(|i, _| SIGNS[i] * self.products[i][5])
    }

    /// Residual sum of squares over the pixels less the fitted parameters and the mean.
    fn residual_variance(
        &self,
        solution: &Vector5<f64>,
        information: &Matrix5<f64>,
        options: FitOptions,
        pixels: f64,
    ) -> f64 {
        let parameters = if options.freedom == Freedom::Shift { 4.0 } else { 6.0 };
        let fitted = self.by_image();
        // With the image r the sum is r'r - 2 x'J'r + x'J'J x for any x, and r'r - x'J'r for that
        // of least squares, which it is not where the contrast is given.
        let (explained, parameters) = match options.contrast {
            Some(_) => (
                2.0 * solution.dot(&fitted) - (information * solution).dot(solution),
                parameters - 1.0,
            ),
            None => (solution.dot(&fitted), parameters),
        };
        ((self.products[5][5] - explained) / (pixels - parameters).max(1.0)).max(0.0)
    }
}

/// Signs of J's columns. The fit is linear in (gain, gain dx, gain dy, gain ds, gain dphi): image =
/// gain * (model - dx by_x - dy by_y - ds by_scale - dphi by_turn). They are negative because the
/// model moves against its slope.
const SIGNS: [f64; 5] = [1.0, -1.0, -1.0, -1.0, -1.0];

/// The sum of samples, in eight SIMD lanes.
#[inline(always)]
fn sum(samples: &[f32]) -> f64 {
    let mut lanes = [0.0_f32; 8];
    let (whole, rest) = samples.as_chunks::<8>();
    for eight in whole {
        for (lane, sample) in lanes.iter_mut().zip(eight) {
            *lane += sample;
        }
    }
    f64::from(lanes.iter().sum::<f32>() + rest.iter().sum::<f32>())
}

/// The sum of products, in eight SIMD lanes.
#[inline(always)]
fn dot(one: &[f32], other: &[f32]) -> f64 {
    let mut lanes = [0.0_f32; 8];
    let (ones, rest) = one.as_chunks::<8>();
    let (others, other_rest) = other.as_chunks::<8>();
    for (a, b) in ones.iter().zip(others) {
        for lane in 0..8 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    let tail: f32 = rest.iter().zip(other_rest).map(|(a, b)| a * b).sum();
    f64::from(lanes.iter().sum::<f32>() + tail)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Window;

    fn spot(width: usize, height: usize, x: f64, y: f64, scale: f64, turn: f64) -> Plane {
        Plane::from_fn(width, height, |column, row| {
            let (dx, dy) = ((column as f64 - x) / scale, (row as f64 - y) / scale);
            let (u, v) = (turn.cos() * dx + turn.sin() * dy, turn.cos() * dy - turn.sin() * dx);
            (10.0 + 5.0 * (-u * u / 8.0 - v * v / 5.0).exp()) as f32
        })
    }

    fn reference() -> Reference {
        Reference::new(spot(15, 13, 7.0, 6.0, 1.0, 0.0), Window::uniform(15, 13))
    }

    #[test]
    fn a_place_contrast_and_brightness_are_found_together() {
        let mut image = spot(60, 50, 30.3, 21.8, 1.0, 0.0);
        image.samples_mut().iter_mut().for_each(|s| *s = 0.7 * *s + 3.0);
        let fit = Fitter::default().fit(&image, &reference(), 23.0, 16.0, FitOptions::default());
        assert!((fit.x - 23.3).abs() < 0.01 && (fit.y - 15.8).abs() < 0.01, "{fit:?}");
        assert!((fit.gain - 0.7).abs() < 0.01 && fit.residual_variance < 1e-3, "{fit:?}");
    }

    #[test]
    fn residuals_of_a_contrast_that_is_given_are_those_of_that_contrast() {
        let mut image = spot(40, 40, 20.0, 20.0, 1.0, 0.0);
        image.samples_mut().iter_mut().for_each(|s| *s *= 0.7);
        let options = FitOptions { contrast: Some(1.0), ..FitOptions::default() };
        let fit = Fitter::default().fit(&image, &reference(), 13.4, 13.7, options);
        // By hand: three tenths of the spot are left, but for their mean, inside its edge.
        let spot: Vec<f64> = (-5..=5)
            .flat_map(|y| (-6..=6).map(move |x| (f64::from(x), f64::from(y))))
            .map(|(x, y)| 5.0 * (-x * x / 8.0 - y * y / 5.0).exp())
            .collect();
        let (count, mean) = (spot.len() as f64, spot.iter().sum::<f64>() / spot.len() as f64);
        let energy: f64 = spot.iter().map(|value| (value - mean).powi(2)).sum();
        // The model is a spline whose filter is cut off at five samples, which changes the model's
        // energy by half a percent, and these residuals by three times that.
        let expected = 0.09 * energy / (count - 3.0);
        assert!((fit.residual_variance / expected - 1.0).abs() < 0.02, "{fit:?}, {expected}");
    }

    #[test]
    fn size_and_angle_are_found_with_the_place() {
        let image = spot(60, 50, 30.3, 21.8, 1.05, 0.06);
        let options = FitOptions { freedom: Freedom::ShiftScaleTurn, ..FitOptions::default() };
        let fit = Fitter::default().fit(&image, &reference(), 23.0, 16.0, options);
        assert!((fit.x - 23.3).abs() < 0.02 && (fit.y - 15.8).abs() < 0.02, "{fit:?}");
        assert!(
            (fit.log_scale - 0.05).abs() < 0.01 && (fit.turn_rad - 0.06).abs() < 0.015,
            "{fit:?}"
        );
    }

    #[test]
    fn the_covariance_is_the_cramer_rao_bound() {
        // By hand: the inverse of the sum of the gradient's outer products. Mean and spot itself,
        // which are fitted as well, take nothing away: a symmetric spot's gradient is orthogonal to
        // both.
        let fit = Fitter::default().fit(
            &spot(40, 40, 20.0, 20.0, 1.0, 0.0),
            &reference(),
            13.0,
            14.0,
            FitOptions::default(),
        );
        let (mut xx, mut yy) = (0.0, 0.0);
        for row in -5..=5 {
            for column in -6..=6 {
                let (x, y) = (f64::from(column), f64::from(row));
                let value = 5.0 * (-x * x / 8.0 - y * y / 5.0).exp();
                xx += (value * x / 4.0).powi(2);
                yy += (value * y / 2.5).powi(2);
            }
        }
        let covariance = fit.covariance(2.0).unwrap();
        assert!((covariance[(0, 0)] * xx / 2.0 - 1.0).abs() < 0.05, "{covariance}");
        assert!((covariance[(1, 1)] * yy / 2.0 - 1.0).abs() < 0.05, "{covariance}");
    }

    #[test]
    fn a_flat_image_tells_no_place_and_nothing_moves() {
        let flat = Plane::from_fn(40, 40, |_, _| 5.0);
        let fit = Fitter::default().fit(&flat, &reference(), 11.0, 12.0, FitOptions::default());
        assert_eq!((fit.x, fit.y), (11.0, 12.0));
        let empty = Reference::new(flat.crop(0, 0, 9, 9), Window::uniform(9, 9));
        let image = spot(40, 40, 15.0, 15.0, 1.0, 0.0);
        let fit = Fitter::default().fit(&image, &empty, 11.0, 11.0, FitOptions::default());
        assert!(fit.covariance(1.0).is_none() && fit.x == 11.0);
    }
}
