//! GeoJSON (RFC 7946): points of the present, lines of whole flights.

use std::collections::BTreeMap;

use crossfix_message::Timestamp;
use serde_json::{Value, json};

use crate::target::{Motion, Target};
use crate::text::{state, utc};
use crate::{Outlet, Snapshot};

/// Rounds a number to some decimals; more are of no use.
fn rounded(value: f64, digits: i32) -> f64 {
    let scale = 10_f64.powi(digits);
    (value * scale).round() / scale
}

/// Longitude, latitude (1 cm), and height above the ellipsoid (1 cm).
fn position(target: &Target) -> [f64; 3] {
    let place = &target.place;
    [
        rounded(place.longitude_deg(), 7),
        rounded(place.latitude_deg(), 7),
        rounded(place.height(), 2),
    ]
}

/// GeoJSON (RFC 7946): one collection of points per snapshot, each collection on a line of its own.
/// Numbers that are too large for JavaScript (`id`, `time_ns`) are strings.
#[derive(Clone, Copy, Debug, Default)]
pub struct GeoJsonLines;

fn feature(time: Timestamp, target: &Target) -> Value {
    let sd = target.place_sd_m().map(|sd| rounded(sd, 3));
    let velocity = target.velocity.map(|v| rounded(v, 3));
    let Motion { course_deg, speed_mps, .. } = target.motion();
    let number = target.number().to_string();
    json!({
        "type": "Feature",
        "id": target.id.to_string(),
        "geometry": { "type": "Point", "coordinates": position(target) },
        "properties": {
            "track": number, "state": state(target.state),
            "time": utc(time), "time_ns": time.nanos().to_string(), "seen": utc(target.seen),
            "velocity_mps": velocity.as_slice(),
            "course_deg": rounded(course_deg.value, 2), "speed_mps": rounded(speed_mps.value, 3),
            "sd_east_m": sd.x, "sd_north_m": sd.y, "sd_up_m": sd.z,
            "covariance_east_north_m2": rounded(target.covariance[(0, 1)], 6),
        },
    })
}

impl Outlet for GeoJsonLines {
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>> {
        let features: Vec<Value> =
            snapshot.targets.iter().map(|target| feature(snapshot.time, target)).collect();
        let collection = json!({ "type": "FeatureCollection", "features": features });
        vec![format!("{collection}\n").into_bytes()]
    }
}

/// One place of a flight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Passed {
    pub time: Timestamp,
    /// Longitude, latitude (degrees), height above the ellipsoid (m).
    pub position: [f64; 3],
}

/// The flights of all tracks, from first to last.
#[derive(Clone, Debug, Default)]
pub(crate) struct Flights {
    pub tracks: BTreeMap<u64, Vec<Passed>>,
}

impl Flights {
    pub fn add(&mut self, snapshot: &Snapshot) {
        let is_there = |target: &&Target| target.state != crossfix_message::TrackState::Lost;
        for target in snapshot.targets.iter().filter(is_there) {
            let passed = Passed { time: snapshot.time, position: position(target) };
            self.tracks.entry(target.id).or_default().push(passed);
        }
    }
}

/// GeoJSON (RFC 7946), one document: each track's flight as a line, with its times in the property
/// `coordTimes`. A track that is in one snapshot only is a point.
#[derive(Clone, Debug, Default)]
pub struct GeoJsonFlights {
    flights: Flights,
}

impl Outlet for GeoJsonFlights {
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>> {
        self.flights.add(snapshot);
        Vec::new()
    }

    fn farewell(&mut self, _now: Timestamp) -> Vec<Vec<u8>> {
        let flights = std::mem::take(&mut self.flights.tracks).into_iter();
        let features: Vec<Value> =
            flights.map(|(id, flight)| flight_feature(id, &flight)).collect();
        let collection = json!({ "type": "FeatureCollection", "features": features });
        vec![collection.to_string().into_bytes()]
    }
}

/// A track's flight as a GeoJSON feature.
fn flight_feature(id: u64, flight: &[Passed]) -> Value {
    let times: Vec<String> = flight.iter().map(|passed| utc(passed.time)).collect();
    let line: Vec<[f64; 3]> = flight.iter().map(|passed| passed.position).collect();
    let geometry = match line[..] {
        [place] => json!({ "type": "Point", "coordinates": place }),
        _ => json!({ "type": "LineString", "coordinates": line }),
    };
    let number = crossfix_message::TrackNumber(id).to_string();
    json!({
        "type": "Feature", "id": id.to_string(), "geometry": geometry,
        "properties": { "track": number, "coordTimes": times },
    })
}
