//! Association: which bearing of an exposure belongs to which track.

use std::collections::BTreeMap;

use crossfix_message::TrackEventKind;
use nalgebra::{Unit, Vector3};

use super::{Noted, TrackChange, Tracker};
use crate::assignment::{Pairing, assign};
use crate::cameras::{Fitting, KnownCamera, Rooted};
use crate::comparison::{Candidate, Comparison};
use crate::evidence::BEYOND_DOUBT;
use crate::track::{FusedTrack, TrackId, TrackStatus};
use crate::{Exposure, Sighting};

/// A camera's bearings are not compared with tracks farther from it than this many times the
/// largest range. With half of it a target loses its bearings before it leaves that range.
const REACH: f64 = 1.5;
/// Upper limit of a track's score: a track that has long been good can still be doubted. With half
/// of it no tentative track reaches the default score of confirmation; with twice as much a ghost
/// lives for twice as many misses.
pub(crate) const MAX_SCORE: f64 = 40.0;
/// Bearings within this angle of a target's expected direction count as beside it, rad: a camera
/// that is turned by no more than this shows the target there. With half of it a camera turned by
/// four degrees is not accused; with twice as much, what else is in the view counts against a good
/// one.
const BESIDE_RAD: f64 = 0.1;

impl Tracker {
    /// The tracks in the order in which they choose bearings: first those that several cameras
    /// support, then those that one camera alone follows, then unconfirmed ones. A ghost must not
    /// take a target's bearings.
    pub(super) fn in_order_of_choice(&self) -> [Vec<TrackId>; 3] {
        let mut order = [const { Vec::new() }; 3];
        for track in self.tracks.values().filter(|track| track.status != TrackStatus::Lost) {
            let place =
                if !track.is_confirmed() { 2 } else { usize::from(!track.is_triangulated()) };
            order[place].push(track.id);
        }
        order
    }

    /// Assigns bearings that are still free to these tracks, updates the tracks with them, and
    /// adjusts the tracks' scores.
    pub(super) fn associate(
        &mut self,
        exposure: &Exposure,
        known: &KnownCamera,
        ids: &[TrackId],
        owners: &mut [Option<TrackId>],
        noted: &mut Noted,
    ) {
        let candidates = self.pairings(exposure, known, owners, ids);
        let comparison = Comparison { exposure, known, motion: &self.motion, rules: self.rules };
        let gains: BTreeMap<(usize, usize), f64> =
            candidates.iter().map(|c| ((c.row, c.column), c.gain)).collect();
        let partner = assign(&candidates);
        for (row, id) in ids.iter().enumerate() {
            let Some(track) = self.tracks.get_mut(id) else {
                continue;
            };
            let sure = track.is_confirmed();
            let column = partner.get(&row).copied();
            let taken = column.and_then(|column| {
                let bearing = comparison.bearing(column);
                let taken = track.measurement_update(bearing, &self.motion)?;
                owners[column] = Some(*id);
                Some(taken)
            });
            let gain = taken.and(column).and_then(|column| gains.get(&(row, column))).copied();
            let sees = comparison.expects(track);
            if sure && (taken.is_some() || sees) {
                let others = track.others_than(&exposure.camera);
                noted.fittings.add(others, fitting(track, exposure, known, taken.is_some()));
            }
            noted
                .third_differences
                .extend(taken.filter(|_| sure).and_then(|taken| taken.third_differences));
            let evidence = Evidence { gain, sees, sure };
            let change = evidence.score_change(track, &comparison, self.config.coasting_after_s);
            track.add_evidence(change, MAX_SCORE);
            if gain.is_some() {
                comparison.note(track, true);
            } else {
                noted.unseen.push(*id);
            }
            if taken.is_some_and(|taken| taken.manoeuvre) {
                noted.changes.push(TrackChange::new(TrackEventKind::Manoeuvre, *id));
            }
        }
    }

    /// Notes that an exposure, whose bearings now have these owners, shows nothing of these tracks.
    pub(super) fn note_unseen(
        &mut self,
        exposure: &Exposure,
        known: &KnownCamera,
        owners: &[Option<TrackId>],
        unseen: &[TrackId],
    ) {
        let comparison = Comparison { exposure, known, motion: &self.motion, rules: self.rules };
        for id in unseen.iter().filter(|id| !owners.contains(&Some(**id))) {
            if let Some(track) = self.tracks.get_mut(id) {
                comparison.note_unseen(track);
            }
        }
    }

