mod index;

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use openh264::OpenH264API;
use openh264::decoder::{DecodedYUV, Decoder, DecoderConfig, Flush};
use openh264::formats::YUVSource;

use self::index::Sample;
use crate::{Frame, FrameClock, FrameSource, MAX_PIXELS, Pixels, VideoError};

/// An MP4 file with H.264, decoded to its brightness plane.
pub struct Mp4Source {
    file: BufReader<File>,
    path: PathBuf,
    samples: VecDeque<Sample>,
    /// Parameter sets, repeated before every key frame.
    headers: Vec<u8>,
    length_bytes: usize,
    decoder: Decoder,
    /// Composition times of the samples that have not come out yet; pictures come out in the order
    /// of display, so the smallest is the next picture's.
    pending: BinaryHeap<Reverse<i64>>,
    ready: VecDeque<Frame>,
    failed: VecDeque<String>,
    /// Frames that lie beyond the file's end, as long as that has not been said.
    missing: usize,
    timescale: f64,
    next: u64,
    clock: FrameClock,
}

impl Mp4Source {
    /// Opens a file and reads its index.
    ///
    /// # Errors
    /// [`VideoError`] if it cannot be opened, is torn or holds no H.264 video.
    pub fn open(path: &Path, clock: FrameClock) -> Result<Self, VideoError> {
        let open = |source| VideoError::Open { path: path.to_owned(), source };
        let damaged = |what: String| VideoError::Damaged { path: path.to_owned(), what };
        let file = File::open(path).map_err(open)?;
        let mut file = BufReader::new(file);
        let index::Index { samples, timescale, parameters, length_bytes, missing } =
            index::read(&mut file).map_err(damaged)?;
        let headers =
            parameters.iter().flat_map(|unit| [&[0, 0, 0, 1][..], &unit[..]].concat()).collect();
        let config = DecoderConfig::new().flush_after_decode(Flush::NoFlush);
        let decoder = Decoder::with_api_config(OpenH264API::from_source(), config)
            .map_err(|error| damaged(in_words(&error)))?;
        Ok(Self {
            file,
            path: path.to_owned(),
            samples: samples.into(),
            headers,
            length_bytes,
            decoder,
            pending: BinaryHeap::new(),
            ready: VecDeque::new(),
            failed: VecDeque::new(),
            missing,
            timescale,
            next: 0,
            clock,
        })
    }

    /// The compressed frame as an Annex B access unit.
    fn access_unit(&mut self, sample: &Sample) -> Result<Vec<u8>, String> {
        let mut bytes = vec![0; sample.size];
        self.file
            .seek(SeekFrom::Start(sample.offset))
            .and_then(|_| self.file.read_exact(&mut bytes))
            .map_err(|_| "the file ends before it".to_owned())?;
        let mut unit = if sample.is_sync { self.headers.clone() } else { Vec::new() };
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            let (length, after) =
                rest.split_at_checked(self.length_bytes).ok_or("it is cut off")?;
            let length = length.iter().fold(0_usize, |sum, &byte| sum << 8 | usize::from(byte));
            let (nal, after) = after.split_at_checked(length).ok_or("it is cut off")?;
            unit.extend([0, 0, 0, 1]);
            unit.extend(nal);
            rest = after;
        }
        Ok(unit)
    }

    /// Decodes one more compressed frame; what comes out waits in `ready`.
    fn advance(&mut self, sample: &Sample) {
        let unit = match self.access_unit(sample) {
            Ok(unit) => unit,
            Err(what) => {
                self.failed.push_back(what);
                return;
            }
        };
        self.pending.push(Reverse(sample.shown_at));
        match self.decoder.decode(&unit) {
            Ok(Some(picture)) => {
                let time = self.pending.pop();
                let frame = frame_of(&picture, time, self.timescale, &self.clock);
                self.collect(frame);
            }
            Ok(None) => {}
            Err(error) => {
                self.pending.retain(|Reverse(time)| *time != sample.shown_at);
                self.failed.push_back(in_words(&error));
            }
        }
    }

    fn collect(&mut self, frame: Result<Frame, String>) {
        match frame {
            Ok(frame) => self.ready.push_back(frame),
            Err(what) => self.failed.push_back(what),
        }
    }

    fn finish(&mut self) {
        // Pictures that the decoder still holds back.
        let rest = self.decoder.flush_remaining().map(|pictures| {
            let frame = |picture| {
                let time = self.pending.pop();
                frame_of(&picture, time, self.timescale, &self.clock)
            };
            pictures.into_iter().map(frame).collect::<Vec<_>>()
        });
        match rest {
            Ok(frames) => frames.into_iter().for_each(|frame| self.collect(frame)),
            Err(error) => self.failed.push_back(in_words(&error)),
        }
        let missing = std::mem::take(&mut self.missing);
        if missing > 0 {
            self.failed
                .push_back(format!("the file ends before it and the {} after it", missing - 1));
        }
    }
}

/// What the decoder says, in words for people: it counts its errors.
fn in_words(error: &openh264::Error) -> String {
    let text = error.to_string();
    let number: String = text
        .split("Native:")
        .nth(1)
        .unwrap_or("")
        .chars()
        .take_while(char::is_ascii_digit)
        .collect();
    let number = if number.is_empty() { String::new() } else { format!(" (OpenH264 {number})") };
    format!("it is damaged, or builds on one that is{number}")
}

fn frame_of(
    picture: &DecodedYUV<'_>,
    time: Option<Reverse<i64>>,
    timescale: f64,
    clock: &FrameClock,
) -> Result<Frame, String> {
    let (width, height) = picture.dimensions();
    let (stride, _, _) = picture.strides();
    if width == 0 || height == 0 || (width * height) as u64 > MAX_PIXELS || stride < width {
        return Err(format!("its size is {width}x{height}"));
    }
    let rows = picture.y().chunks(stride).take(height);
    let samples: Vec<u8> = rows.flat_map(|row| &row[..width.min(row.len())]).copied().collect();
    if samples.len() != width * height {
        return Err("its brightness plane is cut off".to_owned());
    }
    let Reverse(time) = time.ok_or("it has no time")?;
    let capture = clock.at(time as f64 / timescale);
    Ok(Frame { index: 0, capture, width, height, pixels: Pixels::Gray8(samples) })
}

impl FrameSource for Mp4Source {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        loop {
            if let Some(what) = self.failed.pop_front() {
                let index = self.next;
                self.next += 1;
                return Err(VideoError::Frame { path: self.path.clone(), index, what });
            }
            if let Some(frame) = self.ready.pop_front() {
                let index = self.next;
                self.next += 1;
                return Ok(Some(Frame { index, ..frame }));
            }
            match self.samples.pop_front() {
                Some(sample) => self.advance(&sample),
                None => {
                    self.finish();
                    if self.ready.is_empty() && self.failed.is_empty() {
                        return Ok(None);
                    }
                }
            }
        }
    }
}
