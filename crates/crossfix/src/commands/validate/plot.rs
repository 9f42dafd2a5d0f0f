//! Tables as figures. Series with several values of x are drawn as curves; where each series has
//! one value, as with camera layouts, it is a row with a point. Our results are points with bars of
//! one standard error, the paper's figures crosses, and those of a independent implementation
//! circles.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

use anyhow::anyhow;
use crossfix_evaluation::{Table, TableRow};
use plotters::coord::Shift;
use plotters::prelude::*;

type PlotArea<'a> = DrawingArea<SVGBackend<'a>, Shift>;
type PlotFailure = Box<dyn std::error::Error>;

/// Width of a figure, px, and least height of one with curves.
const SIZE: (u32, u32) = (1200, 600);
/// Height of a row, or of a line of the legend, px.
const ROW: u32 = 18;
/// Space for title, axis and margins, px.
const FRAME: u32 = 110;
/// Approximate width of a letter in the small font, px.
const LETTER: usize = 7;
/// Positive figures that differ by more than this factor are drawn on a logarithmic axis. With
/// twice as much figures of 1 and 2 may lie a hundredth of the axis apart.
const WIDE: f64 = 50.0;

/// Colour of our figures.
const OURS: RGBColor = RGBColor(31, 90, 160);
/// Colour of the paper's figures.
const PAPER: RGBColor = RGBColor(200, 70, 20);
/// Colour of a independent implementation's figures.
const INDEPENDENT: RGBColor = RGBColor(30, 130, 60);

/// Draws a table into an SVG file.
pub fn draw(table: &Table, path: &Path) -> anyhow::Result<()> {
    let names: BTreeSet<&str> = table.rows.iter().map(|row| row.series.as_str()).collect();
    let drawn =
        if names.len() == table.rows.len() { rows(table, path) } else { curves(table, path) };
    drawn.map_err(|error| anyhow!("{error}"))
}

/// An axis that spans some figures, linear or logarithmic.
struct PlotAxis {
    is_logarithmic: bool,
    range: Range<f64>,
}

impl PlotAxis {
    fn of(values: impl Iterator<Item = f64>, may_be_logarithmic: bool) -> Self {
        let (low, high) = values
            .filter(|v| v.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        if low > high {
            return Self { is_logarithmic: false, range: 0.0..1.0 };
        }
        let is_logarithmic = may_be_logarithmic && low > 0.0 && high > WIDE * low;
        let (low, high) = if is_logarithmic { (low.log10(), high.log10()) } else { (low, high) };
        let margin = 0.05 * (high - low).max(1e-3 * high.abs()).max(1e-3);
        Self { is_logarithmic, range: (low - margin)..(high + margin) }
    }

    /// Position of a figure on the axis, clamped to its ends.
    fn place(&self, value: f64) -> f64 {
        let place = if self.is_logarithmic { value.max(f64::MIN_POSITIVE).log10() } else { value };
        place.clamp(self.range.start, self.range.end)
    }

    fn label(&self, place: f64) -> String {
        let value = if self.is_logarithmic { 10f64.powf(place) } else { place };
        let digits = if self.is_logarithmic { 2 } else { 4 };
        let rounded: f64 = format!("{value:.digits$e}").parse().unwrap_or(value);
        if rounded == 0.0 || (1e-3..1e6).contains(&rounded.abs()) {
            rounded.to_string()
        } else {
            format!("{rounded:e}")
        }
    }
}

/// All figures of a table: ours, the paper's and the independent one's.
fn figures(table: &Table) -> impl Iterator<Item = f64> {
    table.rows.iter().flat_map(|row| [Some(row.ours), row.paper, row.independent]).flatten()
}

/// A sheet with the table's title and, below it, a key to the marks.
fn sheet<'a>(
    table: &Table,
    path: &'a Path,
    height: u32,
    colour: fn(Mark) -> RGBColor,
) -> Result<PlotArea<'a>, PlotFailure> {
    let area = SVGBackend::new(path, (SIZE.0, height)).into_drawing_area();
    area.fill(&WHITE)?;
    let area = area.titled(&table.title, ("sans-serif", 20))?;
    let mut x = 16;
    let has =
        |figure: fn(&TableRow) -> Option<f64>| table.rows.iter().any(|row| figure(row).is_some());
    let marks = [
        ("ours", Mark::Ours, true),
        ("paper", Mark::Paper, has(|row| row.paper)),
        ("reference", Mark::Independent, has(|row| row.independent)),
    ];
    for (name, mark, _) in marks.into_iter().filter(|(.., is_there)| *is_there) {
        mark.draw_at(&area, (x, 8), colour(mark))?;
        area.draw(&Text::new(name, (x + 9, 2), ("sans-serif", 12)))?;
        x += 30 + (LETTER * name.len()) as i32;
    }
    Ok(area.margin(18, 8, 8, 12))
}

/// Origin of a figure.
#[derive(Clone, Copy)]
enum Mark {
    Ours,
    Paper,
    Independent,
}

impl Mark {
    fn colour(self) -> RGBColor {
        match self {
            Self::Ours => OURS,
            Self::Paper => PAPER,
            Self::Independent => INDEPENDENT,
        }
    }

