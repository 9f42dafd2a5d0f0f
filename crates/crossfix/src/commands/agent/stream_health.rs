//! The state of a live stream, for the agent's health.

use std::time::{Duration, Instant};

use crossfix_message::Timestamp;
use crossfix_video::{Arrival, LiveCounts, TimedBy, VideoError};

/// A frame that comes more than this many usual intervals after the one before it is late. With
/// half of it every frame would be late; with twice as much one that follows a lost frame would not
/// be.
const LATE_INTERVALS: f64 = 1.5;
/// Weight of the newest interval in the usual one: a change of rate is learnt in a dozen frames.
/// With half of it the first eight frames at half the rate would count as late, instead of four.
const LEARNT: f64 = 0.1;
/// A camera that stays unsynchronised for longer than this is reported: a first clock report takes
/// less. With half of it one whose first report takes ten seconds would be reported at each start.
const FIRST_REPORT: Duration = Duration::from_secs(15);
/// Most samples kept per second: no camera produces more. With half of it the percentiles of a
/// camera of more than 500 Hz would leave out the end of each second.
const MOST_SAMPLES: usize = 1000;

/// Durations since the last report, which covers a second, microseconds.
#[derive(Debug, Default)]
struct DurationSamples(Vec<u64>);

impl DurationSamples {
    fn add(&mut self, time: Duration) {
        if self.0.len() < MOST_SAMPLES {
            self.0.push(u64::try_from(time.as_micros()).unwrap_or(u64::MAX));
        }
    }

    /// The smallest sample that at least `hundredths` per cent do not exceed; 0 if there are none.
    fn percentile(&mut self, hundredths: usize) -> u64 {
        self.0.sort_unstable();
        let at = (self.0.len() * hundredths).div_ceil(100).saturating_sub(1);
        self.0.get(at).copied().unwrap_or(0)
    }
}

/// State of a live stream, as the agent's health reports it.
#[derive(Debug, Default)]
pub struct StreamHealth {
    /// Whether the camera's clock reports are used.
    heeds_reports: bool,
    /// Why nothing is seen at the moment.
    lost: Option<String>,
    /// Error about frames whose size is not that of the intrinsics.
    wrong_size: Option<String>,
    timed_by: Option<TimedBy>,
    synchronised: Option<Instant>,
    begun: Option<Instant>,
    last: Option<(Instant, Timestamp)>,
    usual_s: f64,
    late: u64,
    repeated: u64,
    counts: LiveCounts,
    from_arrival: DurationSamples,
    from_exposure: DurationSamples,
    intervals: DurationSamples,
}

impl StreamHealth {
    /// `heeds_reports`: the camera's clock reports are used; otherwise images are timed by their
    /// arrival.
    pub fn new(heeds_reports: bool) -> Self {
        Self { heeds_reports, ..Self::default() }
    }

    /// Notes that the bearings of a frame have been published, given its capture time and arrival.
    pub fn note_frame(
        &mut self,
        captured: Timestamp,
        live: Arrival,
        now: Instant,
        wall: Timestamp,
    ) {
        (self.lost, self.wrong_size) = (None, None);
        self.begun.get_or_insert(now);
        self.timed_by = Some(live.timed_by);
        if matches!(live.timed_by, TimedBy::Camera | TimedBy::Driver) {
            self.synchronised = Some(now);
            let age_s = wall.seconds_since(captured).clamp(0.0, 1e3);
            self.from_exposure.add(Duration::from_secs_f64(age_s));
        }
        self.from_arrival.add(now.saturating_duration_since(live.at));
        let before = self.last.replace((live.at, captured));
        let Some((arrived, captured_before)) = before else { return };
        let interval = live.at.saturating_duration_since(arrived);
        self.intervals.add(interval);
        let interval_s = interval.as_secs_f64();
        if self.usual_s == 0.0 {
            self.usual_s = interval_s;
        }
        // Judged before it enters the usual interval, which is an exponentially weighted mean.
        self.late += u64::from(interval_s > LATE_INTERVALS * self.usual_s);
        self.usual_s += LEARNT * (interval_s - self.usual_s);
        self.repeated += u64::from(captured == captured_before);
    }

    /// Notes that the stream, or one frame of it, was lost.
    pub fn note_trouble(&mut self, trouble: &VideoError) {
        if !trouble.is_one_frame() {
            self.lost = Some(trouble.to_string());
            // The interruption must not count as a late frame.
            self.last = None;
        }
    }

    /// Whether nothing is seen at the moment.
    pub fn is_lost(&self) -> bool {
        self.lost.is_some()
    }

    /// Notes that a frame has a size that the intrinsics do not fit.
    pub fn note_size(&mut self, what: String) {
        (self.lost, self.wrong_size) = (None, Some(what));
    }

    /// Notes the counts of frames so far.
    pub fn note_counts(&mut self, counts: LiveCounts) {
        self.counts = counts;
    }

