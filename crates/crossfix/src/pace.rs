//! Playing data in the time of the wall.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::shutdown::Shutdown;

/// Seconds since the Unix epoch by this machine's clock.
pub fn wall_seconds() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

/// When to handle what: data time runs `speed` times as fast as the wall's from `start` on; with a
/// speed of 0 nothing waits.
#[derive(Clone, Copy, Debug)]
pub struct Pace {
    /// Seconds since the Unix epoch.
    pub start: f64,
    /// How much faster than in life.
    pub speed: f64,
}

impl Pace {
    /// Waits until it is time for what lies `data_s` after the data's beginning. Says whether to go on.
    pub fn wait(&self, data_s: f64, shutdown: &Shutdown) -> bool {
        if self.speed > 0.0 {
            let due = self.start + data_s / self.speed;
            while !shutdown.requested() {
                let left = due - wall_seconds();
                if left <= 0.0 {
                    break;
                }
                std::thread::sleep(Duration::from_secs_f64(left.min(0.05)));
            }
        }
        !shutdown.requested()
    }
}
