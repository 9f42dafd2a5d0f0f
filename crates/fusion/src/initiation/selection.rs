//! Selection of compatible leaves: the set of greatest total score without common lines. A leaf is
//! one way in which some bearings may be one target's.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};

use crate::spatial::LineId;

/// Most comparisons of leaves in one period, about a tenth of a second's worth; half of them are
/// reserved for [`Selection::margin_of`], the question how sure each choice is. What they do not
/// suffice for is not confirmed in that period: with half of it that happens in less clutter.
const MAX_COMPARISONS: usize = 20_000_000;
/// Most passes of the local search; each increases the total, and few are ever needed. With half of
/// it the same.
const MAX_PASSES: usize = 20;

/// A line of a leaf.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct PeriodLine {
    /// The number of its period.
    pub(super) period: u64,
    pub(super) id: LineId,
}

/// A leaf: its score and its lines.
#[derive(Clone, Copy, Debug)]
pub(super) struct ScoredLines<'a> {
    pub(super) score: f64,
    pub(super) lines: &'a [PeriodLine],
}

/// Bearings that may be one target's, and their score.
#[derive(Clone, Debug)]
struct ScoredBearings {
    score: f64,
    /// The numbers of its lines, ascending.
    lines: Vec<usize>,
}

/// All leaves, which lines they share, and the choice.
#[derive(Clone, Debug)]
pub(super) struct Selection {
    leaves: Vec<ScoredBearings>,
    /// The leaves that use a line, by the line's number.
    users: Vec<Vec<usize>>,
    shared_lines: usize,
    chosen: BTreeSet<usize>,
    /// Comparisons that may still be made: time is bounded even if everything clashes with
    /// everything.
    budget: Cell<usize>,
    /// How much the total score falls without each chosen leaf, as far as it was asked for.
    losses: RefCell<BTreeMap<usize, f64>>,
}

