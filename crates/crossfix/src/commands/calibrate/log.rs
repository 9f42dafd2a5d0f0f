//! A drone's log as people have it.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use crossfix_calibration::{FlightLog, LogErrors, LogSample};
use crossfix_geometry::{Geodetic, LocalFrame};
use csv::StringRecord;
use nalgebra::Point3;
use time::OffsetDateTime;

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

/// What a log's times are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum LogTime {
    /// As they are in the file, UTC where that matters.
    #[value(alias = "utc")]
    File,
    /// GPS's.
    Gps,
}

/// How a log's times and places are to be read.
#[derive(Clone, Copy, Debug)]
pub struct Reading {
    pub errors: LogErrors,
    /// Where the site's origin is; the log's first place without.
    pub anchor: Option<Geodetic>,
    /// Whether its times are GPS's.
    pub is_gps_time: bool,
    /// How far the receiver is above what cameras see as the target's middle, m.
    pub antenna_m: f64,
}

/// GPS counts no leap seconds: since 2017 it has been ahead of UTC by this, s.
const GPS_AHEAD_S: f64 = 18.0;

/// A sample as it is in the file.
#[derive(Clone, Copy, Debug)]
struct Row {
    time_s: f64,
    place: Place,
}

#[derive(Clone, Copy, Debug)]
enum Place {
    Local(Point3<f64>),
    Geodetic(Geodetic),
}

/// Reads a log: GPX by its name, CSV otherwise.
pub fn read(path: &Path, reading: &Reading) -> anyhow::Result<FlightLog> {
    let is_gpx = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gpx"));
    let rows = if is_gpx { read_gpx(path) } else { read_csv(path) };
    let rows = rows.with_context(|| format!("cannot read the log {}", path.display()))?;
    let frame = reading.anchor.or_else(|| first_place(&rows)).map(LocalFrame::at);
    let sample = |row: &Row| {
        let mut position = match (row.place, &frame) {
            (Place::Geodetic(place), Some(frame)) => frame.local(place),
            (Place::Local(position), _) => position,
            (Place::Geodetic(_), None) => return None,
        };
        position.z -= reading.antenna_m;
        let ahead_s = if reading.is_gps_time { GPS_AHEAD_S } else { 0.0 };
        Some(LogSample { time_s: row.time_s - ahead_s, position })
    };
    let mut samples: Vec<LogSample> = rows.iter().filter_map(sample).collect();
    samples.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    samples.dedup_by(|a, b| a.time_s == b.time_s);
    Ok(FlightLog { samples, errors: reading.errors })
}

/// The place that a log without an anchor begins at, said.
fn first_place(rows: &[Row]) -> Option<Geodetic> {
    let place = rows.iter().find_map(|row| match row.place {
        Place::Geodetic(place) => Some(place),
        Place::Local(_) => None,
    })?;
    tracing::info!(
        "the site's origin is where the log begins, {:.7},{:.7},{:.2} (--anchor says another)",
        place.latitude_deg(),
        place.longitude_deg(),
        place.height()
    );
    Some(place)
}

const LOCAL: [&str; 4] = ["time_s", "east_m", "north_m", "up_m"];
const GEODETIC: [&str; 4] = ["time_s", "latitude_deg", "longitude_deg", "height_m"];

