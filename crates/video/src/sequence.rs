use std::path::{Path, PathBuf};

use crate::{Frame, FrameClock, FrameSource, Still, VideoError, decode_still};

/// A folder of PNG or JPEG images in the order of their names, with numbers in names compared as
/// numbers.
#[derive(Debug)]
pub struct SequenceSource {
    files: Vec<PathBuf>,
    next: usize,
    clock: FrameClock,
}

/// A name split into texts and numbers, so that `9.png` comes before `10.png`.
fn natural_key(path: &Path) -> Vec<(u64, String)> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut key = Vec::new();
    let mut rest = name.as_str();
    while !rest.is_empty() {
        let digits = rest.len() - rest.trim_start_matches(|c: char| c.is_ascii_digit()).len();
        let (number, after) = rest.split_at(digits);
        let letters = after.find(|c: char| c.is_ascii_digit()).unwrap_or(after.len());
        let (text, after) = after.split_at(letters);
        key.push((number.parse().unwrap_or(u64::MAX), text.to_owned()));
        rest = after;
    }
    key
}

impl SequenceSource {
    /// Lists a folder.
    ///
    /// # Errors
    /// [`VideoError`] if it cannot be listed or holds no image.
    pub fn open(path: &Path, clock: FrameClock) -> Result<Self, VideoError> {
        let open = |source| VideoError::Open { path: path.to_owned(), source };
        let mut files = Vec::new();
        for entry in std::fs::read_dir(path).map_err(open)? {
            let file = entry.map_err(open)?.path();
            let extension = file.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
            if matches!(extension.as_deref(), Some("png" | "jpg" | "jpeg")) {
                files.push(file);
            }
        }
        if files.is_empty() {
            return Err(VideoError::Empty { path: path.to_owned() });
        }
        files.sort_by_cached_key(|file| natural_key(file));
        Ok(Self { files, next: 0, clock })
    }
}

impl FrameSource for SequenceSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        let Some(path) = self.files.get(self.next) else {
            return Ok(None);
        };
        let index = self.next as u64;
        self.next += 1;
        let frame = |what| VideoError::Frame { path: path.clone(), index, what };
        let bytes = std::fs::read(path).map_err(|error| frame(error.to_string()))?;
        let Still { width, height, pixels } = decode_still(&bytes).map_err(frame)?;
        let capture = self.clock.at(index as f64 / self.clock.fallback_rate_hz);
        Ok(Some(Frame { index, capture, live: None, width, height, pixels }))
    }
}
