//! One way in which cameras may have seen one target, one after another.

use crossfix_filter::Gate;
use crossfix_message::CameraName;

use super::super::MAX_LINES;
use super::super::one_target::OneTargetTest;
use crate::cameras::{KnownCamera, view_sr};
use crate::motion::Motion;
use crate::spatial::LineId;
use crate::track::{Expectation, Track};
use crate::uncertainty::CameraUncertainty;
use crate::{Exposure, FusionConfig, Tracking};

/// Two cameras that have seen something together for longer than this, s, and have not made a
/// target of it, see different things.
pub(super) const TOGETHER_S: f64 = 1.0;

/// What is taken for what: parameters of the site's configuration.
#[derive(Debug)]
pub(super) struct Rules {
    pub(super) tracking: Tracking,
    pub(super) gate: Gate,
    /// How fast targets are, m/s, standard deviation per axis.
    pub(super) speed: f64,
    /// How long two cameras may have been apart when both saw it, s.
    pub(super) pair_s: f64,
    pub(super) max_range_m: f64,
}

impl Rules {
    pub(super) fn new(config: &FusionConfig) -> Self {
        Self {
            gate: Gate::with_probability(config.tracking.gate_probability),
            tracking: config.tracking.clone(),
            speed: config.initiation.velocity_prior_sd_mps,
            pair_s: config.initiation.pair_s,
            max_range_m: config.initiation.max_range_m,
        }
    }

    /// How many other targets a camera sees, 1/sr: one, as nothing else is known.
    pub(super) fn strangers_per_sr(&self, known: &KnownCamera) -> f64 {
        1.0 / view_sr(known)
    }
}

/// The newest exposure, and what else its lines are compared by.
#[derive(Clone, Copy)]
pub(super) struct Context<'a> {
    pub(super) exposure: &'a Exposure,
    pub(super) known: &'a KnownCamera,
    pub(super) motion: &'a Motion,
    /// Whether a track knows the line, by index.
    pub(super) is_owned: &'a [bool],
}

impl Context<'_> {
    /// What is uncertain of the exposure's camera: what a clock shifts is not known before the
    /// velocity is.
    pub(super) fn uncertainty(&self) -> CameraUncertainty {
        CameraUncertainty { clock_is_noise: true, ..self.exposure.uncertainty }
    }

    /// What the camera should see of a track.
    pub(super) fn expectation(&self, track: &Track) -> Option<Expectation> {
        let seen_from = (&self.exposure.camera, self.known.camera.pose().position());
        track.expectation(self.exposure.time, seen_from, &self.uncertainty(), self.motion)
    }
}

/// What one camera has followed and others may have seen since, as one target.
#[derive(Clone, Debug)]
pub(super) struct Reading {
    /// The camera that saw it first, and the number of what it saw.
    pub(super) of: (CameraName, u64),
    pub(super) track: Box<Track>,
    pub(super) one_target: OneTargetTest,
    pub(super) newest: LineId,
}

impl Reading {
    /// Takes the exposure's best line in; returns whether it is still open what this is: not if a
    /// track has the line.
    pub(super) fn advance(&mut self, context: &Context<'_>, rules: &Rules) -> bool {
        let Context { exposure, known, is_owned, .. } = *context;
        let Some(expected) = context.expectation(&self.track) else {
            return true;
        };
        let lines = exposure.sightings.iter().enumerate().take(MAX_LINES);
        let fits = lines.filter_map(|(i, sighting)| {
            Some((expected.fit(&sighting.line, rules.gate)?.log_density, i))
        });
        let best = fits.max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((log_density, index)) = best.filter(|(_, index)| !is_owned[*index]) {
            self.take(
                context,
                index,
                &expected,
                log_density - rules.strangers_per_sr(known).ln(),
                rules,
            );
        }
        best.is_none_or(|(_, index)| !is_owned[index])
    }

    /// Takes a line in; `None` if the numbers fail.
    pub(super) fn take(
        &mut self,
        context: &Context<'_>,
        index: usize,
        expected: &Expectation,
        first_ratio: f64,
        rules: &Rules,
    ) -> Option<()> {
        let Context { exposure, motion, .. } = *context;
        let Exposure { camera, time, uncertainty, sightings, .. } = exposure;
        let line = &sightings[index].line;
        let density = motion.density(self.track.model_probabilities());
        self.track.measurement_update(camera, line, (*time, &context.uncertainty()), motion)?;
        self.track.look(camera, *time, true, rules.tracking.detection_probability, motion);
        let timed = (line, *time, uncertainty.time_sd_s);
        // That two cameras which see something at once agree says nothing of what the first one has
        // seen before.
        let is_joint = self.track.residuals.iter().any(|(name, residual)| {
            *name != self.of.0 && name != camera && time.seconds_since(residual.time) < TOGETHER_S
        });
        let first_ratio = if is_joint { 0.0 } else { first_ratio };
        match expected {
            Expectation::Near(prediction) => {
                self.one_target.see(camera, timed, prediction, (density, rules.speed), first_ratio);
            }
            Expectation::Along { .. } if self.one_target.knows(camera) => {}
            Expectation::Along { .. } => {
                let range = (self.track.state().position() - line.origin).norm();
                self.one_target.see_first(camera, (line, *time), rules.speed / range, first_ratio);
            }
        }
        self.newest = (camera.clone(), exposure.sequence, index);
        Some(())
    }

    pub(super) fn ratio(&self) -> f64 {
        self.one_target.log_ratio().unwrap_or(f64::NEG_INFINITY)
    }
}
