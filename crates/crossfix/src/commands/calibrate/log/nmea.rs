//! Logs in NMEA 0183, of which two sentences are used.
//!
//! Parsed by hand, as no maintained crate serves: `nmea` needs a `serde_with` version that
//! conflicts with Zenoh's, and `nmea-parser` drops fractions of a second.

use std::path::Path;

use anyhow::{Context, ensure};
use crossfix_geometry::Geodetic;
use time::{Date, Month};

use super::{Above, LogPlace, LogRow};

/// Seconds per day.
const DAY_S: f64 = 86_400.0;
/// Two-digit years belong to this century: receivers are not older.
const CENTURY: i32 = 2000;

/// Positions of which the receiver was sure (GGA), with dates from other sentences (RMC); a
/// position and the date nearest to it are less than half a day apart. Other sentences and bytes
/// are skipped.
pub(super) fn read(path: &Path) -> anyhow::Result<Vec<LogRow>> {
    let bytes = std::fs::read(path)?;
    let text = String::from_utf8_lossy(&bytes);
    let (mut places, mut dated_s, mut damaged) = (Vec::new(), None, 0_u64);
    for line in text.lines().map(str::trim).filter(|line| line.starts_with('$')) {
        let Some(sentence) = Sentence::of(line) else {
            damaged += 1;
            continue;
        };
        match sentence.kind() {
            "GGA" => places.extend(sentence.place()),
            "RMC" => dated_s = sentence.moment_s().or(dated_s),
            _ => continue,
        }
        if let Some(dated_s) = dated_s {
            place_in_day(&mut places, dated_s);
        }
    }
    if damaged > 0 {
        tracing::warn!("{}: {damaged} sentences are damaged", path.display());
    }
    ensure!(!places.is_empty(), "it has no place that the receiver was sure of (GGA)");
    places.into_iter().map(NmeaPosition::row).collect()
}

/// The fields of a sentence, beginning with its talker and kind.
struct Sentence<'a>(Vec<&'a str>);

impl<'a> Sentence<'a> {
    /// `None` if the checksum is missing or wrong.
    fn of(line: &'a str) -> Option<Self> {
        let (body, sum) = line.strip_prefix('$')?.rsplit_once('*')?;
        let stated = u8::from_str_radix(sum.trim_end(), 16).ok()?;
        let found = body.bytes().fold(0, |sum, byte| sum ^ byte);
        (stated == found).then(|| Self(body.split(',').collect()))
    }

    /// The sentence's kind: what follows the talker's two letters.
    fn kind(&self) -> &str {
        self.0[0].get(2..).unwrap_or_default()
    }

    fn number(&self, field: usize) -> Option<f64> {
        self.0.get(field)?.parse().ok().filter(|number: &f64| number.is_finite())
    }

    /// A field `hhmmss.ss`, in seconds of the day.
    fn of_day_s(&self, field: usize) -> Option<f64> {
        let text = self.0.get(field)?;
        let part = |from: usize, to: usize| text.get(from..to)?.parse::<u32>().ok();
        let (hours, minutes) = (part(0, 2)?, part(2, 4)?);
        let seconds: f64 = text.get(4..)?.parse().ok()?;
        let is_time = hours < 24 && minutes < 60 && (0.0..61.0).contains(&seconds);
        is_time.then(|| f64::from(60 * (60 * hours + minutes)) + seconds)
    }

    /// A field `dddmm.mmmm` with the letter of the hemisphere, in degrees.
    fn degrees(&self, field: usize, [positive, negative]: [&str; 2]) -> Option<f64> {
        let value = self.number(field)?;
        let degrees = (value / 100.0).trunc();
        let size = degrees + (value - 100.0 * degrees) / 60.0;
        match *self.0.get(field + 1)? {
            half if half == positive => Some(size),
            half if half == negative => Some(-size),
            _ => None,
        }
    }

    /// A GGA's position. Its fields: time, latitude, longitude, quality, satellites, dilution,
    /// height above the sea, its unit, and height of the sea above the ellipsoid.
    fn place(&self) -> Option<NmeaPosition> {
        /// Qualities of a real fix: not dead reckoning, manual input or simulation.
        const SURE: [f64; 5] = [1.0, 2.0, 3.0, 4.0, 5.0];
        SURE.contains(&self.number(6)?).then_some(())?;
        Some(NmeaPosition {
            of_day_s: self.of_day_s(1)?,
            time_s: None,
            place: [self.degrees(2, ["N", "S"])?, self.degrees(4, ["E", "W"])?, self.number(9)?],
            geoid_m: self.number(11),
        })
    }

    /// An RMC's time and date `ddmmyy`, in seconds since 1970.
    fn moment_s(&self) -> Option<f64> {
        // Without a fix a receiver may state any date.
        (*self.0.get(2)? == "A").then_some(())?;
        let text = self.0.get(9)?;
        let part = |from: usize| text.get(from..from + 2)?.parse::<u8>().ok();
        let (day, month, year) = (part(0)?, Month::try_from(part(2)?).ok()?, part(4)?);
        let date = Date::from_calendar_date(CENTURY + i32::from(year), month, day).ok()?;
        Some(date.midnight().assume_utc().unix_timestamp() as f64 + self.of_day_s(1)?)
    }
}

/// A position whose day may not be known yet.
#[derive(Clone, Copy, Debug)]
struct NmeaPosition {
    of_day_s: f64,
    time_s: Option<f64>,
    /// Latitude and longitude, degrees, and height above the sea, m.
    place: [f64; 3],
    geoid_m: Option<f64>,
}

impl NmeaPosition {
    fn row(self) -> anyhow::Result<LogRow> {
        let time_s = self.time_s.context(
            "it has no date: let the receiver send RMC sentences as well, or make columns of it",
        )?;
        let [latitude, longitude, height] = self.place;
        let place = Geodetic::from_degrees(latitude, longitude, height)?;
        Ok(LogRow { time_s, place: LogPlace::Geodetic { place, above: Above::Sea(self.geoid_m) } })
    }
}

/// Gives the newest positions that have no day yet the day that brings them nearest to a moment.
fn place_in_day(places: &mut [NmeaPosition], moment_s: f64) {
    for found in places.iter_mut().rev().take_while(|found| found.time_s.is_none()) {
        let days = ((moment_s - found.of_day_s) / DAY_S).round();
        found.time_s = Some(found.of_day_s + days * DAY_S);
    }
}
