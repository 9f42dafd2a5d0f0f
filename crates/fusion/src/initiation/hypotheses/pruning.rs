//! Which hypotheses are kept.

use std::collections::BTreeMap;

use super::{BOUNDS, Hypotheses, Hypothesis, LEAST_SCORE};
use crate::spatial::LineId;

/// A hypothesis less likely than its tree's best by this log-likelihood is given up. With half of
/// it a wrong branch that is ahead by eight can no longer be overtaken.
const TREE_MARGIN: f64 = 15.0;

impl Hypotheses {
    /// Keeps the best hypotheses of each tree.
    pub(super) fn prune_trees(&mut self) {
        self.sort();
        let mut trees: BTreeMap<u64, (f64, usize)> = BTreeMap::new();
        self.hypotheses.retain(|h| is_kept_in_tree(h, &mut trees));
        self.hypotheses.truncate(BOUNDS.hypotheses);
    }

    fn sort(&mut self) {
        self.hypotheses.sort_by(|a, b| {
            b.track.score.total_cmp(&a.track.score).then_with(|| a.lines.cmp(&b.lines))
        });
    }

    /// Keeps the best hypotheses of those that have the same lines in this period.
    pub(super) fn prune(&mut self) {
        self.sort();
        let mut seen: BTreeMap<Vec<LineId>, usize> = BTreeMap::new();
        let period = self.period;
        self.hypotheses.retain(|h| is_kept_of_duplicates(h, period, &mut seen));
        self.hypotheses.truncate(BOUNDS.hypotheses);
    }
}

/// Counts a hypothesis of a tree, given the best score and the number so far of each; whether it is
/// kept. Hypotheses come in order of score: the first of a tree is its best.
fn is_kept_in_tree(hypothesis: &Hypothesis, trees: &mut BTreeMap<u64, (f64, usize)>) -> bool {
    let score = hypothesis.track.score;
    let (best, count) = trees.entry(hypothesis.tree).or_insert((score, 0));
    *count += 1;
    *count <= BOUNDS.of_tree && score > *best - TREE_MARGIN && score > LEAST_SCORE
}

/// Counts a hypothesis among those that have the same lines in a period; whether it is kept.
fn is_kept_of_duplicates(
    hypothesis: &Hypothesis,
    period: u64,
    seen: &mut BTreeMap<Vec<LineId>, usize>,
) -> bool {
    let newest: Vec<LineId> = hypothesis.newest(period).into_iter().cloned().collect();
    if newest.is_empty() {
        return true;
    }
    let count = seen.entry(newest).or_default();
    *count += 1;
    *count <= BOUNDS.duplicates
}
