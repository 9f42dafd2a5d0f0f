//! Logs in GPX, the exchange format of GPS receivers and their programs.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use anyhow::ensure;
use crossfix_geometry::Geodetic;
use time::OffsetDateTime;

use super::{Above, LogPlace, LogRow};

/// The points of all tracks that have a time and a height.
pub(super) fn read(path: &Path) -> anyhow::Result<Vec<LogRow>> {
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
        let place = LogPlace::Geodetic {
            place,
            above: point.geoidheight.map_or(Above::Unsaid, |geoid_m| Above::Sea(Some(geoid_m))),
        };
        rows.push(LogRow { time_s: nanos as f64 * 1e-9, place });
    }
    if bare > 0 {
        tracing::warn!("{}: {bare} points have no time or no height", path.display());
    }
    ensure!(!rows.is_empty(), "it has no track with times and heights");
    Ok(rows)
}
