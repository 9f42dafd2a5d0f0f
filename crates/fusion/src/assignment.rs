//! Assignment of rows to columns with the greatest total gain.

use std::collections::{BTreeMap, BTreeSet};

use pathfinding::prelude::{Matrix, kuhn_munkres};

/// Gains are quantised, as the solver needs totally ordered numbers: steps of a millionth. With
/// half of it the same: gains are logarithms of likelihoods, and a millionth decides nothing.
const STEPS: f64 = 1e6;
/// Most cells of the matrix (rows, by columns and rows) of a cluster that is solved as a whole; a
/// larger one is cut greedily: time is bounded. With half of it one of more than 100 rows and as
/// many columns, and not only of more than 141, is cut, and targets close together may get one
/// another's bearings.
const MAX_CELLS: usize = 40_000;

/// A row and a column that may be paired, and the gain of that over leaving both alone.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pairing {
    pub(crate) row: usize,
    pub(crate) column: usize,
    pub(crate) gain: f64,
}

/// The column of each row that gets one, in the pairing of greatest total gain; a gain of 0 and
/// less is never chosen.
///
/// Candidates that touch no other's row or column decide themselves; only clusters of several are
/// solved as a whole, so the cost grows with the clusters and not with the site.
pub(crate) fn assign(candidates: &[Pairing]) -> BTreeMap<usize, usize> {
    clusters(candidates).iter().flat_map(|cluster| solve(cluster)).collect()
}

/// Groups of candidates that are linked through rows and columns.
fn clusters(candidates: &[Pairing]) -> Vec<Vec<Pairing>> {
    let mut leader: Vec<usize> = (0..candidates.len()).collect();
    fn find(leader: &mut [usize], mut i: usize) -> usize {
        while leader[i] != i {
            leader[i] = leader[leader[i]];
            i = leader[i];
        }
        i
    }
    let (mut rows, mut columns) = (BTreeMap::new(), BTreeMap::new());
    for (i, candidate) in candidates.iter().enumerate() {
        for first in
            [*rows.entry(candidate.row).or_insert(i), *columns.entry(candidate.column).or_insert(i)]
        {
            let (a, b) = (find(&mut leader, first), find(&mut leader, i));
            // Union-find: candidates that share a row or a column have one leader.
            leader[a.max(b)] = a.min(b);
        }
    }
    let mut clusters: BTreeMap<usize, Vec<Pairing>> = BTreeMap::new();
    for (i, candidate) in candidates.iter().enumerate().filter(|(_, c)| c.gain > 0.0) {
        clusters.entry(find(&mut leader, i)).or_default().push(*candidate);
    }
    clusters.into_values().collect()
}

fn solve(cluster: &[Pairing]) -> BTreeMap<usize, usize> {
    if let [only] = cluster {
        return BTreeMap::from([(only.row, only.column)]);
    }
    let rows = distinct(cluster.iter().map(|candidate| candidate.row));
    let columns = distinct(cluster.iter().map(|candidate| candidate.column));
    if rows.len() * (columns.len() + rows.len()) > MAX_CELLS {
        return greedy(cluster);
    }
    // Each row also has a column of its own where it gains nothing, so that it may stay alone.
    let mut gains = Matrix::new(rows.len(), columns.len() + rows.len(), 0i64);
    for candidate in cluster {
        let place = (rows.binary_search(&candidate.row), columns.binary_search(&candidate.column));
        if let (Ok(row), Ok(column)) = place {
            gains[(row, column)] = (candidate.gain * STEPS) as i64;
        }
    }
    let (_, column_of) = kuhn_munkres(&gains);
    let chosen = column_of.into_iter().enumerate();
    chosen
        .filter(|&(row, column)| column < columns.len() && gains[(row, column)] > 0)
        .map(|(row, column)| (rows[row], columns[column]))
        .collect()
}

/// Indices in ascending order, each once.
fn distinct(indices: impl Iterator<Item = usize>) -> Vec<usize> {
    let mut indices: Vec<usize> = indices.collect();
    indices.sort_unstable();
    indices.dedup();
    indices
}

fn greedy(cluster: &[Pairing]) -> BTreeMap<usize, usize> {
    // Equal gains in the order of rows and columns: that of the candidates must decide nothing.
    let mut by_gain = cluster.to_vec();
    by_gain.sort_by(|a, b| {
        b.gain.total_cmp(&a.gain).then(a.row.cmp(&b.row)).then(a.column.cmp(&b.column))
    });
    let (mut column_of, mut columns) = (BTreeMap::new(), BTreeSet::new());
    for Pairing { row, column, .. } in by_gain {
        if !column_of.contains_key(&row) && columns.insert(column) {
            column_of.insert(row, column);
        }
    }
    column_of
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(gains: &[(usize, usize, f64)]) -> Vec<(usize, usize)> {
        let candidate = |&(row, column, gain): &(usize, usize, f64)| Pairing { row, column, gain };
        assign(&gains.iter().map(candidate).collect::<Vec<_>>()).into_iter().collect()
    }

    #[test]
    fn the_total_counts_and_not_each_ones_best() {
        assert_eq!(all(&[(0, 0, 9.0), (0, 1, 8.0), (1, 0, 8.5), (1, 1, 1.0)]), [(0, 1), (1, 0)]);
    }

    #[test]
    fn what_gains_nothing_stays_alone() {
        assert_eq!(all(&[(0, 0, 1.0), (0, 1, -1.0), (1, 1, 0.0)]), [(0, 0)]);
        assert_eq!(all(&[(0, 0, -3.0)]), []);
        assert_eq!(all(&[]), []);
        assert_eq!(all(&[(7, 3, 0.5)]), [(7, 3)]);
    }

    #[test]
    fn a_cluster_too_large_is_cut_and_nobody_gets_two() {
        let side = 300;
        let gains: Vec<_> = (0..side)
            .flat_map(|r| (0..side).map(move |c| (r, c, 1.0 + ((r * 7 + c * 13) % 50) as f64)))
            .collect();
        let pairs = all(&gains);
        let columns: BTreeSet<usize> = pairs.iter().map(|p| p.1).collect();
        assert_eq!((pairs.len(), columns.len()), (side, side));
    }
}
