//! Tables as figures: ours as lines with points, the paper's as crosses, a reference
//! implementation's as circles.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::anyhow;
use crossfix_evaluation::Table;
use plotters::prelude::*;

const SIZE: (u32, u32) = (960, 600);

/// Draws a table into an SVG file.
pub fn draw(table: &Table, path: &Path) -> anyhow::Result<()> {
    draw_on(table, path).map_err(|error| anyhow!("{error}"))
}

fn draw_on(table: &Table, path: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let area = SVGBackend::new(path, SIZE).into_drawing_area();
    area.fill(&WHITE)?;
    let range = |values: &mut dyn Iterator<Item = f64>| {
        let (low, high) = values
            .filter(|v| v.is_finite())
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)));
        let margin = 0.05 * (high - low).max(1e-3);
        (low - margin)..(high + margin)
    };
    let x = range(&mut table.rows.iter().map(|row| row.x));
    let y =
        range(&mut table.rows.iter().flat_map(|row| [Some(row.ours), row.paper, row.reference]).flatten());
    let mut chart = ChartBuilder::on(&area)
        .caption(&table.title, ("sans-serif", 20))
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(x, y)?;
    chart.configure_mesh().x_desc(table.x).y_desc(table.y).draw()?;

    let mut series: BTreeMap<&str, Vec<(f64, f64)>> = BTreeMap::new();
    for row in &table.rows {
        series.entry(&row.series).or_default().push((row.x, row.ours));
    }
    for (index, (name, points)) in series.into_iter().enumerate() {
        let colour = Palette99::pick(index).to_rgba();
        chart
            .draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)).point_size(3))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], colour.stroke_width(2)));
        let rows = || table.rows.iter().filter(|row| row.series == name);
        let papers = rows().filter_map(|row| row.paper.map(|paper| (row.x, paper)));
        chart.draw_series(papers.map(|place| Cross::new(place, 5, colour.stroke_width(2))))?;
        let references = rows().filter_map(|row| row.reference.map(|reference| (row.x, reference)));
        chart.draw_series(references.map(|place| Circle::new(place, 5, colour.stroke_width(2))))?;
    }
    chart
        .configure_series_labels()
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .label_font(("sans-serif", 12))
        .draw()?;
    area.present()?;
    Ok(())
}