impl Selection {
    /// The best set found among leaves; `shared_lines` is how many lines two chosen leaves may have
    /// in common. Leaves with a score of 0 or less are never chosen.
    ///
    /// Choosing greedily by score lets a leaf that mixes several targets' bearings shut out all of
    /// their own leaves. So the choice is improved by exchange: a leaf is taken out if those that
    /// it kept out are worth more.
    pub(super) fn new<'a>(
        scored: impl Iterator<Item = ScoredLines<'a>>,
        shared_lines: usize,
    ) -> Self {
        let mut numbers: BTreeMap<&LineId, usize> = BTreeMap::new();
        let mut leaves = Vec::new();
        for ScoredLines { score, lines } in scored {
            let mut own: Vec<usize> = Vec::with_capacity(lines.len());
            for PeriodLine { id, .. } in lines {
                let next = numbers.len();
                own.push(*numbers.entry(id).or_insert(next));
            }
            own.sort_unstable();
            leaves.push(ScoredBearings { score, lines: own });
        }
        let mut users = vec![Vec::new(); numbers.len()];
        for (i, leaf) in leaves.iter().enumerate() {
            for &line in &leaf.lines {
                users[line].push(i);
            }
        }
        let mut selection = Self {
            leaves,
            users,
            shared_lines,
            chosen: BTreeSet::new(),
            budget: Cell::new(MAX_COMPARISONS),
            losses: RefCell::default(),
        };
        selection.fill(&(0..selection.leaves.len()).collect::<Vec<_>>());
        selection.exchange();
        selection
    }

    /// The chosen leaves, ascending.
    pub(super) fn chosen(&self) -> impl Iterator<Item = usize> + '_ {
        self.chosen.iter().copied()
    }

    /// How much the total score falls if a chosen leaf is wrong, together with all other leaves of
    /// its lines for which `is_same` holds. 0 if the budget of comparisons is used up.
    ///
    /// Without the leaf, others that clash with it may take its lines: only the difference is lost.
    /// A rival may clash with other chosen leaves as well, which it then takes the place of: of
    /// targets that fly close together, the lines of one that is missed now and then are a part of
    /// leaves that mix two of them.
    pub(super) fn margin_of(&self, chosen: usize, is_same: impl Fn(usize) -> bool) -> f64 {
        let is_other = |i: &usize| !is_same(*i);
        let mut least = self.loss_without(&[chosen], &[], &is_other);
        let rivals: Vec<usize> = self.clashing(chosen).into_iter().filter(is_other).collect();
        for rival in rivals {
            let displaced: Vec<usize> =
                self.clashing(rival).into_iter().filter(|i| self.chosen.contains(i)).collect();
            // What is lost of each of them by itself is mostly no more than what is lost of all at
            // once, though another leaf may take lines of several. To try all costs seven times as
            // much in a swarm, and leaves half of the false tracks.
            let at_least = self.leaves[chosen].score - self.leaves[rival].score
                + displaced.iter().filter(|&&i| i != chosen).map(|&i| self.loss_of(i)).sum::<f64>();
            if at_least < least {
                least = least.min(self.loss_without(&displaced, &[rival], &is_other));
            }
        }
        // If there was no time to look for alternatives, nothing is sure.
        if self.budget.get() == 0 { 0.0 } else { least }
    }

    /// How much the total score falls without some chosen leaves, with others in their place, and
    /// with those of their neighbours that still fit.
    fn loss_without(&self, out: &[usize], with: &[usize], may: &impl Fn(&usize) -> bool) -> f64 {
        let mut choice = self.chosen.clone();
        out.iter().for_each(|i| {
            choice.remove(i);
        });
        choice.extend(with);
        let near: BTreeSet<usize> =
            out.iter().flat_map(|&i| self.neighbours(i)).filter(may).collect();
        let added = self.additions(&choice, &near.into_iter().collect::<Vec<_>>());
        let total = |leaves: &[usize]| leaves.iter().map(|&i| self.leaves[i].score).sum::<f64>();
        total(out) - total(with) - total(&added)
    }

    /// How much the total score falls without one chosen leaf.
    fn loss_of(&self, chosen: usize) -> f64 {
        if let Some(known) = self.losses.borrow().get(&chosen) {
            return *known;
        }
        let loss = self.loss_without(&[chosen], &[], &|i: &usize| *i != chosen);
        self.losses.borrow_mut().insert(chosen, loss);
        loss
    }

    /// The leaves that clash with this one; none if the budget of comparisons is used up.
    fn clashing(&self, with: usize) -> Vec<usize> {
        if !self.spend_on(with) {
            return Vec::new();
        }
        self.neighbours(with)
            .filter(|&i| self.leaves[i].score > 0.0 && self.clash(with, i))
            .collect()
    }

    /// The leaves that share a line with this one.
    fn neighbours(&self, of: usize) -> impl Iterator<Item = usize> {
        let lines = &self.leaves[of].lines;
        let all: BTreeSet<usize> =
            lines.iter().flat_map(|&line| self.users[line].iter().copied()).collect();
        all.into_iter().filter(move |&i| i != of)
    }

    fn clash(&self, one: usize, other: usize) -> bool {
        let (a, b) = (&self.leaves[one].lines, &self.leaves[other].lines);
        a.iter().filter(|line| b.binary_search(line).is_ok()).count() > self.shared_lines
    }

    /// Takes from the budget what it costs at most to compare a leaf with its neighbours: one
    /// comparison per user of each of its lines. False if that is more than is left.
    fn spend_on(&self, leaf: usize) -> bool {
        let cost = self.leaves[leaf].lines.iter().map(|&line| self.users[line].len()).sum();
        let left = self.budget.get().checked_sub(cost);
        self.budget.set(left.unwrap_or(0));
        left.is_some()
    }

    fn fits(&self, leaf: usize, choice: &BTreeSet<usize>) -> bool {
        if !self.spend_on(leaf) {
            return false;
        }
        let near = self.leaves[leaf].lines.iter().flat_map(|&line| &self.users[line]);
        // Only leaves that use one of its lines can clash with it.
        near.filter(|i| choice.contains(i)).all(|&i| i != leaf && !self.clash(leaf, i))
    }

    /// Greedy choice: those of `among` that are compatible with a choice and with each other, the
    /// best first.
    fn additions(&self, choice: &BTreeSet<usize>, among: &[usize]) -> Vec<usize> {
        let mut by_score: Vec<usize> = among.to_vec();
        by_score.sort_by(|&a, &b| {
            self.leaves[b].score.total_cmp(&self.leaves[a].score).then(a.cmp(&b))
        });
        let mut choice = choice.clone();
        let mut added = Vec::new();
        for i in by_score {
            if self.leaves[i].score > 0.0 && self.fits(i, &choice) {
                choice.insert(i);
                added.push(i);
            }
        }
        added
    }

    fn fill(&mut self, among: &[usize]) {
        let added = self.additions(&self.chosen, among);
        self.chosen.extend(added);
    }

    /// Local search: takes one leaf out for those that it kept out, or one in for those that it
    /// clashes with, as long as the total grows.
    fn exchange(&mut self) {
        for _ in 0..MAX_PASSES {
            let mut better = false;
            for out in self.chosen.clone() {
                let others: Vec<usize> = self.neighbours(out).collect();
                let mut without = self.chosen.clone();
                without.remove(&out);
                let added = self.additions(&without, &others);
                let gained: f64 = added.iter().map(|&i| self.leaves[i].score).sum();
                if self.budget.get() < MAX_COMPARISONS / 2 {
                    return;
                }
                // Better by more than rounding: otherwise two sets of one score would be exchanged
                // for ever.
                if gained > self.leaves[out].score + 1e-9 {
                    self.chosen = without;
                    self.chosen.extend(added);
                    better = true;
                }
            }
            for i in 0..self.leaves.len() {
                if self.chosen.contains(&i) {
                    continue;
                }
                let against: Vec<usize> = self
                    .neighbours(i)
                    .filter(|k| self.chosen.contains(k) && self.clash(i, *k))
                    .collect();
                let lost: f64 = against.iter().map(|&k| self.leaves[k].score).sum();
                if self.leaves[i].score > lost + 1e-9 {
                    against.iter().for_each(|k| {
                        self.chosen.remove(k);
                    });
                    self.chosen.insert(i);
                    better = true;
                }
            }
            if !better {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crossfix_message::CameraName;

    use super::*;

    fn select(leaves: &[(f64, &[usize])], shared: usize) -> Selection {
        let camera: CameraName = "a".parse().unwrap();
        let line = |&index: &usize| PeriodLine {
            period: 0,
            id: LineId { camera: camera.clone(), sequence: 0, index },
        };
        let owned: Vec<(f64, Vec<PeriodLine>)> =
            leaves.iter().map(|(s, l)| (*s, l.iter().map(line).collect())).collect();
        Selection::new(owned.iter().map(|(s, l)| ScoredLines { score: *s, lines: l }), shared)
    }

    #[test]
    fn two_targets_beat_the_better_ghost_of_both() {
        let selection = select(&[(12.0, &[0, 1, 4]), (10.0, &[0, 2]), (9.0, &[1, 3])], 0);
        assert_eq!(selection.chosen().collect::<Vec<_>>(), [1, 2]);
        // The ghost takes the place of both: 10 + 9 - 12.
        assert!((selection.margin_of(1, |_| false) - 7.0).abs() < 1e-9);
    }

    #[test]
    fn a_rival_takes_the_certainty_and_a_twin_does_not() {
        let selection = select(&[(12.0, &[0, 1]), (11.0, &[1, 2]), (-1.0, &[5])], 0);
        assert_eq!(selection.chosen().collect::<Vec<_>>(), [0]);
        assert!((selection.margin_of(0, |_| false) - 1.0).abs() < 1e-9);
        assert!((selection.margin_of(0, |i| i == 1) - 12.0).abs() < 1e-9);
    }

    #[test]
    fn a_crossing_may_be_allowed() {
        let crossing: [(f64, &[usize]); 2] = [(12.0, &[0, 1, 2]), (11.0, &[2, 3, 4])];
        assert_eq!(select(&crossing, 0).chosen().count(), 1);
        assert_eq!(select(&crossing, 1).chosen().count(), 2);
    }
}
