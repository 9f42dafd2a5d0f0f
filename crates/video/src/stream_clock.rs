//! UTC capture times of a stream's frames, from the camera's clock or from their arrival.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Instant, SystemTime};

use crossfix_message::Timestamp;

use crate::{CaptureTime, StreamLatency, TimedBy};

/// Seconds from the start of NTP's count, in 1900, to that of Unix's, in 1970: 70 years with 17
/// leap days. Another number would be another date.
pub(crate) const NTP_TO_UNIX_S: u64 = 2_208_988_800;
/// How long a sender report is used to estimate the camera's clock, s. Reports come every five
/// seconds or so and each may be some milliseconds off; over a minute a quartz clock's drift is a
/// straight line. With half of it the line has half of the reports and of their span, and its slope
/// errs by 2.8 times as much.
const REPORTS_S: f64 = 60.0;
/// Most reports that are kept: no camera sends more in a minute, and each costs work per image.
/// With half of it a camera that is asked every second would be known by half a minute of answers.
const MOST_REPORTS: usize = 64;
/// A clock that differs by more than this from what its reports predicted was set, s: more than a
/// busy camera is late in reporting, and more than a quartz drifts between two reports. With half
/// of it a report that is late by 0.2 s would discard all before it; with twice as much a clock
/// that was set by 0.4 s is followed late.
pub(crate) const SET_S: f64 = 0.25;
/// If the camera's clock differs from the host's by more than this, one of them is not on UTC, s. A
/// network that stalls holds frames for as long; half of it would refuse cameras on bad networks.
const FARTHEST_S: f64 = 2.0;
/// Reports that span less than this are averaged, not fitted by a sloping line, s: the slope would
/// follow their errors of some milliseconds, as cameras report when they get round to it. With half
/// of it the slope by such reports errs by twice as much.
const LEVEL_S: f64 = REPORTS_S / 5.0;
/// The same for a camera's answers to a question, which are good to a tenth of a millisecond, s:
/// with half of it the line would err by as much as the fastest quartz gains.
const ASKED_LEVEL_S: f64 = 2.0;
/// The quickest arrival within this time counts as one that nothing delayed, s. A quartz drifts
/// by a millisecond in it; with half of it, a stall of some seconds would be attributed to the
/// camera.
const ARRIVALS_S: f64 = 30.0;
/// After a stream broke off, what was known of the camera's clock relative to the host's is used
/// for this long, s: two quartz clocks drift apart by 30 ms in it. With half of it a camera that
/// comes back after six minutes is timed by its arrivals until its first report.
const REMEMBERED_S: f64 = 600.0;

/// Standard deviation of capture times that come from the remembered clock, s: the first frames of
/// a stream arrive as late as the quickest before them, or later by what a camera takes to start.
/// With half of it such times would seem better known than they are.
const REMEMBERED_SD_S: f64 = 0.1;

/// A camera's clock, estimated from its latest reports.
#[derive(Clone, Debug)]
struct Reports {
    latest: VecDeque<ClockReading>,
    /// The clock's time at the stream's time 0, by the first report.
    zero: Option<Timestamp>,
    /// While the reports span less than this, s, the clock is assumed to run as the stream's count
    /// does.
    level_s: f64,
}

/// One report of a camera's clock.
#[derive(Clone, Copy, Debug)]
struct ClockReading {
    /// Stream time, s.
    stream_s: f64,
    /// How far the camera's clock was then ahead of the first report's line, s. That line has slope
    /// 1: it advances as the stream's count does.
    beyond_s: f64,
}

impl Reports {
    fn new(level_s: f64) -> Self {
        Self { latest: VecDeque::new(), zero: None, level_s }
    }

    /// Adds a report; where it shows that the clock was set, the earlier ones are discarded.
    fn add(&mut self, stream_s: f64, shown: Timestamp) {
        let zero = *self.zero.get_or_insert(shown.plus_seconds(-stream_s));
        // beyond = shown - (zero + stream_s)
        let beyond_s = shown.seconds_since(zero.plus_seconds(stream_s));
        let was_set = !self.latest.is_empty() && (beyond_s - self.beyond(stream_s)).abs() > SET_S;
        if was_set {
            self.latest.clear();
            self.zero = Some(shown.plus_seconds(-stream_s));
        }
        let beyond_s = if was_set { 0.0 } else { beyond_s };
        self.latest.push_back(ClockReading { stream_s, beyond_s });
        while self.latest.len() > MOST_REPORTS
            || self.latest.front().is_some_and(|first| stream_s - first.stream_s > REPORTS_S)
        {
            self.latest.pop_front();
        }
    }

