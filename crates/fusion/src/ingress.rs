//! Reads bearing frames from the wire into exposures; every exposure that comes out is physically
//! possible.

use std::fmt;

use crossfix_geometry::{Bearing, Camera, GeometryError, SightLine};
use crossfix_message::{BearingFrame, BearingTrack, CameraName, ImageTrackState, Timestamp};
use nalgebra::Matrix2;

use crate::cameras::{KnownCamera, ReportedPointing, Rooted};
use crate::track::TrackBearing;
use crate::uncertainty::CameraUncertainty;
use crate::{Bearings, Counters, Weighting};

/// Most bearings that are read of one frame: no image has more, and memory is bounded. With half of
/// it the same.
const MAX_BEARINGS: usize = 10_000;

/// One measured target in one exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct Sighting {
    /// The 2D track that measured it.
    pub image_track: u64,
    /// Its sight line.
    pub line: SightLine,
    /// Whether it is of something fixed in the camera's view (a tree, the horizon, a light).
    pub(crate) rooted: Rooted,
}

/// All that one camera measured at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Exposure {
    /// The camera.
    pub camera: CameraName,
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Capture time.
    pub time: Timestamp,
    /// The uncertainty that all its bearings share.
    pub(crate) uncertainty: CameraUncertainty,
    /// Where its mount pointed, if it has one.
    pub(crate) pointed: Option<ReportedPointing>,
    /// Density of the camera's false bearings (clutter), 1/sr.
    pub(crate) clutter_per_sr: f64,
    /// The clock's offset that has been subtracted from the reported time, s.
    pub(crate) correction_s: f64,
    /// The targets, in the frame's order.
    pub sightings: Vec<Sighting>,
}

impl Exposure {
    /// A line of its camera at its time, as tracks take it in.
    pub(crate) fn bearing<'a>(&'a self, line: &'a SightLine) -> TrackBearing<'a> {
        TrackBearing { camera: &self.camera, time: self.time, line, uncertainty: &self.uncertainty }
    }

    /// The rejection of this exposure for a reason.
    pub(crate) fn refused(&self, reason: RejectionReason) -> Rejection {
        Rejection { camera: self.camera.to_string(), sequence: self.sequence, reason }
    }
}

/// Why a frame or a part of it was not used.
#[derive(Clone, Debug, PartialEq)]
pub enum RejectionReason {
    /// The camera has no calibration.
    UnknownCamera,
    /// Its capture time lies before exposures that have been handled already.
    Late {
        /// By how much, s.
        by_s: f64,
    },
    /// Its capture time lies too far ahead of the other cameras.
    Future {
        /// By how much, s.
        by_s: f64,
    },
    /// A frame of this camera with this capture time has been handled before.
    Duplicate,
    /// The frame's time or its standard deviation is impossible.
    Time,
    /// The camera is on a mount, and the frame does not say where the mount pointed, or the angles
    /// are impossible.
    Pointing,
    /// One bearing is impossible; the others of the frame are used.
    Bearing(GeometryError),
    /// The frame has more bearings than an image can have; the first ones are used.
    Crowded {
        /// How many are left out.
        left_out: usize,
    },
}

impl RejectionReason {
    /// The name of its counter.
    pub fn counter(&self) -> &'static str {
        match self {
            Self::UnknownCamera => "rejected_unknown_camera",
            Self::Late { .. } => "rejected_late",
            Self::Future { .. } => "rejected_future",
            Self::Duplicate => "rejected_duplicate",
            Self::Time => "rejected_time",
            Self::Pointing => "rejected_pointing",
            Self::Bearing(_) => "rejected_bearing",
            Self::Crowded { .. } => "frames_crowded",
        }
    }
}

/// A frame, or a part of one, that was not used, with its source.
#[derive(Clone, Debug, PartialEq)]
pub struct Rejection {
    /// The camera as the frame names it.
    pub camera: String,
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Why.
    pub reason: RejectionReason,
}

