//! KML, for Google Earth.

use std::fmt::Write;

use crossfix_message::{Timestamp, TrackNumber};

use crate::geojson::Flights;
use crate::text::utc;
use crate::{Outlet, Snapshot};

/// KML 2.2 with Google's tracks, one document: each track's flight over time.
///
/// KML's heights are above the geoid, Crossfix's above the WGS84 ellipsoid, and the two differ by
/// up to 100 m: the geoid's height at the site is subtracted.
#[derive(Clone, Debug)]
pub struct Kml {
    geoid_height_m: f64,
    flights: Flights,
}

impl Kml {
    /// An outlet for a site where the geoid (mean sea level, EGM96) has this height above the
    /// ellipsoid, m.
    pub fn above_geoid(geoid_height_m: f64) -> Self {
        Self { geoid_height_m, flights: Flights::default() }
    }

    fn document(&self) -> String {
        let mut text = String::from(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n\
             <kml xmlns=\"http://www.opengis.net/kml/2.2\" \
             xmlns:gx=\"http://www.google.com/kml/ext/2.2\"><Document><name>Crossfix</name>\n\
             <Style \
             id=\"track\"><LineStyle><color>ff00a5ff</color><width>2</width></LineStyle></Style>\n",
        );
        for (id, flight) in &self.flights.tracks {
            let number = TrackNumber(*id);
            // The order that the schema requires: name, style, data, geometry; all times before all
            // places. Writing into a string cannot fail.
            let _ = write!(
                text,
                "<Placemark id=\"t{id}\"><name>{number}</name><styleUrl>#track</styleUrl>\
                 <ExtendedData><Data name=\"track_id\"><value>{id}</value></Data></ExtendedData>\
                 <gx:Track><altitudeMode>absolute</altitudeMode>"
            );
            for passed in flight {
                let _ = write!(text, "<when>{}</when>", utc(passed.time));
            }
            for passed in flight {
                let [longitude, latitude, height] = passed.position;
                let height = height - self.geoid_height_m;
                let _ = write!(text, "<gx:coord>{longitude} {latitude} {height:.2}</gx:coord>");
            }
            text.push_str("</gx:Track></Placemark>\n");
        }
        text.push_str("</Document></kml>\n");
        text
    }
}

impl Outlet for Kml {
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>> {
        self.flights.add(snapshot);
        Vec::new()
    }

    fn farewell(&mut self, _now: Timestamp) -> Vec<Vec<u8>> {
        let document = self.document();
        self.flights = Flights::default();
        vec![document.into_bytes()]
    }
}
