use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use openh264::OpenH264API;
use openh264::decoder::{DecodedYUV, Decoder, DecoderConfig, Flush};
use openh264::formats::YUVSource;
use re_mp4::{Mp4, Sample, StsdBoxContent, TrackKind};

use crate::{Frame, FrameClock, FrameSource, MAX_PIXELS, Pixels, VideoError};

/// A compressed frame larger than this is damage.
const MAX_SAMPLE_BYTES: u64 = 64 << 20;

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
        let size = file.metadata().map_err(open)?.len();
        let mut file = BufReader::new(file);
        // The parser is not hardened: on a hostile index it panics.
        let mp4 = catch_unwind(AssertUnwindSafe(|| Mp4::read(&mut file, size)))
            .map_err(|_| damaged("its index is damaged".to_owned()))?
            .map_err(|error| damaged(error.to_string()))?;
        let track = mp4
            .tracks()
            .values()
            .find(|track| track.kind == Some(TrackKind::Video))
            .ok_or_else(|| damaged("it holds no video".to_owned()))?;
        let StsdBoxContent::Avc1(avc1) = &track.trak(&mp4).mdia.minf.stbl.stsd.contents else {
            return Err(damaged("its video is not H.264".to_owned()));
        };
        let sets = avc1.avcc.sequence_parameter_sets.iter().chain(&avc1.avcc.picture_parameter_sets);
        let headers = sets.flat_map(|unit| [&[0, 0, 0, 1][..], &unit.bytes[..]].concat()).collect();
        let length_bytes = usize::from(avc1.avcc.length_size_minus_one) + 1;
        let config = DecoderConfig::new().flush_after_decode(Flush::NoFlush);
        let decoder = Decoder::with_api_config(OpenH264API::from_source(), config)
            .map_err(|error| damaged(error.to_string()))?;
        let samples: VecDeque<Sample> = track.samples.iter().copied().collect();
        let timescale = samples.front().map_or(1.0, |sample| (sample.timescale as f64).max(1.0));
        Ok(Self {
            file,
            path: path.to_owned(),
            samples,
            headers,
            length_bytes,
            decoder,
            pending: BinaryHeap::new(),
            ready: VecDeque::new(),
            failed: VecDeque::new(),
            timescale,
            next: 0,
            clock,
        })
    }

    /// The compressed frame as an Annex B access unit.
    fn access_unit(&mut self, sample: &Sample) -> Result<Vec<u8>, String> {
        if sample.size > MAX_SAMPLE_BYTES {
            return Err(format!("it claims {} bytes", sample.size));
        }
        let mut bytes = vec![0; sample.size as usize];
        self.file
            .seek(SeekFrom::Start(sample.offset))
            .and_then(|_| self.file.read_exact(&mut bytes))
            .map_err(|error| error.to_string())?;
        let mut unit = if sample.is_sync { self.headers.clone() } else { Vec::new() };
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            let (length, after) = rest.split_at_checked(self.length_bytes).ok_or("it is cut off")?;
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
        self.pending.push(Reverse(sample.composition_timestamp));
        match self.decoder.decode(&unit) {
            Ok(Some(picture)) => {
                let time = self.pending.pop();
                let frame = frame_of(&picture, time, self.timescale, &self.clock);
                self.collect(frame);
            }
            Ok(None) => {}
            Err(error) => {
                self.pending.retain(|Reverse(time)| *time != sample.composition_timestamp);
                self.failed.push_back(error.to_string());
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
            Err(error) => self.failed.push_back(error.to_string()),
        }
    }
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
