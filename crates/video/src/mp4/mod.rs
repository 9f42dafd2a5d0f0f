mod boxes;
mod index;

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use self::index::Sample;
use crate::h264::{DecodedPicture, H264Decoder};
use crate::{Frame, FrameClock, FrameSource, Pixels, VideoError};

/// An MP4 file with H.264, decoded to its brightness plane.
pub struct Mp4Source {
    file: BufReader<File>,
    path: PathBuf,
    samples: VecDeque<Sample>,
    /// Parameter sets, repeated before every key frame.
    headers: Vec<u8>,
    length_bytes: usize,
    decoder: H264Decoder,
    ready: VecDeque<Frame>,
    failed: VecDeque<String>,
    /// Frames that lie beyond the file's end; set to 0 once that has been reported.
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
        let decoder = H264Decoder::of_file().map_err(damaged)?;
        Ok(Self {
            file,
            path: path.to_owned(),
            samples: samples.into(),
            headers,
            length_bytes,
            decoder,
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

    /// Decodes one more compressed frame; the pictures that come out wait in `ready`.
    fn advance(&mut self, sample: &Sample) {
        let unit = match self.access_unit(sample) {
            Ok(unit) => unit,
            Err(what) => {
                self.failed.push_back(what);
                return;
            }
        };
        match self.decoder.decode(&unit, sample.shown_at) {
            Ok(Some(picture)) => self.collect(Ok(picture)),
            Ok(None) => {}
            Err(what) => self.failed.push_back(what),
        }
    }

    fn collect(&mut self, picture: Result<DecodedPicture, String>) {
        match picture {
            Ok(DecodedPicture { shown_at, width, height, brightness }) => {
                self.ready.push_back(Frame {
                    index: 0,
                    capture: self.clock.at(shown_at as f64 / self.timescale),
                    live: None,
                    width,
                    height,
                    pixels: Pixels::Gray8(brightness),
                });
            }
            Err(what) => self.failed.push_back(what),
        }
    }

    fn finish(&mut self) {
        match self.decoder.finish() {
            Ok(pictures) => pictures.into_iter().for_each(|picture| self.collect(picture)),
            Err(what) => self.failed.push_back(what),
        }
        let missing = std::mem::take(&mut self.missing);
        if missing > 0 {
            self.failed
                .push_back(format!("the file ends before it and the {} after it", missing - 1));
        }
    }
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
