//! Poses, clocks and lenses of cameras from the flight of one target with a log.
//!
//! All that is unknown is adjusted at once: each camera's pose, clock and lens, the target's way (a
//! cubic spline with white jerk) and the log's drifting bias. The log is a measurement and not the
//! truth: a camera that were held against it alone would take on its errors.

mod adjustment;
mod datum;
mod halves;
mod model;
mod noise;
mod normal;
mod results;
mod spline;
mod start;
mod unknowns;

use crossfix_message::CameraName;
use nalgebra::Vector2;
use thiserror::Error;

use adjustment::{Adjusted, CameraPriors, Flight, NEARLY_SETTLED, Priors, RATE_SD, SETTLED, State};
use model::CameraState;
use results::results;
use spline::{KNOT_S, SPAN, Spline, THIRD_DIFFERENCE};

pub use model::{CameraLabels, FlightLog, Label, LogErrors, LogSample};
pub use noise::LabelNoise;
pub use results::{CameraResult, ClockKnot, ClockResult, FlightResult};

/// Why a flight cannot be adjusted.
#[derive(Debug, Error)]
pub enum FlightError {
    /// The log holds too little.
    #[error("the log has {samples} samples: a flight needs at least {LEAST_SAMPLES}")]
    ShortLog {
        /// How many there are.
        samples: usize,
    },
    /// The log is longer than any flight: a time of it is wrong, or it has to be cut.
    #[error("the log lasts {hours:.1} h: cut it to the flight, at most {LONGEST_LOG_H} h")]
    LongLog {
        /// How long.
        hours: f64,
    },
    /// No camera can be calibrated; why not of the first.
    #[error("no camera can be calibrated: camera `{camera}` {why}")]
    NoCamera {
        /// The camera.
        camera: CameraName,
        /// Why not.
        why: Refusal,
    },
    /// The equations have no solution.
    #[error("the adjustment has no solution: labels and log are hardly of one flight")]
    NoSolution,
}

/// Why one camera cannot be calibrated.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum Refusal {
    /// It saw too little.
    #[error("has {labels} labels: a calibration needs at least {LEAST_LABELS}")]
    FewLabels {
        /// How many there are.
        labels: usize,
    },
    /// Its labels last longer than any flight.
    #[error(
        "has labels over {hours:.1} h: take one flight, at most {LONGEST_FLIGHT_H} h (a time of them \
         may be wrong)"
    )]
    LongFlight {
        /// How long.
        hours: f64,
    },
    /// Its labels and the log have no time in common.
    #[error("has too few labels in the time of the log, whatever its clock shows")]
    NoTime,
    /// No pose and offset makes its labels fit the log.
    #[error(
        "lies {misfit_mrad:.1} mrad beside the log wherever it stands{}",
        mirror.map_or(String::new(), |mirror| format!(": {mirror}"))
    )]
    Misfit {
        /// The median angle between labels and log, mrad.
        misfit_mrad: f64,
        /// What makes it fit.
        mirror: Option<Mirror>,
    },
}

/// A log whose axes are others than it says: only its mirror image fits what cameras see.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mirror {
    /// East and north are exchanged, or the height's sign is: what cameras see does not tell which.
    AxesOrHeight,
}

impl std::fmt::Display for Mirror {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(
            "its mirror image fits, so east and north are exchanged in the log, or its height counts \
             downwards",
        )
    }
}

/// Labels that lie farther than this beside the log, in the median, are not of it, rad: lens files
/// and clocks that are not known yet leave up to 4 mrad. With half of it phones are refused.
const MOST_MISFIT_RAD: f64 = 8e-3;
/// ... and so many deviations of the log's own errors, as they are seen from where the camera
/// stands.
const LOG_DEVIATIONS: f64 = 3.0;
/// The mirror image fits where it fits so many times better.
const CLEARLY_BETTER: f64 = 3.0;