    /// How far the clock is ahead of the first report's line at a stream time, s: the least-squares
    /// line through the reports, or their mean while they span too little.
    fn beyond(&self, stream_s: f64) -> f64 {
        let n = self.latest.len().max(1) as f64;
        let mean = |of: fn(&ClockReading) -> f64| self.latest.iter().map(of).sum::<f64>() / n;
        let (mid, level) = (mean(|r| r.stream_s), mean(|r| r.beyond_s));
        let spread: f64 = self.latest.iter().map(|r| (r.stream_s - mid).powi(2)).sum();
        let span = self.latest.back().map_or(0.0, |last| last.stream_s - self.latest[0].stream_s);
        if span < self.level_s || spread == 0.0 {
            return level;
        }
        // slope = sum (s - mid) (b - level) / sum (s - mid)^2
        let products = self.latest.iter().map(|r| (r.stream_s - mid) * (r.beyond_s - level));
        let slope = products.sum::<f64>() / spread;
        level + slope * (stream_s - mid)
    }

    /// The camera's clock at a stream time.
    fn time(&self, stream_s: f64) -> Option<Timestamp> {
        Some(self.zero?.plus_seconds(stream_s).plus_seconds(self.beyond(stream_s)))
    }
}

/// The quickest recent arrivals.
#[derive(Clone, Debug, Default)]
struct QuickestArrivals {
    /// Each is quicker than all after it, so the first is the quickest.
    quickest: VecDeque<TimedArrival>,
}

/// When a frame arrived.
#[derive(Clone, Copy, Debug)]
struct TimedArrival {
    /// Time of arrival, s.
    at_s: f64,
    /// That less the stream time, s.
    late_s: f64,
}

impl QuickestArrivals {
    fn add(&mut self, stream_s: f64, arrived_s: f64) {
        // Drops entries that this arrival beats: they can never be the quickest again.
        let late_s = arrived_s - stream_s;
        while self.quickest.back().is_some_and(|other| other.late_s >= late_s) {
            self.quickest.pop_back();
        }
        self.quickest.push_back(TimedArrival { at_s: arrived_s, late_s });
        while self.quickest.front().is_some_and(|first| arrived_s - first.at_s > ARRIVALS_S) {
            self.quickest.pop_front();
        }
    }

    /// When a frame of that stream time would have arrived if nothing had delayed it, s.
    fn unhindered_s(&self, stream_s: f64) -> Option<f64> {
        self.quickest.front().map(|first| stream_s + first.late_s)
    }
}

/// What is known of a camera's clock, kept when a stream breaks off: the next stream begins without
/// a report.
#[derive(Clone, Debug, Default)]
pub(crate) struct ClockMemory(Arc<Mutex<Option<Ahead>>>);

/// How far the camera's clock at the exposure is ahead of the host's at the arrival, s, when that
/// was found, and by which reading of the host's clock.
#[derive(Clone, Copy, Debug)]
struct Ahead {
    by_s: f64,
    at: Timestamp,
    host: HostClock,
}

/// This host's clock, read once: setting the clock later changes nothing here.
#[derive(Clone, Copy, Debug)]
pub(crate) struct HostClock {
    wall: Timestamp,
    read: Instant,
}

impl HostClock {
    /// Host time this many seconds after the reading.
    pub(crate) fn at(&self, seconds: f64) -> Timestamp {
        self.wall.plus_seconds(seconds)
    }

    pub(crate) fn read() -> Self {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
        let nanos = i64::try_from(now.as_nanos()).unwrap_or(i64::MAX);
        Self { wall: Timestamp::from_nanos(nanos), read: Instant::now() }
    }

    /// Seconds from the reading to an instant; 0 for an instant before it.
    pub(crate) fn since_s(&self, instant: Instant) -> f64 {
        instant.saturating_duration_since(self.read).as_secs_f64()
    }

    /// By how much the host's clock was set forward between this reading and a later one, s.
    pub(crate) fn set_by_s(&self, later: &Self) -> f64 {
        later.wall.seconds_since(self.wall) - self.since_s(later.read)
    }
}

