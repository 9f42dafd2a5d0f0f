use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use crate::{CaptureTime, Frame, FrameClock, FrameSource, Still, VideoError, decode_still};

/// The longest frame that is read, bytes: no JPEG picture of the largest image is longer. With half
/// of it the same for pictures of cameras.
const MOST_BYTES: u64 = 1 << 28;
/// Codecs in which every frame is a JPEG picture, as files name them.
const MOTION_JPEG: [&[u8; 4]; 4] = [b"MJPG", b"mjpg", b"AVI1", b"JPEG"];

/// An AVI file with Motion JPEG; its first video stream is read.
///
/// Chunks are read in the order of the file, so no index is needed, and a wrong one does no harm.
#[derive(Debug)]
pub struct AviSource {
    chunks: Chunks,
    path: PathBuf,
    /// The number of the video stream: the first two letters of its chunks' names.
    stream: [u8; 2],
    rate_hz: f64,
    next: u64,
    clock: FrameClock,
}

/// The name of a chunk and its length in bytes.
type Chunk = ([u8; 4], u64);

/// The chunks of a file, those within lists included.
#[derive(Debug)]
struct Chunks {
    file: BufReader<File>,
    length: u64,
    /// Where the next chunk begins.
    at: u64,
    /// Where the file has been read to.
    read_to: u64,
}

impl Chunks {
    /// The next chunk that is no list; `None` at the end of the file, or where a chunk's head is
    /// cut off.
    fn next(&mut self) -> std::io::Result<Option<Chunk>> {
        while self.at.saturating_add(8) <= self.length {
            let mut head = [0; 8];
            self.go_to(self.at)?;
            self.file.read_exact(&mut head)?;
            self.read_to += 8;
            let [a, b, c, d, size @ ..] = head;
            let (name, size) = ([a, b, c, d], u64::from(u32::from_le_bytes(size)));
            self.at += 8;
            if matches!(&name, b"RIFF" | b"LIST") {
                // A list's contents follow the four letters of its kind.
                self.at += 4;
                continue;
            }
            return Ok(Some((name, size)));
        }
        Ok(None)
    }

    /// Seeks to a place, keeping what is buffered.
    fn go_to(&mut self, place: u64) -> std::io::Result<()> {
        let by = place as i64 - self.read_to as i64;
        self.file.seek_relative(by)?;
        self.read_to = place;
        Ok(())
    }

    /// The bytes of the chunk returned last, as many as there are and at most `most`.
    fn read(&mut self, size: u64, most: u64) -> std::io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let got = self.file.by_ref().take(size.min(most)).read_to_end(&mut bytes);
        self.read_to += bytes.len() as u64;
        self.skip(size);
        got.map(|_| bytes)
    }

    /// Moves behind the chunk returned last; chunks begin at even places.
    fn skip(&mut self, size: u64) {
        self.at = self.at.saturating_add(size).saturating_add(size % 2);
    }
}

impl AviSource {
    /// Opens a file and reads its headers.
    ///
    /// # Errors
    /// [`VideoError`] if it cannot be opened, is no AVI file, or has no stream of Motion JPEG.
    pub fn open(path: &Path, clock: FrameClock) -> Result<Self, VideoError> {
        let open = |source| VideoError::Open { path: path.to_owned(), source };
        let damaged = |what: String| VideoError::Damaged { path: path.to_owned(), what };
        let mut file = BufReader::new(File::open(path).map_err(open)?);
        let length = file.get_ref().metadata().map_err(open)?.len();
        let mut kind = Vec::new();
        file.by_ref().take(12).read_to_end(&mut kind).map_err(open)?;
        if !(kind.starts_with(b"RIFF") && kind.ends_with(b"AVI ") && kind.len() == 12) {
            return Err(damaged("it does not begin as an AVI file".to_owned()));
        }
        let mut chunks = Chunks { file, length, at: 0, read_to: 12 };
        let (mut streams, mut rate_hz, mut is_video) = (0_u8, 0.0, false);
        while let Some((name, size)) = chunks.next().map_err(open)? {
            match &name {
                b"strh" => {
                    let head = chunks.read(size, 64).map_err(open)?;
                    is_video = head.starts_with(b"vids");
                    // Frames per second are the head's rate over its scale.
                    rate_hz = f64::from(number(&head, 24)) / f64::from(number(&head, 20).max(1));
                    streams = streams.saturating_add(1);
                }
                b"strf" if is_video => {
                    let format = chunks.read(size, 64).map_err(open)?;
                    let codec = format.get(16..20).unwrap_or_default();
                    if !MOTION_JPEG.iter().any(|known| codec == known.as_slice()) {
                        let codec = String::from_utf8_lossy(codec);
                        return Err(damaged(format!("its video is {codec:?}, not Motion JPEG")));
                    }
                    let number = streams.saturating_sub(1);
                    let stream = [b'0' + number / 10 % 10, b'0' + number % 10];
                    let rate_hz = if (0.01..=1e5).contains(&rate_hz) {
                        rate_hz
                    } else {
                        clock.fallback_rate_hz
                    };
                    return Ok(Self {
                        chunks,
                        path: path.to_owned(),
                        stream,
                        rate_hz,
                        next: 0,
                        clock,
                    });
                }
                _ => chunks.skip(size),
            }
        }
        Err(damaged("it has no stream of video".to_owned()))
    }
}

/// The little-endian number at a place; 0 if it lies beyond the end.
fn number(bytes: &[u8], at: usize) -> u32 {
    let four = bytes.get(at..at + 4).and_then(|four| four.try_into().ok());
    four.map_or(0, u32::from_le_bytes)
}

impl FrameSource for AviSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        let index = self.next;
        let damaged = |what: String| VideoError::Damaged { path: self.path.clone(), what };
        while let Some((name, size)) =
            self.chunks.next().map_err(|error| damaged(error.to_string()))?
        {
            let is_frame = name[..2] == self.stream && matches!(&name[2..], b"dc" | b"db");
            if !is_frame {
                self.chunks.skip(size);
                continue;
            }
            self.next += 1;
            let frame = |what: String| VideoError::Frame { path: self.path.clone(), index, what };
            let bytes =
                self.chunks.read(size, MOST_BYTES).map_err(|error| frame(error.to_string()))?;
            if bytes.is_empty() {
                return Err(frame("it was left out by the recorder".to_owned()));
            }
            let Still { width, height, pixels } = decode_still(&bytes).map_err(frame)?;
            let CaptureTime { time, sd_s } = self.clock.at(index as f64 / self.rate_hz);
            return Ok(Some(Frame {
                index,
                capture: CaptureTime { time, sd_s },
                live: None,
                width,
                height,
                pixels,
            }));
        }
        Ok(None)
    }
}
