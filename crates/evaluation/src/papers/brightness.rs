//! The brightness of one pixel by the interacting multiple models and by exponential smoothing
//! (Solonar 2023, Fig. 4 to 6).

use crossfix_vision::{ImmConfig, PixelImm};

use super::ValidationOptions;
use super::runs::{self, Noise};
use super::table::{Limit, SampleStatistic, Table, TableRow, mean};

/// Number of frames of an experiment. At the lowest rate of jumps, 0.1 per second, a run has four;
/// with half of it two, so that the errors scatter more.
const FRAMES: usize = 1000;
/// Interval of the frames, s. With half of it a run has half as many jumps.
const INTERVAL: f64 = 0.04;
/// Weight of the old value in exponential smoothing. It divides the variance of the noise by 19,
/// half of it by 2.6, which would give another ratio than the paper's.
const MEMORY: f64 = 0.9;
/// Number of runs for each run of the tracker. With half of it standard errors are 1.4 times as
/// large.
const CHEAP: usize = 2;

/// Parameters of an experiment: rate of the brightness jumps, 1/s; SD of the jumps and of the
/// noise, levels.
#[derive(Clone, Copy)]
struct JumpCase {
    rate: f64,
    jump: f64,
    noise: f64,
}

/// Mean absolute errors (Solonar 2023, eqs. 17-19) of the filter and of the smoothing in one run.
fn errors(seed: u64, run: usize, cell: JumpCase) -> [f64; 2] {
    let mut random = Noise::new(seed, run);
    let mut truth = 128.0;
    let first = truth + cell.noise * random.normal();
    let variance = (cell.noise * cell.noise) as f32;
    let mut filter = PixelImm::new(ImmConfig::default(), &[first as f32], variance);
    let (mut smoothed, mut sums) = (first, [0.0; 2]);
    for _ in 0..FRAMES {
        // Jumps come at random: the probability of one within a frame is rate * interval.
        if random.uniform() < cell.rate * INTERVAL {
            truth = (truth + cell.jump * random.normal()).clamp(0.0, 255.0);
        }
        let measured = truth + cell.noise * random.normal();
        let mut filtered = [0.0];
        filter.step(&[measured as f32], 1.0, variance, &mut filtered);
        smoothed = MEMORY * smoothed + (1.0 - MEMORY) * measured;
        sums[0] += (f64::from(filtered[0]) - truth).abs();
        sums[1] += (smoothed - truth).abs();
    }
    sums.map(|sum| sum / FRAMES as f64)
}

/// Fig. 4 to 6: errors and their ratio.
pub(super) fn tables(options: ValidationOptions) -> Vec<Table> {
    let (mut rows, mut ratios) = (Vec::new(), Vec::new());
    // The claimed ratios: 2.14 to 3.21 at sigma_w 5, 1.53 to 2.17 at 15, for lambda 0.1 to 0.9.
    for (noise, jump, claimed) in
        [(5.0, 60.0, [2.14, 3.21]), (5.0, 30.0, [2.14, 3.21]), (15.0, 60.0, [1.53, 2.17])]
    {
        for rate in [0.1, 0.3, 0.5, 0.7, 0.9] {
            let cell = JumpCase { rate, jump, noise };
            let samples = runs::all(CHEAP * options.runs, |run| errors(options.seed, run, cell));
            let of = |i: usize| mean(&samples.iter().map(|s| s[i]).collect::<Vec<_>>());
            let (filter, smoothing) = (of(0), of(1));
            let name = format!("sigma_w {noise}, jumps {jump}");
            // The figures of docs/papers.md.
            let asked = match (noise as u32, jump as u32, (rate * 10.0).round() as u32) {
                (5, 60, 1) => Some(0.70),
                (5, 60, 9) => Some(1.47),
                _ => None,
            };
            let row = TableRow::new(format!("IMM, {name}"), rate, filter);
            rows.push(TableRow {
                limit: asked.map(|value| Limit::Near { value, tolerance: 0.1 * value }),
                ..row
            });
            rows.push(TableRow::new(format!("smoothing, {name}"), rate, smoothing));
            let ratio = smoothing.value / filter.value;
            // The relative variances of a quotient's parts add up.
            let relative = relative_error(filter).hypot(relative_error(smoothing));
            let ours = SampleStatistic { value: ratio, standard_error: ratio * relative };
            let row = TableRow::new(name, rate, ours);
            let paper = (rate == 0.1).then_some(claimed[0]).or((rate == 0.9).then_some(claimed[1]));
            let limit = asked.map(|_| Limit::AtLeast(3.0));
            ratios.push(TableRow { paper, limit, ..row });
        }
    }
    vec![
        table(
            "brightness",
            "Error of a pixel's brightness (Solonar 2023, Fig. 4 to 6)",
            "levels",
            rows,
        ),
        table("brightness-ratio", "Smoothing's error over the IMM's", "ratio", ratios),
    ]
}

fn relative_error(of: SampleStatistic) -> f64 {
    of.standard_error / of.value
}

fn table(name: &'static str, title: &str, y: &'static str, rows: Vec<TableRow>) -> Table {
    Table { name, title: title.to_owned(), x: "lambda, 1/s", y, rows }
}