    fn draw_at(
        self,
        area: &PlotArea<'_>,
        at: (i32, i32),
        colour: RGBColor,
    ) -> Result<(), PlotFailure> {
        match self {
            Self::Ours => area.draw(&Circle::new(at, 4, colour.filled()))?,
            Self::Paper => area.draw(&Cross::new(at, 4, colour.stroke_width(2)))?,
            Self::Independent => area.draw(&Circle::new(at, 5, colour.stroke_width(2)))?,
        }
        Ok(())
    }
}

/// Draws a row for each series, with its name in front.
fn rows(table: &Table, path: &Path) -> Result<(), PlotFailure> {
    let count = table.rows.len();
    let area = sheet(table, path, FRAME + ROW * count as u32, Mark::colour)?;
    let bars = table.rows.iter().flat_map(|row| {
        let low = row.ours - row.standard_error;
        // A bar that reaches 0 must not prevent a logarithmic axis.
        [if row.ours > 0.0 { low.max(row.ours / 4.0) } else { low }, row.ours + row.standard_error]
    });
    let axis = PlotAxis::of(figures(table).chain(bars), true);
    let longest = table.rows.iter().map(|row| row.series.chars().count()).max().unwrap_or(0);
    let mut chart = ChartBuilder::on(&area)
        .x_label_area_size(36)
        .y_label_area_size((LETTER * longest + 12) as u32)
        .build_cartesian_2d(axis.range.clone(), (count as f64 - 0.5)..-0.5)?;
    let name = |place: &f64| {
        table.rows.get(place.round() as usize).map_or_else(String::new, |row| row.series.clone())
    };
    chart
        .configure_mesh()
        .max_light_lines(0)
        .bold_line_style(BLACK.mix(0.15))
        .y_labels(2 * count)
        .y_label_formatter(&name)
        .x_label_formatter(&|place| axis.label(*place))
        .x_desc(table.y)
        .draw()?;
    for (index, row) in table.rows.iter().enumerate().filter(|(_, row)| row.ours.is_finite()) {
        let at = |value: f64| chart.backend_coord(&(axis.place(value), index as f64));
        let bar = [row.ours - row.standard_error, row.ours + row.standard_error].map(at);
        let whole = area.strip_coord_spec();
        let origin = area.get_base_pixel();
        let local = |(x, y): (i32, i32)| (x - origin.0, y - origin.1);
        whole.draw(&PathElement::new(bar.map(local), OURS.stroke_width(2)))?;
        let marks = [
            (Some(row.ours), Mark::Ours),
            (row.paper, Mark::Paper),
            (row.independent, Mark::Independent),
        ];
        for (value, mark) in marks.into_iter().filter_map(|(value, mark)| Some((value?, mark))) {
            mark.draw_at(&whole, local(at(value)), mark.colour())?;
        }
    }
    area.present()?;
    Ok(())
}

/// Draws a curve for each series, with a legend beside.
fn curves(table: &Table, path: &Path) -> Result<(), PlotFailure> {
    let mut series: BTreeMap<&str, Vec<&TableRow>> = BTreeMap::new();
    for row in &table.rows {
        series.entry(&row.series).or_default().push(row);
    }
    let height = SIZE.1.max(FRAME + ROW * series.len() as u32);
    // Colours distinguish the series, so the key to the marks is black.
    let area = sheet(table, path, height, |_| BLACK)?;
    let longest = series.keys().map(|name| name.chars().count()).max().unwrap_or(0);
    let legend_width = (LETTER * longest + 50) as u32;
    let (left, legend) = area.split_horizontally(SIZE.0.saturating_sub(20 + legend_width));
    let axis = PlotAxis::of(figures(table), true);
    let across = PlotAxis::of(table.rows.iter().map(|row| row.x), false);
    let mut chart = ChartBuilder::on(&left)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(across.range.clone(), axis.range.clone())?;
    chart
        .configure_mesh()
        .max_light_lines(0)
        .bold_line_style(BLACK.mix(0.15))
        .x_label_formatter(&|place| across.label(*place))
        .y_label_formatter(&|place| axis.label(*place))
        .x_desc(table.x)
        .y_desc(table.y)
        .draw()?;
    let count = series.len();
    for (index, (name, rows)) in series.into_iter().enumerate() {
        // Hues around the colour circle, every other one darker.
        let light = if index % 2 == 0 { 0.45 } else { 0.3 };
        let colour = HSLColor(index as f64 / count as f64, 0.75, light);
        let place = |value: f64, row: &TableRow| (row.x, axis.place(value));
        let ours = rows.iter().filter(|row| row.ours.is_finite()).map(|row| place(row.ours, row));
        chart.draw_series(LineSeries::new(ours, colour.stroke_width(2)).point_size(3))?;
        let papers = rows.iter().filter_map(|row| Some(place(row.paper?, row)));
        chart.draw_series(papers.map(|at| Cross::new(at, 5, colour.stroke_width(2))))?;
        let independents = rows.iter().filter_map(|row| Some(place(row.independent?, row)));
        chart.draw_series(independents.map(|at| Circle::new(at, 5, colour.stroke_width(2))))?;
        let y = (index as u32 * ROW) as i32 + 10;
        legend.draw(&PathElement::new([(10, y), (30, y)], colour.stroke_width(3)))?;
        legend.draw(&Text::new(name, (36, y - 6), ("sans-serif", 12)))?;
    }
    area.present()?;
    Ok(())
}
