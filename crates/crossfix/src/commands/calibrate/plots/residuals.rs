//! Residuals of the labels from the target's fitted trajectory: over time, along its motion, and as
//! noise statistics.

use crossfix_calibration::{CameraResult, FittedLabel};
use plotters::prelude::*;

use super::panel::{
    FIRST, Failure, PanelArea, PanelText, Ranges, SECOND, curve, dots, frame, legend, nothing,
    span, thinned,
};

/// Residuals up to this many SDs are shown: larger ones belong to something else, and are counted.
/// With half of it one good label in forty would be counted, too.
const SHOWN: f64 = 5.0;
/// A target that moves more slowly in the image shows nothing of clocks, pixels/s. With half of
/// it an error of one pixel would be drawn as 100 ms instead of 50.
const LEAST_MOTION_PX_PER_S: f64 = 20.0;
/// Medians are computed over this time, s: errors of labels are correlated for up to a second or
/// two. With half of it successive medians share errors, which look like a clock that wanders.
const BLOCK_S: f64 = 3.0;
/// Bars of a histogram. With half as many each would be 0.4 SDs wide.
const BARS: usize = 50;
/// Correlations are shown up to the longest time for which errors of labels may be correlated, s.
/// With half of it one that lasts this long looks as if it never ended.
const LONGEST_LAG_S: f64 = 3.0;
/// Number of lags at which the correlation is estimated. With half as many a correlation that lasts
/// for less than 0.15 s would not show.
const LAGS: usize = 40;

/// The residuals of both axes, over the camera's own time.
pub fn over_time(camera: &CameraResult, area: &PanelArea<'_>) -> Result<(), Failure> {
    let shown = SHOWN * camera.noise.sd_px();
    let beyond = camera.fitted.iter().filter(|label| label.beside_px.amax() > shown).count();
    let title = format!("{}: labels beside the way ({beyond} farther off)", camera.name);
    let Some(time) = span(camera.fitted.iter().map(|label| label.own_time_s)) else {
        return nothing(area, &title, "too few labels");
    };
    let text = PanelText { title, x: "its own time [s]", y: "px" };
    let mut chart = frame(area, &text, Ranges { x: time, y: -shown..shown })?;
    for (axis, colour) in [(0, FIRST), (1, SECOND)] {
        let points = thinned(&camera.fitted).map(|label| (label.own_time_s, label.beside_px[axis]));
        dots(&mut chart, points.filter(|(_, px)| px.abs() < shown), colour)?;
    }
    legend(area, ["right of it", "below it"])
}

/// Shows clock errors: how far labels lie ahead along the target's motion, in time, beside how far
/// they lie across it, which no clock error explains.
pub fn along_and_across(camera: &CameraResult, area: &PanelArea<'_>) -> Result<(), Failure> {
    let title = "along and across the motion, medians of 3 s".to_owned();
    let along = medians(&camera.fitted, FittedLabel::ahead_s);
    let across = medians(&camera.fitted, FittedLabel::across_s);
    let Some(time) = span(along.iter().map(|(time_s, _)| *time_s)) else {
        return nothing(area, &title, "the target hardly moves in the image");
    };
    let mut sizes: Vec<f64> = along.iter().chain(&across).map(|(_, ms)| ms.abs()).collect();
    sizes.sort_unstable_by(f64::total_cmp);
    // The scale leaves out the largest fiftieth, which a turn or another object causes.
    let shown = (1.3 * sizes[(sizes.len() - 1) * 49 / 50]).max(1.0);
    let text = PanelText { title, x: "its own time [s]", y: "ms" };
    let mut chart = frame(area, &text, Ranges { x: time, y: -shown..shown })?;
    for (points, colour) in [(along, FIRST), (across, SECOND)] {
        let points = points.into_iter().filter(|(_, ms)| ms.abs() < shown);
        chart.draw_series(points.map(|at| Circle::new(at, 2, colour.filled())))?;
    }
    legend(area, ["ahead along it: a clock", "across it: no clock"])
}

/// The medians over blocks of time, ms, of what a function says of the labels that move.
fn medians(
    labels: &[FittedLabel],
    time_of: fn(&FittedLabel, f64) -> Option<f64>,
) -> Vec<(f64, f64)> {
    let moving: Vec<(f64, f64)> = labels
        .iter()
        .filter_map(|label| Some((label.own_time_s, 1e3 * time_of(label, LEAST_MOTION_PX_PER_S)?)))
        .collect();
    let block = |(time_s, _): &(f64, f64)| (time_s / BLOCK_S).floor();
    moving.chunk_by(|a, b| block(a) == block(b)).filter_map(median_of).collect()
}

