//! Calibration of cameras' poses, clocks and lenses from the flight of one target, with its log or
//! with a survey.
//!
//! All unknowns are adjusted at once: each camera's pose, clock and lens, the target's trajectory
//! (a cubic spline with white jerk) and the log's drifting bias. The log is a measurement and not
//! the truth: a camera fitted to the log alone would take on its errors.

mod adjustment;
mod align;
mod begin;
mod clicked;
mod course;
mod datum;
mod error;
mod fitted;
mod gauge;
mod halves;
mod known;
mod known_site;
mod label_rows;
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
mod rows;
mod settle;
mod spline;
mod start;
mod state;
mod survey;
mod things;
mod triangulation;
mod unknowns;
mod way_rows;
mod would_fit;

use begin::BegunFlight;
use error::{LEAST_SAMPLES, LONGEST_LOG_H};
use model::hours;
use results::results;
use settle::settle;
use state::Flight;

use crate::survey::Survey;

pub use clicked::LandmarkMisfit;
pub use error::{FlightError, Refusal};
pub use fitted::{FittedLabel, FittedSample};
pub use model::{CameraLabels, FlightLog, Label, LogErrors, LogSample};
pub use moved::MovedAt;
pub use results::{CameraResult, ClockKnot, ClockResult, FlightResult, LogFit};
pub use would_fit::{Axis, WouldFit};

/// Adjusts a flight, with its log or with what a survey knows of the site.
///
/// # Errors
/// [`FlightError`] naming the camera, or which data are too few.
pub fn calibrate_flight(
    cameras: &[CameraLabels],
    log: Option<&FlightLog>,
    survey: &Survey,
) -> Result<FlightResult, FlightError> {
    let (begun, state) = match log {
        Some(log) => {
            checked(log)?;
            let begun = BegunFlight::by_log(cameras, log)?;
            let state = begun.unknowns(true);
            (begun, state)
        }
        None => BegunFlight::by_pairs(cameras, survey)?,
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
        known_site::keep_known_site(&mut result, survey);
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
