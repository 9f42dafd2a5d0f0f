//! Initiation: new tracks from the bearings that no track has used. They are gathered into
//! observation periods ([`Periods`]), and what belongs together over several periods is
//! found either by following hypotheses ([`Hypotheses`]) or, as in Klochko 2020, by
//! solving each period for fixes and grouping these ([`Grouped`]).

mod first_lines;
mod handover;
mod hypotheses;
mod joint;
mod one_target;
mod own_sights;
mod passing;
mod period;
mod rooted_lines;
mod seeds;
mod selection;
mod sight;
mod speeds;

use std::collections::BTreeSet;

use crossfix_geometry::{BearingModel, SightLine};
use crossfix_message::{CameraName, Timestamp};
use nalgebra::Vector3;

use crate::cameras::{Cameras, KnownCamera};
use crate::cueing::CueTarget;
use crate::motion::MotionSetup;
use crate::papers::Grouped;
use crate::spatial::{LineId, TimedLine};
use crate::track::{FusedTrack, TrackId};
use crate::tracker::UsedSighting;
use crate::uncertainty::CameraUncertainty;
use crate::{Exposure, FusionConfig, InitiationMethod, Sighting, SpatialSolver};

pub(crate) use passing::{Passing, Passings};
pub(crate) use seeds::SeedFinder;

use handover::Handover;
use hypotheses::Hypotheses;
use period::Periods;

/// Most lines of one exposure that the initiation uses: time is bounded, whatever a camera reports.
/// With half of it no track begins with the later ones beyond that.
const MAX_LINES: usize = 500;

/// A sight line with its name.
pub(crate) type NamedLine = (LineId, TimedLine);

/// A new track.
#[derive(Clone, Debug)]
pub(crate) struct NewTrack {
    pub(crate) track: FusedTrack,
    /// Number of cameras that have lately seen it.
    pub(crate) cameras: usize,
    /// The tracks, supported by one camera only, whose bearings it has used.
    pub(crate) provisional_owners: BTreeSet<TrackId>,
}

/// Finds new targets among the bearings that no track has used.
#[derive(Debug)]
pub(crate) struct Initiator {
    periods: Periods,
    method: Method,
    handover: Handover,
}

#[derive(Debug)]
enum Method {
    Hypotheses(Hypotheses),
    Grouped(Grouped),
}

impl Initiator {
    pub(crate) fn new(config: &FusionConfig) -> Self {
        let initiation = &config.initiation;
        let pairs = initiation.method == InitiationMethod::Hypotheses
            || initiation.solver == SpatialSolver::Pair;
        let method = match initiation.method {
            InitiationMethod::Hypotheses => Method::Hypotheses(Hypotheses::new(config)),
            InitiationMethod::Grouping => Method::Grouped(Grouped::new(config)),
        };
        Self {
            periods: Periods::new(initiation.period_s, if pairs { 2 } else { 3 }),
            method,
            handover: Handover::new(config),
        }
    }

    /// Forgets what a camera has followed alone: it has been moved.
    pub(crate) fn forget(&mut self, camera: &CameraName) {
        self.handover.forget_camera(camera);
    }

    /// The confirmed targets that one camera alone sees and no track covers, with their
    /// predictions.
    pub(crate) fn known(&self, now: Timestamp) -> Vec<CueTarget> {
        match self.method {
            Method::Hypotheses(_) => self.handover.known(now),
            Method::Grouped(_) => Vec::new(),
        }
    }

    /// Handles a whole exposure, given which of its lines tracks have used, and returns the new
    /// tracks of targets that cameras see one after another.
    pub(crate) fn hand_over(
        &mut self,
        exposure: &Exposure,
        used: &[UsedSighting],
        known: &KnownCamera,
        motion: &MotionSetup,
    ) -> Vec<NewTrack> {
        match self.method {
            Method::Hypotheses(_) => {
                self.handover.see(&of_unknown_velocity(exposure.clone()), used, known, motion)
            }
            Method::Grouped(_) => Vec::new(),
        }
    }

    /// Adds an exposure's free bearings and returns the tracks that begin with them. `provisional`
    /// are those that a track has used which only one camera supports.
    pub(crate) fn add(
        &mut self,
        mut exposure: Exposure,
        provisional: &[UsedSighting],
        cameras: &Cameras,
        motion: &MotionSetup,
    ) -> Vec<NewTrack> {
        if let Method::Hypotheses(hypotheses) = &mut self.method {
            hypotheses.note_provisional(&exposure, provisional);
            exposure = of_unknown_velocity(exposure);
        }
        let Some(period) = self.periods.add(exposure, cameras.len()) else {
            return Vec::new();
        };
        let mut exposures: Vec<&Exposure> = period.values().collect();
        exposures.sort_by(|a, b| a.time.cmp(&b.time).then_with(|| a.camera.cmp(&b.camera)));
        match &mut self.method {
            Method::Hypotheses(hypotheses) => hypotheses.advance(&exposures, cameras, motion),
            Method::Grouped(grouped) => grouped.advance(&exposures, cameras, motion),
        }
    }
}

/// The exposure for targets whose velocity is hardly known. Its clock's error counts as noise of
/// each bearing: what it shifts is not known before the velocity is.
fn of_unknown_velocity(mut exposure: Exposure) -> Exposure {
    exposure.uncertainty.clock_is_noise = true;
    exposure
}

/// An exposure's sight lines with their names, without the pose's uncertainty.
pub(crate) fn lines_of(exposure: &Exposure) -> impl Iterator<Item = NamedLine> + '_ {
    exposure.sightings.iter().take(MAX_LINES).enumerate().map(|(index, Sighting { line, .. })| {
        let id = LineId::new(exposure, index);
        let time_sd_s = exposure.uncertainty.time_sd_s;
        (id, TimedLine { line: *line, time: exposure.time, time_sd_s, origin_sd_m: 0.0 })
    })
}

/// The same with the uncertainty of the camera's pose added to their noise: where single bearings
/// of several cameras must meet, the pose's error acts like any other noise.
pub(crate) fn lines_with_pose(exposure: &Exposure) -> impl Iterator<Item = NamedLine> + '_ {
    let pose = exposure.uncertainty.pose;
    let origin_sd_m = pose.map_or(0.0, |pose| {
        // Mean over the axes, in metres: only with a range does it become an angle.
        (pose.covariance().fixed_view::<3, 3>(3, 3).trace() / 3.0).max(0.0).sqrt()
    });
    lines_of(exposure).map(move |(id, timed)| {
        let line = widened_by_pose(timed.line, &exposure.uncertainty);
        (id, TimedLine { line, origin_sd_m, ..timed })
    })
}

/// A line with the uncertainty of the pose's rotation added to its noise.
fn widened_by_pose(mut line: SightLine, uncertainty: &CameraUncertainty) -> SightLine {
    // At infinite range only the rotation shifts the line; the position's part is
    // [`TimedLine::origin_sd_m`].
    let at_infinity =
        BearingModel { direction: line.direction, basis: line.basis, range: f64::INFINITY };
    line.covariance *= uncertainty.factor;
    line.covariance += uncertainty.shared(&at_infinity, Vector3::zeros());
    line
}
