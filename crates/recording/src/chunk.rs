//! The framing of records in an MCAP file, and how a chunk is recognised by its byte pattern.

use std::io::Read;

use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, McapResult};

/// Bytes of a record's head: opcode (1) and length (8).
pub(crate) const HEAD_BYTES: usize = 9;
/// Longest record that is read, bytes; a longer one is skipped, and a chunk that states
/// more is not unpacked. The writer closes a chunk at half a megabyte and takes no message above 8
/// MB, so its own records are shorter. With half of it the same, but that chunks of other programs
/// are left out from 32 MB on.
pub(crate) const MAX_RECORD_BYTES: u64 = 64 << 20;
/// Bytes at the beginning of a chunk by which it is recognised: record head, first and last time,
/// unpacked size, checksum, the compression's name with its length before it, and the packed size.
pub(crate) const LOOKS_BYTES: usize = HEAD_BYTES + 8 + 8 + 8 + 4 + 4 + COMPRESSION.len() + 8;
/// The only compression that Crossfix writes.
const COMPRESSION: &[u8] = b"zstd";
/// The longest compression name that is accepted, bytes: the format has `zstd` and `lz4`. With half
/// of it the same.
const LONGEST_NAME: usize = 32;
/// Bytes of a chunk's body before its packed records.
const FIXED_BYTES: u64 = (LOOKS_BYTES - HEAD_BYTES) as u64;

/// A record as it is framed in the file.
pub(crate) struct Framing {
    pub(crate) opcode: u8,
    pub(crate) body: Vec<u8>,
    /// Where the record after it begins.
    pub(crate) next: u64,
}

/// Whether this is an opcode that a record may have. Private ones, which we never write, would hide
/// damage.
pub(crate) fn is_opcode(opcode: u8) -> bool {
    matches!(opcode, op::HEADER..=op::DATA_END)
}

/// Whether a record's body has the shape of a chunk's, whatever its opcode says.
pub(crate) fn has_shape(body: &[u8]) -> bool {
    let name = (FIXED_BYTES as usize) - 8 - COMPRESSION.len();
    let packed = body.get(name + COMPRESSION.len()..FIXED_BYTES as usize);
    body.get(name - 4..name) == Some(&[4, 0, 0, 0])
        && body[name..].starts_with(COMPRESSION)
        && packed.and_then(|bytes| bytes.try_into().ok()).map(u64::from_le_bytes)
            == (body.len() as u64).checked_sub(FIXED_BYTES)
}

/// Offset of the first chunk in some bytes; `left` bytes of the file are left from their beginning.
pub(crate) fn find(bytes: &[u8], left: u64) -> Option<usize> {
    (0..bytes.len().saturating_sub(LOOKS_BYTES - 1)).find(|&at| {
        begins_chunk(&bytes[at..at + LOOKS_BYTES], left.saturating_sub((at + HEAD_BYTES) as u64))
    })
}

/// Whether `LOOKS_BYTES` bytes begin a chunk whose body has at most `left` bytes. The opcode may be
/// what is damaged, so it is not compared.
fn begins_chunk(bytes: &[u8], left: u64) -> bool {
    let name = LOOKS_BYTES - 8 - COMPRESSION.len();
    if bytes[name - 4..name] != [4, 0, 0, 0] || !bytes[name..].starts_with(COMPRESSION) {
        return false;
    }
    // The record's length must agree with that of its packed part.
    let lengths = u64_at(bytes, 1).zip(u64_at(bytes, name + COMPRESSION.len()));
    lengths.is_some_and(|(length, packed)| {
        length == packed.saturating_add(FIXED_BYTES) && length <= MAX_RECORD_BYTES && length <= left
    })
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?))
}

/// Number of bytes of a record's body that belong to the chunk, as the chunk itself states it; only
/// valid for a chunk that was read without error.
pub(crate) fn own_bytes(body: &[u8]) -> u64 {
    match mcap::parse_record(op::CHUNK, body) {
        Ok(Record::Chunk { header, .. }) => {
            let name = header.compression.len() as u64;
            (FIXED_BYTES - COMPRESSION.len() as u64) + name + header.compressed_size
        }
        _ => body.len() as u64,
    }
}

/// Whether the records of an uncompressed chunk, as other programs write them, end where the chunk
/// ends. Where they go on beyond it, the library's count of the bytes left would underflow.
fn is_filled(body: &[u8]) -> bool {
    let Ok(Record::Chunk { header, data }) = mcap::parse_record(op::CHUNK, body) else {
        return false;
    };
    let mut rest = &data[..];
    while header.compression.is_empty() && !rest.is_empty() {
        let Some((head, after)) = rest.split_first_chunk::<HEAD_BYTES>() else { return false };
        let [_, length @ ..] = *head;
        let length = usize::try_from(u64::from_le_bytes(length)).ok();
        let Some(after) = length.and_then(|length| after.get(length..)) else { return false };
        rest = after;
    }
    true
}

/// Hands on the records of a chunk. Its checksum is compared before the first one, so that no
/// record of a damaged chunk is handed on.
///
/// # Errors
/// The inner error says what is wrong with the chunk, the outer one comes from the handler.
pub(crate) fn for_each_record<E>(
    body: &[u8],
    mut handle: impl FnMut(u8, &[u8]) -> Result<(), E>,
) -> Result<McapResult<()>, E> {
    // The library would reserve as much memory as a damaged length states.
    let name_bytes =
        body.get(28..32).and_then(|bytes| bytes.try_into().ok()).map(u32::from_le_bytes);
    if name_bytes.is_none_or(|bytes| bytes as usize > LONGEST_NAME) {
        return Ok(Err(McapError::UnexpectedEoc));
    }
    if !is_filled(body) {
        return Ok(Err(McapError::UnexpectedEoc));
    }
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_record_length_limit(MAX_RECORD_BYTES as usize)
        .with_prevalidate_chunk_crcs(true);
    let mut reader = LinearReader::new_with_options(options);
    let head = [&[op::CHUNK][..], &(body.len() as u64).to_le_bytes()].concat();
    let mut given = head.as_slice().chain(body);
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => match given.read(reader.insert(wanted)) {
                // The reader would go on to the record after the chunk.
                Ok(0) => break,
                Ok(got) => reader.notify_read(got),
                Err(error) => return Ok(Err(error.into())),
            },
            Ok(LinearReadEvent::Record { opcode, data }) => handle(opcode, data)?,
            Err(error) => return Ok(Err(error)),
        }
    }
    Ok(Ok(()))
}