    /// Notes the line that passes nearest to each track that several cameras support and of which
    /// the exposure has no bearing. A camera that is turned may see the target there, if the line
    /// is no other track's and what gives it does not stand in the view.
    pub(super) fn note_beside(
        &mut self,
        exposure: &Exposure,
        known: &KnownCamera,
        owners: &[Option<TrackId>],
    ) {
        let tracks = self.tracks.iter_mut().filter(|(id, track)| {
            track.is_confirmed()
                && track.is_triangulated()
                && track.is_tied_to(&exposure.camera)
                && !owners.contains(&Some(**id))
        });
        for (_, track) in tracks {
            let expected = expected_direction(track, exposure, known);
            let lines = exposure.sightings.iter().zip(owners);
            let beside = lines.filter_map(|(sighting, owner)| {
                Some((chord_squared_beside(sighting, expected)?, sighting, owner))
            });
            if let Some((_, nearest, owner)) = beside.min_by(|a, b| a.0.total_cmp(&b.0)) {
                let may_be_it = owner.is_none() && nearest.rooted == Rooted::No;
                track.gather_beside(&exposure.bearing(&nearest.line), may_be_it);
            }
        }
    }

    /// The possible pairs of these tracks and free bearings in their gates, with the gain of each:
    /// its log-likelihood ratio against clutter, less that of a miss.
    fn pairings(
        &self,
        exposure: &Exposure,
        known: &KnownCamera,
        owners: &[Option<TrackId>],
        ids: &[TrackId],
    ) -> Vec<Pairing> {
        let origin = known.camera.pose().position();
        let comparison = self.comparison(exposure, known);
        let mut pairings = Vec::new();
        for (row, track) in
            ids.iter().enumerate().filter_map(|(row, id)| Some((row, self.tracks.get(id)?)))
        {
            if (track.position_at(exposure.time) - origin).norm() > REACH * self.rules.max_range_m {
                continue;
            }
            let Some(expected) = comparison.expectation(track) else {
                continue;
            };
            let missed = comparison.log_missed(track);
            let lost_sight = track.is_lost_sight_of_by(&exposure.camera);
            let near = comparison.candidates(track, &expected, |index| owners[index].is_none());
            let near = near.filter(|one| !lost_sight || one.ratio > BEYOND_DOUBT);
            pairings.extend(near.map(|Candidate { index, ratio, .. }| Pairing {
                row,
                column: index,
                gain: ratio - missed,
            }));
        }
        pairings
    }
}

/// What an exposure says of a track.
struct Evidence {
    /// Log-likelihood ratio of the track's bearing against clutter, less that of a miss; `None`
    /// without a bearing.
    gain: Option<f64>,
    /// Whether the camera should see the target.
    sees: bool,
    /// Whether the track was confirmed before.
    sure: bool,
}

impl Evidence {
    /// By how much it changes the track's score; the track has been updated with its bearing.
    fn score_change(
        &self,
        track: &FusedTrack,
        comparison: &Comparison<'_>,
        coasting_after_s: f64,
    ) -> f64 {
        let exposure = comparison.exposure;
        let missed = comparison.log_missed(track);
        let silent_s = exposure.time.seconds_since(track.updated_at);
        let silent = self.sure && silent_s > coasting_after_s;
        let seen_since = !self.sure || track.is_seen_since_exposure_of(&exposure.camera);
        match self.gain {
            // No evidence for the target: what one camera alone follows may be anything along its
            // sight line.
            Some(_) if self.sure && !track.is_triangulated() => 0.0,
            // The gain was counted against a miss, ln(P_D N / clutter) - ln(1 - P_D): the score
            // wants the first term alone.
            Some(gain) => gain + missed,
            // If whatever hides the target hides it from all cameras, a miss is no evidence against
            // it; when nobody sees it, time decides.
            None if self.sees && !silent && seen_since => missed,
            None => 0.0,
        }
    }
}

/// How an exposure fits a track that other cameras see; `None` if it has no bearing of the track
/// and none beside it, and so says nothing.
pub(super) fn fitting(
    track: &FusedTrack,
    exposure: &Exposure,
    known: &KnownCamera,
    seen: bool,
) -> Option<Fitting> {
    if seen {
        return Some(Fitting::Fits);
    }
    let expected = expected_direction(track, exposure, known);
    let is_beside = |sighting: &Sighting| chord_squared_beside(sighting, expected).is_some();
    exposure.sightings.iter().any(is_beside).then_some(Fitting::Beside)
}

/// Where an exposure's camera should see a track's target.
fn expected_direction(
    track: &FusedTrack,
    exposure: &Exposure,
    known: &KnownCamera,
) -> Unit<Vector3<f64>> {
    let place = track.position_at(exposure.time);
    Unit::new_normalize(place - known.camera.pose().position())
}

/// Square of the chord between a sighting and an expected direction, if the sighting passes beside
/// it: at these angles the chord is the angle.
fn chord_squared_beside(sighting: &Sighting, expected: Unit<Vector3<f64>>) -> Option<f64> {
    let chord = sighting.line.direction.into_inner() - expected.into_inner();
    Some(chord.norm_squared()).filter(|squared| *squared < BESIDE_RAD.powi(2))
}
