//! Where the compressed frames of an MP4 file lie, and when each is shown.
//!
//! The boxes are parsed by `mp4-atom`. It is given whole boxes in a buffer, so it cannot read
//! beyond them, with nothing in them but what is read here; every loop here advances in the file or
//! ends. So the time and memory that a damaged file costs grow with its size, and
//! not with what it states.

use std::io::{Read, Seek, SeekFrom};

use super::boxes::{self, known};
use mp4_atom::{Avc1, Codec, Decode, FourCC, Moof, Moov, Stbl, StszSamples, Trak, Trex};

/// The longest index that is read, bytes: that of a day at 60 frames per second. With half of it
/// recordings of more than twelve hours at that rate are refused.
const MOST_INDEX_BYTES: u64 = 128 << 20;
/// Most frames of a file: 19 hours at 60 per second. With half of it recordings of more than 9.7
/// hours at that rate are refused.
const MOST_SAMPLES: usize = 1 << 22;
/// A compressed frame longer than this counts as damage, bytes. With half of it the same.
const MOST_SAMPLE_BYTES: u64 = 64 << 20;

/// One compressed frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sample {
    /// Where it begins, bytes from the start of the file.
    pub(super) offset: u64,
    /// How long it is, bytes.
    pub(super) size: usize,
    /// Whether it can be decoded without the frames before it.
    pub(super) is_sync: bool,
    /// When it is shown, in ticks after the first frame shown.
    pub(super) shown_at: i64,
}

/// What is known of a file's video.
#[derive(Clone, Debug)]
pub(super) struct Index {
    /// In the order of decoding.
    pub(super) samples: Vec<Sample>,
    /// Ticks per second.
    pub(super) timescale: f64,
    /// The parameter sets that every picture needs.
    pub(super) parameters: Vec<Vec<u8>>,
    /// Bytes of the length field before each part of a frame.
    pub(super) length_bytes: usize,
    /// Number of frames that lie beyond the file's end.
    pub(super) missing: usize,
}

/// Reads the index of a file's first video.
///
/// # Errors
/// What is wrong with the file, in words.
pub(super) fn read<R: Read + Seek>(file: &mut R) -> Result<Index, String> {
    let (moov, moofs) = boxes(file)?;
    let moov = moov.ok_or("it has no index: it is cut off, or no MP4 file")?;
    let end = file.seek(SeekFrom::End(0)).map_err(|error| error.to_string())?;
    let is_video = |trak: &&Trak| trak.mdia.hdlr.handler == FourCC::new(b"vide");
    let trak = moov.trak.iter().find(is_video).ok_or("it holds no video")?;
    let table = &trak.mdia.minf.stbl;
    let avc1 = h264(table)?;
    let mut samples = Samples { samples: Vec::new(), decoded_at: 0, end, missing: 0 };
    samples.add_table(table)?;
    let mut usual = moov.mvex.iter().flat_map(|mvex| &mvex.trex);
    let usual = usual.find(|trex| trex.track_id == trak.tkhd.track_id);
    for (at, moof) in &moofs {
        samples.add_fragment(*at, moof, trak.tkhd.track_id, usual)?;
    }
    let Samples { mut samples, missing, .. } = samples;
    let first = samples.iter().map(|sample| sample.shown_at).min().unwrap_or(0);
    samples.iter_mut().for_each(|sample| sample.shown_at = sample.shown_at.saturating_sub(first));
    let sets = avc1.avcc.sequence_parameter_sets.iter().chain(&avc1.avcc.picture_parameter_sets);
    Ok(Index {
        samples,
        timescale: f64::from(trak.mdia.mdhd.timescale.max(1)),
        parameters: sets.cloned().collect(),
        length_bytes: usize::from(avc1.avcc.length_size),
        missing,
    })
}

fn h264(table: &Stbl) -> Result<&Avc1, String> {
    let found = table.stsd.codecs.iter().find_map(|codec| match codec {
        Codec::Avc1(avc1) => Some(avc1),
        _ => None,
    });
    found.ok_or_else(|| "its video is not H.264".to_owned())
}

type Fragments = Vec<(u64, Moof)>;

