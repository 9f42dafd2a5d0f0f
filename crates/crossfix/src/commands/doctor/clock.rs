//! The accuracy of this host's clock, as chrony, ptp4l or the kernel states it.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::{CheckResult, Finding};
use crate::host::kernel_clock_bound;
use crate::pace::wall_seconds;

/// How long a program may take to answer. With half of it the programs of a busy host may seem to
/// be absent.
const ANSWER: Duration = Duration::from_secs(5);
/// How often it is checked whether a program has answered. With twice as much each check of a clock
/// takes up to 10 ms longer.
const POLL: Duration = Duration::from_millis(10);
/// A good clock's error is at most this, s: a target at 20 m/s is then off by a tenth of a metre.
/// With twice as much a fifth of a metre would pass.
const GOOD_S: f64 = 0.005;
/// An error above this is worse than what an agent assumes of a camera, s. With half of it clocks
/// would fail for which agents allow.
const BEARABLE_S: f64 = 0.1;
/// A clock last compared longer ago than this is no longer compared at all, s: the longest interval
/// of time servers is 17 minutes. With half of it a single comparison that is lost would be a
/// warning.
const OLD_S: f64 = 3600.0;

/// What `chronyc -c tracking` says.
#[derive(Clone, Debug, PartialEq)]
struct ChronyTracking {
    server: String,
    /// When the clock was last compared, s since the Unix epoch.
    compared_s: f64,
    /// Bound on the clock's error, s.
    bound_s: f64,
    is_synchronised: bool,
}

impl ChronyTracking {
    /// Parses the fourteen comma-separated values; `None` if they are not as expected.
    fn parse(line: &str) -> Option<Self> {
        let fields: Vec<&str> = line.trim().split(',').collect();
        let number = |at: usize| fields.get(at)?.parse::<f64>().ok().filter(|n| n.is_finite());
        let (offset, delay, dispersion) = (number(4)?, number(10)?, number(11)?);
        Some(Self {
            server: (*fields.get(1)?).to_owned(),
            compared_s: number(3)?,
            // NTP's bound: |offset| + root dispersion + root delay / 2.
            bound_s: offset.abs() + dispersion + delay / 2.0,
            is_synchronised: *fields.get(13)? != "Not synchronised",
        })
    }

    /// Judges the clock by its error bound by now and by when it was compared: chrony says "Normal"
    /// as long as it runs, even if its server is dead.
    fn assess(&self, now_s: f64) -> (CheckResult, String) {
        if !self.is_synchronised {
            return (CheckResult::Fail, "chrony runs, and has no time server".to_owned());
        }
        let age_s = now_s - self.compared_s;
        let verdict = match of_bound(self.bound_s) {
            CheckResult::Pass if age_s > OLD_S => CheckResult::Warn,
            verdict => verdict,
        };
        let found = format!(
            "by {}, within {:.1} ms, compared {age_s:.0} s ago",
            self.server,
            self.bound_s * 1e3
        );
        (verdict, found)
    }
}

/// The value of a key in lines that each have a key, white space and a value.
fn value_of<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let mut lines = text.lines().filter_map(|line| line.trim().split_once(char::is_whitespace));
    lines.find(|(found, _)| *found == key).map(|(_, value)| value.trim())
}

/// What `pmc` says of the clock that ptp4l disciplines (IEEE 1588's TIME_STATUS_NP).
#[derive(Clone, Debug, PartialEq)]
struct Ptp {
    grandmaster: String,
    offset_s: f64,
}

impl Ptp {
    /// Parses pmc's answer; `None` if there is none, or no grandmaster is present.
    fn parse(text: &str) -> Option<Self> {
        let offset_ns: f64 = value_of(text, "master_offset")?.parse().ok()?;
        (value_of(text, "gmPresent")? == "true" && offset_ns.is_finite()).then_some(Self {
            grandmaster: value_of(text, "gmIdentity")?.to_owned(),
            offset_s: offset_ns * 1e-9,
        })
    }

    fn assess(&self) -> (CheckResult, String) {
        let off_s = self.offset_s.abs();
        let found = format!("by PTP's grandmaster {}, {:.1} us off", self.grandmaster, off_s * 1e6);
        (of_bound(off_s), found)
    }
}

/// Verdict on a clock with this error bound.
fn of_bound(bound_s: f64) -> CheckResult {
    if bound_s > BEARABLE_S {
        CheckResult::Fail
    } else if bound_s > GOOD_S {
        CheckResult::Warn
    } else {
        CheckResult::Pass
    }
}

