//! What people and programs read: results on stdout, the last error on stderr.

use std::io::{self, Write};

use serde::Serialize;

/// Writes a line of the result. A reader that went away (`| head`) is no error.
pub fn line(text: impl std::fmt::Display) {
    let _ = writeln!(io::stdout().lock(), "{text}");
}

/// Writes a result as JSON.
pub fn json(value: &impl Serialize) -> anyhow::Result<()> {
    line(serde_json::to_string_pretty(value)?);
    Ok(())
}

/// Says why the command failed: the error and what it comes from, a line each.
pub fn error(error: &anyhow::Error) {
    let mut stderr = io::stderr().lock();
    let _ = writeln!(stderr, "error: {error}");
    for cause in error.chain().skip(1) {
        let _ = writeln!(stderr, "  because: {cause}");
    }
}

/// A number for a table, or a dash.
pub fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

/// Lines up the columns of a table; the first row is its head.
pub fn table(rows: &[Vec<String>]) -> String {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        rows.iter().filter_map(|r| r.get(column)).map(|c| c.chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let mut lines: Vec<String> = rows
        .iter()
        .map(|row| {
            let cells = row.iter().zip(&widths).enumerate();
            let cell = |(column, (text, &width)): (usize, (&String, &usize))| {
                if column == 0 { format!("{text:<width$}") } else { format!("{text:>width$}") }
            };
            cells.map(cell).collect::<Vec<_>>().join("  ").trim_end().to_owned()
        })
        .collect();
    if lines.len() > 1 {
        let total = widths.iter().sum::<usize>() + 2 * columns.saturating_sub(1);
        lines.insert(1, "-".repeat(total));
    }
    lines.join("\n")
}