/// The index, and the fragments with their places. Reading stops at a torn box.
fn boxes<R: Read + Seek>(file: &mut R) -> Result<(Option<Moov>, Fragments), String> {
    let text = |error: std::io::Error| error.to_string();
    let end = file.seek(SeekFrom::End(0)).map_err(text)?;
    let (mut moov, mut moofs, mut read_bytes) = (None, Vec::new(), 0);
    let mut at = 0;
    while let Some((kind, size)) = head(file, at, end).map_err(text)? {
        if kind == *b"moov" || kind == *b"moof" {
            read_bytes += size;
            if read_bytes > MOST_INDEX_BYTES {
                return Err(format!("its index has more than {MOST_INDEX_BYTES} bytes"));
            }
            let mut bytes = vec![0; usize::try_from(size).map_err(|error| error.to_string())?];
            file.seek(SeekFrom::Start(at))
                .and_then(|_| file.read_exact(&mut bytes))
                .map_err(text)?;
            let damaged = |error: mp4_atom::Error| format!("its index is damaged: {error}");
            if kind == *b"moov" {
                let known = known(&bytes, boxes::MOOV)?;
                moov = Some(Moov::decode(&mut known.as_slice()).map_err(damaged)?);
            } else {
                let known = known(&bytes, boxes::MOOF)?;
                moofs.push((at, Moof::decode(&mut known.as_slice()).map_err(damaged)?));
            }
        }
        at += size;
    }
    Ok((moov, moofs))
}

/// Kind and size of the box at a place; `None` if no whole box lies there.
fn head<R: Read + Seek>(
    file: &mut R,
    at: u64,
    end: u64,
) -> std::io::Result<Option<([u8; 4], u64)>> {
    /// Length of a box's head, bytes.
    const SHORT: u64 = 8;
    /// Length of the head of a box that is longer than 4 GB, bytes.
    const LONG: u64 = 16;
    if end.saturating_sub(at) < SHORT {
        return Ok(None);
    }
    let mut head = [0; SHORT as usize];
    file.seek(SeekFrom::Start(at))?;
    file.read_exact(&mut head)?;
    let [s0, s1, s2, s3, kind @ ..] = head;
    let (size, least) = match u32::from_be_bytes([s0, s1, s2, s3]) {
        // To the file's end.
        0 => (end - at, SHORT),
        1 if end - at < LONG => return Ok(None),
        1 => {
            let mut long = [0; 8];
            file.read_exact(&mut long)?;
            (u64::from_be_bytes(long), LONG)
        }
        size => (u64::from(size), SHORT),
    };
    Ok((size >= least && size <= end - at).then_some((kind, size)))
}

/// The frames found so far.
struct Samples {
    samples: Vec<Sample>,
    /// When the next one is decoded, ticks.
    decoded_at: i64,
    /// The file's length: what lies beyond it is missing.
    end: u64,
    missing: usize,
}

impl Samples {
    /// Adds a frame; says whether it lies in the file.
    fn push(
        &mut self,
        offset: u64,
        size: u32,
        is_sync: bool,
        shift: i64,
        lasts: u32,
    ) -> Result<bool, String> {
        let number = self.samples.len();
        let bytes = u64::from(size);
        if number >= MOST_SAMPLES || bytes > MOST_SAMPLE_BYTES || size == 0 {
            return Err(format!("its frame {number} claims {bytes} bytes"));
        }
        if offset.checked_add(bytes).is_none_or(|ends| ends > self.end) {
            return Ok(false);
        }
        let shown_at = self.decoded_at.saturating_add(shift);
        self.decoded_at = self.decoded_at.saturating_add(i64::from(lasts));
        self.samples.push(Sample { offset, size: size as usize, is_sync, shown_at });
        Ok(true)
    }