/// Columns of either form, whatever others there are.
fn read_csv(path: &Path) -> anyhow::Result<Vec<Row>> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path)?;
    let head = reader.headers()?.clone();
    let columns = |names: [&str; 4]| {
        let found = names.map(|name| head.iter().position(|column| column == name));
        let [Some(time), Some(x), Some(y), Some(z)] = found else { return None };
        Some([time, x, y, z])
    };
    let (columns, is_geodetic) = match (columns(LOCAL), columns(GEODETIC)) {
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

fn csv_row(record: &StringRecord, columns: [usize; 4], is_geodetic: bool) -> anyhow::Result<Row> {
    let number = |column: usize| record.get(column)?.parse::<f64>().ok().filter(|n| n.is_finite());
    let [Some(time_s), Some(x), Some(y), Some(z)] = columns.map(number) else {
        bail!("not four numbers");
    };
    let place = if is_geodetic {
        Place::Geodetic(Geodetic::from_degrees(x, y, z)?)
    } else {
        Place::Local(Point3::new(x, y, z))
    };
    Ok(Row { time_s, place })
}

/// All tracks' points that have a time and a height.
fn read_gpx(path: &Path) -> anyhow::Result<Vec<Row>> {
    let file = gpx::read(BufReader::new(File::open(path)?))?;
    let points = file.tracks.iter().flat_map(|track| &track.segments).flat_map(|part| &part.points);
    let (mut rows, mut bare) = (Vec::new(), 0_u64);
    for point in points {
        let (Some(time), Some(height)) = (point.time, point.elevation) else {
            bare += 1;
            continue;
        };
        let nanos = OffsetDateTime::from(time).unix_timestamp_nanos();
        let place = Geodetic::from_degrees(point.point().y(), point.point().x(), height)?;
        rows.push(Row { time_s: nanos as f64 * 1e-9, place: Place::Geodetic(place) });
    }
    if bare > 0 {
        tracing::warn!("{}: {bare} points have no time or no height", path.display());
    }
    ensure!(!rows.is_empty(), "it has no track with times and heights");
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    const READING: Reading = Reading {
        errors: LogErrors { sd_m: 1.0, drift_sd_m: 1.0, drift_time_s: 200.0 },
        anchor: None,
        is_gps_time: false,
        antenna_m: 0.0,
    };

    fn log(name: &str, text: &str, reading: &Reading) -> anyhow::Result<FlightLog> {
        let folder = tempfile::tempdir()?;
        let path = folder.path().join(name);
        std::fs::write(&path, text)?;
        read(&path, reading)
    }

    /// A second of latitude is 30.9 m, of longitude 20.5 m at 48.35 degrees.
    const SECOND: &str = "time_s,longitude_deg,latitude_deg,height_m,mode\n\
        100.0,11.7861,48.3538,490.0,3d\n101.0,11.786377778,48.354077778,492.0,3d\n";

    #[test]
    fn degrees_become_metres_from_the_first_place_or_an_anchor() {
        let samples = log("drone.csv", SECOND, &READING).unwrap().samples;
        assert!(samples[0].position.coords.norm() < 1e-6);
        let there = samples[1].position;
        assert!((there.x - 20.6).abs() < 0.1 && (there.y - 30.9).abs() < 0.1, "{there}");
        assert!((there.z - 2.0).abs() < 1e-3, "{there}");
        let anchor = Geodetic::from_degrees(48.3538, 11.7861, 480.0).unwrap();
        let reading =
            Reading { anchor: Some(anchor), is_gps_time: true, antenna_m: 0.1, ..READING };
        let first = log("drone.csv", SECOND, &reading).unwrap().samples[0];
        assert!((first.position.z - 9.9).abs() < 1e-6, "{}", first.position);
        assert_eq!(first.time_s, 82.0);
    }

    #[test]
    fn a_gpx_track_is_a_log() {
        let text = r#"<?xml version="1.0"?><gpx version="1.1" creator="x"
            xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
            <trkpt lat="48.3538" lon="11.7861"><ele>490</ele><time>2026-11-23T12:00:00Z</time></trkpt>
            <trkpt lat="48.3538" lon="11.7861"><ele>491</ele></trkpt>
            <trkpt lat="48.3538" lon="11.7861"><ele>495</ele><time>2026-11-23T12:00:00.500Z</time></trkpt>
            </trkseg></trk></gpx>"#;
        let samples = log("drone.GPX", text, &READING).unwrap().samples;
        assert_eq!(samples.len(), 2);
        assert!((samples[1].time_s - samples[0].time_s - 0.5).abs() < 1e-6);
        assert!((samples[1].position.z - 5.0).abs() < 1e-6);
        assert!(log("drone.gpx", &text[..200], &READING).is_err());
    }

    #[test]
    fn what_is_wrong_with_a_log_is_said() {
        let wrong = |text: &str| format!("{:#}", log("drone.csv", text, &READING).unwrap_err());
        assert!(wrong("t,lat,lon\n1,2,3\n").contains("latitude_deg"), "{}", wrong("t,lat,lon\n"));
        let bad = "time_s,latitude_deg,longitude_deg,height_m\n1,48,11,490\n2,480,11,490\n";
        assert!(wrong(bad).contains("row 3"), "{}", wrong(bad));
    }
}
