//! Why a flight, or a camera of it, cannot be calibrated.

use crossfix_message::CameraName;
use thiserror::Error;

use super::would_fit::WouldFit;

/// Why a flight cannot be adjusted.
#[derive(Debug, Error)]
pub enum FlightError {
    /// The log has too few samples.
    #[error("the log has {samples} samples: a flight needs at least {LEAST_SAMPLES}")]
    ShortLog {
        /// How many there are.
        samples: usize,
    },
    /// The log is longer than any flight: one of its times is wrong, or it has to be cut.
    #[error("the log lasts {hours:.1} h: cut it to the flight, at most {LONGEST_LOG_H} h")]
    LongLog {
        /// How long.
        hours: f64,
    },
    /// No camera can be calibrated; the reason for the first.
    #[error("no camera can be calibrated: camera `{camera}` {why}")]
    NoCamera {
        /// The camera.
        camera: CameraName,
        /// Why not.
        why: Refusal,
    },
    /// No two cameras saw the target together for long enough.
    #[error(
        "no two cameras saw the target together for long enough: without a log, two that see it \
         from different sides are begun with"
    )]
    NoPair,
    /// What was seen fits two relative poses of the cameras.
    #[error(
        "the cameras may stand to each other in two ways that fit alike, as the flight lies in a \
         plane: a third camera that saw it, a flight at several heights, or a log of it tells which"
    )]
    TwoWays,
    /// Nothing determines the site's size.
    #[error(
        "nothing says how large the site is: --log, --positions of two cameras that saw the \
         flight, --distance between two, or --landmarks: three of them in two cameras' pictures, \
         or four in each of two cameras'{}",
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
    /// It has too few labels.
    #[error("has {labels} labels: a calibration needs at least {LEAST_LABELS}")]
    FewLabels {
        /// How many there are.
        labels: usize,
    },
    /// Its labels last longer than any flight.
    #[error(
        "has labels over {hours:.1} h: take one flight, at most {LONGEST_FLIGHT_H} h (a time of \
         them may be wrong)"
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
    /// With no pose and offset do its labels fit the log.
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

/// Longest flight, h. The equations take memory in proportion to its time: an hour of six cameras
/// takes 0.2 GB, and minutes. With half of it a flight of more than half an hour has to be cut by
/// hand.
pub(super) const LONGEST_FLIGHT_H: f64 = 1.0;
/// Longest log, h. All of its times are tried for each camera's clock: six hours take seconds per
/// camera, and minutes for one that does not fit, as a correction that would make it fit is
/// searched. With half of it the log of a morning of flights has to be cut by hand first.
pub(super) const LONGEST_LOG_H: f64 = 6.0;
/// Least number of samples of a log. With half of it ten seconds of a receiver of one sample a
/// second, hardly a turn, may be fitted by wrong poses and clocks as well.
pub(super) const LEAST_SAMPLES: usize = 20;
/// Least number of labels of a camera. With half of it half a second of a video, nearly a straight
/// line in the image, would count as a flight.
pub(super) const LEAST_LABELS: usize = 30;