/// A flight's equations take memory by its time: an hour of six cameras 0.2 GB, and minutes.
const LONGEST_FLIGHT_H: f64 = 1.0;
/// All of a log's times are tried for each camera's clock: six hours take seconds a camera.
const LONGEST_LOG_H: f64 = 6.0;
/// A log with fewer samples is none.
const LEAST_SAMPLES: usize = 20;
/// A camera with fewer labels has seen nothing.
const LEAST_LABELS: usize = 30;
/// Beyond the labels the way goes on for so long, s: their times may still move.
const MARGIN_S: f64 = 2.0;
/// Rounds in which deviations and powers are found beside the unknowns.
const ROUNDS: usize = 6;
/// What labels are taken to err by before anything is known, pixels: a hand's or a tracker's, and
/// what a lens file leaves.
const FIRST_NOISE: LabelNoise = LabelNoise { white_px: 0.5, lasting_px: 1.4, lasting_s: 0.5 };
/// Power of a clock's wander in the first round, s^2/s: a phone's, which is large. From too little
/// it would not be found.
const FIRST_WANDER: f64 = 2e-6;
/// What clocks are usually like, 0.03 ms after a second, is believed as two steps that were seen; the
/// least is a crystal's.
const USUAL_WANDER: f64 = 1e-9;
const USUAL_STEPS: f64 = 2.0;
const LEAST_WANDER: f64 = 1e-12;

/// Adjusts a flight.
///
/// # Errors
/// [`FlightError`] naming the camera, or what of the log is too little.
pub fn calibrate_flight(
    cameras: &[CameraLabels],
    log: &FlightLog,
) -> Result<FlightResult, FlightError> {
    if log.samples.len() < LEAST_SAMPLES {
        return Err(FlightError::ShortLog { samples: log.samples.len() });
    }
    let hours = hours(log.samples.iter().map(|sample| sample.time_s));
    if hours > LONGEST_LOG_H {
        return Err(FlightError::LongLog { hours });
    }
    let (of_log, jerk) = log_alone(log).ok_or(FlightError::NoSolution)?;
    let (mut used, mut starts, mut refused) = (Vec::new(), Vec::new(), Vec::new());
    for camera in cameras {
        match start_of(camera, &of_log, &log.errors) {
            Ok(start) => {
                used.push(camera.clone());
                starts.push(start);
            }
            Err(why) => refused.push((camera.name.clone(), why)),
        }
    }
    if used.is_empty() {
        let (camera, why) = refused.into_iter().next().ok_or(FlightError::NoSolution)?;
        return Err(FlightError::NoCamera { camera, why });
    }
    let flight = Flight { cameras: &used, log };
    let (state, priors) = begin(&flight, starts, &of_log, jerk);
    let (adjusted, priors) = settle(&flight, priors, state).ok_or(FlightError::NoSolution)?;
    let mut result = results(&flight, adjusted, &priors).ok_or(FlightError::NoSolution)?;
    result.refused = refused;
    Ok(result)
}

/// How long times last that are in order.
fn hours(mut times_s: impl DoubleEndedIterator<Item = f64>) -> f64 {
    let (first, last) = (times_s.next(), times_s.next_back());
    first.zip(last).map_or(0.0, |(first, last)| (last - first) / 3600.0)
}

/// A camera's start against the log's way.
fn start_of(
    camera: &CameraLabels,
    of_log: &State,
    errors: &LogErrors,
) -> Result<CameraState, Refusal> {
    let labels = camera.labels.len();
    if labels < LEAST_LABELS {
        return Err(Refusal::FewLabels { labels });
    }
    let hours = hours(camera.labels.iter().map(|label| label.time_s));
    if hours > LONGEST_FLIGHT_H {
        return Err(Refusal::LongFlight { hours });
    }
    let frame_s = frame_time(camera);
    let (state, misfit) = start::find(camera, &of_log.way, frame_s).ok_or(Refusal::NoTime)?;
    tracing::debug!(
        "camera `{}` starts at {:.2} with the clock {:.3} s behind, {:.2} mrad off",
        camera.name,
        state.centre,
        state.clock.offset_s,
        misfit * 1e3
    );
    let of_errors = LOG_DEVIATIONS * errors.sd_m.hypot(errors.drift_sd_m);
    let range_m = middle_distance(&of_log.way, &state);
    if misfit <= MOST_MISFIT_RAD + of_errors / range_m {
        return Ok(state);
    }
    // Exchanging two axes or turning one round is the same but for where the camera stands.
    let mut mirrored = of_log.way.clone();
    mirrored.coefficients.iter_mut().for_each(|place| place.z = -place.z);
    let of_mirror = start::find(camera, &mirrored, frame_s).map_or(f64::INFINITY, |found| found.1);
    let mirror = (of_mirror * CLEARLY_BETTER < misfit).then_some(Mirror::AxesOrHeight);
    Err(Refusal::Misfit { misfit_mrad: misfit * 1e3, mirror })
}

