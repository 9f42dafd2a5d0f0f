//! Klochko's temporal processing on the fixes of each period.

use std::collections::BTreeSet;

use super::fixes::{FixFinder, SPEED_SIGMAS};
use super::grouping::{Group, Grouping, GroupingRules, TemporalGate};
use crate::cameras::Cameras;
use crate::initiation::{NamedLine, NewTrack};
use crate::motion::MotionSetup;
use crate::spatial::{Fix, LineId, VAGUE_VELOCITY_SD, VelocityKnowledge, chi_square};
use crate::track::{FusedTrack, StartLine, TrackBearing};
use crate::uncertainty::CameraUncertainty;
use crate::{Exposure, FusionConfig};

/// Solves periods for fixes and groups the fixes.
#[derive(Debug)]
pub(crate) struct Grouped {
    finder: FixFinder,
    grouping: Grouping,
}

impl Grouped {
    pub(crate) fn new(config: &FusionConfig) -> Self {
        let initiation = &config.initiation;
        let gate = match initiation.temporal_gate_m {
            Some(beta) => TemporalGate::Distance(beta),
            None => TemporalGate::Covariance {
                threshold: chi_square(initiation.spatial_gate_probability, 3),
                density: config.tracking.acceleration_density,
            },
        };
        let rules = GroupingRules {
            periods: initiation.periods,
            fixes: initiation.fixes,
            gate,
            max_speed: SPEED_SIGMAS * initiation.velocity_prior_sd_mps,
            shared_lines: initiation.shared_lines,
        };
        Self { finder: FixFinder::new(config), grouping: Grouping::new(rules) }
    }

    /// Takes one period in and returns a tentative track for every group that is good enough.
    pub(crate) fn advance(
        &mut self,
        exposures: &[&Exposure],
        cameras: &Cameras,
        motion: &MotionSetup,
    ) -> Vec<NewTrack> {
        let groups = self.grouping.advance(&self.finder.fixes(exposures, cameras));
        let tracks = groups.iter().filter_map(|group| start(group, motion));
        tracks
            .map(|track| NewTrack {
                cameras: track.residuals.len(),
                track,
                provisional_owners: BTreeSet::new(),
            })
            .collect()
    }
}

/// A tentative track: started from a group's first fix, updated with the lines of the later ones.
fn start(group: &Group, motion: &MotionSetup) -> Option<FusedTrack> {
    let (fix, later) = starting_point(group)?;
    let vague = Fix { state: vague_velocity(fix), ..fix.clone() };
    let uncertainty = CameraUncertainty::of_time(0.0);
    let first = group.fixes.first()?;
    let named = first.lines.iter();
    let named = named.map(|(LineId { camera, .. }, line)| StartLine { camera, line, uncertainty });
    let mut track = FusedTrack::start(&vague, named, motion);
    for (LineId { camera, .. }, timed) in later {
        let (time, line) = (timed.time, &timed.line);
        let bearing = TrackBearing { camera, time, line, uncertainty: &uncertainty };
        track.measurement_update(bearing, motion)?;
    }
    track.solver = fix.solver;
    Some(track)
}

/// The fix that a new track starts from, and the lines of the group's later fixes to take in.
fn starting_point(group: &Group) -> Option<(&Fix, Vec<&NamedLine>)> {
    let (first, later) = group.fixes.split_first()?;
    let mut lines: Vec<&NamedLine> = later.iter().flat_map(|fix| &fix.lines).collect();
    lines.sort_by(|a, b| a.1.time.cmp(&b.1.time).then_with(|| a.0.cmp(&b.0)));
    Some((&first.fix, lines))
}

/// The state of a fix; for one without a velocity the velocity prior is replaced by a vague one, so
/// that the covariance says so.
fn vague_velocity(fix: &Fix) -> crossfix_filter::KinematicState {
    let mut state = fix.state.clone();
    if fix.velocity == VelocityKnowledge::Unknown {
        state.covariance.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
        state.covariance.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
        let mut velocity = state.covariance.fixed_view_mut::<3, 3>(3, 3);
        velocity.fill_with_identity();
        velocity.scale_mut(VAGUE_VELOCITY_SD.powi(2) / 9.0);
    }
    state
}