impl fmt::Display for Rejection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { camera, sequence, reason } = self;
        write!(f, "frame {sequence} of camera `{camera}`: ")?;
        match reason {
            RejectionReason::UnknownCamera => f.write_str("no calibration is known for it"),
            RejectionReason::Late { by_s } => {
                write!(f, "{by_s:.3} s too late (see event_time.lateness_s)")
            }
            RejectionReason::Future { by_s } => {
                write!(f, "{by_s:.3} s ahead of the other cameras: check its clock")
            }
            RejectionReason::Duplicate => f.write_str("its capture time came before"),
            RejectionReason::Time => f.write_str("its capture time or its SD is impossible"),
            RejectionReason::Pointing => {
                f.write_str("its camera is on a mount, and where that pointed is not said")
            }
            RejectionReason::Crowded { left_out } => {
                write!(
                    f,
                    "{left_out} bearings are not used: more than {MAX_BEARINGS} are no picture"
                )
            }
            RejectionReason::Bearing(error) => write!(f, "a bearing is impossible: {error}"),
        }
    }
}

fn sighting(
    track: &BearingTrack,
    camera: &Camera,
    config: &Bearings,
) -> Result<Sighting, GeometryError> {
    let vector = track.bearing.ok_or(GeometryError::NotUnit { length: 0.0 })?;
    let covariance = match config.weighting {
        Weighting::Equal => Matrix2::identity() * config.equal_sd_rad.powi(2),
        Weighting::Reported => {
            let [xx, xy, yy] = [track.covariance_xx, track.covariance_xy, track.covariance_yy];
            Matrix2::new(xx, xy, xy, yy) + Matrix2::identity() * config.systematic_sd_rad.powi(2)
        }
    };
    let bearing = Bearing::new(vector.into(), covariance)?;
    Ok(Sighting {
        image_track: track.track_id,
        line: camera.sight_line(&bearing),
        rooted: Rooted::Unknown,
    })
}

/// The direction in which the mount of a frame's camera pointed; `None` without a mount.
fn pointed(
    frame: &BearingFrame,
    known: &KnownCamera,
) -> Result<Option<ReportedPointing>, RejectionReason> {
    if known.mount.is_none() {
        return Ok(None);
    }
    let said = frame.pointing.as_ref().and_then(ReportedPointing::read);
    said.map(Some).ok_or(RejectionReason::Pointing)
}

/// Reads a frame: returns its measurements, and the reasons for which parts of it were left out.
pub(crate) fn read(
    frame: &BearingFrame,
    name: &CameraName,
    calibrated: &KnownCamera,
    config: &Bearings,
    counters: &mut Counters,
) -> Result<(Exposure, Vec<RejectionReason>), RejectionReason> {
    let sd = frame.capture_time_sd_s;
    if !(sd.is_finite() && (0.0..10.0).contains(&sd)) {
        return Err(RejectionReason::Time);
    }
    let pointed = pointed(frame, calibrated)?;
    let turned = pointed.as_ref().map(|pointed| calibrated.pointed(pointed));
    let known = turned.as_ref().unwrap_or(calibrated);
    let mut rejected = Vec::new();
    let mut sightings = Vec::new();
    let (mut measured, mut left_out) = (0, 0);
    for track in &frame.tracks {
        if track.state() != ImageTrackState::Tracking {
            counters.count("bearings_predicted_only");
            continue;
        }
        if known.is_turning {
            counters.count("bearings_while_turning");
            continue;
        }
        measured += 1;
        if measured > MAX_BEARINGS {
            left_out += 1;
            continue;
        }
        match sighting(track, &known.camera, config) {
            Ok(sighting) => sightings.push(sighting),
            Err(error) => rejected.push(RejectionReason::Bearing(error)),
        }
    }
    if left_out > 0 {
        rejected.push(RejectionReason::Crowded { left_out });
    }
    let exposure = Exposure {
        camera: name.clone(),
        sequence: frame.sequence,
        time: Timestamp::from_nanos(frame.capture_time_ns),
        uncertainty: CameraUncertainty {
            time_sd_s: sd,
            clock_source: frame.clock_source(),
            ..known.uncertainty()
        },
        pointed,
        clutter_per_sr: 1.0,
        correction_s: 0.0,
        sightings,
    };
    Ok((exposure, rejected))
}
