//! Re-acquisition: a second camera sees the target of a track that one camera alone follows. Any of
//! its bearings that crosses the sight line may be the target's, so each is followed as a
//! hypothesis of its own (a leaf) until one is sure. All others, of other objects or of nothing,
//! are clutter.

use std::collections::BTreeMap;

use crossfix_filter::Gate;

use crate::cameras::KnownCamera;
use crate::evidence::BEYOND_DOUBT;
use crate::motion::MotionSetup;
use crate::track::{FusedTrack, TrackId};
use crate::visibility::log_missed;
use crate::{Exposure, Tracking};

/// A leaf whose log-likelihood ratio falls to this is given up. With half of it one miss ends a
/// leaf of even odds; as it is, two do.
const GIVEN_UP: f64 = -3.0;
/// Most leaves of one track at a time, the best ones: memory is bounded however much clutter
/// there is. With half of it, where more of them cross the sight line, the target's own leaf may
/// be dropped before it is sure.
const MAX_LEAVES: usize = 4;

/// A copy of the track that has used bearings of a second camera, with the log-likelihood ratio of
/// these being the target's against being clutter.
#[derive(Clone, Debug)]
struct Leaf {
    track: FusedTrack,
    log_ratio: f64,
}

/// The leaves of all tracks that one camera alone follows.
#[derive(Clone, Debug, Default)]
pub(crate) struct Reacquisition {
    leaves: BTreeMap<TrackId, Vec<Leaf>>,
}

/// An exposure with what it is compared by.
pub(crate) struct ReacquisitionContext<'a> {
    pub(crate) exposure: &'a Exposure,
    pub(crate) known: &'a KnownCamera,
    pub(crate) motion: &'a MotionSetup,
    pub(crate) config: &'a Tracking,
    pub(crate) gate: Gate,
    pub(crate) max_range_m: f64,
    /// The track that each sighting belongs to, if any.
    pub(crate) owners: &'a [Option<TrackId>],
}

impl ReacquisitionContext<'_> {
    /// The sightings (by index) in a track's gate, with their log-likelihood ratios against
    /// clutter, the best first.
    fn fits(&self, track: &FusedTrack, owner: TrackId) -> Vec<(f64, usize)> {
        let Self { exposure, known, motion, config, .. } = self;
        let (camera, origin) = (&exposure.camera, known.camera.pose().position());
        let Some(expected) =
            track.expectation(exposure.time, camera, origin, &exposure.uncertainty, motion)
        else {
            return Vec::new();
        };
        // P(detected) = P(visible) P_D.
        let detection = track.visible_to(&exposure.camera, exposure.time, motion)
            * config.detection_probability;
        let open = exposure.sightings.iter().enumerate();
        let open = open.filter(|(i, _)| self.owners[*i].is_none_or(|id| id == owner));
        let fits = open.filter_map(|(i, sighting)| {
            let fit = expected.fit(&sighting.line, self.gate)?;
            Some((fit.log_ratio(detection, exposure.clutter_per_sr), i))
        });
        let mut fits: Vec<(f64, usize)> = fits.collect();
        fits.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        fits
    }

    /// Whether the camera should see the track's target.
    fn expects(&self, track: &FusedTrack) -> bool {
        self.known.expects(track.position_at(self.exposure.time), self.max_range_m)
    }

    /// A copy of a track, updated with a sighting; `None` if the numbers fail.
    fn taken(&self, track: &FusedTrack, index: usize) -> Option<FusedTrack> {
        let Exposure { camera, time, sightings, .. } = self.exposure;
        let mut track = track.clone();
        track.measurement_update(self.exposure.bearing(&sightings[index].line), self.motion)?;
        track.note_visibility(camera, *time, true, self.config.detection_probability, self.motion);
        Some(track)
    }

    /// A leaf after the exposure, with the sighting (by index) that it has used; `None` if it is
    /// given up.
    fn advanced(&self, mut leaf: Leaf, owner: TrackId) -> Option<(Leaf, Option<usize>)> {
        let Exposure { camera, time, .. } = self.exposure;
        let best = self.fits(&leaf.track, owner).first().copied();
        if let Some((ratio, index)) = best
            && let Some(track) = self.taken(&leaf.track, index)
        {
            // A sighting that the track itself has used is evidence neither for nor against its
            // leaves.
            let gained = if self.owners[index].is_some() { 0.0 } else { ratio };
            return Some((Leaf { track, log_ratio: leaf.log_ratio + gained }, Some(index)));
        }
        if self.expects(&leaf.track) {
            let detection = self.config.detection_probability;
            let visible = leaf.track.visible_to(camera, *time, self.motion);
            leaf.log_ratio += log_missed(visible, detection);
            leaf.track.note_visibility(camera, *time, false, detection, self.motion);
        }
        (leaf.log_ratio > GIVEN_UP).then_some((leaf, None))
    }

    /// New leaves, one for each of the exposure's best free sightings.
    fn begun(&self, track: &FusedTrack) -> Vec<(Leaf, Option<usize>)> {
        if !track.is_lost_sight_of_by(&self.exposure.camera, self.motion) {
            return Vec::new();
        }
        let fits =
            self.fits(track, track.id).into_iter().filter(|(_, i)| self.owners[*i].is_none());
        fits.take(MAX_LEAVES)
            .filter_map(|(log_ratio, i)| {
                Some((Leaf { track: self.taken(track, i)?, log_ratio }, Some(i)))
            })
            .collect()
    }
}

impl Reacquisition {
    /// Continues the leaves of all tracks that one camera alone follows; returns the tracks that
    /// are found again, with the sighting (by index) that has settled it.
    pub(crate) fn advance(
        &mut self,
        tracks: &BTreeMap<TrackId, FusedTrack>,
        context: &ReacquisitionContext<'_>,
    ) -> Vec<(FusedTrack, Option<usize>)> {
        self.leaves.retain(|id, _| tracks.get(id).is_some_and(|track| !track.is_triangulated()));
        let mut found = Vec::new();
        let alone =
            tracks.values().filter(|track| track.is_confirmed() && !track.is_triangulated());
        for track in alone {
            let before = self.leaves.remove(&track.id).unwrap_or_default();
            let mut next: Vec<_> =
                before.into_iter().filter_map(|leaf| context.advanced(leaf, track.id)).collect();
            next.extend(context.begun(track));
            // Old leaves and new ones compete for the same few places.
            next.sort_by(|a, b| b.0.log_ratio.total_cmp(&a.0.log_ratio));
            next.truncate(MAX_LEAVES);
            match next.first() {
                Some((best, index)) if best.log_ratio >= BEYOND_DOUBT => {
                    found.push((best.track.clone(), *index));
                }
                Some(_) => {
                    self.leaves.insert(track.id, next.into_iter().map(|(leaf, _)| leaf).collect());
                }
                None => {}
            }
        }
        found
    }
}
