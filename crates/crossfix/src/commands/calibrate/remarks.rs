//! Remarks on a calibration that its figures do not make.

use crossfix_calibration::{CameraResult, FlightResult, LandmarkMisfit};

/// A focal length that has changed by more than this share is remarked on. At 30 degrees from the
/// axis it moves a direction by 1.3 mrad. With twice as much 2.6 mrad would pass without a remark.
const REMARKED_FOCAL: f64 = 0.003;
/// A log whose residuals are larger than its kind allows by this factor is remarked on. With half
/// of it a log that is a quarter worse than its kind would be remarked on.
const REMARKED_LOG: f64 = 2.5;
/// Cameras whose clock rates agree to within this run against one common clock: the log's. With
/// half of it good clocks may not agree, and nothing is said of the log.
const ALIKE_RATE: f64 = 1e-4;
/// The log's clock is remarked on if they run against it by more than this: two quartzes agree
/// within 1e-4. With half of it a good log might be remarked on.
const REMARKED_RATE: f64 = 2e-4;
/// Fewer cameras than this do not outvote a log. With two, a chance agreement of two clocks would
/// speak against the log.
const LEAST_CAMERAS: usize = 3;
/// Larger times are times of day (1973 and later), not seconds since the camera was switched on, s.
/// With half of it the same: few cameras run for a year and a half.
const CLOCK_S: f64 = 1e8;
/// Clocks that agree with each other to within this have been set, s. With half of it clocks that
/// were set by hand might not agree.
const ALIKE_S: f64 = 2.0;
/// How far GPS time is ahead of UTC, s.
const GPS_S: f64 = 18.0;
/// Offsets of time zones are multiples of this, s.
const ZONE_S: f64 = 900.0;

/// A landmark that deviates by more SDs than this is remarked on: of good clicks one in 7000 does.
/// With half of it one in nine would.
const BESIDE: f64 = 4.2;

/// What determines the size and position of the site.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rests {
    /// Only the log; nothing could contradict it.
    OnLogAlone,
    /// A survey, with a log or without.
    OnSurvey,
}

/// All remarks on a result.
pub fn of(result: &FlightResult, rests: Rests) -> Vec<String> {
    let clocks: Option<Vec<ClockAgainstLog>> =
        result.log.map(|_| result.cameras.iter().map(ClockAgainstLog::of).collect());
    [
        of_log(result),
        of_size(rests),
        of_landmarks(&result.landmarks),
        clocks.as_deref().and_then(of_offsets),
        clocks.as_deref().and_then(of_rates),
        of_lenses(result),
    ]
    .into_iter()
    .flatten()
    .collect()
}

fn of_size(rests: Rests) -> Option<String> {
    (rests == Rests::OnLogAlone).then(|| {
        "Where the site is and how large rests on the log alone: feet for metres, or heights over \
         another sea, would not show. Places of two cameras (--positions) or a taped --distance \
         would tell."
            .to_owned()
    })
}

fn of_log(result: &FlightResult) -> Option<String> {
    let log = result.log?;
    let times = log.residual_m / log.stated_sd_m;
    (times > REMARKED_LOG).then(|| {
        format!(
            "The log lies {times:.1} times as far beside the way as its kind allows: another \
             --log-kind, or feet for metres."
        )
    })
}

/// Whether most landmarks deviate from where the flight places them.
pub fn most_lie_beside(landmarks: &[LandmarkMisfit]) -> bool {
    let beside = landmarks.iter().filter(|misfit| misfit.deviations > BESIDE).count();
    2 * beside > landmarks.len()
}

fn of_landmarks(landmarks: &[LandmarkMisfit]) -> Option<String> {
    let beside: Vec<&LandmarkMisfit> =
        landmarks.iter().filter(|misfit| misfit.deviations > BESIDE).collect();
    if beside.is_empty() {
        return None;
    }
    if most_lie_beside(landmarks) {
        return Some(
            "Most landmarks lie beside where the flight has them: their places or the log's are in \
             feet, count from another origin or have a wrong sign, or pictures were taken before a \
             camera was moved. Of few landmarks one wrong place may do that."
                .to_owned(),
        );
    }
    let name = |misfit: &&LandmarkMisfit| format!("`{}` of `{}`", misfit.landmark, misfit.camera);
    let names: Vec<String> = beside.iter().map(name).collect();
    Some(format!(
        "Beside where the flight and the other landmarks have it, and so counted for less: {}. A \
         wrong click, or another's place.",
        names.join(", ")
    ))
}

/// A camera's clock in relation to the log's.
#[derive(Clone, Copy, Debug)]
struct ClockAgainstLog {
    own_s: f64,
    /// The log's time minus the camera's own, s.
    ahead_s: f64,
    rate: f64,
}

