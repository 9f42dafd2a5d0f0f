//! Accuracy of a single measurement (Herasymenko 2021, Fig. 5), beside the Cramer-Rao bound.

use crossfix_correlation::{FitOptions, Fitter, LowPass, LowPassMemory, Plane, Reference, Window};
use crossfix_simulation::{Silhouette, TEMPLATE_SIZES};

use super::ValidationOptions;
use super::runs::{self, Noise};
use super::table::{Limit, SampleStatistic, Table, TableRow, root_mean_square};

/// Margin of the reference, px. The widest low-pass, 0.9 px, reaches three pixels; with half of it
/// the reference's edge would act on the silhouette.
const MARGIN: usize = 3;
/// Width of the low-pass for a clean reference, px: without one the silhouettes' edges, which are
/// finer than a pixel, pull the fit towards whole pixels. With half of it that pull returns; with
/// twice as much the fit loses the sharp edges that the bound counts on.
const CLEAN_LOW_PASS: f32 = 0.45;
/// Number of fits here for each run of the tracker. With half of it standard errors are 1.4 times
/// as large.
const CHEAP: usize = 20;
/// The bound for noise of SD 1, x and y, px, for the sizes in their order: the errata's figures.
const ERRATA_BOUNDS: [[f64; 2]; 4] =
    [[0.195, 0.155], [0.255, 0.197], [0.281, 0.241], [0.502, 0.392]];

/// Half of the distance over which slopes are computed, px: below the eighth of a pixel of the
/// silhouette's own grid, so that half of it gives nearly the same.
const SLOPE_STEP: f64 = 0.05;

/// The Cramer-Rao bound for noise of SD 1: `sqrt(diag J^-1)`, J the sum of the gradient's outer
/// products, here with contrast and brightness known.
fn bound(silhouette: &Silhouette) -> [f64; 2] {
    let [width, height] = silhouette.sides().map(|side| side as i32 / 2 + 5);
    let half = silhouette.sides().map(|side| (side as f64 - 1.0) / 2.0);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for row in -height..=height {
        for column in -width..=width {
            let at = [f64::from(column) + half[0].fract(), f64::from(row) + half[1].fract()];
            let [gx, gy] =
                [[SLOPE_STEP, 0.0], [0.0, SLOPE_STEP]].map(|step| slope(silhouette, at, step));
            xx += gx * gx;
            xy += gx * gy;
            yy += gy * gy;
        }
    }
    let determinant = xx * yy - xy * xy;
    // Diagonal of the inverse of the 2 x 2 matrix.
    [(yy / determinant).sqrt(), (xx / determinant).sqrt()]
}

/// Slope of a silhouette at a place along a step of length `SLOPE_STEP`, 1/px.
fn slope(silhouette: &Silhouette, [x, y]: [f64; 2], [dx, dy]: [f64; 2]) -> f64 {
    let ahead = f64::from(silhouette.pixel(x + dx, y + dy));
    (ahead - f64::from(silhouette.pixel(x - dx, y - dy))) / (2.0 * SLOPE_STEP)
}

/// Width of the low-pass for a noisy reference, px: the more noise, the wider.
fn noisy_low_pass(sigma_n: f64) -> f32 {
    (0.75 + 0.5 * sigma_n) as f32
}

/// A picture of the silhouette, whose middle is off the picture's by (dx, dy).
fn picture(silhouette: &Silhouette, margin: usize, [dx, dy]: [f64; 2]) -> Plane {
    let [width, height] = silhouette.sides().map(|side| side + 2 * margin);
    let mut image = Plane::from_fn(width, height, |_, _| 0.0);
    let middle = [(width as f64 - 1.0) / 2.0 + dx, (height as f64 - 1.0) / 2.0 + dy];
    silhouette.draw(image.samples_mut(), width, middle, 1.0);
    image
}

/// The error of one fit, px, after the low-pass, and the contrast that was fitted or given.
fn error(
    image: &Plane,
    reference: &Plane,
    low_pass: f32,
    contrast: Option<f64>,
    offset: [f64; 2],
) -> ([f64; 2], f64) {
    let mut smooth = Plane::default();
    LowPass::new(low_pass).apply(reference, &mut LowPassMemory::default(), &mut smooth);
    let window = Window::uniform(reference.width(), reference.height());
    let reference = Reference::new(smooth, window);
    // The image's margin is two pixels wider than the reference's.
    let start = 2.0;
    let options = FitOptions { steps: 6, contrast, ..FitOptions::default() };
    let fit = Fitter::default().fit(image, &reference, start, start, options);
    ([fit.x - start - offset[0], fit.y - start - offset[1]], fit.gain)
}

/// The largest error on an axis without noise, over the target's phases within a pixel.
fn worst_bias(silhouette: &Silhouette, axis: usize) -> f64 {
    // 20 x 20 phases, a twentieth of a pixel apart.
    let phases = (0..400)
        .map(|phase| [(phase % 20) as f64 / 20.0 - 0.475, (phase / 20) as f64 / 20.0 - 0.475]);
    phases.map(|phase| bias(silhouette, phase)[axis].abs()).fold(0.0, f64::max)
}

/// The error of a fit without noise to a target at a phase within a pixel, px.
fn bias(silhouette: &Silhouette, phase: [f64; 2]) -> [f64; 2] {
    let image = picture(silhouette, MARGIN + 2, phase);
    let reference = picture(silhouette, MARGIN, [0.0; 2]);
    error(&image, &reference, CLEAN_LOW_PASS, None, phase).0
}