/// The median distance of a way from a camera, m.
fn middle_distance(way: &Spline, camera: &CameraState) -> f64 {
    let distance = |place: &nalgebra::Vector3<f64>| (place - camera.centre.coords).norm();
    let mut distances: Vec<f64> = way.coefficients.iter().map(distance).collect();
    distances.sort_unstable_by(f64::total_cmp);
    distances[distances.len() / 2].max(1.0)
}

/// All unknowns as they are begun with: each camera at its start, the way as the log shows it.
fn begin(
    flight: &Flight<'_>,
    states: Vec<CameraState>,
    of_log: &State,
    jerk: f64,
) -> (State, Priors) {
    let prior = |camera: &CameraLabels| CameraPriors {
        noise: FIRST_NOISE,
        lens: camera.intrinsics,
        frame_s: frame_time(camera),
        wander: FIRST_WANDER,
    };
    let priors = flight.cameras.iter().map(prior).collect();
    let times = flight
        .cameras
        .iter()
        .zip(&states)
        .flat_map(|(camera, state)| camera.labels.iter().map(|label| state.time_s(label)));
    let (from, to) = times.fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), time_s| {
        (from.min(time_s), to.max(time_s))
    });
    let mut way = Spline::over(from - MARGIN_S, to + MARGIN_S);
    way.follow(&of_log.way);
    let mut states = states;
    states.iter_mut().for_each(|camera| camera.clock.wander = way.drift());
    let bias = [0, 1, 2].map(|_| way.drift());
    (State { way, cameras: states, bias }, Priors { jerk, rate_sd: RATE_SD, cameras: priors })
}

/// The time between a camera's frames: the median between its labels, s.
fn frame_time(camera: &CameraLabels) -> f64 {
    let mut steps: Vec<f64> =
        camera.labels.windows(2).map(|pair| pair[1].time_s - pair[0].time_s).collect();
    steps.sort_unstable_by(f64::total_cmp);
    steps[steps.len() / 2].max(1e-3)
}

/// The way that the log shows, and the power of its jerk.
fn log_alone(log: &FlightLog) -> Option<(State, f64)> {
    const ROUNDS: usize = 12;
    const FIRST_JERK: f64 = 10.0;
    let (from, to) = (log.samples.first()?.time_s, log.samples.last()?.time_s);
    let flight = Flight { cameras: &[], log };
    let way = Spline::over(from, to + KNOT_S);
    let bias = [0, 1, 2].map(|_| way.drift());
    let mut state = State { way, cameras: Vec::new(), bias };
    let mut priors = Priors { jerk: FIRST_JERK, rate_sd: RATE_SD, cameras: Vec::new() };
    for _ in 0..ROUNDS {
        let adjusted = adjustment::adjust(&flight, &priors, state, NEARLY_SETTLED)?;
        priors.jerk = jerk(&adjusted);
        state = adjusted.state;
    }
    Some((state, priors.jerk))
}

/// The power of the jerk that a way shows: what its third differences are, and what they may be
/// beside (expectation and maximisation).
fn jerk(adjusted: &Adjusted) -> f64 {
    let (way, order) = (&adjusted.state.way, adjusted.state.order());
    let mut sum = 0.0;
    for first in 0..way.intervals() {
        sum += way.third_difference(first).norm_squared();
        for axis in 0..3 {
            let terms = [0, 1, 2, 3].map(|k| (order.way(first + k, axis), THIRD_DIFFERENCE[k]));
            sum += adjusted.covariance.variance_held(&terms);
        }
    }
    (sum / (3.0 * way.intervals() as f64) / KNOT_S.powi(5)).max(1e-6)
}

