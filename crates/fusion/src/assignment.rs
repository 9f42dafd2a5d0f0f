use pathfinding::prelude::{Matrix, kuhn_munkres_min};

/// What a cost equal to the gate weighs; costs are quantised, as the solver wants an order.
const GATE_WEIGHT: i64 = 1 << 30;
/// What a forbidden pair weighs: more than leaving both alone.
const FORBIDDEN: i64 = 4 * GATE_WEIGHT;

/// The pairs (row, column) of least total cost; a pair costlier than `gate` stays apart.
///
/// `cost` gives `None` for a pair that cannot be.
pub(crate) fn assign(
    rows: usize,
    columns: usize,
    gate: f64,
    cost: impl Fn(usize, usize) -> Option<f64>,
) -> Vec<(usize, usize)> {
    if rows == 0 || columns == 0 {
        return Vec::new();
    }
    let weight = |row, column| match cost(row, column) {
        Some(cost) if cost <= gate => (cost / gate * GATE_WEIGHT as f64) as i64,
        _ => FORBIDDEN,
    };
    // Each row has a column of its own at the gate's price: it may stay alone.
    let weights = Matrix::from_fn(rows, columns + rows, |(row, column)| {
        if column < columns { weight(row, column) } else { GATE_WEIGHT }
    });
    let (_, column_of) = kuhn_munkres_min(&weights);
    let pairs = column_of.into_iter().enumerate();
    pairs.filter(|&(row, column)| column < columns && weights[(row, column)] < FORBIDDEN).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_total_counts_and_not_each_ones_best() {
        let costs = [[1.0, 2.0], [1.5, 9.0]];
        assert_eq!(assign(2, 2, 10.0, |r, c| Some(costs[r][c])), [(0, 1), (1, 0)]);
    }

    #[test]
    fn what_is_beyond_the_gate_stays_alone() {
        let costs = [[1.0, 50.0], [50.0, f64::NAN]];
        assert_eq!(assign(2, 2, 10.0, |r, c| Some(costs[r][c])), [(0, 0)]);
        assert_eq!(assign(1, 1, 10.0, |_, _| None), []);
        assert_eq!(assign(3, 0, 10.0, |_, _| Some(0.0)), []);
    }
}
