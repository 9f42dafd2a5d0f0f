//! Recordings: MCAP files of the bytes that went over the wire, chunked,
//! compressed, indexed, with the schema of every message inside.
//!
//! A channel's topic is the Zenoh key. `log_time` is the message's own data
//! time (the capture time of what it speaks of), `publish_time` the time at
//! which the recorder received it.
//!
//! ```
//! use crossfix_message::{BearingFrame, Channel, Key, Payload, Timestamp};
//! use crossfix_recording::{Entry, RecordingReader, RecordingWriter};
//!
//! let folder = tempfile::tempdir()?;
//! let path = folder.path().join("one.mcap");
//! let key = Key::new("field".parse()?, Channel::Bearings("north".parse()?));
//! let time = Timestamp::from_seconds(1.5);
//!
//! let mut writer = RecordingWriter::create(&path)?;
//! let data = BearingFrame { camera: "north".into(), ..Default::default() }.encode();
//! writer.write(&Entry { key: key.clone(), data_time: time, arrival: time, data })?;
//! writer.finish()?;
//!
//! let mut seen = 0;
//! let report = RecordingReader::open(&path)?.for_each(|entry| {
//!     assert_eq!(entry.key, key);
//!     seen += 1;
//!     Ok::<_, std::convert::Infallible>(())
//! })?;
//! assert_eq!(seen, 1);
//! assert!(report.damage.is_none());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod chunk;
mod damage;
mod error;
mod info;
mod reader;
mod schema;
mod source;
mod writer;

pub use damage::Damage;
pub use error::RecordingError;
pub use info::{ChannelInfo, LastHealth, RecordingInfo};
pub use reader::{ReadFailure, ReadReport, RecordingReader};
pub use schema::schema_of;
pub use source::Source;
pub use writer::RecordingWriter;

use crossfix_message::{Key, Timestamp};

/// The name of the metadata record that repeats the channels' ids and topics.
pub(crate) const CHANNELS: &str = "crossfix.channels";

/// One message of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Entry {
    /// The key under which it was published.
    pub key: Key,
    /// Its data time.
    pub data_time: Timestamp,
    /// When the recorder received it; equal to `data_time` in imported data.
    pub arrival: Timestamp,
    /// The bytes as on the wire.
    pub data: Vec<u8>,
}

/// A message in a foreign schema, written in addition to our own messages.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beside<'a> {
    /// Its topic, which must not be one of ours: those begin with `crossfix/`.
    pub topic: &'a str,
    /// Its schema's full protobuf name.
    pub schema: &'a str,
    /// The schema's definitions, a `google.protobuf.FileDescriptorSet`.
    pub definitions: &'a [u8],
    /// Its data time.
    pub data_time: Timestamp,
    /// When the message that it was derived from was received.
    pub arrival: Timestamp,
    /// The encoded message.
    pub data: &'a [u8],
}