/// Output of a program, if it exists and answers in time.
fn said(program: &str, arguments: &[&str]) -> Option<String> {
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = command.spawn().ok()?;
    let begun = Instant::now();
    while child.try_wait().ok()?.is_none() {
        if begun.elapsed() > ANSWER {
            // The program is needed for nothing else, so it may be killed.
            let _ = child.kill();
            let _ = child.wait();
            return None;
        }
        std::thread::sleep(POLL);
    }
    let output = child.wait_with_output().ok()?;
    Some(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Accuracy of this host's clock: by the program that disciplines it, or by what that has set in
/// the kernel.
pub fn host_clock() -> Finding {
    let chrony = || ChronyTracking::parse(&said("chronyc", &["-c", "tracking"])?);
    let ptp = || Ptp::parse(&said("pmc", &["-u", "-b", "0", "GET TIME_STATUS_NP"])?);
    let (chrony, kernel) = (chrony(), kernel_clock_bound());
    let keeps = |tracking: &&ChronyTracking| tracking.is_synchronised || kernel.is_none();
    let (verdict, found) = if let Some(tracking) = chrony.as_ref().filter(keeps) {
        tracking.assess(wall_seconds())
    // ptp4l disciplines a network card's clock; it is this host's only if the kernel knows of
    // it.
    } else if let (Some(ptp), Some(_)) = (ptp(), kernel) {
        ptp.assess()
    } else if let Some(bound) = kernel {
        let bound_s = bound.as_secs_f64();
        (of_bound(bound_s), format!("within {:.1} ms, as the kernel was told", bound_s * 1e3))
    } else {
        (CheckResult::Warn, "nothing here keeps it".to_owned())
    };
    Finding::new("host clock", verdict, found)
        .remedy("run chrony, with the time server that the cameras have: apt-get install chrony")
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW_S: f64 = 1_795_000_100.0;

    fn verdict_of(offset: &str, delay: &str, dispersion: &str, leap: &str) -> CheckResult {
        let line = format!(
            "7F7F0101,10.0.0.1,3,1795000000.0,{offset},0.000001,0.00001,-1.2,0.0,0.1,{delay},{dispersion},64.5,{leap}\n"
        );
        ChronyTracking::parse(&line).unwrap().assess(NOW_S).0
    }

    #[test]
    fn a_clock_is_judged_by_what_it_may_be_off_and_not_by_what_it_calls_itself() {
        assert_eq!(verdict_of("-0.0001", "0.002", "0.0005", "Normal"), CheckResult::Pass);
        assert_eq!(verdict_of("0.0001", "0.02", "0.0005", "Normal"), CheckResult::Warn);
        // Its server is dead, and only the dispersion shows it.
        assert_eq!(verdict_of("0.0001", "0.002", "0.9", "Normal"), CheckResult::Fail);
        assert_eq!(verdict_of("0.0", "0.0", "0.0", "Not synchronised"), CheckResult::Fail);
    }

    #[test]
    fn a_clock_by_ptp_is_judged_by_its_offset_and_without_a_grandmaster_not_at_all() {
        let said = |offset: &str, present: &str| {
            format!(
                "sending: GET TIME_STATUS_NP\n\t5254.0-1 seq 0 RESPONSE MANAGEMENT TIME_STATUS_NP\n\t\t\
                 master_offset              {offset}\n\t\tgmPresent                  {present}\n\t\t\
                 gmIdentity                 525400.fffe.123456\n"
            )
        };
        let verdict_of = |offset: &str| Ptp::parse(&said(offset, "true")).unwrap().assess();
        let (verdict, found) = verdict_of("-500");
        assert_eq!(verdict, CheckResult::Pass);
        assert_eq!(found, "by PTP's grandmaster 525400.fffe.123456, 0.5 us off");
        assert_eq!(verdict_of("20000000").0, CheckResult::Warn);
        assert_eq!(verdict_of("-37000000000").0, CheckResult::Fail);
        assert_eq!(Ptp::parse(&said("0", "false")), None);
        assert_eq!(Ptp::parse("sending: GET TIME_STATUS_NP\n"), None);
    }

    #[test]
    fn what_is_no_answer_is_none() {
        for line in ["", "506 Cannot talk to daemon", "1,2,3", "a,b,c,d,e,f,g,h,i,j,k,l,m,n"] {
            assert_eq!(ChronyTracking::parse(line), None);
        }
    }
}
