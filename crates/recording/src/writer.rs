use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::Path;

use crossfix_message::{Key, file_descriptor_set};
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};

use crate::{Entry, RecordingError, schema};

/// Uncompressed size at which a chunk is closed: small enough that a crash loses little.
const CHUNK_BYTES: u64 = 512 * 1024;

/// Writes a recording. Call [`Self::flush`] about once a second: what was flushed survives a crash.
pub struct RecordingWriter<W: Write + Seek> {
    writer: Writer<W>,
    channels: BTreeMap<Key, (u16, u32)>,
    messages: u64,
}

impl RecordingWriter<BufWriter<File>> {
    /// A new file; an existing one is replaced.
    ///
    /// # Errors
    /// [`RecordingError::Open`] if it cannot be made.
    pub fn create(path: &Path) -> Result<Self, RecordingError> {
        let open = |source| RecordingError::Open { path: path.to_owned(), source };
        Self::new(BufWriter::new(File::create(path).map_err(open)?))
    }
}

impl<W: Write + Seek> RecordingWriter<W> {
    /// A recording into anything that can be written.
    ///
    /// # Errors
    /// [`RecordingError::Write`] if the first bytes cannot be written.
    pub fn new(sink: W) -> Result<Self, RecordingError> {
        let writer = WriteOptions::new()
            .compression(Some(Compression::Zstd))
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            // Chunks are put together in memory and written whole: a crash leaves no half header.
            .disable_seeking(true)
            .library(concat!("crossfix ", env!("CARGO_PKG_VERSION")))
            .create(sink)
            .map_err(RecordingError::Write)?;
        Ok(Self { writer, channels: BTreeMap::new(), messages: 0 })
    }

    /// Writes one message. Keys that carry no message (liveliness) are left out.
    ///
    /// # Errors
    /// [`RecordingError::Write`]; nothing can be written after one.
    pub fn write(&mut self, entry: &Entry) -> Result<(), RecordingError> {
        let Some(name) = schema::of(&entry.key.channel) else {
            return Ok(());
        };
        let (channel_id, sequence) = match self.channels.get(&entry.key) {
            Some(&known) => known,
            None => {
                let writer = &mut self.writer;
                let channel = writer
                    .add_schema(name, "protobuf", file_descriptor_set())
                    .and_then(|id| {
                        writer.add_channel(id, &entry.key.to_string(), "protobuf", &BTreeMap::new())
                    })
                    .map_err(RecordingError::Write)?;
                (channel, 0)
            }
        };
        // MCAP has no time before the epoch.
        let nanos = |time: crossfix_message::Timestamp| u64::try_from(time.nanos()).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time: nanos(entry.data_time),
            publish_time: nanos(entry.arrival),
        };
        self.writer.write_to_known_channel(&header, &entry.data).map_err(RecordingError::Write)?;
        self.channels.insert(entry.key.clone(), (channel_id, sequence.wrapping_add(1)));
        self.messages += 1;
        Ok(())
    }

    /// Closes the chunk and hands all bytes to the system.
    ///
    /// # Errors
    /// [`RecordingError::Write`].
    pub fn flush(&mut self) -> Result<(), RecordingError> {
        self.writer.flush().map_err(RecordingError::Write)
    }

    /// Messages written so far.
    pub fn messages(&self) -> u64 {
        self.messages
    }

    /// Writes the index and ends the file.
    ///
    /// # Errors
    /// [`RecordingError::Write`].
    pub fn finish(mut self) -> Result<u64, RecordingError> {
        self.writer.finish().map_err(RecordingError::Write)?;
        Ok(self.messages)
    }
}
