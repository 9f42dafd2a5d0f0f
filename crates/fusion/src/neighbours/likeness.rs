//! Which track here and which of a neighbour are of one target.

use std::collections::BTreeMap;

use crossfix_filter::KinematicState;
use crossfix_message::Timestamp;

use super::{Number, Own};

/// How long two tracks are compared before anything follows, s. With half of it two targets that
/// cross are taken for one; with twice as much a fast one has left where both centres see it.
const LONG_ENOUGH_S: f64 = 1.0;
/// Squared Mahalanobis distance (three degrees of freedom) beyond which two places are hardly of
/// one target: of one they are once in a thousand times. A mean over a second is no better than one
/// of them, as the errors of both tracks last. With half of it, once in 23 times, and that target
/// keeps two numbers.
const UNLIKE: f64 = 16.3;
/// Squared distance beyond which two tracks that have been taken for one target are two: seven
/// standard deviations. With half of it poses that disagree by more than they say take a target to
/// and fro.
const PARTED: f64 = 3.0 * UNLIKE;
/// A squared distance counts no more than this, so that one bad update is outweighed in a second.
/// With half of it two that part are told apart after 1.1 s and not after 0.4 s.
const MAX_DISTANCE: f64 = 3.0 * PARTED;
/// Assumed density of targets, 1/m^3: one in a cube of 100 m. With ten times as much the error has
/// to be half as large before two tracks are one.
const DENSITY: f64 = 1e-6;
/// That two tracks are one target must be this many times likelier than each other reading. With
/// half of it one pairing in fifty may be wrong, and two targets have one number.
const CLEARLY: f64 = 100.0;

/// A track of a neighbour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct NeighbourTrackId {
    /// Which neighbour.
    pub(super) neighbour: usize,
    /// The number under which it says the track.
    pub(super) number: Number,
}

/// A track here and one of a neighbour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct TrackPair {
    pub(super) own: Own,
    pub(super) theirs: NeighbourTrackId,
}

/// How well the places of two tracks have agreed lately, as means over about [`LONG_ENOUGH_S`].
#[derive(Clone, Copy, Debug)]
struct TrackLikeness {
    since: Timestamp,
    seen: Timestamp,
    /// Squared Mahalanobis distance.
    distance: f64,
    /// The distance plus the log determinant of the covariance of both errors together: -2 times
    /// the logarithm of the likelihood of one target, less a constant. A track that may be anywhere
    /// explains nothing.
    cost: f64,
}

impl TrackLikeness {
    fn is_of_late(&self, now: Timestamp) -> bool {
        (0.0..LONG_ENOUGH_S).contains(&now.seconds_since(self.seen))
    }

    fn has_lasted(&self) -> bool {
        self.seen.seconds_since(self.since) >= LONG_ENOUGH_S
    }

    /// Whether one target is clearly likelier than two that are there by chance.
    fn is_likely(&self) -> bool {
        // exp(-cost / 2) / (2 pi)^(3/2) must exceed CLEARLY times the density of targets.
        let by_chance = CLEARLY * DENSITY * (2.0 * std::f64::consts::PI).powf(1.5);
        self.distance < UNLIKE && self.cost < -2.0 * by_chance.ln()
    }

    /// Whether this pair is recent and not clearly less likely than another, where only one of the
    /// two can be of one target.
    fn rivals(&self, other: &Self, now: Timestamp) -> bool {
        // Costs are -2 ln L: a rival is one that is not less likely by the factor `CLEARLY`.
        self.is_of_late(now) && self.cost < other.cost + 2.0 * CLEARLY.ln()
    }
}

/// All pairs of tracks that may be of one target.
#[derive(Clone, Debug, Default)]
pub(super) struct Likenesses(BTreeMap<TrackPair, TrackLikeness>);

