use std::time::{Duration, Instant};

use crossfix_message::Timestamp;
use gstreamer::prelude::*;
use gstreamer::{ClockTime, MessageView, Pipeline, ReferenceTimestampMeta, Sample, State};
use gstreamer_app::AppSink;
use gstreamer_video::{VideoFrameExt, VideoFrameRef, VideoInfo};

use super::GstreamerOptions;
use crate::stream_clock::{ClockMemory, HostClock, SET_S, StreamClock, unix_time};
use crate::{Arrival, Frame, FrameSource, MOST_PIXELS, Pixels, TimedBy, VideoError};

/// Ends every pipeline: brightness alone, handed over as soon as it is there. The caller takes each
/// frame at once, and what a decoder keeps is limited by what it was given.
const BRIGHTNESS: &str =
    "videoconvert ! video/x-raw,format=GRAY8 ! appsink name=brightness sync=false";
/// GStreamer's name of reference times from the start of NTP's count.
const NTP: &str = "timestamp/x-ntp";
/// GStreamer's name of reference times from the start of Unix's count.
const UNIX: &str = "timestamp/x-unix";

/// Builds the pipeline that is described, with the brightness sink at its end.
pub(super) fn built(description: &str) -> Result<(Pipeline, AppSink), String> {
    gstreamer::init().map_err(|error| error.to_string())?;
    let built = gstreamer::parse::launch(&format!("{description} ! {BRIGHTNESS}"));
    let built = built.map_err(|error| error.to_string())?;
    let pipeline = built.downcast::<Pipeline>().map_err(|_| "it is one element".to_owned())?;
    let sink = pipeline.by_name("brightness").and_then(|sink| sink.downcast::<AppSink>().ok());
    sink.map(|sink| (pipeline, sink)).ok_or_else(|| "it has no end".to_owned())
}

/// A picture's brightness, row by row.
pub(super) struct Brightness {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) samples: Vec<u8>,
}

/// Brightness of a sample, without the padding of its rows.
pub(super) fn brightness(sample: &Sample) -> Result<Brightness, String> {
    let caps = sample.caps().ok_or("a frame has no format")?;
    let info = VideoInfo::from_caps(caps).map_err(|error| error.to_string())?;
    let buffer = sample.buffer().ok_or("a frame is empty")?;
    let frame = VideoFrameRef::from_buffer_ref_readable(buffer, &info)
        .map_err(|_| "a frame cannot be read".to_owned())?;
    let (width, height) = (info.width() as usize, info.height() as usize);
    if (width as u64) * (height as u64) > MOST_PIXELS {
        return Err(format!("{width}x{height} is too large"));
    }
    let rows = frame.plane_data(0).map_err(|error| error.to_string())?;
    let stride = usize::try_from(frame.plane_stride()[0]).unwrap_or(0).max(1);
    let samples: Vec<u8> =
        rows.chunks(stride).take(height).flat_map(|row| row.iter().take(width)).copied().collect();
    if samples.len() != width * height {
        return Err("a frame is cut off".to_owned());
    }
    Ok(Brightness { width, height, samples })
}

/// The first error that a pipeline has reported, if any; messages of other kinds are discarded.
pub(super) fn trouble(pipeline: &Pipeline) -> Option<String> {
    let message = pipeline.bus()?.pop_filtered(&[gstreamer::MessageType::Error])?;
    match message.view() {
        MessageView::Error(error) => {
            let element = error.src().map(|element| element.name().to_string());
            Some(format!("{}: {}", element.unwrap_or_default(), error.error()))
        }
        _ => None,
    }
}

/// When a sample was captured by its reference time, which the pipeline has from the source.
fn reference_time(sample: &Sample) -> Option<Timestamp> {
    let meta = sample.buffer()?.meta::<ReferenceTimestampMeta>()?;
    let nanos = meta.timestamp().nseconds();
    match meta.reference().structure(0)?.name().as_str() {
        NTP => {
            let (seconds, rest) = (nanos / 1_000_000_000, nanos % 1_000_000_000);
            unix_time((seconds << 32) | ((rest << 32) / 1_000_000_000))
        }
        UNIX => Some(Timestamp::from_nanos(i64::try_from(nanos).ok()?)),
        _ => None,
    }
}

