//! Load of this process and its host, and the accuracy of the host's clock.

use std::time::{Duration, Instant};

use crossfix_message::HostLoad;
use sysinfo::{Components, Pid, ProcessRefreshKind, ProcessesToUpdate, System};

/// Measures the load of this process and its host once a second.
#[derive(Debug, Default)]
pub struct HostWatch {
    /// `None` where the system does not say.
    system: Option<System>,
    parts: Option<Components>,
    /// When it was measured last, and the process's processor time (CPU time) by then.
    before: Option<(Instant, Duration)>,
}

impl HostWatch {
    /// Starts measuring; the load is available from the second measurement on.
    pub fn start() -> Self {
        let parts = Components::new_with_refreshed_list();
        Self { system: System::new().ok(), parts: parts.ok(), before: None }
    }

    /// Load since the previous measurement; `None` where the system does not say.
    pub fn measure(&mut self) -> Option<HostLoad> {
        let system = self.system.as_mut()?;
        let own = Pid::from_u32(std::process::id());
        system.refresh_cpu_usage();
        system.refresh_memory();
        let kind = ProcessRefreshKind::nothing().with_cpu().with_memory();
        system.refresh_processes_specifics(ProcessesToUpdate::Some(&[own]), false, kind);
        let process = system.process(own)?;
        let (now, used) = (Instant::now(), Duration::from_millis(process.accumulated_cpu_time()));
        let process_cores = self.before.map_or(0.0, |(at, before)| {
            let passed_s = now.saturating_duration_since(at).as_secs_f64();
            used.saturating_sub(before).as_secs_f64() / passed_s.max(f64::EPSILON)
        });
        self.before = Some((now, used));
        Some(HostLoad {
            process_cores,
            process_memory: process.memory(),
            cores_in_use: f64::from(system.global_cpu_usage()) / 100.0,
            memory_available: system.available_memory(),
            temperature_c: self.parts.as_mut().and_then(hottest),
            clock_bound_s: kernel_clock_bound().map(|bound| bound.as_secs_f64()),
        })
    }
}

/// The temperature of the hottest part, degrees Celsius.
fn hottest(parts: &mut Components) -> Option<f64> {
    parts.refresh(false);
    let read = parts.iter().filter_map(|part| part.temperature());
    read.filter(|celsius| celsius.is_finite()).map(f64::from).max_by(f64::total_cmp)
}

/// How far off the host's clock may be, as the program that disciplines the clock has set in the
/// kernel; `None` where no program does. Such programs tell the kernel every few seconds to
/// minutes; in between the kernel adds half a millisecond per second, and reports the clock as
/// unsynchronised once that has come to 16 s.
#[cfg(target_os = "linux")]
#[expect(unsafe_code, reason = "no crate that is kept has this call without setting the clock")]
pub fn kernel_clock_bound() -> Option<Duration> {
    // SAFETY: `timex` is made of numbers only, for which zeros are valid; with `modes` 0 the call
    // writes into it and sets nothing.
    let (state, answer) = unsafe {
        let mut answer: libc::timex = std::mem::zeroed();
        (libc::adjtimex(&raw mut answer), answer)
    };
    let is_kept = (0..libc::TIME_ERROR).contains(&state) && answer.status & libc::STA_UNSYNC == 0;
    is_kept.then(|| Duration::from_micros(answer.maxerror.max(0).unsigned_abs()))
}

/// As on Linux, except that no kernel can be asked: always `None`.
#[cfg(not(target_os = "linux"))]
pub fn kernel_clock_bound() -> Option<Duration> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_that_works_is_seen_to_work() {
        let mut watch = HostWatch::start();
        let first = watch.measure().unwrap();
        assert!(first.process_memory > 1 << 20 && first.memory_available > 1 << 20, "{first:?}");
        let until = Instant::now() + Duration::from_millis(500);
        while Instant::now() < until {}
        let load = watch.measure().unwrap();
        // Other tests of this process may run at the same time.
        assert!(load.process_cores > 0.3, "{load:?}");
        assert!((0.0..=1.0).contains(&load.cores_in_use), "{load:?}");
        // Nobody's clock is off by the age of the universe, however it is kept.
        assert!(load.clock_bound_s.is_none_or(|bound| (0.0..100.0).contains(&bound)), "{load:?}");
    }
}