/// Adjusts, finds the noise in what is left, and adjusts again.
fn settle(flight: &Flight<'_>, mut priors: Priors, mut state: State) -> Option<(Adjusted, Priors)> {
    let mut adjusted = None;
    for round in 0..ROUNDS {
        let is_last = round + 1 == ROUNDS;
        let settled = if is_last { SETTLED } else { NEARLY_SETTLED };
        let next = adjustment::adjust(flight, &priors, state, settled)?;
        state = next.state.clone();
        if !is_last {
            priors = learnt(flight, &next, &priors);
            tracing::debug!(
                "round {round}: cost {:.1}, jerk {:.2} m^2/s^5",
                next.cost,
                priors.jerk
            );
        }
        adjusted = Some(next);
    }
    Some((adjusted?, priors))
}

/// Noise, wander and jerk as an adjustment shows them.
fn learnt(flight: &Flight<'_>, adjusted: &Adjusted, priors: &Priors) -> Priors {
    let state = &adjusted.state;
    let mut cameras = Vec::new();
    for (index, camera) in state.cameras.iter().enumerate() {
        let residuals = residuals(flight, state, index);
        let explained = explained(flight, adjusted, index);
        let frame_s = priors.cameras[index].frame_s;
        let noise = LabelNoise::of(&residuals, explained, frame_s);
        let wander = wander(adjusted, index, priors.cameras[index].wander);
        tracing::debug!(
            "camera `{}`: noise {:.3} px and {:.3} px lasting {:.2} s ({:.3} px explained), wander {:.3} ms/sqrt(s), rate {:.2e}, read-out {:.1} ms, focal ratio {:.4}, centre {:.2}",
            flight.cameras[index].name,
            noise.white_px,
            noise.lasting_px,
            noise.lasting_s,
            explained.sqrt(),
            wander.sqrt() * 1e3,
            camera.clock.rate,
            camera.clock.readout_s * 1e3,
            camera.intrinsics.fx / priors.cameras[index].lens.fx,
            camera.centre
        );
        cameras.push(CameraPriors { noise, wander, ..priors.cameras[index].clone() });
    }
    Priors { jerk: jerk(adjusted), rate_sd: priors.rate_sd, cameras }
}

/// A camera's residuals with their own times.
fn residuals(flight: &Flight<'_>, state: &State, index: usize) -> Vec<(f64, Vector2<f64>)> {
    let labels = flight.cameras[index].labels.iter();
    labels.filter_map(|label| Some((label.time_s, state.see(index, label)?.2.residual))).collect()
}

/// What of a label's variance the way has taken, pixels^2 an axis, in the mean.
fn explained(flight: &Flight<'_>, adjusted: &Adjusted, index: usize) -> f64 {
    const STRIDE: usize = 10;
    let order = adjusted.state.order();
    let (mut sum, mut count) = (0.0, 0);
    for label in flight.cameras[index].labels.iter().step_by(STRIDE) {
        let Some((first, weights, seen)) = adjusted.state.see(index, label) else { continue };
        for axis in 0..2 {
            let term = |k: usize| {
                let by = seen.by_place[(axis, k % 3)] * weights[k / 3];
                (order.way(first + k / 3, k % 3), by)
            };
            let terms: [_; 3 * SPAN] = std::array::from_fn(term);
            sum += adjusted.covariance.variance_held(&terms);
            count += 1;
        }
    }
    if count == 0 { 0.0 } else { sum / f64::from(count) }
}

/// The power of a clock's random walk, s^2/s: of its steps' squares, by how many of them the labels
/// have told (MacKay's fixed point), and of what clocks are like beforehand.
fn wander(adjusted: &Adjusted, camera: usize, before: f64) -> f64 {
    let order = adjusted.state.order();
    let knots = &adjusted.state.cameras[camera].clock.wander;
    let (mut squares, mut told) = (0.0, 0.0);
    for (k, pair) in knots.values.windows(2).enumerate() {
        let step = [(order.wander(k, camera), -1.0), (order.wander(k + 1, camera), 1.0)];
        let spread = adjusted.covariance.variance(&step);
        squares += (pair[1] - pair[0]).powi(2) / knots.step_s;
        told += (1.0 - spread / (before * knots.step_s)).clamp(0.0, 1.0);
    }
    ((squares + USUAL_STEPS * USUAL_WANDER) / (told + USUAL_STEPS)).max(LEAST_WANDER)
}
