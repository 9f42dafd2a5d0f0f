//! Tables as text.

use std::fmt::Write;

use crossfix_evaluation::{Limit, Table, Verdict};

fn limit(limit: Option<Limit>) -> String {
    match limit {
        None => String::new(),
        Some(Limit::AtMost(most)) => format!("<= {}", short(most)),
        Some(Limit::AtLeast(least)) => format!(">= {}", short(least)),
        Some(Limit::Between(least, most)) => format!("{} to {}", short(least), short(most)),
        Some(Limit::Near { value, tolerance }) => {
            format!("{} +- {}", short(value), short(tolerance))
        }
    }
}

/// A figure with four digits, or as a power of ten where there are too many.
fn short(value: f64) -> String {
    if value.abs() >= 1e7 {
        return format!("{value:.0e}");
    }
    let digits =
        if value == 0.0 { 0 } else { (3 - value.abs().log10().floor() as i32).clamp(0, 6) };
    let text = format!("{value:.*}", digits as usize);
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

/// One table as text.
pub fn table(table: &Table) -> String {
    let mut text = format!("\n{}\n", table.title);
    let width = table.rows.iter().map(|row| row.series.len()).max().unwrap_or(0).max(6);
    let has_independent = table.rows.iter().any(|row| row.independent.is_some());
    let independent =
        |cell: &str| if has_independent { format!("{cell:>9} ") } else { String::new() };
    let _ = writeln!(
        text,
        "{:width$} {:>12} {:>9} {}{:>9} {:>8}  {:16} {}",
        "",
        table.x,
        "paper",
        independent("reference"),
        "ours",
        "+-",
        "asked",
        table.y
    );
    for row in &table.rows {
        let verdict = match row.verdict() {
            Verdict::Pass => "pass",
            Verdict::Fail => "FAIL",
            Verdict::Information => "",
        };
        let _ = writeln!(
            text,
            "{:width$} {:>12} {:>9} {}{:>9} {:>8}  {:16} {}",
            row.series,
            short(row.x),
            row.paper.map_or(String::new(), short),
            independent(&row.independent.map_or(String::new(), short)),
            short(row.ours),
            short(row.standard_error),
            limit(row.limit),
            verdict
        );
    }
    text
}

/// A sentence on how many figures are within their limits.
pub fn summary(tables: &[Table]) -> String {
    let rows = || tables.iter().flat_map(|table| &table.rows);
    let asked = rows().filter(|row| row.verdict() != Verdict::Information).count();
    if asked == 0 {
        return format!("{} figures, of which nothing is asked", rows().count());
    }
    let failed = rows().filter(|row| row.verdict() == Verdict::Fail).count();
    format!(
        "{} of {asked} figures are what they must be ({} figures in all)",
        asked - failed,
        rows().count()
    )
}