/// The middle time and median value of a block.
fn median_of(block: &[(f64, f64)]) -> Option<(f64, f64)> {
    let mut values: Vec<f64> = block.iter().map(|(_, value)| *value).collect();
    values.sort_unstable_by(f64::total_cmp);
    Some((block.get(block.len() / 2)?.0, values[values.len() / 2]))
}

/// Histogram of the residuals of both axes in SDs, with the normal curve that they are assumed to
/// follow.
pub fn histogram(camera: &CameraResult, area: &PanelArea<'_>) -> Result<(), Failure> {
    let noise = camera.noise;
    let title = format!("in deviations of {:.2} px, and a normal curve", noise.sd_px());
    let width = 2.0 * SHOWN / BARS as f64;
    let mut bars = [0.0; BARS];
    // A density: a bar's area is its share of all residuals, of which each label has two.
    let share = 0.5 / camera.fitted.len().max(1) as f64;
    for label in &camera.fitted {
        for axis in [0, 1] {
            let place = (label.beside_px[axis] / noise.sd_px() + SHOWN) / width;
            if let Some(bar) = bars.get_mut(place.max(0.0) as usize).filter(|_| place >= 0.0) {
                *bar += share / width;
            }
        }
    }
    let normal = |x: f64| (-x * x / 2.0).exp() / std::f64::consts::TAU.sqrt();
    let most = bars.iter().copied().fold(normal(0.0), f64::max);
    let text = PanelText { title, x: "deviations", y: "density" };
    let mut chart = frame(area, &text, Ranges { x: -SHOWN..SHOWN, y: 0.0..1.1 * most })?;
    let low = |bar: usize| bar as f64 * width - SHOWN;
    chart.draw_series(bars.iter().enumerate().map(|(bar, height)| {
        Rectangle::new([(low(bar), 0.0), (low(bar + 1), *height)], FIRST.mix(0.4).filled())
    }))?;
    curve(&mut chart, (0..=BARS).map(|bar| (low(bar), normal(low(bar)))), SECOND)
}

/// Autocorrelation of the labels' errors over the time between them, with the fitted noise model.
pub fn autocorrelation(camera: &CameraResult, area: &PanelArea<'_>) -> Result<(), Failure> {
    let noise = camera.noise;
    let title = format!(
        "two labels err alike: new each time {:.2} px, lasting {:.2} px for {:.2} s",
        noise.white_px, noise.lasting_px, noise.lasting_s
    );
    let within = |label: &&FittedLabel| label.beside_px.amax() < SHOWN * noise.sd_px();
    let labels: Vec<FittedLabel> = camera.fitted.iter().filter(within).copied().collect();
    let step_s = (LONGEST_LAG_S / LAGS as f64).max(camera.frame_s);
    let (mut products, mut counts) = ([0.0; LAGS], [0_u32; LAGS]);
    let (mut squares, mut count) = (0.0, 0_u32);
    for (first, label) in labels.iter().enumerate() {
        squares += label.beside_px.norm_squared();
        count += 1;
        for other in &labels[first + 1..] {
            let lag = ((other.own_time_s - label.own_time_s) / step_s).round() as usize;
            if lag >= LAGS {
                break;
            }
            // Residuals are two-dimensional: the correlation is mean(r1 . r2) / mean(|r|^2).
            products[lag] += label.beside_px.dot(&other.beside_px);
            counts[lag] += 1;
        }
    }
    let variance = squares / f64::from(count.max(1));
    let text = PanelText { title, x: "time between them [s]", y: "correlation" };
    let longest_s = step_s * LAGS as f64;
    let mut chart = frame(area, &text, Ranges { x: 0.0..longest_s, y: -0.3..1.0 })?;
    let found = (1..LAGS)
        .filter(|lag| counts[*lag] > 0)
        .map(|lag| (lag as f64 * step_s, products[lag] / f64::from(counts[lag]) / variance));
    chart.draw_series(found.map(|at| Circle::new(at, 3, FIRST.filled())))?;
    let model = (1..=LAGS).map(|lag| lag as f64 * step_s).map(|s| (s, noise.correlation(s)));
    curve(&mut chart, model, SECOND)?;
    legend(area, ["found", "taken for"])
}
