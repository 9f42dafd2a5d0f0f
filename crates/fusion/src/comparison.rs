//! Comparison of an exposure's bearings with tracks: the tracker's, those of the hypotheses and
//! readings that may become tracks, and the leaves of a track that one camera alone follows.

use crossfix_filter::Gate;

use crate::cameras::KnownCamera;
use crate::motion::MotionSetup;
use crate::prediction::BearingFit;
use crate::track::{FusedTrack, Taken, TrackBearing, TrackExpectation};
use crate::visibility::log_missed;
use crate::{Exposure, FusionConfig};

/// What all comparisons go by, from the site's configuration.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ComparisonRules {
    pub(crate) gate: Gate,
    /// Probability that a camera reports a target that is visible to it.
    pub(crate) detection: f64,
    pub(crate) max_range_m: f64,
}

impl ComparisonRules {
    pub(crate) fn new(config: &FusionConfig) -> Self {
        Self {
            gate: Gate::with_probability(config.tracking.gate_probability),
            detection: config.tracking.detection_probability,
            max_range_m: config.initiation.max_range_m,
        }
    }
}

/// A bearing in the gate of a track.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Candidate {
    /// Its index in the exposure.
    pub(crate) index: usize,
    pub(crate) fit: BearingFit,
    /// Log-likelihood ratio of it being the track's, against it being clutter.
    pub(crate) ratio: f64,
}

/// An exposure with what its bearings are compared by.
#[derive(Clone, Copy)]
pub(crate) struct Comparison<'a> {
    pub(crate) exposure: &'a Exposure,
    pub(crate) known: &'a KnownCamera,
    pub(crate) motion: &'a MotionSetup,
    pub(crate) rules: ComparisonRules,
}

impl<'a> Comparison<'a> {
    /// The bearing of a track that is predicted for the exposure's camera.
    pub(crate) fn expectation(&self, track: &FusedTrack) -> Option<TrackExpectation> {
        let Exposure { camera, time, uncertainty, .. } = self.exposure;
        let origin = self.known.camera.pose().position();
        track.expectation(*time, camera, origin, uncertainty, self.motion)
    }

    /// Whether the camera should see the track's target.
    pub(crate) fn expects(&self, track: &FusedTrack) -> bool {
        self.known.expects(track.position_at(self.exposure.time), self.rules.max_range_m)
    }

    /// Probability that the camera reports the track's target, if that is in its view.
    pub(crate) fn detection_of(&self, track: &FusedTrack) -> f64 {
        let Exposure { camera, time, .. } = self.exposure;
        // P(detected) = P(visible) P_D.
        track.visible_to(camera, *time) * self.rules.detection
    }

    /// Log-likelihood ratio of no report, for a track whose target is in the camera's view.
    pub(crate) fn log_missed(&self, track: &FusedTrack) -> f64 {
        log_missed(self.detection_of(track))
    }

    /// The bearings in a track's gate, among those (by index) that are open to it.
    pub(crate) fn candidates(
        &self,
        track: &FusedTrack,
        expected: &TrackExpectation,
        is_open: impl Fn(usize) -> bool,
    ) -> impl Iterator<Item = Candidate> {
        let detection = self.detection_of(track);
        let open = self.exposure.sightings.iter().enumerate();
        open.filter(move |(index, _)| is_open(*index)).filter_map(move |(index, sighting)| {
            let fit = expected.fit(&sighting.line, self.rules.gate)?;
            let ratio = fit.log_ratio(detection, self.exposure.clutter_per_sr);
            Some(Candidate { index, fit, ratio })
        })
    }

    /// The same in order, the likeliest first.
    pub(crate) fn ranked(
        &self,
        track: &FusedTrack,
        expected: &TrackExpectation,
        is_open: impl Fn(usize) -> bool,
    ) -> Vec<Candidate> {
        let mut ranked: Vec<Candidate> = self.candidates(track, expected, is_open).collect();
        ranked.sort_by(|a, b| b.ratio.total_cmp(&a.ratio).then(a.index.cmp(&b.index)));
        ranked
    }

    /// A bearing of the exposure by its index, as tracks take it in.
    pub(crate) fn bearing(&self, index: usize) -> TrackBearing<'a> {
        self.exposure.bearing(&self.exposure.sightings[index].line)
    }

    /// Updates a track with a bearing (by index); `None` if the numbers fail.
    pub(crate) fn take(&self, track: &mut FusedTrack, index: usize) -> Option<Taken> {
        let taken = track.measurement_update(self.bearing(index), self.motion)?;
        self.note(track, true);
        Some(taken)
    }

    /// Notes whether the camera, which should see the track's target, has reported it.
    pub(crate) fn note(&self, track: &mut FusedTrack, seen: bool) {
        let Exposure { camera, time, .. } = self.exposure;
        track.note_visibility(camera, *time, seen, self.rules.detection);
    }

    /// Notes that the camera has not reported the track's target: it has missed it in its view, and
    /// sees nothing outside of that. A camera that turns has no view.
    pub(crate) fn note_unseen(&self, track: &mut FusedTrack) {
        if self.known.is_turning {
            return;
        }
        if self.expects(track) {
            self.note(track, false);
            return;
        }
        let Exposure { camera, time, .. } = self.exposure;
        let expects = |place| self.known.expects(place, self.rules.max_range_m);
        if !track.places_along(*time, self.motion).any(expects) {
            track.note_out_of_view(camera, *time);
        }
    }
}