    /// The frames that the index itself lists.
    fn add_table(&mut self, table: &Stbl) -> Result<(), String> {
        let (size_of, count): (Box<dyn Fn(usize) -> Option<u32>>, usize) = match &table.stsz.samples
        {
            StszSamples::Identical { count, size } => {
                let (count, size) = (*count as usize, *size);
                (Box::new(move |index| (index < count).then_some(size)), count)
            }
            StszSamples::Different { sizes } => {
                (Box::new(|index| sizes.get(index).copied()), sizes.len())
            }
        };
        let chunks: Vec<u64> = match (&table.stco, &table.co64) {
            (Some(short), _) => short.entries.iter().map(|&offset| u64::from(offset)).collect(),
            (None, Some(long)) => long.entries.clone(),
            (None, None) => Vec::new(),
        };
        let times = table.stts.entries.iter();
        let mut durations =
            times.flat_map(|e| std::iter::repeat_n(e.sample_delta, e.sample_count as usize));
        let shifts = table.ctts.iter().flat_map(|ctts| &ctts.entries);
        let mut shifts =
            shifts.flat_map(|e| std::iter::repeat_n(e.sample_offset, e.sample_count as usize));
        let mut runs = table.stsc.entries.iter().peekable();
        let mut a_chunk = 0;
        let mut number = 0;
        for (chunk, &begins) in chunks.iter().enumerate() {
            while let Some(run) = runs.next_if(|run| run.first_chunk as usize <= chunk + 1) {
                a_chunk = run.samples_per_chunk;
            }
            let mut offset = begins;
            for _ in 0..a_chunk {
                let Some(size) = size_of(number) else {
                    break;
                };
                let is_sync = table.stss.is_none();
                let shift = shifts.next().map_or(0, i64::from);
                if !self.push(offset, size, is_sync, shift, durations.next().unwrap_or(0))? {
                    self.missing = self.missing.saturating_add(count - number);
                    self.mark_sync(table);
                    return Ok(());
                }
                number += 1;
                offset = offset.saturating_add(u64::from(size));
            }
        }
        self.mark_sync(table);
        Ok(())
    }

    /// Notes which of the listed frames can be decoded by themselves.
    fn mark_sync(&mut self, table: &Stbl) {
        for number in table.stss.iter().flat_map(|stss| &stss.entries) {
            let index = (*number as usize).checked_sub(1);
            if let Some(sample) = index.and_then(|index| self.samples.get_mut(index)) {
                sample.is_sync = true;
            }
        }
    }

    /// The frames of a fragment at a place of the file.
    fn add_fragment(
        &mut self,
        at: u64,
        moof: &Moof,
        track: u32,
        usual: Option<&Trex>,
    ) -> Result<(), String> {
        /// Flag of a frame that others are needed for (ISO/IEC 14496-12, 8.8.3).
        const IS_NOT_SYNC: u32 = 1 << 16;
        for part in moof.traf.iter().filter(|part| part.tfhd.track_id == track) {
            let head = &part.tfhd;
            let base = head.base_data_offset.unwrap_or(at);
            if let Some(tfdt) = &part.tfdt {
                self.decoded_at = i64::try_from(tfdt.base_media_decode_time).unwrap_or(i64::MAX);
            }
            let mut offset = base;
            for run in &part.trun {
                if let Some(by) = run.data_offset {
                    offset = base.saturating_add_signed(i64::from(by));
                }
                for (done, entry) in run.samples.iter().enumerate() {
                    let size = first_stated([
                        entry.size,
                        head.default_sample_size,
                        usual.map(|u| u.default_sample_size),
                    ]);
                    let flags = first_stated([
                        entry.flags,
                        head.default_sample_flags,
                        usual.map(|u| u.default_sample_flags),
                    ]);
                    let lasts = first_stated([
                        entry.duration,
                        head.default_sample_duration,
                        usual.map(|u| u.default_sample_duration),
                    ]);
                    let shift = entry.cts.map_or(0, i64::from);
                    if !self.push(offset, size, flags & IS_NOT_SYNC == 0, shift, lasts)? {
                        // What is left of the run lies beyond the end too, whatever its number.
                        self.missing = self.missing.saturating_add(run.samples.len() - done);
                        return Ok(());
                    }
                    offset = offset.saturating_add(u64::from(size));
                }
            }
        }
        Ok(())
    }
}

/// What the first says that says anything: the sample itself, its part, or the whole track; else 0.
fn first_stated(said: [Option<u32>; 3]) -> u32 {
    said.into_iter().flatten().next().unwrap_or(0)
}
