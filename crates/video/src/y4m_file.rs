use std::fs::File;
use std::io::{BufRead, BufReader, Chain, Cursor, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::{Frame, FrameClock, FrameSource, MOST_PIXELS, Pixels, VideoError};

/// The longest header line that is read, bytes. With half of it the same.
const MOST_HEADER: u64 = 4096;

type Input = Chain<Cursor<Vec<u8>>, CountingFile>;

/// A file that counts how many bytes have been read since the count was reset.
struct CountingFile {
    file: BufReader<File>,
    read: Arc<AtomicU64>,
}

impl Read for CountingFile {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let got = self.file.read(buffer)?;
        self.read.fetch_add(got as u64, Ordering::Relaxed);
        Ok(got)
    }
}

/// A YUV4MPEG2 file; only the brightness plane is used, 8 to 16 bits.
pub struct Y4mSource {
    decoder: y4m::Decoder<Input>,
    /// Bytes read so far of the current frame.
    read: Arc<AtomicU64>,
    path: PathBuf,
    next: u64,
    rate_hz: f64,
    /// Left shift that scales a sample of more than 8 bits to 16.
    shift: u32,
    clock: FrameClock,
}

impl Y4mSource {
    /// Opens a file and reads its header.
    ///
    /// # Errors
    /// [`VideoError`] if it cannot be opened or its header makes no sense.
    pub fn open(path: &Path, clock: FrameClock) -> Result<Self, VideoError> {
        let open = |source| VideoError::Open { path: path.to_owned(), source };
        let damaged = |what: String| VideoError::Damaged { path: path.to_owned(), what };
        let mut file = BufReader::new(File::open(path).map_err(open)?);
        let mut header = Vec::new();
        file.by_ref().take(MOST_HEADER).read_until(b'\n', &mut header).map_err(open)?;
        let text = String::from_utf8_lossy(&header).into_owned();
        if !text.starts_with("YUV4MPEG2") {
            return Err(damaged("it does not begin with YUV4MPEG2".to_owned()));
        }
        let (width, height) = (side(&text, 'W'), side(&text, 'H'));
        if width == 0 || height == 0 || width.saturating_mul(height) > MOST_PIXELS {
            return Err(damaged(format!("its size is {width}x{height}")));
        }
        // The library does not know mono16, which is laid out as mono12.
        let sixteen = text.contains("Cmono16");
        let header = text.replace("Cmono16", "Cmono12").into_bytes();
        let read = Arc::new(AtomicU64::new(0));
        let counted = CountingFile { file, read: Arc::clone(&read) };
        let limits = y4m::Limits { bytes: 8 * MOST_PIXELS as usize };
        let decoder = y4m::Decoder::new_with_limits(Cursor::new(header).chain(counted), limits)
            .map_err(|error| damaged(error.to_string()))?;
        let rate = decoder.get_framerate();
        let rate_hz = if rate.num > 0 && rate.den > 0 {
            rate.num as f64 / rate.den as f64
        } else {
            clock.fallback_rate_hz
        };
        let bits = if sixteen { 16 } else { decoder.get_bit_depth() as u32 };
        let path = path.to_owned();
        Ok(Self {
            decoder,
            read,
            path,
            next: 0,
            rate_hz,
            shift: 16_u32.saturating_sub(bits),
            clock,
        })
    }
}

/// The picture's width or height by its letter in the header; 0 where that does not say.
fn side(header: &str, letter: char) -> u64 {
    let mut tokens = header.split_whitespace().filter_map(|token| token.strip_prefix(letter));
    // The library takes the last of several values, whatever it is, so exactly one is allowed.
    let only = tokens.next().filter(|_| tokens.next().is_none());
    only.and_then(|digits| digits.parse().ok()).unwrap_or(0)
}

impl FrameSource for Y4mSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        let (width, height) = (self.decoder.get_width(), self.decoder.get_height());
        let wide = self.decoder.get_bytes_per_sample() == 2;
        self.read.store(0, Ordering::Relaxed);
        let frame = match self.decoder.read_frame() {
            Ok(frame) => frame,
            Err(y4m::Error::EOF) if self.read.load(Ordering::Relaxed) == 0 => return Ok(None),
            Err(y4m::Error::EOF) => {
                let index = self.next;
                self.next += 1;
                let what = "the file ends in the middle of it".to_owned();
                return Err(VideoError::Frame { path: self.path.clone(), index, what });
            }
            Err(error) => {
                return Err(VideoError::Damaged {
                    path: self.path.clone(),
                    what: error.to_string(),
                });
            }
        };
        let plane = frame.get_y_plane();
        let pixels = if wide {
            let sample = |b: &[u8]| u16::from_le_bytes([b[0], b[1]]) << self.shift;
            Pixels::Gray16(plane.chunks_exact(2).map(sample).collect())
        } else {
            Pixels::Gray8(plane.to_vec())
        };
        let index = self.next;
        self.next += 1;
        let capture = self.clock.at(index as f64 / self.rate_hz);
        Ok(Some(Frame { index, capture, live: None, width, height, pixels }))
    }
}
