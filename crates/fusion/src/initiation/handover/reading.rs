//! A reading: one way in which cameras may have seen one target, one after another.

use crossfix_message::CameraName;

use super::super::MAX_LINES;
use super::super::one_target::{Mobility, OneTargetTest};
use crate::cameras::{KnownCamera, view_sr};
use crate::comparison::{Comparison, ComparisonRules};
use crate::spatial::LineId;
use crate::track::{FusedTrack, TrackBearing, TrackExpectation};
use crate::{Exposure, FusionConfig, Tracking};

/// Two cameras that have both seen something for longer than this, s, without a track coming of it,
/// see different things. With half of it an overlap that is too short for a track already forbids
/// the handover.
pub(super) const TOGETHER_S: f64 = 1.0;

/// Parameters from the site's configuration.
#[derive(Debug)]
pub(super) struct Rules {
    pub(super) comparison: ComparisonRules,
    pub(super) tracking: Tracking,
    /// Speed of targets, m/s, standard deviation per axis.
    pub(super) speed: f64,
    /// Sightings by two cameras up to this far apart count as simultaneous, s.
    pub(super) pair_s: f64,
}

impl Rules {
    pub(super) fn new(config: &FusionConfig) -> Self {
        Self {
            comparison: ComparisonRules::new(config),
            tracking: config.tracking.clone(),
            speed: config.initiation.velocity_prior_sd_mps,
            pair_s: config.initiation.pair_s,
        }
    }

    /// Assumed density of other targets in a camera's view, 1/sr: one per view, as nothing else is
    /// known.
    pub(super) fn clutter_per_sr(&self, known: &KnownCamera) -> f64 {
        1.0 / view_sr(known)
    }
}

/// The newest exposure, and whether each of its lines belongs to a track, by index.
#[derive(Clone, Copy)]
pub(super) struct ReadingContext<'a> {
    pub(super) comparison: Comparison<'a>,
    pub(super) is_owned: &'a [bool],
}

/// What one camera has followed and other cameras may have seen since, taken for one target.
#[derive(Clone, Debug)]
pub(super) struct Reading {
    /// The camera that saw it first, and the number of the direction it followed.
    pub(super) of: (CameraName, u64),
    pub(super) track: Box<FusedTrack>,
    pub(super) one_target: OneTargetTest,
    pub(super) newest: LineId,
}

impl Reading {
    /// The reading that the target of a track is now seen in the exposure's line of this index.
    /// `of` is whose direction the track is of, and `one_target` what is known of that. `None` if
    /// the line does not fit.
    pub(super) fn begin(
        of: (CameraName, u64),
        track: FusedTrack,
        one_target: OneTargetTest,
        index: usize,
        context: &ReadingContext<'_>,
        rules: &Rules,
    ) -> Option<Self> {
        let Comparison { exposure, known, .. } = context.comparison;
        let line = &exposure.sightings[index].line;
        // Price of the velocity that the reading implies: v^2 / (2 sd^2), of a prior about zero.
        let unlikely = track.state().velocity().norm_squared() / (2.0 * rules.speed.powi(2));
        let expected = context.comparison.expectation(&track)?;
        let fit = expected.fit(line, rules.comparison.gate)?;
        // Against one other target in the view: the line is there, so it is not weighed by P_D.
        let ratio = fit.log_ratio(1.0, rules.clutter_per_sr(known)) - unlikely;
        let mut reading =
            Self { of, track: Box::new(track), one_target, newest: LineId::new(exposure, index) };
        reading.take(context, index, &expected, ratio, rules)?;
        Some(reading)
    }

    /// Updates the reading with the exposure's best line; returns whether the reading is still
    /// open: not if that line belongs to a track, or the numbers fail.
    pub(super) fn advance(&mut self, context: &ReadingContext<'_>, rules: &Rules) -> bool {
        let ReadingContext { comparison, is_owned } = *context;
        let Some(expected) = comparison.expectation(&self.track) else {
            return true;
        };
        let near = comparison.candidates(&self.track, &expected, |index| index < MAX_LINES);
        let Some(best) = near.max_by(|a, b| a.fit.log_density.total_cmp(&b.fit.log_density)) else {
            return true;
        };
        // Its best line belongs to a track: then so does the target, and the reading ends.
        if is_owned[best.index] {
            return false;
        }
        let ratio = best.fit.log_ratio(1.0, rules.clutter_per_sr(comparison.known));
        self.take(context, best.index, &expected, ratio, rules).is_some()
    }

    /// Updates the reading with a line; `None` if the numbers fail.
    pub(super) fn take(
        &mut self,
        context: &ReadingContext<'_>,
        index: usize,
        expected: &TrackExpectation,
        ratio: f64,
        rules: &Rules,
    ) -> Option<()> {
        let comparison = context.comparison;
        let bearing @ TrackBearing { camera, time, line, .. } = comparison.bearing(index);
        // If two other cameras see something at the same time, their agreement tells nothing about
        // what the first camera saw before.
        let is_joint = self.track.residuals.iter().any(|(name, residual)| {
            *name != self.of.0 && name != camera && time.seconds_since(residual.time) < TOGETHER_S
        });
        let is_first = !self.one_target.knows(camera);
        let ratio = if is_first && is_joint { 0.0 } else { ratio };
        match expected {
            TrackExpectation::Near(_) => {
                let density = comparison.motion.density(self.track.model_probabilities());
                let mobility = Mobility { density, speed: rules.speed };
                self.one_target.see(&bearing, &self.track, mobility, ratio);
            }
            TrackExpectation::Along { .. } => self.one_target.pass_over(),
        }
        comparison.take(&mut self.track, index)?;
        if is_first && matches!(expected, TrackExpectation::Along { .. }) {
            let range = (self.track.state().position() - line.origin).norm();
            self.one_target.see_first(&bearing, rules.speed / range, ratio);
        }
        self.newest = LineId::new(comparison.exposure, index);
        Some(())
    }

    /// Whether its newest line is of this exposure.
    pub(super) fn is_of(&self, exposure: &Exposure) -> bool {
        self.newest.is_of(exposure)
    }

    /// Log-likelihood ratio of one target against one target per camera.
    pub(super) fn ratio(&self) -> f64 {
        self.one_target.log_ratio().unwrap_or(f64::NEG_INFINITY)
    }
}
