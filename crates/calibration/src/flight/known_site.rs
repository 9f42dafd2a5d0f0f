//! Where no log places a site, an earlier calibration of it does.

use crossfix_message::Datum;

use super::results::{CameraResult, FlightResult};
use crate::calibrated_camera::ClockOffset;
use crate::survey::Survey;

/// No clock is taken to be known better than this at another time than that of its calibration, s:
/// a weighted mean of zero deviations does not exist. With half of it a clock that is stated better
/// counts four times as much, and may decide alone.
const LEAST_CLOCK_SD_S: f64 = 1e-3;

/// Keeps a site as a whole where an earlier calibration has it: its datum may be off by what was
/// stated then. The common time is the one that the cameras' clocks showed by their earlier
/// calibration.
pub(super) fn keep_known_site(result: &mut FlightResult, survey: &Survey) {
    if let (Some(datum), Some(known)) = (&mut result.datum, survey.known_datum()) {
        *datum = known.clone();
    }
    let Some(Lateness { later_s, sd_s }) = later(result, survey) else { return };
    for camera in &mut result.cameras {
        camera.clock.knots.iter_mut().for_each(|knot| knot.ahead_s += later_s);
        camera.fitted.iter_mut().for_each(|label| label.time_s += later_s);
    }
    if let Some(datum) = &mut result.datum {
        datum.covariance[(Datum::LATE, Datum::LATE)] += sd_s * sd_s;
    }
}

/// How much later the common time is than by an earlier calibration.
#[derive(Clone, Copy, Debug)]
struct Lateness {
    later_s: f64,
    sd_s: f64,
}

/// How much later the common time is by the earlier calibration of the clocks: the median of what
/// the cameras state, as one clock may have been set again. Clocks that no flight has calibrated
/// are not counted.
fn later(result: &FlightResult, survey: &Survey) -> Option<Lateness> {
    let mut said: Vec<Lateness> =
        result.cameras.iter().filter_map(|camera| later_by_clock(camera, survey)).collect();
    said.sort_by(|a, b| a.later_s.total_cmp(&b.later_s));
    // Weighted median: the value at which the summed weights 1 / sd^2 reach half of their total.
    let half: f64 = said.iter().map(|one| one.sd_s.powi(-2)).sum::<f64>() / 2.0;
    let mut below = 0.0;
    let middle = said.iter().find(|one| {
        below += one.sd_s.powi(-2);
        below >= half
    })?;
    // A median's variance is pi / 2 times a mean's, or more where the cameras differ by more than
    // they state.
    let deviations = said.iter().map(|one| (one.later_s - middle.later_s) / one.sd_s);
    let beside: f64 = deviations.map(|deviations| deviations.abs().min(3.0).powi(2)).sum();
    let spread = (beside / said.len() as f64).max(1.0);
    let sd_s = (std::f64::consts::FRAC_PI_2 * spread / (2.0 * half)).sqrt();
    Some(Lateness { later_s: middle.later_s, sd_s })
}

/// The same by the clock of one camera.
fn later_by_clock(found: &CameraResult, survey: &Survey) -> Option<Lateness> {
    let known = survey.known(&found.name)?;
    known.clock.knots_s.first()?;
    let middle = found.clock.knots.get(found.clock.knots.len() / 2)?;
    let ClockOffset { ahead_s, sd_s } = known.clock.at(middle.time_s);
    // Compared in the middle of the flight, where its own rate matters least.
    Some(Lateness { later_s: ahead_s - middle.ahead_s, sd_s: sd_s.max(LEAST_CLOCK_SD_S) })
}
