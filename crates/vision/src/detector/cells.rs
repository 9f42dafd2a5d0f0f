//! Which cells known targets cover, and which are in view.

use std::ops::Range;

use super::filter::SURROUNDINGS;
use super::straight::Straightening;

/// A range of cells: from the first to before the second, in columns and in rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Cells {
    pub(super) columns: [usize; 2],
    pub(super) rows: [usize; 2],
}

impl Cells {
    /// Whether the range is in a cell's surroundings: what covers it may stand out there.
    pub(super) fn are_near(&self, [x, y]: [usize; 2]) -> bool {
        is_near(x, self.columns) && is_near(y, self.rows)
    }
}

/// Whether a column or row is in a range or within a cell's surroundings of it.
fn is_near(at: usize, [from, to]: [usize; 2]) -> bool {
    at + SURROUNDINGS >= from && at < to.saturating_add(SURROUNDINGS)
}

/// Which of a scale's cells are in view.
#[derive(Debug, Default)]
pub(super) struct CellsInView {
    /// Whether all are.
    are_all: bool,
    /// Number of cells in a row.
    width: usize,
    /// Those in view, row by row.
    rows: Vec<Range<usize>>,
}

impl CellsInView {
    /// Notes which cells of a scale, with cells of `cell` px, a view shows, but for a margin,
    /// cells.
    pub(super) fn see(
        &mut self,
        view: Straightening,
        [width, height]: [usize; 2],
        cell: usize,
        margin: usize,
    ) {
        (self.are_all, self.width) = (view.is_none() && margin == 0, width);
        let inner = |count: usize| margin..count.saturating_sub(margin).max(margin);
        self.rows.clear();
        self.rows.extend((0..height).map(|row| {
            if !inner(height).contains(&row) {
                return 0..0;
            }
            let (shown, inner) = (view.cells_in_view(row, width, cell), inner(width));
            let from = shown.start.max(inner.start);
            from..shown.end.min(inner.end).max(from)
        }));
    }

    /// Whether a cell is in view, by its number among all.
    pub(super) fn hold(&self, cell: usize) -> bool {
        self.are_all || self.rows[cell / self.width].contains(&(cell % self.width))
    }

    /// The cells of a row that are in view.
    pub(super) fn of_row(&self, row: usize) -> Range<usize> {
        self.rows[row].clone()
    }
}

/// The parts of a row that no known target covers.
pub(super) fn free_of(known: &[Cells], row: usize, width: usize) -> Vec<[usize; 2]> {
    let in_row = known.iter().filter(|cells| (cells.rows[0]..cells.rows[1]).contains(&row));
    let mut covered: Vec<[usize; 2]> = in_row.map(|cells| cells.columns).collect();
    covered.sort_unstable();
    covered.push([width, width]);
    let mut at = 0;
    let mut free = Vec::with_capacity(covered.len());
    for [from, to] in covered {
        if from.min(width) > at {
            free.push([at, from.min(width)]);
        }
        at = at.max(to);
    }
    free
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_free_of_a_row_is_between_what_is_known() {
        let known = [
            Cells { columns: [5, 8], rows: [0, 4] },
            Cells { columns: [2, 6], rows: [3, 9] },
            Cells { columns: [15, 40], rows: [3, 4] },
        ];
        assert_eq!(free_of(&known, 3, 20), [[0, 2], [8, 15]]);
        assert_eq!(free_of(&known, 2, 20), [[0, 5], [8, 20]]);
        assert_eq!(free_of(&known, 10, 20), [[0, 20]]);
    }
}
