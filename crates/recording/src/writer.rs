use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, ErrorKind, Seek, Write};
use std::path::Path;

use crossfix_message::{Key, MOST_MESSAGE_BYTES, Timestamp, file_descriptor_set};
use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, McapResult, WriteOptions, Writer};

use crate::{Beside, CHANNELS, Entry, RecordingError, Source, schema_of};

/// The fastest compression: recordings are mostly floating-point numbers, which higher levels
/// hardly make smaller.
const COMPRESSION_LEVEL: u32 = 1;
/// Uncompressed size at which a chunk is closed: small enough that a crash loses little. With half
/// of it chunks are twice as many, and each is compressed alone; with twice as much a damaged byte
/// costs twice as many messages.
const CHUNK_BYTES: u64 = 512 * 1024;

/// Header of a channel's message with this sequence number. MCAP has no time before the epoch:
/// earlier times become 0.
fn header(
    (channel_id, sequence): (u16, u32),
    data_time: Timestamp,
    arrival: Timestamp,
) -> MessageHeader {
    let nanos = |time: Timestamp| u64::try_from(time.nanos()).unwrap_or(0);
    MessageHeader { channel_id, sequence, log_time: nanos(data_time), publish_time: nanos(arrival) }
}

/// Writes a recording. Call [`Self::flush`] about once a second: what was flushed survives a crash.
pub struct RecordingWriter<W: Write + Seek> {
    writer: Writer<W>,
    channels: BTreeMap<Key, (u16, u32)>,
    /// The channels of messages in foreign schemas, by topic: id and next sequence number.
    beside: BTreeMap<String, (u16, u32)>,
    /// Whether a channel has been added since the channels were last listed outside of the chunks.
    has_new_channels: bool,
    messages: u64,
}

impl RecordingWriter<BufWriter<File>> {
    /// Creates a file; an existing one is replaced.
    ///
    /// # Errors
    /// [`RecordingError::Create`] if it cannot be made.
    pub fn create(path: &Path) -> Result<Self, RecordingError> {
        let create = |source| RecordingError::Create { path: path.to_owned(), source };
        Self::new(BufWriter::new(File::create(path).map_err(create)?))
    }

    /// Creates a file where none exists.
    ///
    /// # Errors
    /// [`RecordingError::Exists`] if there is one, [`RecordingError::Create`] if it cannot be made.
    pub fn create_new(path: &Path) -> Result<Self, RecordingError> {
        let file = File::create_new(path).map_err(|source| match source.kind() {
            ErrorKind::AlreadyExists => RecordingError::Exists { path: path.to_owned() },
            _ => RecordingError::Create { path: path.to_owned(), source },
        })?;
        Self::new(BufWriter::new(file))
    }
}

impl<W: Write + Seek> RecordingWriter<W> {
    /// A recording to any sink.
    ///
    /// # Errors
    /// [`RecordingError::Write`] if the first bytes cannot be written.
    pub fn new(sink: W) -> Result<Self, RecordingError> {
        let writer = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .compression_level(COMPRESSION_LEVEL)
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            // Chunks are assembled in memory and written whole: a crash leaves no half-written
            // header.
            .disable_seeking(true)
            .library(concat!("crossfix ", env!("CARGO_PKG_VERSION")))
            .create(sink)
            .map_err(RecordingError::Write)?;
        Ok(Self {
            writer,
            channels: BTreeMap::new(),
            beside: BTreeMap::new(),
            has_new_channels: false,
            messages: 0,
        })
    }

    /// Writes to the file who writes it.
    ///
    /// # Errors
    /// [`RecordingError::Write`].
    pub fn sign(&mut self, source: &Source) -> Result<(), RecordingError> {
        self.writer.write_metadata(&source.write()).map_err(RecordingError::Write)
    }

    /// Writes one message. Keys that carry no message (liveliness) are left out.
    ///
    /// # Errors
    /// [`RecordingError::TooLong`]: the message is left out; [`RecordingError::Write`]: nothing can
    /// be written any more.
    pub fn write(&mut self, entry: &Entry) -> Result<(), RecordingError> {
        if entry.data.len() > MOST_MESSAGE_BYTES {
            return Err(RecordingError::TooLong {
                topic: entry.key.to_string(),
                bytes: entry.data.len(),
            });
        }
        let Some(name) = schema_of(&entry.key.channel) else {
            return Ok(());
        };
        let (channel_id, sequence) = match self.channels.get(&entry.key) {
            Some(&known) => known,
            None => (self.add_channel(name, &entry.key).map_err(RecordingError::Write)?, 0),
        };
        let header = header((channel_id, sequence), entry.data_time, entry.arrival);
        self.writer.write_to_known_channel(&header, &entry.data).map_err(RecordingError::Write)?;
        self.channels.insert(entry.key.clone(), (channel_id, sequence.wrapping_add(1)));
        self.messages += 1;
        Ok(())
    }

    /// Writes a message in a foreign schema for other programs. Our own readers leave it out, and
    /// it is not counted.
    ///
    /// # Errors
    /// [`RecordingError::Write`].
    pub fn write_beside(&mut self, message: &Beside<'_>) -> Result<(), RecordingError> {
        let known = self.beside.get(message.topic).copied();
        let (channel_id, sequence) = match known {
            Some(known) => known,
            None => (self.add_beside(message).map_err(RecordingError::Write)?, 0),
        };
        let header = header((channel_id, sequence), message.data_time, message.arrival);
        let written = self.writer.write_to_known_channel(&header, message.data);
        written.map_err(RecordingError::Write)?;
        self.beside.insert(message.topic.to_owned(), (channel_id, sequence.wrapping_add(1)));
        Ok(())
    }

    fn add_beside(&mut self, message: &Beside<'_>) -> McapResult<u16> {
        self.has_new_channels = true;
        let schema = self.writer.add_schema(message.schema, "protobuf", message.definitions)?;
        self.writer.add_channel(schema, message.topic, "protobuf", &BTreeMap::new())
    }

    fn add_channel(&mut self, schema: &str, key: &Key) -> McapResult<u16> {
        self.has_new_channels = true;
        let schema = self.writer.add_schema(schema, "protobuf", file_descriptor_set())?;
        self.writer.add_channel(schema, &key.to_string(), "protobuf", &BTreeMap::new())
    }

    /// Lists the channels outside of the chunks. A torn file has no end to list them again, and
    /// without this a damaged first chunk would make all later ones unreadable.
    fn say_channels(&mut self) -> McapResult<()> {
        if !std::mem::take(&mut self.has_new_channels) {
            return Ok(());
        }
        let ours = self.channels.iter().map(|(key, (id, _))| (id.to_string(), key.to_string()));
        let beside = self.beside.iter().map(|(topic, (id, _))| (id.to_string(), topic.clone()));
        let said = ours.chain(beside);
        self.writer
            .write_metadata(&Metadata { name: CHANNELS.to_owned(), metadata: said.collect() })
    }

    /// Closes the chunk and hands all bytes to the operating system.
    ///
    /// # Errors
    /// [`RecordingError::Write`].
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.say_channels().and_then(|()| self.writer.flush()).map_err(RecordingError::Write)
    }

    /// Number of messages written so far.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Writes the index and ends the file.
    ///
    /// # Errors
    /// [`RecordingError::Write`].
    pub fn finish(mut self) -> Result<u64, RecordingError> {
        self.writer.finish().map_err(RecordingError::Write)?;
        // Flushed here, as a dropped buffer does not report what the disk did not take.
        self.writer.into_inner().flush().map_err(|error| RecordingError::Write(error.into()))?;
        Ok(self.messages)
    }
}
