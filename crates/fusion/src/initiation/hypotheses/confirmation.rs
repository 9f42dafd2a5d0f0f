//! Which hypotheses are confirmed.

use std::collections::{BTreeMap, BTreeSet};

use crossfix_message::{CameraName, Timestamp};

use super::{Hypotheses, Hypothesis, Said};
use crate::Exposure;
use crate::cameras::Rooted;
use crate::evidence::{BEYOND_DOUBT, ONE_IN_A_HUNDRED};
use crate::initiation::NewTrack;
use crate::initiation::rooted_lines::RootedLines;
use crate::initiation::selection::{ScoredLines, Selection};
use crate::motion::MotionSetup;
use crate::spatial::LineId;
use crate::track::{FusedTrack, TrackStatus};
use crate::tracker::same_target;

impl Hypothesis {
    /// Whether enough cameras agree on it: three, or two for at least `pair_s` seconds. Lines of
    /// two targets, each seen by another one of two cameras, may cross for a while; and what one
    /// camera gave may be clutter, whatever the other one follows meanwhile: any line that lies
    /// near the plane of the other's makes a target with it.
    fn agrees(&self, pair_s: f64, lines: &BTreeMap<&CameraName, LineCounts>) -> bool {
        let cameras = self.cameras();
        if cameras.len() >= 3 {
            return true;
        }
        let all = |camera: &&CameraName| lines.get(*camera).map_or(1, |counts| counts.all);
        let choices: f64 = cameras.iter().map(|camera| log_number(all(camera))).sum();
        let is_sure = |said: &Said| said.evidence >= BEYOND_DOUBT + choices;
        cameras.into_iter().all(|camera| self.said.get(camera).is_some_and(is_sure))
            && self.track.updated_at.seconds_since(self.born) >= pair_s
            && self.track.is_placed()
    }

    /// The cameras in whose views what it is made of stands, if all of it does but for one line at
    /// most, which may be clutter (of two cameras, but for none).
    fn rooted_cameras(&self) -> Option<Vec<&CameraName>> {
        let cameras = self.cameras();
        let clutter = usize::from(cameras.len() > 2);
        let (rooted, others): (Vec<_>, Vec<_>) =
            cameras.into_iter().partition(|camera| self.rooted(camera) == Rooted::Yes);
        (others.len() <= clutter).then_some(rooted)
    }

    /// Whether what stands in the cameras' views explains it: not if so little stands there that it
    /// crosses nowhere by chance. As long as this is unknown of a line (its camera has only begun
    /// to look), two cameras are not enough.
    fn stands(&self, lines: &RootedLines) -> bool {
        let cameras = self.cameras();
        let is_unknown = cameras.iter().any(|camera| self.rooted(camera) == Rooted::Unknown);
        (is_unknown && cameras.len() == 2)
            || self.rooted_cameras().is_some_and(|rooted| lines.may_cross(rooted.into_iter()))
    }

    /// Least log-likelihood ratio of one target against an object per camera with which it is
    /// confirmed: the logarithm of the number of sets of lines that it may have been chosen from by
    /// chance, the product of the numbers of its cameras' lines. What stands in a view is counted
    /// where the hypothesis has such a line, but not for two cameras, of which one line at least
    /// has come or moved: a target that flies slowly passes for standing before one of them, and
    /// would be found ten seconds later. If none of its lines has been seen to come or to move, and
    /// how many things stand in the views is not known yet, it must be a hundred times likelier.
    fn least_one_target_ratio(&self, lines: &BTreeMap<&CameraName, LineCounts>) -> f64 {
        let cameras = self.cameras();
        let moves = cameras.iter().any(|camera| self.rooted(camera) == Rooted::No);
        let choices = cameras.iter().map(|camera| {
            let may_stand = self.rooted(camera) == Rooted::Yes;
            let count_all = may_stand && (cameras.len() > 2 || !moves);
            let number = |counts: &LineCounts| if count_all { counts.all } else { counts.others };
            log_number(lines.get(camera).map_or(1, number))
        });
        let is_unknown = !moves && self.rooted_cameras().is_none();
        choices.sum::<f64>() - if is_unknown { ONE_IN_A_HUNDRED } else { 0.0 }
    }
}

