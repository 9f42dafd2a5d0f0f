//! A drone's log as people have it.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use crossfix_calibration::{FlightLog, LogErrors, LogSample};
use nalgebra::Point3;

/// What wrote a log, and so how good it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum LogKind {
    /// Real-time kinematic: centimetres.
    Rtk,
    /// With corrections: decimetres.
    Dgps,
    /// A consumer's receiver: metres, and alike for minutes.
    Consumer,
}

impl LogKind {
    /// What is wrong of its samples.
    pub fn errors(self) -> LogErrors {
        let (sd_m, drift_sd_m) = match self {
            Self::Rtk => (0.02, 0.02),
            Self::Dgps => (0.3, 0.5),
            Self::Consumer => (1.5, 2.0),
        };
        LogErrors { sd_m, drift_sd_m, drift_time_s: 200.0 }
    }
}

/// Reads a CSV with the columns `time_s,east_m,north_m,up_m`, whatever others there are.
pub fn read(path: &Path, errors: LogErrors) -> anyhow::Result<FlightLog> {
    let wrong = || format!("cannot read the log {}", path.display());
    let mut reader =
        csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).with_context(wrong)?;
    let head = reader.headers().with_context(wrong)?.clone();
    let column = |name: &str| head.iter().position(|column| column == name);
    let columns = ["time_s", "east_m", "north_m", "up_m"].map(|name| (name, column(name)));
    if let Some((missing, _)) = columns.iter().find(|(_, column)| column.is_none()) {
        bail!(
            "the log {} has no column `{missing}`: it needs time_s, east_m, north_m and up_m",
            path.display()
        );
    }
    let columns = columns.map(|(_, column)| column.unwrap_or_default());
    let mut samples = Vec::new();
    for (row, record) in reader.records().enumerate() {
        let record = record.with_context(wrong)?;
        let number =
            |column: usize| record.get(column)?.parse::<f64>().ok().filter(|n| n.is_finite());
        let [time_s, east, north, up] = columns.map(number);
        let (Some(time_s), Some(east), Some(north), Some(up)) = (time_s, east, north, up) else {
            bail!("the log {}, row {}: not four numbers", path.display(), row + 2);
        };
        samples.push(LogSample { time_s, position: Point3::new(east, north, up) });
    }
    ensure!(!samples.is_empty(), "the log {} has no rows", path.display());
    samples.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    samples.dedup_by(|a, b| a.time_s == b.time_s);
    Ok(FlightLog { samples, errors })
}