/// A pipeline's frames.
pub(super) struct PipelineSource {
    name: String,
    pipeline: Pipeline,
    sink: AppSink,
    clock: StreamClock,
    host: HostClock,
    silence: Duration,
    next: u64,
}

impl PipelineSource {
    pub(super) fn open(
        options: &GstreamerOptions,
        memory: ClockMemory,
        silence: Duration,
    ) -> Result<Self, VideoError> {
        let name = options.pipeline.clone();
        let wrong = |what: String| VideoError::Stream { url: name.clone(), what };
        let (pipeline, sink) = built(&options.pipeline).map_err(wrong)?;
        if let Some(login) = &options.login {
            let camera = pipeline
                .by_name("camera")
                .ok_or_else(|| wrong("no element has name=camera, to log in to".to_owned()))?;
            for (property, value) in [("user-id", login.user()), ("user-pw", login.password())] {
                if camera.find_property(property).is_none() {
                    return Err(wrong(format!("the element `camera` has no property {property}")));
                }
                camera.set_property(property, value);
            }
        }
        let host = HostClock::read();
        let source = Self {
            clock: StreamClock::new(host, options.latency, options.heeds_reports, memory),
            name: name.clone(),
            pipeline,
            sink,
            host,
            silence,
            next: 0,
        };
        if source.pipeline.set_state(State::Playing).is_err() {
            let what = trouble(&source.pipeline).unwrap_or_else(|| "it does not start".to_owned());
            return Err(wrong(what));
        }
        Ok(source)
    }

    fn frame(&mut self, sample: &Sample) -> Result<Frame, VideoError> {
        let at = Instant::now();
        let index = self.next;
        self.next += 1;
        let decoded = brightness(sample).map_err(|what| VideoError::StreamFrame {
            url: self.name.clone(),
            index,
            what,
        });
        let Brightness { width, height, samples } = decoded?;
        let arrived_s = self.host.since_s(at);
        let count = sample.buffer().and_then(|buffer| buffer.pts());
        let by_source = reference_time(sample);
        // The pipeline's own count varies with the network's delays; the reference time does not.
        let stream_s = match (by_source, count) {
            (Some(time), _) => time.seconds(),
            (None, Some(count)) => count.nseconds() as f64 * 1e-9,
            (None, None) => arrived_s,
        };
        if let Some(time) = by_source {
            self.clock.report(stream_s, time);
        }
        let (capture, timed_by) = self.clock.time(stream_s, arrived_s);
        let set_by_s = self.host.set_by_s(&HostClock::read());
        if timed_by != TimedBy::Camera && set_by_s.abs() > SET_S {
            return Err(VideoError::HostClockSet { by_s: set_by_s });
        }
        let live = Some(Arrival { at, stream_s, timed_by });
        Ok(Frame { index, capture, live, width, height, pixels: Pixels::Gray8(samples) })
    }
}

impl FrameSource for PipelineSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, VideoError> {
        let patience = ClockTime::try_from(self.silence).unwrap_or(ClockTime::from_seconds(1));
        let sample = self.sink.try_pull_sample(patience);
        if let Some(what) = trouble(&self.pipeline) {
            return Err(VideoError::Stream { url: self.name.clone(), what });
        }
        if let Some(sample) = sample {
            return self.frame(&sample).map(Some);
        }
        if self.sink.is_eos() {
            return Ok(None);
        }
        let seconds = self.silence.as_secs_f64();
        Err(VideoError::Silent { url: self.name.clone(), seconds })
    }
}

impl Drop for PipelineSource {
    fn drop(&mut self) {
        // If it does not stop it is left: there is nobody to report that to.
        let _ = self.pipeline.set_state(State::Null);
    }
}