impl Hypotheses {
    /// Confirms hypotheses: those of the best set without common lines that are likely enough and
    /// have no rival. The log-likelihood ratio of one target against a target per camera must reach
    /// the logarithm of the number of sets of lines that may look like one target by chance.
    pub(super) fn confirm(
        &mut self,
        now: Timestamp,
        lines: &BTreeMap<&CameraName, LineCounts>,
        motion: &MotionSetup,
    ) -> Vec<NewTrack> {
        // Sorted by score: the rest have scores of 0 and less, which are never chosen.
        let likely = self.hypotheses.iter().take_while(|h| h.track.score > 0.0);
        let scored = likely.map(|h| ScoredLines { score: h.track.score, lines: &h.lines });
        let selection = Selection::new(scored, self.shared_lines);
        let state = |i: usize| self.hypotheses[i].track.predicted(now, motion);
        let has_no_rival = |i: usize| {
            let own = state(i);
            selection.margin_of(i, |k| same_target(&own, &state(k))) >= BEYOND_DOUBT
        };
        let likely =
            selection.chosen().filter_map(|i| Some((i, self.likely_in_place_of(i, lines)?)));
        let sure = likely.filter(|(i, _)| has_no_rival(*i)).map(|(_, hypothesis)| hypothesis);
        let sure: Vec<&Hypothesis> = sure.collect();
        let lines: BTreeSet<LineId> = sure
            .iter()
            .flat_map(|hypothesis| &hypothesis.lines)
            .map(|line| line.id.clone())
            .collect();
        let starts = sure.into_iter().map(|hypothesis| self.start(hypothesis)).collect();
        if !lines.is_empty() {
            self.hypotheses.retain(|h| h.lines.iter().all(|line| !lines.contains(&line.id)));
        }
        if !self.provisional.is_empty() {
            let alive: BTreeSet<&LineId> =
                self.hypotheses.iter().flat_map(|h| &h.lines).map(|line| &line.id).collect();
            self.provisional.retain(|id, _| alive.contains(id));
        }
        starts
    }

    /// What is confirmed in the place of a chosen hypothesis, if that has no rival: itself, if it is
    /// likely enough.
    ///
    /// The best of the hypotheses with its lines, as a rule the oldest, is chosen by its score,
    /// whatever is wrong with its past.
    /// If lines of a camera went into that which has given none since, another with the same lines
    /// of late may be confirmed. As that may have begun in any of its periods, it must be likelier
    /// by the number of these.
    fn likely_in_place_of(
        &self,
        chosen: usize,
        lines: &BTreeMap<&CameraName, LineCounts>,
    ) -> Option<&Hypothesis> {
        let chosen = &self.hypotheses[chosen];
        if self.is_likely(chosen, lines, 1) {
            return Some(chosen);
        }
        let cameras = chosen.cameras();
        if chosen.said.keys().all(|camera| cameras.contains(camera)) {
            return None;
        }
        // Sorted by score: the first one is the best.
        self.hypotheses.iter().find(|other| {
            other.lines == chosen.lines
                && other.said.keys().all(|camera| cameras.contains(camera))
                && self.is_likely(other, lines, chosen.periods)
        })
    }

    /// Whether a hypothesis, one of so many, is likely enough to be confirmed if it has no rival,
    /// given the numbers of the cameras' lines.
    fn is_likely(
        &self,
        hypothesis: &Hypothesis,
        lines: &BTreeMap<&CameraName, LineCounts>,
        choices: usize,
    ) -> bool {
        let least = hypothesis.least_one_target_ratio(lines) + log_number(choices);
        let is_one = hypothesis.one_target.log_ratio().is_none_or(|ratio| ratio >= least);
        hypothesis.agrees(self.pair_s, lines)
            && is_one
            && hypothesis.track.score >= self.confirm_score
            && hypothesis.periods >= self.needed
            && !hypothesis.stands(&self.rooted_lines)
    }

    fn start(&self, hypothesis: &Hypothesis) -> NewTrack {
        let mut track = FusedTrack::clone(&hypothesis.track);
        track.status = TrackStatus::Confirmed;
        track.observe();
        let lines = hypothesis.lines.iter();
        let provisional_owners =
            lines.filter_map(|line| self.provisional.get(&line.id)).copied().collect();
        NewTrack { track, cameras: hypothesis.cameras().len(), provisional_owners }
    }
}

/// Numbers of lines of a camera in an exposure.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct LineCounts {
    all: usize,
    /// Those of which it is not known that they are of something that stands in its view.
    others: usize,
}

/// Logarithm of a number of things, of which there is at least one.
fn log_number(number: usize) -> f64 {
    (number.max(1) as f64).ln()
}

/// Numbers of lines of each camera in an exposure, the largest of the period.
pub(super) fn numbers_of_lines<'a>(
    exposures: &[&'a Exposure],
) -> BTreeMap<&'a CameraName, LineCounts> {
    let mut lines: BTreeMap<&CameraName, LineCounts> = BTreeMap::new();
    for exposure in exposures {
        let others = exposure.sightings.iter().filter(|sighting| sighting.rooted != Rooted::Yes);
        let most = lines.entry(&exposure.camera).or_default();
        most.all = most.all.max(exposure.sightings.len());
        most.others = most.others.max(others.count());
    }
    lines
}