impl Likenesses {
    /// Compares two states of one time; `is_one` is for tracks that are said under one number,
    /// whose pair is kept whatever comes out.
    pub(super) fn see(
        &mut self,
        pair: TrackPair,
        is_one: bool,
        [here, there]: [&KinematicState; 2],
        now: Timestamp,
    ) {
        let apart = here.position() - there.position();
        let spread = here.position_covariance() + there.position_covariance();
        // No direction's variance is greater than the sum of all.
        let is_far = apart.norm_squared() > UNLIKE * spread.trace();
        if is_far && !is_one && !self.0.contains_key(&pair) {
            return;
        }
        let Some(factor) = spread.cholesky() else { return };
        // -2 ln N(d; 0, S) = d' S^-1 d + ln det S, less a constant.
        let distance = apart.dot(&factor.solve(&apart)).min(MAX_DISTANCE);
        let cost = distance + 2.0 * factor.l().diagonal().map(f64::ln).sum();
        let new = TrackLikeness { since: now, seen: now, distance, cost };
        let known = self.0.entry(pair).or_insert(new);
        if !known.is_of_late(now) {
            *known = new;
        }
        // Exponential mean to first order, m += (dt / T) (x - m); dt < T, as older ones begin
        // again.
        let share = now.seconds_since(known.seen) / LONG_ENOUGH_S;
        known.distance += share * (distance - known.distance);
        known.cost += share * (cost - known.cost);
        known.seen = now;
        if known.distance > UNLIKE && !is_one {
            self.0.remove(&pair);
        }
    }

    fn of_own(&self, own: Own) -> impl Iterator<Item = (NeighbourTrackId, &TrackLikeness)> {
        let first = NeighbourTrackId { neighbour: 0, number: Number(0) };
        let last = NeighbourTrackId { neighbour: usize::MAX, number: Number(u64::MAX) };
        let all = TrackPair { own, theirs: first }..=TrackPair { own, theirs: last };
        self.0.range(all).map(|(pair, likeness)| (pair.theirs, likeness))
    }

    /// The neighbours' tracks that are beyond doubt of the same target as one here: at most one per
    /// neighbour, as each has one track of a target.
    pub(super) fn same_as(
        &self,
        own: Own,
        now: Timestamp,
    ) -> impl Iterator<Item = NeighbourTrackId> + '_ {
        self.of_own(own)
            .filter(move |(said, likeness)| {
                self.is_sure(TrackPair { own, theirs: *said }, likeness, now)
            })
            .map(|(said, _)| said)
    }

    fn is_sure(&self, pair: TrackPair, likeness: &TrackLikeness, now: Timestamp) -> bool {
        let neighbour = pair.theirs.neighbour;
        let mut of_neighbour =
            self.of_own(pair.own).filter(|(other, _)| other.neighbour == neighbour);
        let mut of_theirs = self.0.iter().filter(|(other, _)| other.theirs == pair.theirs);
        likeness.is_of_late(now)
            && likeness.has_lasted()
            && likeness.is_likely()
            && !of_neighbour
                .any(|(other, rival)| other != pair.theirs && rival.rivals(likeness, now))
            && !of_theirs.any(|(other, rival)| other.own != pair.own && rival.rivals(likeness, now))
    }

    /// Whether a track here may be one of the neighbours'.
    pub(super) fn may_be_theirs(&self, own: Own, now: Timestamp) -> bool {
        self.of_own(own).any(|(_, likeness)| likeness.is_of_late(now) && likeness.is_likely())
    }

    /// Whether two tracks that are said under one number are near enough to be of one target.
    pub(super) fn may_be_one(&self, own: Own, said: NeighbourTrackId) -> bool {
        let likeness = self.0.get(&TrackPair { own, theirs: said });
        likeness.is_some_and(|likeness| likeness.distance < PARTED)
    }

    /// Whether two tracks that are said under one number are of two targets, beyond doubt.
    pub(super) fn have_parted(&self, own: Own, said: NeighbourTrackId) -> bool {
        let likeness = self.0.get(&TrackPair { own, theirs: said });
        likeness.is_some_and(|likeness| likeness.has_lasted() && likeness.distance > PARTED)
    }

    /// Forgets pairs of which one track has not been seen lately.
    pub(super) fn forget(&mut self, now: Timestamp) {
        self.0.retain(|_, likeness| likeness.is_of_late(now));
    }
}
