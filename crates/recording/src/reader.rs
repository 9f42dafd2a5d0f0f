use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use crossfix_message::{Key, KeyError, Timestamp};
use mcap::MAGIC;
use mcap::records::{Record, op};
use thiserror::Error;

use crate::chunk::{self, Framing, HEAD_BYTES, MAX_RECORD_BYTES};
use crate::source::{self, Texts};
use crate::{CHANNELS, Damage, Entry, RecordingError, Source};

/// Damaged records may claim bytes that belong to other records, so that these bytes are read
/// again: in total at most this many times the size of the file. With half of it the rest of a
/// badly damaged file is given up sooner; with twice as much a hostile one takes twice as long.
const MAX_READINGS: u64 = 16;

/// Result of reading a recording: what it contained, and what could not be read.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReadReport {
    /// Number of messages handed on.
    pub messages: u64,
    /// Number of messages on topics that are not Crossfix's; they were left out.
    pub foreign: u64,
    /// Topics that begin as Crossfix's do but are none, as a name in them is not possible; their
    /// messages are among the foreign ones.
    pub misnamed: BTreeSet<String>,
    /// Who wrote it, if the file states it.
    pub source: Option<Source>,
    /// What could not be read; everything else was handed on.
    pub damage: Option<Damage>,
}

