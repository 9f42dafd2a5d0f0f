//! Outlets: a site's tracks in the formats of programs that are not Crossfix.
//!
//! A [`Situation`] takes in the fusion centre's tracks and computes where all targets are at one
//! instant, on the Earth and with their uncertainty: a [`Snapshot`]. An [`Outlet`] encodes it in
//! another program's format:
//!
//! | format | outlet | its uncertainty |
//! |---|---|---|
//! | Cursor on Target (MITRE, XML 2.0) | [`CursorOnTarget`] | 1 standard deviation, circular and linear |
//! | SAPIENT (BSI Flex 335 v2.0) | [`Sapient`] | 1 standard deviation per axis |
//! | ASTERIX category 062 (EUROCONTROL) | [`Asterix`] | 1 standard deviation per axis, rounded up |
//! | GeoJSON (RFC 7946) | [`GeoJsonLines`], [`GeoJsonFlights`] | properties of our own |
//! | KML 2.2 (OGC) | [`Kml`] | none |
//!
//! [`foxglove`] writes Foxglove's well-known schemas beside our own messages.
//!
//! The datum is WGS84 (G2139 or whatever the anchor was measured in), heights are above the
//! ellipsoid; where a format wants another height, its outlet says so.
//!
//! ```
//! use crossfix_geometry::Geodetic;
//! use crossfix_message::{Track, TrackFrame, TrackState, Vector3};
//! use crossfix_outlet::{GeoJsonLines, Outlet, Situation};
//!
//! let anchor = Geodetic::from_degrees(48.3538, 11.7861, 490.0)?;
//! let mut situation = Situation::new("airfield".parse()?, anchor);
//! let covariance = (0..36).map(|k| if k % 7 == 0 { 0.01 } else { 0.0 }).collect();
//! situation.add_tracks(None, &TrackFrame {
//!     time_ns: 1_790_000_000_000_000_000,
//!     tracks: vec![Track {
//!         id: 7,
//!         state: TrackState::Confirmed.into(),
//!         position: Some(Vector3 { x: 100.0, y: 50.0, z: 30.0 }),
//!         velocity: Some(Vector3 { x: 12.0, y: 0.0, z: 0.0 }),
//!         covariance,
//!         ..Default::default()
//!     }],
//!     ..Default::default()
//! });
//! let snapshot = situation.snapshot(0.0).ok_or("nothing was heard")?;
//! let said = GeoJsonLines.tracks(&snapshot);
//! assert!(String::from_utf8_lossy(&said[0]).contains("\"id\":\"7\""));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! To write an own outlet, implement [`Outlet::tracks`] for a type, as in `examples/own_outlet.rs`.

mod asterix;
mod cot;
pub mod foxglove;
mod geojson;
mod kml;
#[cfg(feature = "sapient")]
mod sapient;
mod situation;
mod target;
mod text;

use crossfix_message::{Timestamp, TrackEvent};
use thiserror::Error;

pub use asterix::Asterix;
pub use cot::CursorOnTarget;
pub use geojson::{GeoJsonFlights, GeoJsonLines};
pub use kml::Kml;
#[cfg(feature = "sapient")]
pub use sapient::Sapient;
pub use situation::{Situation, Snapshot};
pub use target::Target;

/// Why the other side does not take our messages.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum OutletRefusal {
    /// It refuses this site.
    #[error("it refuses this site: {0}")]
    Registration(String),
    /// What it sends is not in the format.
    #[error("what it says cannot be read: {0}")]
    Malformed(String),
}

/// Encodes tracks and events in another program's format.
///
/// The caller that carries the bytes calls [`Self::greeting`] on each new connection and
/// [`Self::heard`] with whatever the other side sends. Once [`Self::is_ready`], it calls
/// [`Self::tracks`] with one snapshot after the other, in increasing time, and [`Self::event`];
/// last [`Self::farewell`]. Each returned element is one message: a datagram, or a part of a stream
/// that needs no separator before the next.
///
/// Only `tracks` must be implemented; the others do nothing by default, for formats that have
/// nothing of the kind.
pub trait Outlet {
    /// The first messages on a connection; the state of an earlier connection is reset.
    fn greeting(&mut self, _now: Timestamp) -> Vec<Vec<u8>> {
        Vec::new()
    }

    /// Takes what the other side sends.
    ///
    /// # Errors
    /// [`OutletRefusal`] if the other side takes nothing: the connection is useless then.
    fn heard(&mut self, _bytes: &[u8]) -> Result<(), OutletRefusal> {
        Ok(())
    }

    /// Whether the other side takes tracks now.
    fn is_ready(&self) -> bool {
        true
    }

    /// Encodes where all targets are at one instant.
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>>;

    /// Encodes what happened to a track.
    fn event(&mut self, _event: &TrackEvent) -> Vec<Vec<u8>> {
        Vec::new()
    }

    /// The last messages. Formats of whole documents return everything here.
    fn farewell(&mut self, _now: Timestamp) -> Vec<Vec<u8>> {
        Vec::new()
    }
}
