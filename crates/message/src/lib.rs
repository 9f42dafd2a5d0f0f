//! The messages that Crossfix sends over the network and writes into its recordings.
//!
//! The messages are protobuf (`proto/crossfix/v1/messages.proto`); the same types carry `serde` for
//! JSON. The bytes that go over Zenoh are the bytes in a recording, so [`Payload::encode`] and
//! [`decode`] are the only way out and the only way in. [`decode`] refuses a newer major version;
//! unknown fields of a newer minor version are skipped.
//!
//! ```
//! use crossfix_message::{BearingFrame, Payload, decode};
//!
//! let frame = BearingFrame { camera: "north".into(), sequence: 7, ..Default::default() };
//! let bytes = frame.encode();
//! assert_eq!(decode::<BearingFrame>(&bytes)?.sequence, 7);
//! # Ok::<(), crossfix_message::DecodeError>(())
//! ```

mod camera;
mod covariance;
mod datum;
mod glance;
mod key;
mod name;
mod payload;
mod size;
mod time;
mod track;

pub use camera::{Calibration, CalibrationError, LastingNoise, MOST_POSITION_SD, MOST_ROTATION_SD};
pub use datum::Datum;
pub use glance::{Glance, glance};
pub use key::{Channel, Key, KeyError};
pub use name::{AreaName, CameraName, NameError, SiteName};
pub use payload::{DecodeError, Payload, decode, file_descriptor_set};
pub use size::{MOST_DECODED_BYTES, MOST_MESSAGE_BYTES, Repeated};
pub use time::Timestamp;
pub use track::{TrackNumber, renumbered, track_id};
pub use wire::*;

/// The types that `tests/generated.rs` generates from `messages.proto`, which documents them.
#[allow(missing_docs, clippy::all)]
mod wire {
    include!("generated/crossfix.v1.rs");
}

/// The version of the message definitions that this build speaks.
pub const VERSION: Version = Version { major: 1, minor: 7 };
