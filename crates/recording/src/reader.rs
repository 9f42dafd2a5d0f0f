use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use crossfix_message::{Key, Timestamp};
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use thiserror::Error;

use crate::{Entry, RecordingError};

/// A record longer than this is damage: the largest true one is a preview picture.
const MAX_RECORD_BYTES: usize = 64 << 20;

/// What a recording held, and how it ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReadReport {
    /// Messages handed on.
    pub messages: u64,
    /// Messages on topics that are not Crossfix's, left out.
    pub foreign: u64,
    /// Where and why reading had to stop early; everything before was handed on.
    pub damage: Option<String>,
}

/// Why going through a recording stopped.
#[derive(Debug, Error)]
pub enum ReadFailure<E: std::error::Error + 'static> {
    /// The recording.
    #[error("the recording cannot be read")]
    Recording(#[source] RecordingError),
    /// What the messages were handed to.
    #[error("a message of the recording could not be handled")]
    Handler(#[source] E),
}

/// Reads a recording from its first to its last message, in constant memory; a torn one up to the
/// damage.
#[derive(Debug)]
pub struct RecordingReader<R: Read> {
    source: R,
    path: PathBuf,
}

impl RecordingReader<BufReader<File>> {
    /// Opens a file.
    ///
    /// # Errors
    /// [`RecordingError::Open`] if it is not there.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let open = |source| RecordingError::Open { path: path.to_owned(), source };
        Ok(Self::new(BufReader::new(File::open(path).map_err(open)?), path))
    }
}

impl<R: Read> RecordingReader<R> {
    /// Reads from anything; `path` is for messages.
    pub fn new(source: R, path: &Path) -> Self {
        Self { source, path: path.to_owned() }
    }

    /// Hands every message on, in the order of the file, until the end, the damage or the
    /// handler's first error.
    ///
    /// # Errors
    /// [`ReadFailure`]; a torn file is no error but a report.
    pub fn for_each<E: std::error::Error + 'static>(
        mut self,
        mut handle: impl FnMut(Entry) -> Result<(), E>,
    ) -> Result<ReadReport, ReadFailure<E>> {
        let options = LinearReaderOptions::default()
            .with_skip_end_magic(true)
            .with_record_length_limit(MAX_RECORD_BYTES)
            .with_prevalidate_chunk_crcs(true);
        let mut reader = LinearReader::new_with_options(options);
        let mut report = ReadReport::default();
        let mut topics: BTreeMap<u16, Option<Key>> = BTreeMap::new();
        let mut complete = false;
        while let Some(event) = reader.next_event() {
            let record = match event {
                Ok(LinearReadEvent::ReadRequest(wanted)) => {
                    let got = self.source.read(reader.insert(wanted)).map_err(|source| {
                        ReadFailure::Recording(RecordingError::Read { path: self.path.clone(), source })
                    })?;
                    reader.notify_read(got);
                    continue;
                }
                // The library's parser would panic on a torn attachment, and we have none.
                Ok(LinearReadEvent::Record { opcode: op::ATTACHMENT, .. }) => continue,
                Ok(LinearReadEvent::Record { opcode, data }) => mcap::parse_record(opcode, data),
                Err(error) => Err(error),
            };
            match record {
                Ok(Record::Channel(channel)) => {
                    topics.insert(channel.id, channel.topic.parse().ok());
                }
                Ok(Record::Message { header, data }) => match topics.get(&header.channel_id) {
                    Some(Some(key)) => {
                        let time =
                            |nanos: u64| Timestamp::from_nanos(i64::try_from(nanos).unwrap_or(i64::MAX));
                        let entry = Entry {
                            key: key.clone(),
                            data_time: time(header.log_time),
                            arrival: time(header.publish_time),
                            data: data.into_owned(),
                        };
                        report.messages += 1;
                        handle(entry).map_err(ReadFailure::Handler)?;
                    }
                    _ => report.foreign += 1,
                },
                Ok(Record::DataEnd(_)) => complete = true,
                Ok(_) => {}
                Err(mcap::McapError::BadMagic) if report == ReadReport::default() && topics.is_empty() => {
                    return Err(ReadFailure::Recording(RecordingError::NotMcap { path: self.path }));
                }
                Err(error) => {
                    report.damage = Some(error.to_string());
                    return Ok(report);
                }
            }
        }
        if !complete {
            report.damage = Some("the file ends before its end record".to_owned());
        }
        Ok(report)
    }
}
