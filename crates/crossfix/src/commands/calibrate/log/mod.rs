//! A drone's position log, in the formats in common use.

mod columns;
mod gpx;
mod nmea;

use std::fs::File;
use std::io::Read;
use std::path::Path;

use anyhow::{Context, ensure};
use crossfix_calibration::{FlightLog, LogErrors, LogSample};
use crossfix_geometry::{Geodetic, LocalFrame};
use nalgebra::Point3;

/// What wrote a log, and so how good it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum LogKind {
    /// Real-time kinematic: centimetres.
    Rtk,
    /// With corrections: decimetres.
    Dgps,
    /// A consumer's receiver: errors of metres that stay the same for minutes.
    Consumer,
}

impl LogKind {
    /// Error model of the samples of such a log.
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

/// What a log's heights count from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum LogHeight {
    /// The WGS84 ellipsoid, as the anchor's does.
    Ellipsoid,
    /// The sea, which is above the ellipsoid by what the log or --geoid says.
    Sea,
    /// Where the drone took off, at the anchor's height.
    Takeoff,
}

/// How a log's times and positions are to be interpreted.
#[derive(Clone, Copy, Debug)]
pub struct LogReading {
    pub errors: LogErrors,
    /// Origin of the site; if absent, the log's first position.
    pub anchor: Option<Geodetic>,
    /// Whether its times are GPS time.
    pub is_gps_time: bool,
    /// Zero of the heights that are given with degrees.
    pub height: LogHeight,
    /// Height of the sea above the ellipsoid there, m; if absent, as the log states it.
    pub geoid_m: Option<f64>,
    /// Height of the receiver above what cameras see as the target's centre, m.
    pub antenna_m: f64,
}

/// GPS counts no leap seconds: since 2017 it has been ahead of UTC by this, s.
const GPS_AHEAD_S: f64 = 18.0;

/// One sample as it stands in the file.
#[derive(Clone, Copy, Debug)]
struct LogRow {
    time_s: f64,
    place: LogPlace,
}

#[derive(Clone, Copy, Debug)]
enum LogPlace {
    Local(Point3<f64>),
    /// Degrees, and a height with its zero.
    Geodetic {
        place: Geodetic,
        above: Above,
    },
}

/// Zero of a log's heights as the log itself states it.
#[derive(Clone, Copy, Debug)]
enum Above {
    Unsaid,
    /// The sea, with its height above the ellipsoid, m, if the log states that.
    Sea(Option<f64>),
}

/// Reads a log: GPX if the file's name says so, NMEA by the first character, otherwise columns.
pub fn read(path: &Path, reading: &LogReading) -> anyhow::Result<FlightLog> {
    let is_gpx = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("gpx"));
    let rows = if is_gpx {
        gpx::read(path)
    } else if begins_with(path, b'$') {
        nmea::read(path)
    } else {
        columns::read(path)
    };
    let wrong = || format!("cannot read the log {}", path.display());
    let rows = rows.with_context(wrong)?;
    let rows: Vec<LogRow> = rows
        .into_iter()
        .map(|row| reading.placed(row))
        .collect::<Result<_, _>>()
        .with_context(wrong)?;
    let frame = reading.anchor.or_else(|| first_place(&rows)).map(LocalFrame::at);
    let mut samples: Vec<LogSample> =
        rows.iter().filter_map(|row| reading.sample(row, frame.as_ref())).collect();
    samples.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    samples.dedup_by(|a, b| a.time_s == b.time_s);
    Ok(FlightLog { samples, errors: reading.errors })
}

fn begins_with(path: &Path, letter: u8) -> bool {
    let mut first = [0];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut first));
    read.is_ok() && first == [letter]
}

impl LogReading {
    /// A row with its height converted to height above the ellipsoid.
    fn placed(&self, row: LogRow) -> anyhow::Result<LogRow> {
        ensure!(
            self.geoid_m.is_none() || self.height == LogHeight::Sea,
            "--geoid is of heights above the sea (--height sea)"
        );
        let LogPlace::Geodetic { place, above } = row.place else {
            ensure!(
                self.height == LogHeight::Ellipsoid,
                "--height is of a log in degrees: its metres are the site's"
            );
            return Ok(row);
        };
        let said_m = match above {
            Above::Unsaid => None,
            Above::Sea(geoid_m) => geoid_m,
        };
        let raise_m = match (self.height, above) {
            (LogHeight::Ellipsoid, Above::Unsaid) => 0.0,
            (LogHeight::Ellipsoid | LogHeight::Sea, _) => self.geoid_m.or(said_m).context(
                "it does not say how far the sea, from which its heights count, is above the \
                 ellipsoid: --height sea --geoid METRES (in Europe 30 to 60)",
            )?,
            (LogHeight::Takeoff, _) => self.anchor.map_or(0.0, |anchor| anchor.height()),
        };
        let (latitude, longitude) = (place.latitude_deg(), place.longitude_deg());
        let place = Geodetic::from_degrees(latitude, longitude, place.height() + raise_m)?;
        Ok(LogRow { place: LogPlace::Geodetic { place, above: Above::Unsaid }, ..row })
    }

    /// Where the target was, by a row; `None` if it is in degrees and the site has no frame.
    fn sample(&self, row: &LogRow, frame: Option<&LocalFrame>) -> Option<LogSample> {
        let mut position = match (row.place, frame) {
            (LogPlace::Geodetic { place, .. }, Some(frame)) => frame.local(place),
            (LogPlace::Local(position), _) => position,
            (LogPlace::Geodetic { .. }, None) => return None,
        };
        position.z -= self.antenna_m;
        let ahead_s = if self.is_gps_time { GPS_AHEAD_S } else { 0.0 };
        Some(LogSample { time_s: row.time_s - ahead_s, position })
    }
}

