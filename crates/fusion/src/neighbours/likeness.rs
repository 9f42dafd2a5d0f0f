//! Which track here and which of a neighbour are of one target.

use std::collections::BTreeMap;

use crossfix_filter::KinematicState;
use crossfix_message::Timestamp;

/// Two tracks are held against each other for so long before anything follows, s. Half of it and two
/// targets that cross are taken for one; with twice as much a fast one has left where both see it.
const LONG_ENOUGH_S: f64 = 1.0;
/// Places that are farther apart, as a squared Mahalanobis distance of three degrees of freedom, are
/// of two targets: of one they are once in a thousand times. A mean over a second is no better than
/// one of them, as what both tracks are off by lasts.
const UNLIKE: f64 = 16.3;
/// A squared distance counts no more than this, so that one bad update is outweighed in a second.
const MOST: f64 = 3.0 * UNLIKE;
/// Another reading must be so much worse, in squared distance: a hundred times less likely.
const CLEARLY: f64 = 9.2;

/// A track of the fusion here and one of a neighbour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Pair {
    /// The number that the fusion here has given.
    pub(super) own: u64,
    /// The number that the neighbour says.
    pub(super) number: u64,
}

/// How well the places of two tracks have agreed of late.
#[derive(Clone, Copy, Debug)]
struct Likeness {
    since: Timestamp,
    seen: Timestamp,
    /// Squared Mahalanobis distance, mean over about [`LONG_ENOUGH_S`].
    mean: f64,
}

impl Likeness {
    fn is_old_enough(&self) -> bool {
        self.seen.seconds_since(self.since) >= LONG_ENOUGH_S
    }

    fn is_of_late(&self, now: Timestamp) -> bool {
        now.seconds_since(self.seen).abs() < LONG_ENOUGH_S
    }
}

/// All pairs that may be of one target.
#[derive(Clone, Debug, Default)]
pub(super) struct Likenesses(BTreeMap<Pair, Likeness>);

impl Likenesses {
    /// Holds two states of one time against each other; `is_one` of tracks that are said under one
    /// number, whose pair is kept whatever comes out.
    pub(super) fn see(
        &mut self,
        pair: Pair,
        is_one: bool,
        [here, there]: [&KinematicState; 2],
        now: Timestamp,
    ) {
        let apart = here.position() - there.position();
        let spread = here.position_covariance() + there.position_covariance();
        // No direction's variance is greater than the sum of all.
        let is_far = apart.norm_squared() > MOST * spread.trace();
        if is_far && !is_one && !self.0.contains_key(&pair) {
            return;
        }
        let Some(factor) = spread.cholesky() else { return };
        let distance = apart.dot(&factor.solve(&apart)).min(MOST);
        let mean = match self.0.get_mut(&pair) {
            Some(known) => {
                let share = (now.seconds_since(known.seen) / LONG_ENOUGH_S).clamp(0.0, 1.0);
                known.mean += share * (distance - known.mean);
                known.seen = now;
                known.mean
            }
            None => {
                self.0.insert(pair, Likeness { since: now, seen: now, mean: distance });
                distance
            }
        };
        if mean > UNLIKE && !is_one {
            self.0.remove(&pair);
        }
    }

    /// The number of a neighbour's track that is of the same target as one here, beyond doubt.
    pub(super) fn same_as(&self, own: u64, now: Timestamp) -> Option<u64> {
        let late = || self.0.iter().filter(|(_, likeness)| likeness.is_of_late(now));
        let of_own = late().filter(|(pair, _)| pair.own == own);
        let (best, likeness) = of_own.min_by(|(_, a), (_, b)| a.mean.total_cmp(&b.mean))?;
        let is_rival = |(pair, other): &(&Pair, &Likeness)| {
            *pair != best
                && (pair.own == own || pair.number == best.number)
                && other.mean < likeness.mean + CLEARLY
        };
        let is_sure = likeness.is_old_enough()
            && likeness.mean < UNLIKE
            && !late().any(|other| is_rival(&other));
        is_sure.then_some(best.number)
    }

    /// Whether a track here may be one of the neighbours'.
    pub(super) fn may_be_theirs(&self, own: u64, now: Timestamp) -> bool {
        let of_own = self.0.iter().filter(|(pair, _)| pair.own == own);
        of_own.into_iter().any(|(_, likeness)| likeness.is_of_late(now) && likeness.mean < UNLIKE)
    }

    /// Whether two tracks that are said under one number are of two targets, beyond doubt.
    pub(super) fn is_unlike(&self, pair: Pair) -> bool {
        let likeness = self.0.get(&pair);
        likeness.is_some_and(|likeness| likeness.is_old_enough() && likeness.mean > UNLIKE)
    }

    /// Forgets pairs of which one has not been seen of late.
    pub(super) fn forget(&mut self, now: Timestamp) {
        self.0.retain(|_, likeness| likeness.is_of_late(now));
    }
}