/// The errors of fits to pictures at random phases, less the bias at that phase, which has a row of
/// its own.
fn fits(
    options: ValidationOptions,
    silhouette: &Silhouette,
    sigma_n: f64,
    noisy: bool,
) -> Vec<[f64; 2]> {
    runs::all(CHEAP * options.runs, |run| {
        unbiased_error(silhouette, sigma_n, noisy, Noise::new(options.seed, run))
    })
}

/// The error of one fit to pictures at a random phase, less the bias at that phase.
fn unbiased_error(
    silhouette: &Silhouette,
    sigma_n: f64,
    noisy: bool,
    mut noise: Noise,
) -> [f64; 2] {
    let offset = [noise.uniform() - 0.5, noise.uniform() - 0.5];
    let clean = [picture(silhouette, MARGIN + 2, offset), picture(silhouette, MARGIN, [0.0; 2])];
    let [mut image, mut reference] = clean.clone();
    noise.add_to(image.samples_mut(), sigma_n as f32);
    if noisy {
        noise.add_to(reference.samples_mut(), sigma_n as f32);
    }
    let low_pass = if noisy { noisy_low_pass(sigma_n) } else { CLEAN_LOW_PASS };
    // The contrast is given, as the bound assumes it known.
    let (bias, contrast) = error(&clean[0], &clean[1], low_pass, None, offset);
    let ([x, y], _) = error(&image, &reference, low_pass, Some(contrast), offset);
    [x - bias[0], y - bias[1]]
}

/// The axes' names, in their order.
const AXES: [&str; 2] = ["x", "y"];

/// Rows of the three tables.
#[derive(Default)]
struct PositioningRows {
    accuracy: Vec<TableRow>,
    ratios: Vec<TableRow>,
    bias: Vec<TableRow>,
}

impl PositioningRows {
    /// Adds the rows of a silhouette.
    fn add(&mut self, options: ValidationOptions, silhouette: &Silhouette, errata: [f64; 2]) {
        let (sides, bound) = (silhouette.sides(), bound(silhouette));
        for sigma_n in [0.1, 0.2, 0.3] {
            for noisy in [false, true] {
                let errors = fits(options, silhouette, sigma_n, noisy);
                for axis in 0..2 {
                    let errors: Vec<f64> = errors.iter().map(|e| e[axis]).collect();
                    let kind = if noisy { "noisy reference" } else { "clean reference" };
                    let series = format!("{}, {kind}", name(silhouette, axis));
                    let figure = root_mean_square(&errors);
                    self.accuracy.push(accuracy(&series, sigma_n, figure, sides[axis]));
                    self.ratios.push(over_bound(series, sigma_n, figure, bound[axis], noisy));
                }
            }
        }
        for axis in 0..2 {
            let name = name(silhouette, axis);
            let near = Limit::Near { value: errata[axis], tolerance: 0.02 * errata[axis] };
            let exact = SampleStatistic::exact(bound[axis]);
            self.ratios.push(TableRow::new(format!("bound {name}"), 1.0, exact).limit(near));
            let worst = SampleStatistic::exact(worst_bias(silhouette, axis));
            self.bias.push(TableRow::new(name, 0.0, worst).limit(Limit::AtMost(0.01)));
        }
    }
}

/// Name of an axis of a silhouette.
fn name(silhouette: &Silhouette, axis: usize) -> String {
    let [width, height] = silhouette.sides();
    format!("{width}x{height} {}", AXES[axis])
}

/// Row of the normalised error, 2 sigma over the side (Herasymenko 2021, eq. 16). The paper claims
/// it to be below a pixel.
fn accuracy(series: &str, sigma_n: f64, error: SampleStatistic, side: usize) -> TableRow {
    let normalised = 2.0 / side as f64;
    let ours = SampleStatistic {
        value: error.value * normalised,
        standard_error: error.standard_error * normalised,
    };
    TableRow::new(series, sigma_n, ours)
}

/// Row of the error over the bound, which is that for noise of SD 1.
fn over_bound(
    series: String,
    sigma_n: f64,
    error: SampleStatistic,
    bound: f64,
    noisy: bool,
) -> TableRow {
    // Two noisy pictures determine their offset root 2 less well than one noisy and one clean.
    let best = bound * sigma_n * if noisy { std::f64::consts::SQRT_2 } else { 1.0 };
    let asked = Limit::AtMost(if noisy { 1.35 } else { 1.10 });
    let ours =
        SampleStatistic { value: error.value / best, standard_error: error.standard_error / best };
    TableRow::new(series, sigma_n, ours).limit(asked)
}

/// Fig. 5 with clean and noisy reference, and the bias over the phases of a pixel.
pub(super) fn tables(options: ValidationOptions) -> Vec<Table> {
    let mut rows = PositioningRows::default();
    for (size, errata) in TEMPLATE_SIZES.into_iter().zip(ERRATA_BOUNDS) {
        rows.add(options, &Silhouette::new(size[0], size[1]), errata);
    }
    let PositioningRows { accuracy, ratios, bias } = rows;
    let table = |name, title: &str, x, y, rows| Table { name, title: title.to_owned(), x, y, rows };
    vec![
        table(
            "figure-5",
            "Normalised positioning error 2 sigma / side (Herasymenko 2021, Fig. 5)",
            "sigma_n",
            "",
            accuracy,
        ),
        table(
            "bound",
            "Error of the fit alone, contrast known, over the Cramer-Rao bound",
            "sigma_n",
            "ratio",
            ratios,
        ),
        table("bias", "Largest bias over the phases of a pixel", "", "px", bias),
    ]
}
