//! Playing data at the speed of the wall clock.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::service;
use crate::shutdown::Shutdown;

/// Seconds since the Unix epoch by this machine's clock.
pub fn wall_seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// How often a wait checks whether to stop. With twice as much a stop comes up to a tenth of a
/// second late.
const POLL: Duration = Duration::from_millis(50);
/// Longer waits are cut to this length: about a hundred years, s. With half of it the same.
const LONGEST_S: f64 = 3e9;

/// When to handle which data: data time runs `speed` times as fast as a monotonic clock, from
/// `start` on; with a speed of 0 nothing waits.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    start: Instant,
    speed: f64,
}

impl Pace {
    /// Pace of data that begin at a wall clock time, seconds since the Unix epoch. The clock is
    /// read once, so later changes of it have no effect.
    pub fn beginning_at(wall_s: f64, speed: f64) -> Self {
        Self::beginning_in(wall_s - wall_seconds(), speed)
    }

    /// Pace of data that begin in `seconds`, or began that long ago if it is negative.
    pub fn beginning_in(seconds: f64, speed: f64) -> Self {
        let (now, by) = (Instant::now(), duration(seconds.abs()));
        let start = if seconds < 0.0 { now.checked_sub(by) } else { now.checked_add(by) };
        Self { start: start.unwrap_or(now), speed }
    }

    /// Waits until it is time for the data `data_s` after the beginning. Returns whether to go on.
    pub fn wait(&self, data_s: f64, shutdown: &Shutdown) -> bool {
        if let Some(due) = self.due(data_s) {
            while !shutdown.requested() {
                let left = due.saturating_duration_since(Instant::now());
                if left.is_zero() {
                    break;
                }
                service::alive();
                std::thread::sleep(left.min(POLL));
            }
        }
        !shutdown.requested()
    }

    /// How late the data `data_s` after the beginning are by now.
    pub fn behind(&self, data_s: f64) -> Duration {
        self.due(data_s).map_or(Duration::ZERO, |due| Instant::now().saturating_duration_since(due))
    }

    fn due(&self, data_s: f64) -> Option<Instant> {
        (self.speed > 0.0).then(|| self.start.checked_add(duration(data_s / self.speed))).flatten()
    }
}

fn duration(seconds: f64) -> Duration {
    // NaN becomes zero.
    Duration::from_secs_f64(seconds.clamp(0.0, LONGEST_S).max(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_are_due_when_their_time_has_come_and_behind_after_it() {
        let begun = Pace::beginning_in(-10.0, 2.0);
        assert!(begun.behind(21.0).is_zero());
        let behind = begun.behind(18.0).as_secs_f64();
        assert!((1.0..1.5).contains(&behind), "{behind}");
        assert!(Pace::beginning_in(-10.0, 0.0).behind(1.0).is_zero(), "nothing waits");
        for strange in [f64::NAN, f64::INFINITY, -1.0, 1e300] {
            let _ = Pace::beginning_in(strange, 1.0).behind(strange);
        }
    }
}
