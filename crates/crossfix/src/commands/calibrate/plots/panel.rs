//! Parts that all panels use: frames, points, curves.

use std::ops::Range;

use plotters::coord::Shift;
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

pub type PanelArea<'a> = DrawingArea<SVGBackend<'a>, Shift>;
pub type Failure = Box<dyn std::error::Error>;
pub type Chart<'a, 'b> =
    ChartContext<'a, SVGBackend<'b>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Colour of a panel's first series: an image's x axis, or along the motion. A dark blue, which is
/// also told from the second where colours are not.
pub const FIRST: RGBColor = RGBColor(31, 90, 160);
/// Colour of a panel's second series: an image's y axis, or across the motion.
pub const SECOND: RGBColor = RGBColor(200, 70, 20);

/// Most points drawn of a series: the eye sees no more, and the file stays small. With half as many
/// a short excursion is more often skipped.
const MOST_POINTS: usize = 1500;

/// Title and axis labels of a panel.
pub struct PanelText<'a> {
    pub title: String,
    pub x: &'a str,
    pub y: &'a str,
}

/// The ranges that a panel shows.
pub struct Ranges {
    pub x: Range<f64>,
    pub y: Range<f64>,
}

/// A frame with axes and labels.
pub fn frame<'a, 'b>(
    area: &'a PanelArea<'b>,
    text: &PanelText<'_>,
    ranges: Ranges,
) -> Result<Chart<'a, 'b>, Failure> {
    let mut chart = ChartBuilder::on(area)
        .caption(&text.title, ("sans-serif", 15))
        .margin(10)
        .x_label_area_size(32)
        .y_label_area_size(48)
        .build_cartesian_2d(ranges.x, ranges.y)?;
    chart
        .configure_mesh()
        .max_light_lines(0)
        .bold_line_style(BLACK.mix(0.12))
        .x_desc(text.x)
        .y_desc(text.y)
        .draw()?;
    Ok(chart)
}

/// A panel with no data, and the reason.
pub fn nothing(area: &PanelArea<'_>, title: &str, why: &str) -> Result<(), Failure> {
    area.draw(&Text::new(title.to_owned(), (60, 12), ("sans-serif", 15)))?;
    area.draw(&Text::new(why.to_owned(), (60, 60), ("sans-serif", 13)))?;
    Ok(())
}

/// Every n-th of the points, so that there are not too many.
pub fn thinned<T: Copy>(points: &[T]) -> impl Iterator<Item = T> + '_ {
    points.iter().copied().step_by(points.len().div_ceil(MOST_POINTS).max(1))
}

/// Draws points.
pub fn dots(
    chart: &mut Chart<'_, '_>,
    points: impl Iterator<Item = (f64, f64)>,
    colour: RGBColor,
) -> Result<(), Failure> {
    let dot = |at| Circle::new(at, 1, colour.mix(0.5).filled());
    chart.draw_series(points.map(dot))?;
    Ok(())
}

/// Draws a curve.
pub fn curve(
    chart: &mut Chart<'_, '_>,
    points: impl Iterator<Item = (f64, f64)>,
    colour: RGBColor,
) -> Result<(), Failure> {
    chart.draw_series(LineSeries::new(points, colour.stroke_width(2)))?;
    Ok(())
}

/// Names of a panel's two series, each in its colour.
pub fn legend(area: &PanelArea<'_>, names: [&str; 2]) -> Result<(), Failure> {
    /// Width of a letter, px.
    const LETTER_PX: usize = 7;
    let mut x = 66;
    for (name, colour) in names.into_iter().zip([FIRST, SECOND]) {
        let style = ("sans-serif", 12).into_font().color(&colour);
        area.draw(&Text::new(name.to_owned(), (x, 34), style))?;
        x += (LETTER_PX * name.len()) as i32 + 24;
    }
    Ok(())
}

/// Range from the least to the greatest of some numbers.
pub fn span(values: impl Iterator<Item = f64>) -> Option<Range<f64>> {
    let (low, high) = values
        .filter(|value| value.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
    (low < high).then_some(low..high)
}
