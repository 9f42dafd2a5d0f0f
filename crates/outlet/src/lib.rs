//! Tracks for others: what leaves a site for programs that are not Crossfix.
//!
//! A [`Situation`] hears the fusion centre's tracks and says where all targets are at one instant, on
//! the Earth and with their uncertainty: a [`Snapshot`]. An [`Outlet`] makes bytes of it, in a format
//! of others:
//!
//! | format | outlet | its uncertainty |
//! |---|---|---|
//! | Cursor on Target (MITRE, XML 2.0) | [`CursorOnTarget`] | one standard deviation, circular and linear |
//! | SAPIENT (BSI Flex 335 v2.0) | [`Sapient`] | one standard deviation an axis |
//! | ASTERIX category 062 (EUROCONTROL) | [`Asterix`] | one standard deviation an axis, rounded up |
//! | GeoJSON (RFC 7946) | [`GeoJsonLines`], [`GeoJsonFlights`] | properties of our own |
//! | KML 2.2 (OGC) | [`Kml`] | none |
//!
//! [`foxglove`] has Foxglove's well-known schemas beside our own messages.
//!
//! The datum is WGS84 (G2139 or whatever the anchor was measured in), heights are above the ellipsoid;
//! where a format wants another height, its outlet says so.
//!
//! ```
//! use crossfix_geometry::Geodetic;
//! use crossfix_message::{Track, TrackFrame, TrackState, Vector3};
//! use crossfix_outlet::{GeoJsonLines, Outlet, Situation};
//!
//! let anchor = Geodetic::from_degrees(48.3538, 11.7861, 490.0)?;
//! let mut situation = Situation::new("airfield".parse()?, anchor);
//! let covariance = (0..36).map(|k| if k % 7 == 0 { 0.01 } else { 0.0 }).collect();
//! situation.hear(None, &TrackFrame {
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
//! An outlet of one's own is a type with [`Outlet::tracks`]: `examples/own_outlet.rs` is one.

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

/// Why the other side takes nothing.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum Refused {
    /// It does not take this site.
    #[error("it refuses this site: {0}")]
    Registration(String),
    /// What it says is not of the format.
    #[error("what it says cannot be read: {0}")]
    Malformed(String),
}

/// Makes bytes of tracks and events, in a format of others.
///
/// Who carries them calls [`Self::greeting`] on each new connection, [`Self::heard`] with whatever the
/// other side says, and, once [`Self::is_ready`], [`Self::tracks`] with one snapshot after the other,
/// whose times grow, and [`Self::event`]; last [`Self::farewell`]. Each returned element is one message:
/// a datagram, or a part of a stream that needs nothing between it and the next.
///
/// Only `tracks` must be written; the others do nothing for formats that know of nothing of the kind.
pub trait Outlet {
    /// What is said first on a connection. Whatever was said on an earlier one is forgotten.
    fn greeting(&mut self, _now: Timestamp) -> Vec<Vec<u8>> {
        Vec::new()
    }

    /// Takes what the other side says.
    ///
    /// # Errors
    /// [`Refused`] if it takes nothing: the connection is of no use.
    fn heard(&mut self, _bytes: &[u8]) -> Result<(), Refused> {
        Ok(())
    }

    /// Whether the other side takes tracks now.
    fn is_ready(&self) -> bool {
        true
    }

    /// Where all targets are at one instant.
    fn tracks(&mut self, snapshot: &Snapshot) -> Vec<Vec<u8>>;

    /// What happened to a track.
    fn event(&mut self, _event: &TrackEvent) -> Vec<Vec<u8>> {
        Vec::new()
    }

    /// What is said last. Formats of whole documents say everything here.
    fn farewell(&mut self, _now: Timestamp) -> Vec<Vec<u8>> {
        Vec::new()
    }
}