/// The position at which a log without an anchor begins; it is also logged.
fn first_place(rows: &[LogRow]) -> Option<Geodetic> {
    let place = rows.iter().find_map(|row| match row.place {
        LogPlace::Geodetic { place, .. } => Some(place),
        LogPlace::Local(_) => None,
    })?;
    tracing::info!(
        "the site's origin is where the log begins, {:.7},{:.7},{:.2} (--anchor says another)",
        place.latitude_deg(),
        place.longitude_deg(),
        place.height()
    );
    Some(place)
}

#[cfg(test)]
mod tests {
    use super::*;

    const READING: LogReading = LogReading {
        errors: LogErrors { sd_m: 1.0, drift_sd_m: 1.0, drift_time_s: 200.0 },
        anchor: None,
        is_gps_time: false,
        height: LogHeight::Ellipsoid,
        geoid_m: None,
        antenna_m: 0.0,
    };

    fn log(name: &str, text: &str, reading: &LogReading) -> anyhow::Result<FlightLog> {
        let folder = tempfile::tempdir()?;
        let path = folder.path().join(name);
        std::fs::write(&path, text)?;
        read(&path, reading)
    }

    /// Two samples a second of latitude (30.9 m) and of longitude (20.5 m at 48.35 degrees) apart.
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
            LogReading { anchor: Some(anchor), is_gps_time: true, antenna_m: 0.1, ..READING };
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

    /// Two samples across midnight, the second without a date; one of the others damaged, one
    /// without a fix.
    const NMEA: &str = "$GPRMC,235959.50,A,4821.2280,N,01147.1660,E,0.0,0.0,230926,,,A*5E\r\n\
        $GPGGA,235959.50,4821.2280,N,01147.1660,E,4,12,0.8,440.0,M,46.5,M,1.0,0001*7C\r\n\
        $GPGGA,000000.00,4821.2280,N,01147.1660,E,4,12,0.8,441.0,M,46.5,M,1.0,0001*00\r\n\
        $GPGGA,000000.25,4821.2280,N,01147.1660,E,0,00,,,M,,M,,*4A\r\n\
        noise\r\n\
        $GPGGA,000000.50,4821.2280,N,01147.1660,E,4,12,0.8,442.0,M,46.5,M,1.0,0001*7E\r\n";

    #[test]
    fn nmea_sentences_are_a_log() {
        let text: String =
            NMEA.lines().map(|line| format!("{}\r\n", with_checksum(line))).collect();
        let samples = log("drone.nmea", &text, &READING).unwrap().samples;
        assert_eq!(samples.len(), 2);
        // 2026-09-24 00:00:00.5 UTC.
        assert_eq!(samples[1].time_s, 1_790_208_000.5);
        assert!((samples[1].time_s - samples[0].time_s - 1.0).abs() < 1e-6);
        assert!((samples[1].position.z - 2.0).abs() < 1e-3);
        let anchor = Geodetic::from_degrees(48.3538, 11.786_1, 486.5).unwrap();
        let reading = LogReading { anchor: Some(anchor), ..READING };
        let first = log("drone.nmea", &text, &reading).unwrap().samples[0];
        assert!(first.position.z.abs() < 1e-3, "440 m above a sea that is 46.5 m up: {first:?}");
        let no_geoid: String = NMEA
            .replace(",46.5,M,1", ",,M,1")
            .lines()
            .map(|line| format!("{}\n", with_checksum(line)))
            .collect();
        let error = format!("{:#}", log("drone.nmea", &no_geoid, &READING).unwrap_err());
        assert!(error.contains("--geoid"), "{error}");
        let undated = text.split_once('\n').unwrap().1;
        let error = format!("{:#}", log("drone.nmea", undated, &READING).unwrap_err());
        assert!(error.contains("no date"), "{error}");
    }

    /// The line with a correct checksum, unless it is meant to be wrong.
    fn with_checksum(line: &str) -> String {
        let Some((body, sum)) = line.strip_prefix('$').and_then(|line| line.rsplit_once('*'))
        else {
            return line.to_owned();
        };
        if sum == "00" {
            return line.to_owned();
        }
        let sum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        format!("${body}*{sum:02X}")
    }

    #[test]
    fn heights_count_from_the_sea_or_the_take_off() {
        let anchor = Geodetic::from_degrees(48.3538, 11.7861, 500.0).unwrap();
        let up = |height, geoid_m| {
            let reading = LogReading { anchor: Some(anchor), height, geoid_m, ..READING };
            log("drone.csv", SECOND, &reading).map(|log| log.samples[0].position.z)
        };
        let near = |up: f64, metres: f64| assert!((up - metres).abs() < 1e-6, "{up}");
        near(up(LogHeight::Ellipsoid, None).unwrap(), -10.0);
        near(up(LogHeight::Sea, Some(46.5)).unwrap(), 36.5);
        near(up(LogHeight::Takeoff, None).unwrap(), 490.0);
        let error = format!("{:#}", up(LogHeight::Sea, None).unwrap_err());
        assert!(error.contains("--geoid"), "{error}");
        assert!(up(LogHeight::Ellipsoid, Some(46.5)).is_err());
        let local = "time_s,east_m,north_m,up_m\n1,2,3,4\n";
        let reading = LogReading { height: LogHeight::Takeoff, ..READING };
        let error = format!("{:#}", log("drone.csv", local, &reading).unwrap_err());
        assert!(error.contains("in degrees"), "{error}");
    }
}