impl ClockMemory {
    fn locked(&self) -> MutexGuard<'_, Option<Ahead>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The offset found last, s, if it is not too old and the host's clock has not been set since.
    fn ahead_s(&self, now: Timestamp, host: &HostClock) -> Option<f64> {
        self.locked().filter(|ahead| ahead.is_valid(now, host)).map(|ahead| ahead.by_s)
    }
}

impl Ahead {
    fn is_valid(&self, now: Timestamp, host: &HostClock) -> bool {
        now.seconds_since(self.at).abs() <= REMEMBERED_S && self.host.set_by_s(host).abs() <= SET_S
    }
}

/// Computes when a stream's frames were captured: by the camera's reports of its clock, and by the
/// frames' arrival before the first report or where the reports cannot be true.
///
/// Streams count time from an instant of their own. From time to time a camera reports (RTCP sender
/// reports) what its clock showed at a given value of that count.
#[derive(Clone, Debug)]
pub(crate) struct StreamClock {
    host: HostClock,
    latency: StreamLatency,
    heeds_reports: bool,
    reports: Reports,
    arrivals: QuickestArrivals,
    memory: ClockMemory,
    last: Option<LastFrame>,
}

/// The times of the last frame, s.
#[derive(Clone, Copy, Debug)]
struct LastFrame {
    stream_s: f64,
    arrived_s: f64,
}

impl StreamClock {
    /// A clock for a stream whose arrival times count from when the host's clock was read.
    pub(crate) fn new(
        host: HostClock,
        latency: StreamLatency,
        heeds_reports: bool,
        memory: ClockMemory,
    ) -> Self {
        let (reports, arrivals) = (Reports::new(LEVEL_S), QuickestArrivals::default());
        Self { host, latency, heeds_reports, reports, arrivals, memory, last: None }
    }

    /// The same for a camera that is asked over a fast network what its clock shows.
    pub(crate) fn of_asked(host: HostClock, latency: StreamLatency) -> Self {
        let reports = Reports::new(ASKED_LEVEL_S);
        Self { reports, ..Self::new(host, latency, true, ClockMemory::default()) }
    }

    /// The camera says that its clock showed `shown` at a stream time.
    pub(crate) fn report(&mut self, stream_s: f64, shown: Timestamp) {
        if self.heeds_reports {
            self.reports.add(stream_s, shown);
        }
    }

    /// Capture time of a frame with a stream time, which arrived `arrived_s` after the host's clock
    /// was read, and whose clock it is by.
    pub(crate) fn time(&mut self, stream_s: f64, arrived_s: f64) -> (CaptureTime, TimedBy) {
        if let Some(before) = self.last.replace(LastFrame { stream_s, arrived_s }) {
            let passed_s = stream_s - before.stream_s;
            // The stream's count started again from another instant: it went back, or ahead of the
            // arrivals. The reverse is no sign of that: a network may delay a frame by any time.
            if passed_s < 0.0 || passed_s - (arrived_s - before.arrived_s) > FARTHEST_S {
                self.reports = Reports::new(self.reports.level_s);
                self.arrivals = QuickestArrivals::default();
            }
        }
        self.arrivals.add(stream_s, arrived_s);
        // An arrival as if nothing had delayed the frame: every time below is relative to it.
        let unhindered = self.arrivals.unhindered_s(stream_s).unwrap_or(arrived_s);
        let arrival = self.host.wall.plus_seconds(unhindered);
        let StreamLatency { mean_s, sd_s } = self.latency;
        let by_arrival = CaptureTime { time: arrival.plus_seconds(-mean_s), sd_s };
        let Some(time) = self.reports.time(stream_s) else {
            let remembered = self.memory.ahead_s(arrival, &self.host);
            return remembered.filter(|_| self.heeds_reports).map_or(
                (by_arrival, TimedBy::Arrival),
                |by_s| {
                    let time = arrival.plus_seconds(by_s);
                    (CaptureTime { time, sd_s: REMEMBERED_SD_S }, TimedBy::Remembered)
                },
            );
        };
        let camera_ahead_s = time.seconds_since(arrival);
        if camera_ahead_s.abs() > FARTHEST_S {
            return (by_arrival, TimedBy::ArrivalAgainstCamera { camera_ahead_s });
        }
        *self.memory.locked() = Some(Ahead { by_s: camera_ahead_s, at: arrival, host: self.host });
        (CaptureTime { time, sd_s }, TimedBy::Camera)
    }
}

