//! Anything that GStreamer can show: cameras, codecs and hardware decoders that this crate does not
//! support itself. Needs the feature `gstreamer` and the system's libraries.

#[cfg(feature = "gstreamer")]
mod h265;
#[cfg(feature = "gstreamer")]
mod pipeline;

use std::time::Duration;

#[cfg(feature = "gstreamer")]
pub(crate) use self::h265::H265Decoder;

use crate::stream_clock::ClockMemory;
use crate::{FrameSource, Login, StreamLatency, VideoError};

/// A pipeline to watch, and how.
#[derive(Clone, Debug)]
pub struct GstreamerOptions {
    /// Elements with `!` between them, as `gst-launch-1.0` takes them, up to the decoded video,
    /// without a sink. Frames that carry a reference time (`rtspsrc
    /// add-reference-timestamp-meta=true`) are timed by it.
    pub pipeline: String,
    /// User and password: set as `user-id` and `user-pw` of the element that is named `camera`.
    pub login: Option<Login>,
    /// Whether the reference time is believed; otherwise frames are timed by their arrival.
    pub heeds_reports: bool,
    /// Delay from the exposure to the arrival.
    pub latency: StreamLatency,
}

/// A pipeline that can be started again and again.
#[derive(Clone, Debug)]
pub struct GstreamerCamera {
    options: GstreamerOptions,
    memory: ClockMemory,
}

impl GstreamerCamera {
    /// A camera that is watched with these options.
    pub fn new(options: GstreamerOptions) -> Self {
        Self { options, memory: ClockMemory::default() }
    }

    /// The pipeline.
    pub fn address(&self) -> String {
        self.options.pipeline.clone()
    }

    /// Starts it. `silence` is how long it may show nothing before that is an error.
    ///
    /// # Errors
    /// [`VideoError::Stream`] if there are no such elements, or they do not fit.
    #[cfg(feature = "gstreamer")]
    pub fn open(&self, silence: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        let source = pipeline::PipelineSource::open(&self.options, self.memory.clone(), silence)?;
        Ok(Box::new(source))
    }

    /// Without the feature nothing can be opened.
    ///
    /// # Errors
    /// [`VideoError::Stream`], always.
    #[cfg(not(feature = "gstreamer"))]
    pub fn open(&self, _: Duration) -> Result<Box<dyn FrameSource>, VideoError> {
        let _ = &self.memory;
        let what = "this program was built without GStreamer: cargo build --features gstreamer";
        Err(VideoError::Stream { url: self.address(), what: what.to_owned() })
    }
}