/// Why reading a recording stopped.
#[derive(Debug, Error)]
pub enum ReadFailure<E: std::error::Error + 'static> {
    /// The recording itself.
    #[error("the recording cannot be read")]
    Recording(#[source] RecordingError),
    /// The handler that the messages were handed to.
    #[error("a message of the recording could not be handled")]
    Handler(#[source] E),
}

/// Reads a recording from its first to its last message, in constant memory. Damage costs the chunk
/// that it is in, which holds about a second: the next chunk is found again, by its place or by its
/// byte pattern.
#[derive(Debug)]
pub struct RecordingReader<R: Read + Seek> {
    source: R,
    path: PathBuf,
    size: u64,
    /// Where the next record begins.
    at: u64,
    /// The keys of the file's channels; `None` for those that are not Crossfix's.
    keys: BTreeMap<u16, Option<Key>>,
    report: ReadReport,
    /// All chunks that begin before this place have been found: a chunk has a checksum that
    /// confirms its extent.
    sure_until: u64,
    /// Whether the record that ends the messages has been seen.
    is_complete: bool,
    /// Where the index begins, if the file has a valid end.
    index_at: Option<u64>,
    /// Total bytes of damaged records so far, which may have to be read again.
    spent: u64,
}

impl<R: Read + Seek> RecordingReader<R> {
    /// The keys of the channels of a complete file; none for a torn one, which names them only
    /// among its messages.
    pub fn keys(&self) -> impl Iterator<Item = &Key> {
        self.keys.values().flatten()
    }
}

impl RecordingReader<BufReader<File>> {
    /// Opens a file.
    ///
    /// # Errors
    /// [`RecordingError`] if it is not there, empty, or no MCAP file.
    pub fn open(path: &Path) -> Result<Self, RecordingError> {
        let open = |source| RecordingError::Open { path: path.to_owned(), source };
        let file = File::open(path).map_err(open)?;
        if file.metadata().map_err(open)?.is_dir() {
            return Err(open(std::io::Error::from(std::io::ErrorKind::IsADirectory)));
        }
        Self::new(BufReader::new(file), path)
    }
}

impl<R: Read + Seek> RecordingReader<R> {
    /// Reads from any source; `path` is only for error messages.
    ///
    /// # Errors
    /// [`RecordingError`] if it cannot be read, is empty, or no MCAP file.
    pub fn new(source: R, path: &Path) -> Result<Self, RecordingError> {
        let report = ReadReport::default();
        let mut reader = Self {
            source,
            path: path.to_owned(),
            size: 0,
            at: 0,
            sure_until: 0,
            keys: BTreeMap::new(),
            report,
            is_complete: false,
            index_at: None,
            spent: 0,
        };
        reader.begin()?;
        Ok(reader)
    }

    fn begin(&mut self) -> Result<(), RecordingError> {
        self.size = self.io(|source| source.seek(SeekFrom::End(0)))?;
        if self.size == 0 {
            return Err(RecordingError::Empty { path: self.path.clone() });
        }
        let mut magic = [0; MAGIC.len()];
        let has_magic = self.fill(0, &mut magic)? && magic == MAGIC;
        self.at = MAGIC.len() as u64;
        if !has_magic {
            // A damaged first byte costs no more than any other, if anything in the file looks like
            // a chunk.
            self.at = 0;
            self.lose("it does not begin as an MCAP file", 0)?;
            if self.at >= self.size {
                return Err(RecordingError::NotMcap { path: self.path.clone() });
            }
        }
        // The channels are listed in the first chunk, and again at the end of the file: they are
        // read from there first, in case that chunk is lost.
        self.learn_channels()
    }

    /// Hands every message on, in the order of the file, until the end or the handler's first
    /// error.
    ///
    /// # Errors
    /// [`ReadFailure`]; damage is not an error but is reported.
    pub fn for_each<E: std::error::Error + 'static>(
        mut self,
        mut handle: impl FnMut(Entry) -> Result<(), E>,
    ) -> Result<ReadReport, ReadFailure<E>> {
        while let Some(Framing { mut opcode, body, next }) =
            self.next_record().map_err(ReadFailure::Recording)?
        {
            if opcode != op::CHUNK && chunk::has_shape(&body) {
                self.note(self.at, 0, "a chunk says that it is none");
                opcode = op::CHUNK;
            }
            let read = if opcode == op::CHUNK {
                chunk::for_each_record(&body, |opcode, record| {
                    let read = self.take_inner(opcode, record, &mut handle)?;
                    if let Err(what) = read {
                        self.note(self.at, record.len() as u64, &what);
                    }
                    Ok(())
                })?
                .map_err(|error| error.to_string())
            } else {
                self.take_outer(opcode, &body, &mut handle)?
            };
            self.go_on(opcode, &body, next, read);
        }
        if !self.is_complete || self.index_at.is_none() {
            self.note(self.size, 0, "the file ends before its end record");
        }
        Ok(self.report)
    }

    /// Continues after a record. Where its length is what is damaged, other chunks lie in the bytes
    /// that it states. A chunk that was read without error states its length once more inside,
    /// under its checksum.
    fn go_on(&mut self, opcode: u8, body: &[u8], mut next: u64, read: Result<(), String>) {
        if opcode == op::CHUNK && read.is_ok() {
            next = next.min(self.at + HEAD_BYTES as u64 + chunk::own_bytes(body));
        }
        let inside = (opcode != op::CHUNK || read.is_err())
            .then(|| chunk::find(body, self.size - self.at - HEAD_BYTES as u64))
            .flatten();
        let resumed = inside.map_or(next, |offset| self.at + (HEAD_BYTES + offset) as u64);
        let what = match read {
            Err(what) => Some(what),
            Ok(()) => inside.map(|_| "a record claims more than is its own".to_owned()),
        };
        if let Some(what) = what {
            self.note(self.at, resumed - self.at, &what);
            self.spent += next - self.at;
        }
        if opcode == op::CHUNK {
            self.sure_until = if inside.is_some() { self.at + 1 } else { resumed };
        }
        self.at = resumed;
        // The rest of a file is given up if it was made to have everything in it read many times.
        if self.spent > self.size.saturating_mul(MAX_READINGS) {
            self.note(self.at, self.size - self.at, "it is damaged in too many places");
            self.at = self.size;
        }
    }

    /// Handles one record of a chunk; the inner error says what is wrong with it. The library's
    /// parser is given only message records here, as it trusts the lengths that damaged records
    /// state.
    fn take_inner<E: std::error::Error + 'static>(
        &mut self,
        opcode: u8,
        body: &[u8],
        handle: &mut impl FnMut(Entry) -> Result<(), E>,
    ) -> Result<Result<(), String>, ReadFailure<E>> {
        if opcode == op::CHANNEL {
            let channel = source::channel(body);
            channel.iter().for_each(|channel| self.learn(channel));
            return Ok(channel.map(drop).ok_or_else(|| "a channel record is damaged".to_owned()));
        }
        if opcode != op::MESSAGE {
            return Ok(Ok(()));
        }
        match mcap::parse_record(opcode, body) {
            Ok(Record::Message { header, data }) => {
                let key = match self.keys.get(&header.channel_id) {
                    Some(Some(key)) => key,
                    Some(None) => {
                        self.report.foreign += 1;
                        return Ok(Ok(()));
                    }
                    None => return Ok(Err("a message is of a channel that was lost".to_owned())),
                };
                let time =
                    |nanos: u64| Timestamp::from_nanos(i64::try_from(nanos).unwrap_or(i64::MAX));
                let entry = Entry {
                    key: key.clone(),
                    data_time: time(header.log_time),
                    arrival: time(header.publish_time),
                    data: data.into_owned(),
                };
                self.report.messages += 1;
                handle(entry).map_err(ReadFailure::Handler)?;
            }
            Ok(_) => {}
            Err(error) => return Ok(Err(error.to_string())),
        }
        Ok(Ok(()))
    }

    /// Handles one record outside of the chunks; a file without chunks has its messages there.
    fn take_outer<E: std::error::Error + 'static>(
        &mut self,
        opcode: u8,
        body: &[u8],
        handle: &mut impl FnMut(Entry) -> Result<(), E>,
    ) -> Result<Result<(), String>, ReadFailure<E>> {
        match opcode {
            // A file with chunks has no messages outside of them: this is another record, damaged.
            op::MESSAGE if self.sure_until > 0 => {
                Ok(Err("a message lies between chunks".to_owned()))
            }
            op::CHANNEL | op::MESSAGE => self.take_inner(opcode, body, handle),
            op::METADATA => {
                let texts = Texts::read(body);
                texts.iter().for_each(|texts| self.learn_texts(texts));
                Ok(texts.map(drop).ok_or_else(|| "a metadata record is damaged".to_owned()))
            }
            // After the end record come only an index, and the channels again.
            op::DATA_END => {
                let next = self.at + (HEAD_BYTES + body.len()) as u64;
                self.is_complete = self.index_at.is_none_or(|index| index == next);
                Ok(Ok(()))
            }
            _ => Ok(Ok(())),
        }
    }

    fn learn(&mut self, (id, topic): &(u16, String)) {
        let key = self.key(topic);
        self.keys.insert(*id, key);
    }

    fn key(&mut self, topic: &str) -> Option<Key> {
        let key: Result<Key, KeyError> = topic.parse();
        if let Err(KeyError::Name { .. }) = &key {
            self.report.misnamed.insert(topic.to_owned());
        }
        key.ok()
    }

    fn learn_texts(&mut self, texts: &Texts) {
        if texts.name == CHANNELS {
            for (id, topic) in &texts.pairs {
                if let Ok(id) = id.parse()
                    && !self.keys.contains_key(&id)
                {
                    let key = self.key(topic);
                    self.keys.insert(id, key);
                }
            }
        }
        self.report.source = Source::read(texts).or(self.report.source.take());
    }

    /// Reads the channels that a complete file lists again after its messages.
    fn learn_channels(&mut self) -> Result<(), RecordingError> {
        /// The footer: a record of 20 bytes, then the magic, as MCAP defines it.
        const FOOTER_BYTES: u64 = HEAD_BYTES as u64 + 20 + MAGIC.len() as u64;
        let mut footer = [0; FOOTER_BYTES as usize];
        let Some(place) = self.size.checked_sub(FOOTER_BYTES) else {
            return Ok(());
        };
        if !self.fill(place, &mut footer)? || footer[0] != op::FOOTER || !footer.ends_with(MAGIC) {
            return Ok(());
        }
        let begins = self.at;
        let Ok(Record::Footer(found)) =
            mcap::parse_record(op::FOOTER, &footer[HEAD_BYTES..HEAD_BYTES + 20])
        else {
            return Ok(());
        };
        self.at = if found.summary_start == 0 { place } else { found.summary_start };
        self.index_at = Some(self.at);
        while self.at < place {
            let Some((opcode, length)) = self.head(self.at)? else {
                break;
            };
            if length > MAX_RECORD_BYTES {
                break;
            }
            let body = if opcode == op::CHANNEL { self.body(self.at, length)? } else { Vec::new() };
            if opcode == op::CHANNEL
                && let Some(channel) = source::channel(&body)
            {
                self.learn(&channel);
            }
            self.at += HEAD_BYTES as u64 + length;
        }
        self.at = begins;
        Ok(())
    }

    /// The next complete record; damage before it is noted.
    fn next_record(&mut self) -> Result<Option<Framing>, RecordingError> {
        if self.is_complete || self.at >= self.size {
            return Ok(None);
        }
        match self.head(self.at)? {
            Some((opcode, length)) if length <= MAX_RECORD_BYTES => {
                let next = self.at + HEAD_BYTES as u64 + length;
                return Ok(Some(Framing { opcode, body: self.body(self.at, length)?, next }));
            }
            Some(_) => self.lose("a record is too long to be true", self.at + 1)?,
            // The record before may have claimed the beginning of the one that is missing here.
            None => self.lose("no record begins where one must", self.sure_until)?,
        }
        self.chunk_here()
    }

    /// The chunk at this place, which was found by its shape, whatever its opcode says.
    fn chunk_here(&mut self) -> Result<Option<Framing>, RecordingError> {
        let mut head = [0; HEAD_BYTES];
        if self.at >= self.size || !self.fill(self.at, &mut head)? {
            return Ok(None);
        }
        let [_, length @ ..] = head;
        let length = u64::from_le_bytes(length);
        let body = self.body(self.at, length)?;
        Ok(Some(Framing { opcode: op::CHUNK, body, next: self.at + HEAD_BYTES as u64 + length }))
    }

    /// The opcode and length of the record at a place, if it has a valid opcode and ends within the
    /// file.
    fn head(&mut self, at: u64) -> Result<Option<(u8, u64)>, RecordingError> {
        let mut head = [0; HEAD_BYTES];
        if !self.fill(at, &mut head)? {
            return Ok(None);
        }
        let [opcode, length @ ..] = head;
        let length = u64::from_le_bytes(length);
        let fits = length <= self.size - at - HEAD_BYTES as u64;
        Ok((chunk::is_opcode(opcode) && fits).then_some((opcode, length)))
    }

    fn body(&mut self, at: u64, length: u64) -> Result<Vec<u8>, RecordingError> {
        let mut body = vec![0; usize::try_from(length).unwrap_or(0)];
        self.fill(at + HEAD_BYTES as u64, &mut body)?;
        Ok(body)
    }

    /// Skips to the next thing that looks like a chunk.
    fn lose(&mut self, what: &str, search_from: u64) -> Result<(), RecordingError> {
        let begun = self.at.max(search_from);
        let found = self.find_chunk(search_from)?;
        self.at = found.unwrap_or(self.size);
        // The rest of a file that was cut off is not damage within it: the note on the missing end
        // covers it.
        if found.is_some() {
            self.note(begun, self.at.saturating_sub(begun), what);
        }
        Ok(())
    }

    /// The place of the first chunk at or after a place.
    fn find_chunk(&mut self, from: u64) -> Result<Option<u64>, RecordingError> {
        /// Bytes that are searched at a time: with half of it the same.
        const WINDOW: usize = 1 << 20;
        let mut window = vec![0; WINDOW + chunk::LOOKS_BYTES];
        let mut at = from;
        while at < self.size {
            let length = usize::try_from(self.size - at).unwrap_or(usize::MAX).min(window.len());
            self.fill(at, &mut window[..length])?;
            if let Some(offset) = chunk::find(&window[..length], self.size - at) {
                return Ok(Some(at + offset as u64));
            }
            at += WINDOW as u64;
        }
        Ok(None)
    }

    /// Fills a buffer from a place; `false` if the file ends before.
    fn fill(&mut self, at: u64, buffer: &mut [u8]) -> Result<bool, RecordingError> {
        if at.saturating_add(buffer.len() as u64) > self.size {
            return Ok(false);
        }
        self.io(|source| {
            // No seek where none is needed, as it would empty the reader's buffer: the file is read
            // mostly from its beginning to its end.
            let here = source.stream_position()?;
            if here != at {
                source.seek(SeekFrom::Start(at))?;
            }
            source.read_exact(buffer)
        })?;
        Ok(true)
    }

    fn io<T>(
        &mut self,
        action: impl FnOnce(&mut R) -> std::io::Result<T>,
    ) -> Result<T, RecordingError> {
        action(&mut self.source)
            .map_err(|source| RecordingError::Read { path: self.path.clone(), source })
    }

    fn note(&mut self, at: u64, bytes: u64, what: &str) {
        Damage::note(&mut self.report.damage, at, bytes, what);
    }
}
