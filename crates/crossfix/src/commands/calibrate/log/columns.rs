//! Logs in table columns.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use crossfix_geometry::Geodetic;
use csv::StringRecord;
use nalgebra::Point3;

use super::{Above, LogPlace, LogRow};

/// Columns of a log in metres from the site's origin, by their names in the table's head.
const LOCAL: [&str; 4] = ["time_s", "east_m", "north_m", "up_m"];
/// Columns of a log in WGS84 degrees and metres of height. Where a table has both forms, that in
/// metres is read.
const GEODETIC: [&str; 4] = ["time_s", "latitude_deg", "longitude_deg", "height_m"];

/// Reads the columns of either form and ignores all others.
pub(super) fn read(path: &Path) -> anyhow::Result<Vec<LogRow>> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path)?;
    let head = reader.headers()?.clone();
    let (columns, is_geodetic) = match (columns(&head, LOCAL), columns(&head, GEODETIC)) {
        (Some(local), _) => (local, false),
        (None, Some(geodetic)) => (geodetic, true),
        (None, None) => bail!(
            "it has the columns {}: it needs {}, or {}",
            head.iter().collect::<Vec<_>>().join(", "),
            LOCAL.join(", "),
            GEODETIC.join(", ")
        ),
    };
    let mut rows = Vec::new();
    for (index, record) in reader.records().enumerate() {
        let record = record?;
        let row = csv_row(&record, columns, is_geodetic);
        rows.push(row.with_context(|| format!("row {}", index + 2))?);
    }
    ensure!(!rows.is_empty(), "it has no rows");
    Ok(rows)
}

/// The places of four columns in a head, if it has them all.
fn columns(head: &StringRecord, names: [&str; 4]) -> Option<[usize; 4]> {
    let found = names.map(|name| head.iter().position(|column| column == name));
    let [Some(time), Some(x), Some(y), Some(z)] = found else { return None };
    Some([time, x, y, z])
}

fn csv_row(
    record: &StringRecord,
    columns: [usize; 4],
    is_geodetic: bool,
) -> anyhow::Result<LogRow> {
    let number = |column: usize| record.get(column)?.parse::<f64>().ok().filter(|n| n.is_finite());
    let [Some(time_s), Some(x), Some(y), Some(z)] = columns.map(number) else {
        bail!("not four numbers");
    };
    let place = if is_geodetic {
        LogPlace::Geodetic { place: Geodetic::from_degrees(x, y, z)?, above: Above::Unsaid }
    } else {
        LogPlace::Local(Point3::new(x, y, z))
    };
    Ok(LogRow { time_s, place })
}
