//! Poses, clocks and lenses of cameras from the flight of one target, with a log of it or a survey.
//!
//! All that is unknown is adjusted at once: each camera's pose, clock and lens, the target's way (a
//! cubic spline with white jerk) and the log's drifting bias. The log is a measurement and not the
//! truth: a camera that were held against it alone would take on its errors.

mod adjustment;
mod align;
mod begin;
mod clicked;
mod course;
mod datum;
mod fitted;
mod gauge;
mod halves;
mod known;
mod linear;
mod model;
mod moved;
mod noise;
mod normal;
mod pairs;
mod pieces;
mod plane;
mod pull;
mod results;
mod settle;
mod spline;
mod start;
mod survey;
mod things;
mod triangulation;
mod unknowns;
mod would_fit;

use crossfix_message::CameraName;
use thiserror::Error;

use adjustment::Flight;
use begin::Begun;
use results::results;
use settle::settle;

use crate::survey::Survey;

pub use clicked::LandmarkMisfit;
pub use fitted::{FittedLabel, FittedSample};
pub use model::{CameraLabels, FlightLog, Label, LogErrors, LogSample};
pub use moved::MovedAt;
pub use results::{CameraResult, ClockKnot, ClockResult, FlightResult, LogFit};
pub use would_fit::{Axis, WouldFit};

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
    /// No two cameras saw the target together for long enough.
    #[error(
        "no two cameras saw the target together for long enough: without a log, two that see it from \
         different sides are begun with"
    )]
    NoPair,
    /// What was seen fits two ways of standing.
    #[error(
        "the cameras may stand to each other in two ways that fit alike, as the flight lies in a plane: a \
         third camera that saw it, a flight at several heights, or a log of it tells which"
    )]
    TwoWays,
    /// Nothing says how large the site is.
    #[error(
        "nothing says how large the site is: --log, --positions of two cameras that saw the flight, \
         --distance between two, or --landmarks: three of them in two cameras' pictures, or four in each \
         of two cameras'{}",
        untold.iter().map(|why| format!("; {why}")).collect::<String>()
    )]
    NoSize {
        /// Why landmarks of cameras do not tell it.
        untold: Vec<String>,
    },
    /// The equations have no solution.
    #[error("the adjustment has no solution: labels, log and survey are hardly of one flight")]
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
    #[error(
        "has too few labels in the time that the target's way is known, whatever its clock shows"
    )]
    NoTime,
    /// No pose and offset makes its labels fit the log.
    #[error(
        "lies {misfit_mrad:.1} mrad beside the target's way wherever it stands: {}",
        would_fit.as_ref().map_or_else(
            || "it saw something else, or its lens or frame rate is another's".to_owned(),
            WouldFit::to_string
        )
    )]
    Misfit {
        /// The median angle between labels and log, mrad.
        misfit_mrad: f64,
        /// What makes it fit.
        would_fit: Option<WouldFit>,
    },
}

/// A flight's equations take memory by its time: an hour of six cameras 0.2 GB, and minutes.
const LONGEST_FLIGHT_H: f64 = 1.0;
/// All of a log's times are tried for each camera's clock: six hours take seconds a camera, and minutes
/// one that does not fit, as what would make it fit is looked for.
const LONGEST_LOG_H: f64 = 6.0;
/// A log with fewer samples is none.
const LEAST_SAMPLES: usize = 20;
/// A camera with fewer labels has seen nothing.
const LEAST_LABELS: usize = 30;

/// Adjusts a flight, with a log of it or with what a survey says.
///
/// # Errors
/// [`FlightError`] naming the camera, or what is too little.
pub fn calibrate_flight(
    cameras: &[CameraLabels],
    log: Option<&FlightLog>,
    survey: &Survey,
) -> Result<FlightResult, FlightError> {
    let (begun, state) = match log {
        Some(log) => {
            checked(log)?;
            let begun = Begun::by_log(cameras, log)?;
            let state = begun.unknowns(true);
            (begun, state)
        }
        None => Begun::by_pairs(cameras, survey)?,
    };
    let flight = Flight { cameras: &begun.cameras, log, survey };
    let settled = settle(&flight, begun.priors(), state);
    let (adjusted, priors) = settled.ok_or(FlightError::NoSolution)?;
    let mut result = results(&flight, adjusted, &priors).ok_or(FlightError::NoSolution)?;
    for (name, count) in begun.of_others {
        let found = result.cameras.iter_mut().find(|camera| camera.name == name);
        found.into_iter().for_each(|camera| camera.labels += count);
    }
    result.refused = begun.refused;
    if log.is_none() {
        known::hold_site(&mut result, survey);
    }
    Ok(result)
}

fn checked(log: &FlightLog) -> Result<(), FlightError> {
    if log.samples.len() < LEAST_SAMPLES {
        return Err(FlightError::ShortLog { samples: log.samples.len() });
    }
    let hours = hours(log.samples.iter().map(|sample| sample.time_s));
    if hours > LONGEST_LOG_H {
        return Err(FlightError::LongLog { hours });
    }
    Ok(())
}

/// How long times last that are in order.
fn hours(mut times_s: impl DoubleEndedIterator<Item = f64>) -> f64 {
    let (first, last) = (times_s.next(), times_s.next_back());
    first.zip(last).map_or(0.0, |(first, last)| (last - first) / 3600.0)
}
