//! How good this host's clock is, as chrony tells it.

use std::process::Command;

use super::{Finding, Verdict};
use crate::pace::wall_seconds;

/// A clock that may be off by so much costs a target at 20 m/s a tenth of a metre, s.
const GOOD_S: f64 = 0.005;
/// One that may be off by more is worse than what an agent assumes of a camera, s.
const BEARABLE_S: f64 = 0.1;
/// A clock that was compared longer ago than this is compared no more: the longest interval of time
/// servers is 17 minutes, s.
const OLD_S: f64 = 3600.0;

/// What `chronyc -c tracking` says.
#[derive(Clone, Debug, PartialEq)]
struct Tracking {
    server: String,
    /// When it was last compared, s since the Unix epoch.
    compared_s: f64,
    /// By how much it may be off, s.
    bound_s: f64,
    is_synchronised: bool,
}

impl Tracking {
    /// Reads the fourteen values with commas between them; `None` if they are others.
    fn parse(line: &str) -> Option<Self> {
        let fields: Vec<&str> = line.trim().split(',').collect();
        let number = |at: usize| fields.get(at)?.parse::<f64>().ok().filter(|n| n.is_finite());
        let (offset, delay, dispersion) = (number(4)?, number(10)?, number(11)?);
        Some(Self {
            server: (*fields.get(1)?).to_owned(),
            compared_s: number(3)?,
            bound_s: offset.abs() + dispersion + delay / 2.0,
            is_synchronised: *fields.get(13)? != "Not synchronised",
        })
    }

    /// "Normal" is said as long as chrony runs, of a server that is dead as well: what counts is how
    /// far off the clock may be by now, and when it was compared.
    fn judge(&self, now_s: f64) -> (Verdict, String) {
        if !self.is_synchronised {
            return (Verdict::Fail, "chrony runs, and has no time server".to_owned());
        }
        let age_s = now_s - self.compared_s;
        let verdict = if self.bound_s > BEARABLE_S {
            Verdict::Fail
        } else if self.bound_s > GOOD_S || age_s > OLD_S {
            Verdict::Warn
        } else {
            Verdict::Pass
        };
        let found = format!(
            "by {}, within {:.1} ms, compared {age_s:.0} s ago",
            self.server,
            self.bound_s * 1e3
        );
        (verdict, found)
    }
}

/// How good this host's clock is.
pub fn host_clock() -> Finding {
    let said = Command::new("chronyc").args(["-c", "tracking"]).output();
    let line = said.map(|output| String::from_utf8_lossy(&output.stdout).into_owned());
    let (verdict, found) = match line.as_deref().map(Tracking::parse) {
        Ok(Some(tracking)) => tracking.judge(wall_seconds()),
        Ok(None) => (Verdict::Warn, "chrony is there and does not answer".to_owned()),
        Err(_) => (Verdict::Warn, "nobody here can say how good it is".to_owned()),
    };
    Finding::new("host clock", verdict, found)
        .mend("run chrony, with the time server that the cameras have: apt-get install chrony")
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW_S: f64 = 1_795_000_100.0;

    fn judged(offset: &str, delay: &str, dispersion: &str, leap: &str) -> Verdict {
        let line = format!(
            "7F7F0101,10.0.0.1,3,1795000000.0,{offset},0.000001,0.00001,-1.2,0.0,0.1,{delay},{dispersion},64.5,{leap}\n"
        );
        Tracking::parse(&line).unwrap().judge(NOW_S).0
    }

    #[test]
    fn a_clock_is_judged_by_what_it_may_be_off_and_not_by_what_it_calls_itself() {
        assert_eq!(judged("-0.0001", "0.002", "0.0005", "Normal"), Verdict::Pass);
        assert_eq!(judged("0.0001", "0.02", "0.0005", "Normal"), Verdict::Warn);
        // Its server is dead, and nothing but the dispersion says so.
        assert_eq!(judged("0.0001", "0.002", "0.9", "Normal"), Verdict::Fail);
        assert_eq!(judged("0.0", "0.0", "0.0", "Not synchronised"), Verdict::Fail);
    }

    #[test]
    fn what_is_no_answer_is_none() {
        for line in ["", "506 Cannot talk to daemon", "1,2,3", "a,b,c,d,e,f,g,h,i,j,k,l,m,n"] {
            assert_eq!(Tracking::parse(line), None);
        }
    }
}