/// Unix time of an NTP time (32 bits of seconds, 32 bits of fraction); `None` for 0, by which a
/// camera says that it knows no time. NTP's seconds start again from 0 in 2036 (RFC 4330, 3).
pub(crate) fn unix_time(ntp: u64) -> Option<Timestamp> {
    let (seconds, fraction) = ((ntp >> 32) as i64, ntp & 0xFFFF_FFFF);
    let seconds = if seconds < 1 << 31 { seconds + (1 << 32) } else { seconds };
    let nanos = ((u128::from(fraction) * 1_000_000_000) >> 32) as i64;
    (ntp != 0)
        .then(|| Timestamp::from_nanos((seconds - NTP_TO_UNIX_S as i64) * 1_000_000_000 + nanos))
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOST_S: f64 = 1.8e9;
    const LATENCY: StreamLatency = StreamLatency { mean_s: 0.1, sd_s: 0.1 };

    fn host() -> Timestamp {
        Timestamp::from_seconds(HOST_S)
    }

    fn clock(memory: &ClockMemory) -> StreamClock {
        let host = HostClock { wall: host(), read: Instant::now() };
        StreamClock::new(host, LATENCY, true, memory.clone())
    }

    /// A camera whose count began 7 s before the host's, at 30 frames per second, whose frames take
    /// 80 ms and up to 50 ms more. Returns the frame's stream time, arrival and true capture time;
    /// the last two count from the host's start, s.
    fn frame(n: u32) -> (f64, f64, f64) {
        let exposed = f64::from(n) / 30.0 + 0.5;
        (exposed + 7.0, exposed + 0.08 + 0.05 * f64::from(n * 7 % 11) / 10.0, exposed)
    }

    fn error_s(found: CaptureTime, exposed_s: f64) -> f64 {
        found.time.seconds_since(host().plus_seconds(exposed_s))
    }

    #[test]
    fn before_a_report_frames_are_timed_by_the_quickest_arrival() {
        let mut clock = clock(&ClockMemory::default());
        for n in 0..90 {
            let (stream_s, arrived_s, exposed_s) = frame(n);
            let (found, by) = clock.time(stream_s, arrived_s);
            assert_eq!(by, TimedBy::Arrival);
            // The true delay is 80 ms, and 100 ms are assumed: once the quickest frame has come,
            // all are off by the same 20 ms.
            assert!(n < 11 || (error_s(found, exposed_s) + 0.02).abs() < 1e-6, "{n}");
            assert!(error_s(found, exposed_s).abs() < found.sd_s);
        }
    }

    #[test]
    fn reports_are_followed_through_noise_and_drift() {
        let mut clock = clock(&ClockMemory::default());
        // The camera's clock is 30 ms ahead and gains 40 microseconds per second; its reports are
        // alternately 2 ms too late and too early.
        let shows = |exposed_s: f64| exposed_s + 0.03 + 40e-6 * exposed_s;
        let mut worst: f64 = 0.0;
        for n in 0..9000 {
            let (stream_s, arrived_s, exposed_s) = frame(n);
            if n % 150 == 0 {
                let off = if n % 300 == 0 { 0.002 } else { -0.002 };
                clock.report(stream_s, host().plus_seconds(shows(exposed_s) + off));
            }
            let (found, by) = clock.time(stream_s, arrived_s);
            assert_eq!(by, TimedBy::Camera);
            if n > 1800 {
                worst = worst.max(error_s(found, shows(exposed_s)).abs());
            }
        }
        assert!(worst < 0.0015, "{worst}");
    }

    #[test]
    fn a_clock_that_is_set_is_followed_and_one_of_another_time_is_not_believed() {
        let mut clock = clock(&ClockMemory::default());
        let mut found = Vec::new();
        for n in 0..900 {
            let (stream_s, arrived_s, exposed_s) = frame(n);
            // Right, then a second ahead, then an hour, then right again.
            let ahead_s = [0.0, 1.0, 3600.0, 0.0][n as usize / 225];
            if n % 75 == 0 {
                clock.report(stream_s, host().plus_seconds(exposed_s + ahead_s));
            }
            let (time, by) = clock.time(stream_s, arrived_s);
            found.push((error_s(time, exposed_s), by));
        }
        let near = |n: usize, error_s: f64| (found[n].0 - error_s).abs() < 1e-6;
        assert!(near(100, 0.0) && near(300, 1.0) && near(800, 0.0), "{found:?}");
        let TimedBy::ArrivalAgainstCamera { camera_ahead_s } = found[600].1 else {
            panic!("{:?}", found[600])
        };
        assert!((camera_ahead_s - 3599.92).abs() < 0.01 && near(600, -0.02), "{camera_ahead_s}");
        assert_eq!(found[800].1, TimedBy::Camera);
    }

    #[test]
    fn a_stream_that_begins_again_is_timed_by_what_was_known() {
        let memory = ClockMemory::default();
        let mut before = clock(&memory);
        for n in 0..60 {
            let (stream_s, arrived_s, exposed_s) = frame(n);
            before.report(stream_s, host().plus_seconds(exposed_s + 0.03));
            before.time(stream_s, arrived_s);
        }
        let mut after = clock(&memory);
        let mut last = None;
        for n in 120..150 {
            let (stream_s, arrived_s, exposed_s) = frame(n);
            let (found, by) = after.time(stream_s + 1e4, arrived_s);
            assert_eq!(by, TimedBy::Remembered);
            last = Some(error_s(found, exposed_s + 0.03));
        }
        assert!(last.unwrap().abs() < 1e-6, "{last:?}");
        // If the host's clock has been set since, the remembered offset is not used.
        let set = HostClock { wall: host().plus_seconds(3600.0), read: Instant::now() };
        let mut set = StreamClock::new(set, LATENCY, true, memory);
        assert_eq!(set.time(0.0, 0.1).1, TimedBy::Arrival);
    }

    #[test]
    fn a_count_that_begins_anew_in_mid_stream_moves_no_time() {
        for jump_s in [-1e5, -3.0, 3.0, 1e5] {
            let mut clock = clock(&ClockMemory::default());
            for n in 0..600 {
                let (stream_s, arrived_s, exposed_s) = frame(n);
                let stream_s = stream_s + if n < 300 { 0.0 } else { jump_s };
                if n % 75 == 0 && n != 300 {
                    clock.report(stream_s, host().plus_seconds(exposed_s));
                }
                let (found, by) = clock.time(stream_s, arrived_s);
                let is_told = !(300..375).contains(&n);
                let expected = if is_told { TimedBy::Camera } else { TimedBy::Remembered };
                assert_eq!(by, expected, "{jump_s} s, frame {n}");
                // Until the camera reports again the remembered offset is used; it is exact once
                // the quickest arrival has come.
                let known_s = if is_told { 1e-6 } else { 0.051 };
                assert!(error_s(found, exposed_s).abs() < known_s, "{jump_s} s, frame {n}");
            }
        }
    }

    #[test]
    fn what_a_network_holds_up_is_timed_by_the_camera_all_the_same() {
        let (mut clock, mut came_s) = (clock(&ClockMemory::default()), 0.0_f64);
        for n in 0..600 {
            let (stream_s, arrived_s, exposed_s) = frame(n);
            // From the tenth second on frames are delayed more and more, by up to three seconds,
            // and then all come at once.
            let held_s = if (300..450).contains(&n) { f64::from(n - 300) * 0.02 } else { 0.0 };
            if n % 300 == 0 {
                clock.report(stream_s, host().plus_seconds(exposed_s));
            }
            came_s = (arrived_s + held_s).max(came_s + 1e-3);
            let (found, by) = clock.time(stream_s, came_s);
            assert_eq!(by, TimedBy::Camera);
            assert!(error_s(found, exposed_s).abs() < 1e-6, "frame {n}");
        }
    }

    #[test]
    fn whatever_a_camera_says_times_are_times() {
        let strange = [0.0, -1e18, 1e18, f64::NAN, f64::INFINITY];
        for shown in [Timestamp::EPOCH, Timestamp::MIN, Timestamp::from_nanos(i64::MAX)] {
            for stream_s in strange {
                let mut clock = clock(&ClockMemory::default());
                clock.report(stream_s, shown);
                clock.report(1.0, shown);
                let (found, _) = clock.time(stream_s, 0.1);
                assert!(found.sd_s.is_finite());
            }
        }
    }

    #[test]
    fn times_of_ntp_are_read_before_and_after_their_count_begins_again() {
        let of = |seconds: u64| unix_time(seconds << 32 | 1 << 31).map(Timestamp::seconds);
        assert_eq!(of(2_208_988_800), Some(0.5));
        // 2026-01-01, and 2036-02-07 06:28:17.
        assert_eq!(of(3_976_214_400), Some(1_767_225_600.5));
        assert_eq!(of(1), Some(2_085_978_497.5));
        assert_eq!(unix_time(0), None);
        assert!(unix_time(u64::MAX).is_some());
    }
}
