//! Frames with their capture times, from files (PNG and JPEG sequences, Y4M, MP4 with H.264, AVI
//! with Motion JPEG), from network cameras (RTSP with H.264 or Motion JPEG) and, on Linux, from
//! cameras of the host (V4L2). Needs nothing but cargo dependencies.
//!
//! Every source implements [`FrameSource`]; [`Live`] reopens a live source that breaks off.
//! [`open`] finds the right source for a path; a camera of one's own is another:
//!
//! ```
//! use crossfix_message::Timestamp;
//! use crossfix_video::{CaptureTime, Frame, FrameSource, Pixels, VideoError};
//!
//! /// A grey wall, seen ten times per second.
//! struct Wall {
//!     next: u64,
//! }
//!
//! impl FrameSource for Wall {
//!     fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
//!         let index = self.next;
//!         self.next += 1;
//!         let time = Timestamp::from_seconds(index as f64 / 10.0);
//!         Ok((index < 3).then(|| Frame {
//!             index,
//!             // When it was exposed, and how well that is known.
//!             capture: CaptureTime { time, sd_s: 0.001 },
//!             live: None,
//!             width: 64,
//!             height: 48,
//!             pixels: Pixels::Gray8(vec![128; 64 * 48]),
//!         }))
//!     }
//! }
//!
//! let mut wall = Wall { next: 0 };
//! let mut frames = 0;
//! while let Some(frame) = wall.next_frame()? {
//!     assert_eq!(frame.brightness().len(), 64 * 48);
//!     frames += 1;
//! }
//! assert_eq!(frames, 3);
//! # Ok::<(), VideoError>(())
//! ```

mod annex_b;
mod avi;
mod error;
mod frame;
mod gige;
mod gstreamer;
mod h264;
mod live;
mod live_camera;
mod mp4;
mod rtsp;
mod sequence;
mod still;
mod stream_clock;
mod usb;
mod y4m_file;

use std::path::Path;

pub use avi::AviSource;
pub use error::VideoError;
pub use frame::{Arrival, CaptureTime, Frame, Pixels, TimedBy};
pub use gige::{GigeCamera, GigeOptions, gige_cameras};
pub use gstreamer::{GstreamerCamera, GstreamerOptions};
pub use h264::{H264Encoder, decoding_time};
pub use live::{Live, LiveCounts, LiveEvent};
pub use live_camera::LiveCamera;
pub use mp4::Mp4Source;
pub use rtsp::{
    Login, RtspCamera, RtspOptions, RtspServer, RtspSource, RtspTransport, ServedStream,
    StreamAddress, StreamLatency,
};
pub use sequence::SequenceSource;
pub use still::{Still, decode_still};
pub use usb::{UsbCamera, UsbOptions, usb_cameras};
pub use y4m_file::Y4mSource;

use crossfix_message::Timestamp;

/// Images of more pixels than this are refused: a damaged header must not take all memory. With
/// half of it images of more than 33 megapixels are refused; with twice as much one of 16-bit
/// colours may take 800 MB.
pub const MOST_PIXELS: u64 = 1 << 26;

/// A source of frames in the order of their capture.
///
/// The caller asks until the answer is `Ok(None)`, the end. If [`VideoError::is_one_frame`] holds
/// for an error, that frame still has its number, and the next call continues with the frame after
/// it; any other error is the end too.
pub trait FrameSource: Send {
    /// The next frame, or `None` at the end.
    ///
    /// # Errors
    /// [`VideoError`] naming the file and the frame.
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError>;

    /// What was lost on the way from the camera, if the source knows.
    fn losses(&self) -> Losses {
        Losses::default()
    }
}

/// What was lost on the way from a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Losses {
    /// Packets that never came.
    pub packets_lost: u64,
    /// Packets that came when they were requested again.
    pub packets_recovered: u64,
    /// Frames that arrived but were discarded, as they were not fetched in time.
    pub frames_left_out: u64,
}

/// Capture times of a file's frames, for files that do not state them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameClock {
    /// Capture time of the first frame.
    pub start: Timestamp,
    /// Frames per second, for files that state no rate.
    pub fallback_rate_hz: f64,
    /// Standard deviation of the capture times, s.
    pub sd_s: f64,
}

impl Default for FrameClock {
    fn default() -> Self {
        Self { start: Timestamp::EPOCH, fallback_rate_hz: 30.0, sd_s: 1e-3 }
    }
}

impl FrameClock {
    fn at(&self, seconds: f64) -> CaptureTime {
        CaptureTime { time: self.start.plus_seconds(seconds), sd_s: self.sd_s }
    }
}

/// Opens a folder of images, a `.y4m`, `.mp4` or `.avi` file.
///
/// # Errors
/// [`VideoError`] if it is not there, of another kind, or damaged from the start.
pub fn open(path: &Path, clock: FrameClock) -> Result<Box<dyn FrameSource>, VideoError> {
    let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    match extension.as_deref() {
        _ if path.is_dir() => Ok(Box::new(SequenceSource::open(path, clock)?)),
        Some("y4m") => Ok(Box::new(Y4mSource::open(path, clock)?)),
        Some("mp4" | "m4v" | "mov") => Ok(Box::new(Mp4Source::open(path, clock)?)),
        Some("avi") => Ok(Box::new(AviSource::open(path, clock)?)),
        _ => Err(VideoError::UnknownKind { path: path.to_owned() }),
    }
}
