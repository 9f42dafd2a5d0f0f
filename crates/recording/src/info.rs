use std::collections::{BTreeMap, BTreeSet};
use std::convert::Infallible;
use std::path::Path;

use crossfix_message::{CameraName, Channel, Health, Timestamp, decode, glance};
use serde::Serialize;

use crate::{Damage, Entry, ReadFailure, RecordingError, RecordingReader, Source, schema_of};

/// Contents of one channel of a recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ChannelInfo {
    /// The Zenoh key.
    pub topic: String,
    /// The full protobuf name of its messages.
    pub schema: &'static str,
    /// Number of messages.
    pub messages: u64,
    /// Bytes of all messages, before compression.
    pub bytes: u64,
    /// Data time of the first, ns since the Unix epoch.
    pub first: Timestamp,
    /// Data time of the last, ns since the Unix epoch.
    pub last: Timestamp,
}

/// The last health report of a component.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LastHealth {
    /// Its counters, without those that are zero.
    pub counters: BTreeMap<String, u64>,
    /// The problems that it reported then.
    pub problems: Vec<String>,
}

impl LastHealth {
    fn read(entry: &Entry) -> Option<(String, Self)> {
        if !matches!(
            entry.key.channel,
            Channel::CameraHealth(_) | Channel::FusionHealth | Channel::RecorderHealth
        ) {
            return None;
        }
        let health: Health = decode(&entry.data).ok()?;
        let counters = health.counters.into_iter().filter(|counter| counter.value > 0);
        let counters = counters.map(|counter| (counter.name, counter.value)).collect();
        Some((health.component, Self { counters, problems: health.problems }))
    }
}

/// Contents of a recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct RecordingInfo {
    /// Ordered by topic.
    pub channels: Vec<ChannelInfo>,
    /// The cameras that it has messages of.
    pub cameras: BTreeSet<CameraName>,
    /// Number of messages of a newer major version, which this build cannot read.
    pub newer: u64,
    /// Number of messages on topics that are not Crossfix's.
    pub foreign: u64,
    /// Topics that begin as Crossfix's do but are none, as a name in them is not possible.
    #[serde(skip_serializing_if = "BTreeSet::is_empty")]
    pub misnamed: BTreeSet<String>,
    /// Who wrote it, if the file states it.
    pub source: Option<Source>,
    /// The last health report of each component, by its name: counters and problems.
    pub health: BTreeMap<String, LastHealth>,
    /// What could not be read, if anything.
    pub damage: Option<Damage>,
}

/// What the messages read so far say of a recording's contents.
#[derive(Default)]
struct MessageSummary {
    /// By topic.
    channels: BTreeMap<String, ChannelInfo>,
    cameras: BTreeSet<CameraName>,
    newer: u64,
    health: BTreeMap<String, LastHealth>,
}

impl MessageSummary {
    fn add(&mut self, entry: &Entry) {
        self.health.extend(LastHealth::read(entry));
        let seen = glance(&entry.key.channel, &entry.data).ok().flatten();
        self.newer += u64::from(seen.is_some_and(|seen| !seen.is_readable));
        self.cameras.extend(entry.key.channel.camera().cloned());
        let topic = entry.key.to_string();
        let channel = self.channels.entry(topic.clone()).or_insert_with(|| ChannelInfo {
            topic,
            schema: schema_of(&entry.key.channel).unwrap_or_default(),
            messages: 0,
            bytes: 0,
            first: entry.data_time,
            last: entry.data_time,
        });
        channel.messages += 1;
        channel.bytes += entry.data.len() as u64;
        channel.first = channel.first.min(entry.data_time);
        channel.last = channel.last.max(entry.data_time);
    }
}

impl RecordingInfo {
    /// Reads a recording and summarises its contents and its damage.
    ///
    /// # Errors
    /// [`RecordingError`] if it does not exist or is not an MCAP file.
    pub fn of(path: &Path) -> Result<Self, RecordingError> {
        let mut messages = MessageSummary::default();
        let report = RecordingReader::open(path)?.for_each(|entry| {
            messages.add(&entry);
            Ok::<_, Infallible>(())
        });
        match report {
            Ok(report) => Ok(Self {
                channels: messages.channels.into_values().collect(),
                cameras: messages.cameras,
                newer: messages.newer,
                foreign: report.foreign,
                misnamed: report.misnamed,
                source: report.source,
                health: messages.health,
                damage: report.damage,
            }),
            Err(ReadFailure::Recording(error)) => Err(error),
            Err(ReadFailure::Handler(never)) => match never {},
        }
    }
}
