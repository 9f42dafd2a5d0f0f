use std::collections::BTreeMap;
use std::convert::Infallible;
use std::path::Path;

use crossfix_message::Timestamp;
use serde::Serialize;

use crate::{ReadFailure, RecordingError, RecordingReader, schema};

/// What one channel of a recording holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ChannelInfo {
    /// The Zenoh key.
    pub topic: String,
    /// The full protobuf name of its messages.
    pub schema: &'static str,
    /// How many.
    pub messages: u64,
    /// Bytes of all messages, before compression.
    pub bytes: u64,
    /// Data time of the first, ns since the Unix epoch.
    pub first: Timestamp,
    /// Data time of the last, ns since the Unix epoch.
    pub last: Timestamp,
}

/// What a recording holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RecordingInfo {
    /// Ordered by topic.
    pub channels: Vec<ChannelInfo>,
    /// Messages on topics that are not Crossfix's.
    pub foreign: u64,
    /// Where and why reading had to stop early, if it had to.
    pub damage: Option<String>,
}

impl RecordingInfo {
    /// Goes through a recording and says what it holds; a torn one is told up to the damage.
    ///
    /// # Errors
    /// [`RecordingError`] if it is not there or no MCAP file.
    pub fn of(path: &Path) -> Result<Self, RecordingError> {
        let mut channels: BTreeMap<String, ChannelInfo> = BTreeMap::new();
        let report = RecordingReader::open(path)?.for_each(|entry| {
            let topic = entry.key.to_string();
            let channel = channels.entry(topic.clone()).or_insert_with(|| ChannelInfo {
                topic,
                schema: schema::of(&entry.key.channel).unwrap_or_default(),
                messages: 0,
                bytes: 0,
                first: entry.data_time,
                last: entry.data_time,
            });
            channel.messages += 1;
            channel.bytes += entry.data.len() as u64;
            channel.first = channel.first.min(entry.data_time);
            channel.last = channel.last.max(entry.data_time);
            Ok::<_, Infallible>(())
        });
        match report {
            Ok(report) => Ok(Self {
                channels: channels.into_values().collect(),
                foreign: report.foreign,
                damage: report.damage,
            }),
            Err(ReadFailure::Recording(error)) => Err(error),
            Err(ReadFailure::Handler(never)) => match never {},
        }
    }
}
