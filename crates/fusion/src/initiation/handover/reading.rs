//! A reading: one way in which cameras may have seen one target, one after another.

use crossfix_filter::Gate;
use crossfix_message::CameraName;

use super::super::MAX_LINES;
use super::super::one_target::{Mobility, OneTargetTest};
use crate::cameras::{KnownCamera, view_sr};
use crate::motion::MotionSetup;
use crate::spatial::LineId;
use crate::track::{FusedTrack, TrackBearing, TrackExpectation};
use crate::uncertainty::CameraUncertainty;
use crate::{Exposure, FusionConfig, Tracking};

/// Two cameras that have both seen something for longer than this, s, without a track coming of it,
/// see different things. With half of it an overlap that is too short for a track already forbids
/// the handover.
pub(super) const TOGETHER_S: f64 = 1.0;

/// Parameters from the site's configuration.
#[derive(Debug)]
pub(super) struct Rules {
    pub(super) tracking: Tracking,
    pub(super) gate: Gate,
    /// Speed of targets, m/s, standard deviation per axis.
    pub(super) speed: f64,
    /// Sightings by two cameras up to this far apart count as simultaneous, s.
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

    /// Assumed density of other targets in a camera's view, 1/sr: one per view, as nothing else is
    /// known.
    pub(super) fn clutter_per_sr(&self, known: &KnownCamera) -> f64 {
        1.0 / view_sr(known)
    }
}

/// The newest exposure with what its lines are compared by.
#[derive(Clone, Copy)]
pub(super) struct ReadingContext<'a> {
    pub(super) exposure: &'a Exposure,
    pub(super) known: &'a KnownCamera,
    pub(super) motion: &'a MotionSetup,
    /// Whether a line belongs to a track, by index.
    pub(super) is_owned: &'a [bool],
}

impl ReadingContext<'_> {
    /// The uncertainty of the exposure's camera. The clock's error counts as noise: what it shifts
    /// is not known before the velocity is.
    pub(super) fn uncertainty(&self) -> CameraUncertainty {
        CameraUncertainty { clock_is_noise: true, ..self.exposure.uncertainty }
    }

    /// The bearing of a track that is predicted for the exposure's camera.
    pub(super) fn expectation(&self, track: &FusedTrack) -> Option<TrackExpectation> {
        let (camera, origin) = (&self.exposure.camera, self.known.camera.pose().position());
        track.expectation(self.exposure.time, camera, origin, &self.uncertainty(), self.motion)
    }
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
        let ReadingContext { exposure, known, .. } = *context;
        let line = &exposure.sightings[index].line;
        // Price of the velocity that the reading implies: v^2 / (2 sd^2), of a prior about zero.
        let unlikely = track.state().velocity().norm_squared() / (2.0 * rules.speed.powi(2));
        let expected = context.expectation(&track)?;
        let fit = expected.fit(line, rules.gate)?;
        // Against one other target in the view: the line is there, so it is not weighed by P_D.
        let ratio = fit.log_ratio(1.0, rules.clutter_per_sr(known)) - unlikely;
        let mut reading =
            Self { of, track: Box::new(track), one_target, newest: LineId::new(exposure, index) };
        reading.take(context, index, &expected, ratio, rules)?;
        Some(reading)
    }

    /// Updates the reading with the exposure's best line; returns whether the reading is still
    /// open: not if that line belongs to a track.
    pub(super) fn advance(&mut self, context: &ReadingContext<'_>, rules: &Rules) -> bool {
        let ReadingContext { exposure, known, is_owned, .. } = *context;
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
                log_density - rules.clutter_per_sr(known).ln(),
                rules,
            );
        }
        // Its best line belongs to a track: then so does the target, and the reading ends.
        best.is_none_or(|(_, index)| !is_owned[index])
    }

    /// Updates the reading with a line; `None` if the numbers fail.
    pub(super) fn take(
        &mut self,
        context: &ReadingContext<'_>,
        index: usize,
        expected: &TrackExpectation,
        first_ratio: f64,
        rules: &Rules,
    ) -> Option<()> {
        let ReadingContext { exposure, motion, .. } = *context;
        let Exposure { camera, time, sightings, .. } = exposure;
        let line = &sightings[index].line;
        let uncertainty = context.uncertainty();
        let bearing = TrackBearing { uncertainty: &uncertainty, ..exposure.bearing(line) };
        let density = motion.density(self.track.model_probabilities());
        self.track.measurement_update(bearing, motion)?;
        self.track.note_visibility(
            camera,
            *time,
            true,
            rules.tracking.detection_probability,
            motion,
        );
        // If two other cameras see something at the same time, their agreement tells nothing about
        // what the first camera saw before.
        let is_joint = self.track.residuals.iter().any(|(name, residual)| {
            *name != self.of.0 && name != camera && time.seconds_since(residual.time) < TOGETHER_S
        });
        let first_ratio = if is_joint { 0.0 } else { first_ratio };
        match expected {
            TrackExpectation::Near(prediction) => {
                let mobility = Mobility { density, speed: rules.speed };
                self.one_target.see(&bearing, prediction, mobility, first_ratio);
            }
            TrackExpectation::Along { .. } if self.one_target.knows(camera) => {}
            TrackExpectation::Along { .. } => {
                let range = (self.track.state().position() - line.origin).norm();
                self.one_target.see_first(&bearing, rules.speed / range, first_ratio);
            }
        }
        self.newest = LineId::new(exposure, index);
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
