//! Which bearing of an exposure is which track's.

use std::collections::BTreeMap;

use crossfix_message::TrackEventKind;

use super::{Noted, TrackChange, Tracker};
use crate::assignment::{Candidate, assign};
use crate::cameras::Fitting;
use crate::cameras::KnownCamera;
use crate::reacquisition::FOUND_AGAIN_MARGIN;
use crate::track::{Track, TrackId, TrackStatus};
use crate::visibility::log_missed;
use crate::{Exposure, Sighting};

/// A bearing is not compared with tracks beyond this many times the range of the cameras.
const REACH: f64 = 1.5;
/// A score beyond this counts no more: a track that has long been good can still be doubted.
const MAX_SCORE: f64 = 40.0;
/// A camera that is turned by no more than this shows a target beside where the others have it,
/// rad.
const BESIDE_RAD: f64 = 0.1;

impl Tracker {
    /// Which tracks choose first: those that several cameras hold in their place, then those that
    /// one alone follows, then those that are not sure. A ghost must not take a target's bearings.
    pub(super) fn in_order_of_choice(&self) -> [Vec<TrackId>; 3] {
        let mut order = [const { Vec::new() }; 3];
        for track in self.tracks.values().filter(|track| track.status != TrackStatus::Lost) {
            let place = if !track.is_confirmed() { 2 } else { usize::from(!track.is_held()) };
            order[place].push(track.id);
        }
        order
    }

    /// Gives bearings that are still open to some tracks, and judges these by it.
    pub(super) fn associate(
        &mut self,
        exposure: &Exposure,
        known: &KnownCamera,
        ids: &[TrackId],
        owners: &mut [Option<TrackId>],
        noted: &mut Noted,
    ) {
        let candidates = self.candidates(exposure, known, owners, ids);
        let gains: BTreeMap<(usize, usize), f64> =
            candidates.iter().map(|c| ((c.row, c.column), c.gain)).collect();
        let partner: BTreeMap<usize, usize> = assign(&candidates).into_iter().collect();
        for (row, id) in ids.iter().enumerate() {
            let Some(track) = self.tracks.get_mut(id) else {
                continue;
            };
            let sure = track.is_confirmed();
            let column = partner.get(&row).copied();
            let taken = column.and_then(|column| {
                let sighting = &exposure.sightings[column];
                let time = (exposure.time, &exposure.uncertainty);
                let taken = track.measurement_update(
                    &exposure.camera,
                    &sighting.line,
                    time,
                    &self.motion,
                )?;
                owners[column] = Some(*id);
                Some(taken)
            });
            let gain = taken.and(column).and_then(|column| gains.get(&(row, column))).copied();
            let sees = known.expects(track.position_at(exposure.time), self.max_range_m);
            if sure && taken.is_none() && track.is_held() {
                note_beside(track, exposure, known);
            }
            if sure && (taken.is_some() || sees) {
                let others = track.others_than(&exposure.camera, &self.motion);
                noted.fittings.add(others, fitting(track, exposure, known, taken.is_some()));
            }
            noted
                .third_differences
                .extend(taken.filter(|_| sure).and_then(|taken| taken.third_difference));
            let silent = exposure.time.seconds_since(track.updated) > self.config.coasting_after_s;
            let detection = self.config.detection_probability;
            let visible = track.visible_to(&exposure.camera, exposure.time, &self.motion);
            let missed = log_missed(visible, detection);
            let seen_since = !sure || track.is_seen_since_look_of(&exposure.camera);
            let silent = sure && silent;
            let change = match gain {
                // What one camera alone follows may be anything along its sight line.
                Some(_) if sure && !track.is_held() => 0.0,
                Some(gain) => gain + missed,
                // What hides the target from all is no evidence against it: of what nobody sees
                // time decides.
                None if sees && !silent && seen_since => missed,
                None => 0.0,
            };
            track.judge(change, MAX_SCORE);
            // Outside its field of view a camera has missed nothing.
            if gain.is_some() || sees {
                track.look(
                    &exposure.camera,
                    exposure.time,
                    gain.is_some(),
                    detection,
                    &self.motion,
                );
            }
            if taken.is_some_and(|taken| taken.manoeuvre) {
                noted.changes.push(TrackChange::new(TrackEventKind::Manoeuvre, *id));
            }
        }
    }

    /// What the open bearings in the gates of these tracks are worth to them.
    fn candidates(
        &self,
        exposure: &Exposure,
        known: &KnownCamera,
        owners: &[Option<TrackId>],
        ids: &[TrackId],
    ) -> Vec<Candidate> {
        // What a line must be worth to bring a track back that the camera has lost sight of.
        let stranger = exposure.clutter_per_sr.ln() + FOUND_AGAIN_MARGIN;
        let origin = known.camera.pose().position();
        let mut candidates = Vec::new();
        for (row, track) in
            ids.iter().enumerate().filter_map(|(row, id)| Some((row, self.tracks.get(id)?)))
        {
            if (track.position_at(exposure.time) - origin).norm() > REACH * self.max_range_m {
                continue;
            }
            let prediction = track.expectation(
                exposure.time,
                (&exposure.camera, origin),
                &exposure.uncertainty,
                &self.motion,
            );
            let Some(prediction) = prediction else {
                continue;
            };
            let detection = self.config.detection_probability;
            let visible = track.visible_to(&exposure.camera, exposure.time, &self.motion);
            let lost_sight = track.is_lost_sight_of_by(&exposure.camera, &self.motion);
            let open = exposure.sightings.iter().enumerate().filter(|(i, _)| owners[*i].is_none());
            for (column, sighting) in open {
                let fit = prediction.fit(&sighting.line, self.gate);
                if let Some(fit) = fit.filter(|fit| !lost_sight || fit.log_density > stranger) {
                    let gain = fit.log_ratio(visible * detection, exposure.clutter_per_sr)
                        - log_missed(visible, detection);
                    candidates.push(Candidate { row, column, gain });
                }
            }
        }
        candidates
    }
}

/// Keeps the line that passes nearest to a track, of an exposure that has none of it.
fn note_beside(track: &mut Track, exposure: &Exposure, known: &KnownCamera) {
    let expected = track.position_at(exposure.time) - known.camera.pose().position();
    let away = |sighting: &Sighting| sighting.line.direction.angle(&expected);
    let beside = exposure.sightings.iter().filter(|sighting| away(sighting) < BESIDE_RAD);
    if let Some(nearest) = beside.min_by(|one, other| away(one).total_cmp(&away(other))) {
        track.gather_beside(
            &exposure.camera,
            (&nearest.line, exposure.time),
            &exposure.uncertainty,
        );
    }
}

/// How an exposure fits a track that other cameras see; `None` if it says nothing.
pub(super) fn fitting(
    track: &Track,
    exposure: &Exposure,
    known: &KnownCamera,
    seen: bool,
) -> Option<Fitting> {
    let expected = track.position_at(exposure.time) - known.camera.pose().position();
    let is_beside = |sighting: &Sighting| sighting.line.direction.angle(&expected) < BESIDE_RAD;
    if seen {
        Some(Fitting::Fits)
    } else {
        exposure.sightings.iter().any(is_beside).then_some(Fitting::Beside)
    }
}