    /// Problems that need a person's attention now.
    pub fn problems(&self, now: Instant) -> Vec<String> {
        let lost = self.lost.as_ref().map(|what| format!("sees nothing: {what}"));
        let size = self.wrong_size.clone();
        let since = self.synchronised.or(self.begun);
        let is_late = since.is_some_and(|at| now.saturating_duration_since(at) > FIRST_REPORT);
        let clock = match self.timed_by {
            Some(TimedBy::ArrivalAgainstCamera { camera_ahead_s }) => Some(format!(
                "the camera's clock is {camera_ahead_s:+.1} s from this host's: images are timed \
                 by their arrival; set the camera to a time server"
            )),
            Some(TimedBy::Arrival) if is_late && self.heeds_reports => Some(
                "the camera does not say what its clock shows (RTCP sender reports; of an \
                 industrial one, what it answers): images are timed by their arrival"
                    .to_owned(),
            ),
            _ => None,
        };
        [lost, size, clock].into_iter().flatten().collect()
    }

    /// Counts and durations since the last report.
    pub fn counters(&mut self) -> Vec<(&'static str, u64)> {
        let counters = vec![
            ("arrival_to_bearings_p50_us", self.from_arrival.percentile(50)),
            ("arrival_to_bearings_p99_us", self.from_arrival.percentile(99)),
            ("exposure_to_bearings_p99_us", self.from_exposure.percentile(99)),
            ("frame_interval_p50_us", self.intervals.percentile(50)),
            ("frame_interval_p99_us", self.intervals.percentile(99)),
            ("frames_late", self.late),
            ("frames_left_out", self.counts.left_out),
            ("frames_repeated", self.repeated),
            ("packets_lost", self.counts.packets_lost),
            ("packets_recovered", self.counts.packets_recovered),
            ("stream_opened", self.counts.opened),
            (
                "synchronised",
                u64::from(
                    self.lost.is_none()
                        && matches!(self.timed_by, Some(TimedBy::Camera | TimedBy::Driver)),
                ),
            ),
        ];
        for samples in [&mut self.from_arrival, &mut self.from_exposure, &mut self.intervals] {
            samples.0.clear();
        }
        counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_counted_is_what_was() {
        let (begun, mut health) = (Instant::now(), StreamHealth::default());
        let after = |seconds: f64| begun + Duration::from_secs_f64(seconds);
        for n in 0..100 {
            // Frame 50 comes late and frame 60 comes twice.
            let late_s = if n == 50 { 0.06 } else { 0.0 };
            let exposed_s = 100.0 + f64::from(n) / 30.0;
            let arrived_s = f64::from(n) / 30.0 + late_s;
            for _ in 0..if n == 60 { 2 } else { 1 } {
                let live =
                    Arrival { at: after(arrived_s), stream_s: 0.0, timed_by: TimedBy::Camera };
                let [captured, wall] = [exposed_s, exposed_s + 0.05].map(Timestamp::from_seconds);
                health.note_frame(captured, live, after(arrived_s + 0.01), wall);
            }
        }
        let counters = health.counters();
        let of = |name: &str| counters.iter().find(|(n, _)| *n == name).unwrap().1;
        assert_eq!((of("frames_late"), of("frames_repeated"), of("synchronised")), (1, 1, 1));
        assert!((9_999..=10_001).contains(&of("arrival_to_bearings_p99_us")), "{counters:?}");
        assert!((49_999..=50_001).contains(&of("exposure_to_bearings_p99_us")), "{counters:?}");
        assert!((33_332..=33_334).contains(&of("frame_interval_p50_us")), "{counters:?}");
        assert!(health.problems(after(4.0)).is_empty());
    }

    #[test]
    fn what_a_person_should_see_to_is_said_as_long_as_it_lasts() {
        let (begun, mut health) = (Instant::now(), StreamHealth::new(true));
        let after = |seconds: f64| begun + Duration::from_secs_f64(seconds);
        health.note_trouble(&VideoError::Ended);
        assert!(health.problems(begun)[0].contains("has ended"));
        let see = |health: &mut StreamHealth, timed_by, seconds: f64| {
            let time = Timestamp::from_seconds(seconds);
            let live = Arrival { at: after(seconds), stream_s: seconds, timed_by };
            health.note_frame(time, live, after(seconds), time);
        };
        see(&mut health, TimedBy::Arrival, 1.0);
        assert!(health.problems(after(3.0)).is_empty(), "its report may be on the way");
        assert!(health.problems(after(20.0))[0].contains("RTCP"));
        see(&mut health, TimedBy::ArrivalAgainstCamera { camera_ahead_s: 3600.0 }, 21.0);
        assert!(health.problems(after(21.0))[0].contains("+3600.0 s"));
        see(&mut health, TimedBy::Camera, 22.0);
        health.note_size("of another size".to_owned());
        assert_eq!(health.problems(after(22.0)), ["of another size"]);
    }
}
