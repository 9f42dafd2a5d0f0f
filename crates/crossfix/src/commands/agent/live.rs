//! Following targets in a live camera's stream, as long as the agent runs.

use std::time::{Duration, Instant};

use crossfix_message::{ClockSource, Timestamp};
use crossfix_video::{
    Arrival, CaptureTime, Frame, Live, LiveCamera, LiveEvent, TimedBy, VideoError,
};
use crossfix_vision::ImageTracker;

use super::stream_health::StreamHealth;
use super::{Agent, corrected};
use crate::config::CameraFile;
use crate::eye::brightness;
use crate::pace::wall_seconds;
use crate::service;

/// How often an agent that receives no images checks whether to stop. With half of it the same;
/// with ten times as much a stop, and the health report of each second, would come late.
const POLL: Duration = Duration::from_millis(200);

/// If stream time and arrival time between two frames differ by this much, the stream has started a
/// new count, s. With half of it an image that was delayed by a second on its way moves the
/// tracker's time a second too far.
const ANOTHER_COUNT_S: f64 = 2.0;
/// The shortest time between two frames that the tracker is given, s: its time must always advance.
/// With half of it the same.
const SHORTEST_S: f64 = 1e-3;

/// Follows targets in a stream.
pub(super) struct StreamFollower {
    pub(super) file: CameraFile,
    begins: Timestamp,
    pub(super) tracker: ImageTracker,
    /// Basis of the tracker's time, which runs evenly whatever happens to the clocks: the last
    /// frame's tracker time, stream time, s, and arrival.
    tracked: Option<(Timestamp, f64, Instant)>,
    shown: Option<Timestamp>,
}

impl StreamFollower {
    /// A frame's time for the tracker: advanced by the stream's own time, or by arrival where the
    /// stream has started a new count.
    fn even_time(&mut self, live: Arrival) -> Timestamp {
        let time = self.tracked.map_or(self.begins, |(before, stream_s, at)| {
            let passed_s = live.stream_s - stream_s;
            let arrived_s = live.at.saturating_duration_since(at).as_secs_f64();
            // A stream that was opened again counts from another instant.
            let goes_on = passed_s > 0.0 && (passed_s - arrived_s).abs() < ANOTHER_COUNT_S;
            before.plus_seconds(if goes_on { passed_s } else { arrived_s.max(SHORTEST_S) })
        });
        self.tracked = Some((time, live.stream_s, live.at));
        time
    }
}

impl Agent {
    /// Follows targets in a live camera's images until asked to stop. If the camera is lost this is
    /// logged, and it is opened again.
    pub(super) fn watch_live(
        &mut self,
        file: &CameraFile,
        camera: LiveCamera,
        begins: Timestamp,
    ) -> anyhow::Result<()> {
        let mut tracker = ImageTracker::new(file.tracker.clone())?;
        for place in file.boxes() {
            tracker.take_up(place);
        }
        let mut watch =
            StreamFollower { file: file.clone(), begins, tracker, tracked: None, shown: None };
        let heeds_reports = file.clock_source() != ClockSource::Arrival;
        self.stream = Some(StreamHealth::new(heeds_reports));
        let live = Live::start(move |silence| camera.open(silence));
        while !self.shutdown.requested() {
            match live.next(POLL) {
                LiveEvent::Frame(frame) => self.follow(&mut watch, &frame)?,
                LiveEvent::Trouble(trouble) => {
                    self.bad_frames += u64::from(trouble.is_one_frame());
                    self.note_trouble(&trouble);
                }
                LiveEvent::Nothing => {}
            }
            if let Some(stream) = &mut self.stream {
                stream.note_counts(live.counts());
            }
            if self.shutdown.take_reload() {
                service::reloading();
                self.reload(&mut watch)?;
                service::ready(&format!("camera {}", self.identity.name));
            }
            self.keep_up()?;
        }
        Ok(())
    }

    /// Logs a problem of the stream: the loss of the stream at once, further reasons now and then.
    fn note_trouble(&mut self, trouble: &VideoError) {
        let Some(stream) = &mut self.stream else { return };
        let is_news = !trouble.is_one_frame() && !stream.is_lost();
        stream.note_trouble(trouble);
        let name = &self.identity.name;
        let text = || format!("camera `{name}`: {trouble}; going on");
        if is_news {
            tracing::warn!("{}", text());
        } else {
            let kind = if trouble.is_one_frame() { "bad frame" } else { "lost" };
            self.repeats.warn(kind, Instant::now(), text);
        }
    }

    /// Follows targets in one frame and publishes their bearings.
    fn follow(&mut self, watch: &mut StreamFollower, frame: &Frame) -> anyhow::Result<()> {
        if let Err(error) = self.check_size(frame) {
            // The right size may come back, and the other cameras still work, so this does not end
            // the agent.
            self.bad_frames += 1;
            self.repeats.warn("size", Instant::now(), || format!("{error:#}"));
            if let Some(stream) = &mut self.stream {
                stream.note_size(format!("{error:#}"));
            }
            return Ok(());
        }
        let (Some(image), Some(live)) = (brightness(frame), frame.live) else {
            return Ok(());
        };
        let declared_s = watch.file.clock_sd_s();
        let of_camera = |sd_s: f64| {
            corrected(CaptureTime { sd_s, ..frame.capture }, watch.begins, &watch.file.clock)
        };
        let (is_by_camera, capture) = match live.timed_by {
            TimedBy::Camera | TimedBy::Driver => (true, of_camera(declared_s)),
            TimedBy::Remembered => (true, of_camera(declared_s.max(frame.capture.sd_s))),
            TimedBy::Arrival | TimedBy::ArrivalAgainstCamera { .. } => (false, frame.capture),
        };
        let time = watch.even_time(live);
        let mut message = self.see(&mut watch.tracker, &image, frame.index, time, capture);
        if !is_by_camera {
            message.clock_source = ClockSource::Arrival.into();
        }
        self.publish(message)?;
        if let Some(stream) = &mut self.stream {
            if stream.is_lost() {
                tracing::info!("camera `{}` sees again", self.identity.name);
            }
            let wall = Timestamp::from_seconds(wall_seconds());
            stream.note_frame(capture.time, live, Instant::now(), wall);
        }
        self.show(&watch.file, &mut watch.shown, &image, capture)
    }
}