impl ClockAgainstLog {
    fn of(camera: &CameraResult) -> Self {
        let middle = &camera.clock.knots[camera.clock.knots.len() / 2];
        Self { own_s: middle.time_s, ahead_s: middle.ahead_s, rate: camera.clock.rate }
    }
}

/// The median of some numbers, if at least two thirds of them lie within a distance of it.
fn agreed(numbers: impl Iterator<Item = f64>, within: f64) -> Option<f64> {
    let mut numbers: Vec<f64> = numbers.collect();
    numbers.sort_unstable_by(f64::total_cmp);
    let middle = *numbers.get(numbers.len() / 2)?;
    let near = numbers.iter().filter(|number| (*number - middle).abs() < within).count();
    (near >= LEAST_CAMERAS && 3 * near >= 2 * numbers.len()).then_some(middle)
}

fn of_rates(clocks: &[ClockAgainstLog]) -> Option<String> {
    let rate = agreed(clocks.iter().map(|clock| clock.rate), ALIKE_RATE)?;
    (rate.abs() > REMARKED_RATE).then(|| {
        let word = if rate > 0.0 { "fast" } else { "slow" };
        format!(
            "The log's clock runs {:.2} % {word} against the cameras', which agree among \
             themselves: its times are hardly seconds.",
            100.0 * rate.abs()
        )
    })
}

fn of_offsets(clocks: &[ClockAgainstLog]) -> Option<String> {
    let is_of_day = |s: f64| s > CLOCK_S;
    if !clocks.iter().all(|c| is_of_day(c.own_s) && is_of_day(c.own_s + c.ahead_s)) {
        return None;
    }
    let ahead_s = agreed(clocks.iter().map(|clock| clock.ahead_s), ALIKE_S)?;
    if ahead_s.abs() < ALIKE_S {
        return None;
    }
    let zones = (ahead_s / ZONE_S).round();
    let why = if (ahead_s - GPS_S).abs() < ALIKE_S {
        ": they are GPS's (--time gps)".to_owned()
    } else if zones != 0.0 && (ahead_s - zones * ZONE_S).abs() < ALIKE_S {
        format!(": another time zone, by {} h", zones * ZONE_S / 3600.0)
    } else {
        String::new()
    };
    let word = if ahead_s > 0.0 { "ahead of" } else { "behind" };
    Some(format!("The log's times are {:.1} s {word} all cameras' clocks{why}.", ahead_s.abs()))
}

fn of_lenses(result: &FlightResult) -> Option<String> {
    let moved = |camera: &CameraResult| (camera.focal_ratio - 1.0).abs() > REMARKED_FOCAL;
    result.cameras.iter().any(moved).then(|| {
        "A lens's focal length is shorter or longer at a distance than near the checkerboard that \
         its file was made with: that is usual up to 2 %."
            .to_owned()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clocks(ahead_s: [f64; 3], rates: [f64; 3]) -> Vec<ClockAgainstLog> {
        let clock = |(ahead_s, rate)| ClockAgainstLog { own_s: 1.7e9, ahead_s, rate };
        ahead_s.into_iter().zip(rates).map(clock).collect()
    }

    #[test]
    fn a_log_in_gps_time_or_of_another_zone_is_named() {
        let said = |ahead_s| of_offsets(&clocks(ahead_s, [0.0; 3]));
        assert_eq!(said([0.02, -0.3, 0.1]), None);
        assert!(said([18.02, 17.9, 18.4]).unwrap().contains("--time gps"));
        assert!(said([-7200.1, -7199.8, -7200.0]).unwrap().contains("by -2 h"));
        assert!(said([41.0, 40.9, 41.2]).unwrap().contains("41.0 s ahead of all"));
        // Cameras that do not agree with each other have clocks that nobody has set.
        assert_eq!(said([41.0, -900.0, 12.0]), None);
    }

    #[test]
    fn seconds_since_a_camera_was_switched_on_are_no_times_of_day() {
        let mut clocks = clocks([18.0; 3], [0.0; 3]);
        clocks.iter_mut().for_each(|clock| clock.own_s = 151.0);
        assert_eq!(of_offsets(&clocks), None);
        // Times counted from the start of a log are no times of day either.
        assert_eq!(of_offsets(&self::clocks([-1.7e9 + 20.0; 3], [0.0; 3])), None);
    }

    #[test]
    fn a_log_whose_seconds_are_none_is_named_and_a_phone_is_not() {
        let said = |rates| of_rates(&clocks([0.0; 3], rates));
        assert!(said([9.8e-4, 1.0e-3, 1.02e-3]).unwrap().contains("0.10 % fast"));
        assert_eq!(said([-8.3e-4, 2e-6, 1.9e-5]), None);
    }
}
