//! Re-acquisition: a camera sees the target of a track that no two cameras see. Any of its bearings
//! that crosses the sight line of the last one may be the target's, so each is followed as a
//! hypothesis of its own (a leaf) until one is sure. All others, of other objects or of nothing,
//! are clutter.

use std::collections::BTreeMap;

use crate::comparison::{Candidate, Comparison};
use crate::evidence::BEYOND_DOUBT;
use crate::track::{FusedTrack, TrackId};

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

/// The leaves of all tracks that no two cameras see.
#[derive(Clone, Debug, Default)]
pub(crate) struct Reacquisition {
    leaves: BTreeMap<TrackId, Vec<Leaf>>,
}

/// An exposure, and the track that each of its bearings belongs to, if any.
pub(crate) struct OwnedExposure<'a> {
    pub(crate) comparison: Comparison<'a>,
    pub(crate) owners: &'a [Option<TrackId>],
}

impl OwnedExposure<'_> {
    /// The bearings in a track's gate, the best first: those that are free, and those of `owner`.
    fn candidates(&self, track: &FusedTrack, owner: Option<TrackId>) -> Vec<Candidate> {
        let is_open = |index: usize| self.owners[index].is_none_or(|id| Some(id) == owner);
        let expected = self.comparison.expectation(track);
        expected.map_or_else(Vec::new, |expected| self.comparison.ranked(track, &expected, is_open))
    }

    /// A copy of a track, updated with a bearing; `None` if the numbers fail.
    fn taken(&self, track: &FusedTrack, index: usize) -> Option<FusedTrack> {
        let mut track = track.clone();
        self.comparison.take(&mut track, index)?;
        Some(track)
    }

    /// A leaf after the exposure, with the bearing (by index) that it has used; `None` if it is
    /// given up.
    fn advanced(&self, mut leaf: Leaf, owner: TrackId) -> Option<(Leaf, Option<usize>)> {
        let best = self.candidates(&leaf.track, Some(owner)).first().copied();
        if let Some(Candidate { index, ratio, .. }) = best
            && let Some(track) = self.taken(&leaf.track, index)
        {
            // A bearing that the track itself has used is evidence neither for nor against its
            // leaves.
            let gained = if self.owners[index].is_some() { 0.0 } else { ratio };
            return Some((Leaf { track, log_ratio: leaf.log_ratio + gained }, Some(index)));
        }
        if self.comparison.expects(&leaf.track) {
            leaf.log_ratio += self.comparison.log_missed(&leaf.track);
            self.comparison.note(&mut leaf.track, false);
        }
        (leaf.log_ratio > GIVEN_UP).then_some((leaf, None))
    }

    /// New leaves, one for each of the exposure's best free bearings.
    fn begun(&self, track: &FusedTrack) -> Vec<(Leaf, Option<usize>)> {
        if !track.is_lost_sight_of_by(&self.comparison.exposure.camera) {
            return Vec::new();
        }
        let candidates = self.candidates(track, None).into_iter().take(MAX_LEAVES);
        let leaf = |Candidate { index, ratio, .. }| {
            Some((Leaf { track: self.taken(track, index)?, log_ratio: ratio }, Some(index)))
        };
        candidates.filter_map(leaf).collect()
    }
}

impl Reacquisition {
    /// Continues the leaves of all tracks that no two cameras see; returns the tracks that
    /// are found again, with the bearing (by index) that has settled it.
    pub(crate) fn advance(
        &mut self,
        tracks: &BTreeMap<TrackId, FusedTrack>,
        exposure: &OwnedExposure<'_>,
    ) -> Vec<(FusedTrack, Option<usize>)> {
        self.leaves.retain(|id, _| tracks.get(id).is_some_and(|track| !track.is_ranged()));
        let mut found = Vec::new();
        let alone = tracks.values().filter(|track| track.is_confirmed() && !track.is_ranged());
        for track in alone {
            let before = self.leaves.remove(&track.id).unwrap_or_default();
            let mut next: Vec<_> =
                before.into_iter().filter_map(|leaf| exposure.advanced(leaf, track.id)).collect();
            next.extend(exposure.begun(track));
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
