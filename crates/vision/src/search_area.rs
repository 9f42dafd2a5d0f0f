//! The area of a coarse picture in which a lost target is searched for: its cells, how likely each
//! is before the picture is looked at, and what the scene without the target looked like there.

use std::ops::Range;

use crossfix_correlation::Plane;

use crate::lanes::greatest;
use crate::scratch::Scratch;
use crate::search_memory::SearchMemory;
use crate::state::TargetBelief;
use crate::{ImagePoint, TrackerConfig};

/// The best placement on the coarse picture.
#[derive(Clone, Copy)]
pub(crate) struct BestCell {
    /// Its column and row.
    pub(crate) cell: [usize; 2],
    /// Its log likelihood ratio, less that of the next best place.
    pub(crate) margin: f32,
}

/// Prior of a lost target's place, per px^2: `(1 - a) N(place; predicted, variances) + a / area`,
/// with a the share that is anywhere.
pub(crate) struct AreaPrior {
    predicted: [f64; 2],
    variances: [f64; 2],
    /// Greatest density of the first part, and the density of the second.
    near: f64,
    anywhere: f64,
}

impl AreaPrior {
    pub(crate) fn density(&self, place: [f64; 2]) -> f64 {
        let off = [0, 1].map(|i| (place[i] - self.predicted[i]).powi(2) / self.variances[i]);
        self.near * (-0.5 * (off[0] + off[1])).exp() + self.anywhere
    }

    /// The greatest density.
    fn most(&self) -> f64 {
        self.near + self.anywhere
    }
}

/// The scene without the target, as a search sees it.
pub(crate) struct EmptyScene<'a> {
    /// The scene's own log likelihood ratios, in the picture that was taken of it.
    ratios: &'a Plane,
    /// By how many cells it has moved since.
    by: [isize; 2],
    /// Columns and rows of the cells that the target hid then.
    hidden: [Range<usize>; 2],
}

impl EmptyScene<'_> {
    /// The scene's own ratio in a cell; 0 where the target hid it, and where it is unlike the
    /// target.
    pub(crate) fn at(&self, [column, row]: [usize; 2]) -> f32 {
        if self.hidden[0].contains(&column) && self.hidden[1].contains(&row) {
            return 0.0;
        }
        let [column, row] = [0, 1].map(|i| ([column, row][i] as isize).saturating_add(self.by[i]));
        self.ratios.clamped(column, row).max(0.0)
    }

    /// Subtracts the scene's own ratios: the reference found this much of the target in the empty
    /// scene already.
    pub(crate) fn subtract_from(&self, ratios: &mut Plane) {
        let last = [self.ratios.width(), self.ratios.height()].map(|side| side as isize - 1);
        let width = ratios.width();
        for y in 0..ratios.height() {
            let scene =
                self.ratios.row((y as isize).saturating_add(self.by[1]).clamp(0, last[1]) as usize);
            let hidden = if self.hidden[1].contains(&y) { self.hidden[0].clone() } else { 0..0 };
            let row = ratios.row_mut(y);
            for columns in [0..hidden.start, hidden.end..width] {
                for (x, ratio) in columns.clone().zip(&mut row[columns]) {
                    let column = (x as isize).saturating_add(self.by[0]).clamp(0, last[0]) as usize;
                    *ratio -= scene[column].max(0.0);
                }
            }
        }
    }
}

/// The area in which a target is searched for.
pub(crate) struct SearchArea {
    /// Columns and rows of the coarse picture.
    pub(crate) ranges: [Range<usize>; 2],
    /// The predicted place, and the half sides of the area about it, px of the full picture.
    predicted: [f64; 2],
    half: [f64; 2],
    /// Sides of the reference, px.
    sides: [usize; 2],
    pub(crate) coarseness: usize,
}

impl SearchArea {
    /// All of a coarse picture of these sides.
    pub(crate) fn whole(state: &TargetBelief, picture: [usize; 2], coarseness: usize) -> Self {
        let working = state.appearance.working.image();
        let position = state.position();
        Self {
            ranges: picture.map(|side| 0..side),
            predicted: [position.x, position.y],
            half: picture.map(|side| (side * coarseness) as f64 / 2.0),
            sides: [working.width(), working.height()],
            coarseness,
        }
    }

    /// What is about the predicted place: the more, the longer the target has not been seen.
    pub(crate) fn about(
        state: &TargetBelief,
        image: &Plane,
        coarseness: usize,
        config: &TrackerConfig,
    ) -> Self {
        let half = state.search_half_sides(image, config);
        let picture = [image.width(), image.height()].map(|side| side / coarseness);
        let whole = Self::whole(state, picture, coarseness);
        let side = coarseness as f64;
        let ranges = [0, 1].map(|i| {
            let last = picture[i] - 1;
            let first = (((whole.predicted[i] - half[i]) / side).max(0.0) as usize).min(last);
            let end = (((whole.predicted[i] + half[i]) / side).max(0.0) as usize + 1).min(last);
            first..end.max(first) + 1
        });
        Self { ranges, half, ..whole }
    }

    /// Half sides of a peak, places of the coarse picture.
    pub(crate) fn near(&self) -> [usize; 2] {
        self.sides.map(|side| ((side / self.coarseness) / 4).max(2))
    }

    pub(crate) fn prior(&self, state: &TargetBelief, config: &TrackerConfig) -> AreaPrior {
        let variances = state.motion.found().map(|found| found.variance);
        let density = 1.0 / (std::f64::consts::TAU * (variances[0] * variances[1]).sqrt());
        let share = state.anywhere(config);
        let area = (2.0 * self.half[0] + 1.0) * (2.0 * self.half[1] + 1.0);
        AreaPrior {
            predicted: self.predicted,
            variances,
            near: (1.0 - share) * density,
            anywhere: share / area,
        }
    }

    /// The likeliest place, by the log likelihood ratios in `scratch.ratios`.
    pub(crate) fn best_cell(&self, prior: &AreaPrior, scratch: &Scratch) -> BestCell {
        let Self { ranges, .. } = self;
        let (mut best, mut most) = ([0, 0], f64::NEG_INFINITY);
        let most_prior = prior.most().ln();
        for (y, row) in ranges[1].clone().enumerate() {
            let ratios = scratch.ratios.row(y);
            // If even the largest prior does not reach the best, the row and the logarithm are
            // spared.
            if f64::from(greatest(ratios)) + most_prior <= most {
                continue;
            }
            for (x, column) in ranges[0].clone().enumerate() {
                let ratio = f64::from(ratios[x]);
                if ratio + most_prior <= most {
                    continue;
                }
                let score = ratio + prior.density([self.middle(column), self.middle(row)]).ln();
                if score > most {
                    (best, most) = ([x, y], score);
                }
            }
        }
        let near = self.near();
        // The next best place, away from the best, for the margin.
        let mut rival = f32::NEG_INFINITY;
        for y in 0..scratch.ratios.height() {
            let row = scratch.ratios.row(y);
            let beside = if y.abs_diff(best[1]) > near[1] {
                greatest(row)
            } else {
                let before = &row[..best[0].saturating_sub(near[0])];
                let after = &row[(best[0] + near[0] + 1).min(row.len())..];
                greatest(before).max(greatest(after))
            };
            rival = rival.max(beside);
        }
        let (column, row) = (ranges[0].start + best[0], ranges[1].start + best[1]);
        BestCell { cell: [column, row], margin: scratch.ratios.row(best[1])[best[0]] - rival }
    }

    /// What the scene itself had at the places of a coarse picture with these sides, given how it
    /// has turned by now, and where the target was `seen` in the picture that was taken of it;
    /// `None` if nothing is known of it.
    pub(crate) fn empty_scene<'a>(
        &self,
        picture: [usize; 2],
        turned: [f64; 2],
        seen: ImagePoint,
        memory: &'a SearchMemory,
    ) -> Option<EmptyScene<'a>> {
        let background = memory.background.as_ref()?;
        let shift = [0, 1].map(|i| turned[i] - background.turned[i]);
        let seen = [seen.x, seen.y];
        let hidden =
            [0, 1].map(|i| self.hidden(picture[i], self.sides[i] as f64, shift[i], seen[i]));
        let by = shift.map(|shift| (shift / self.coarseness as f64).round() as isize);
        Some(EmptyScene { ratios: &background.ratios, by, hidden })
    }

    /// The columns (or rows) of `count` that a target hides which is `seen` there and reaches as
    /// far as `reach`, px, when they have moved by `shift`, px.
    fn hidden(&self, count: usize, reach: f64, shift: f64, seen: f64) -> Range<usize> {
        let off = |index: usize| self.middle(index) + shift - seen;
        let first = (0..count).find(|index| off(*index) >= -reach).unwrap_or(count);
        let end = (first..count).find(|index| off(*index) > reach);
        first..end.unwrap_or(count)
    }

    /// The middle of a cell of the coarse picture, px of the full picture.
    pub(crate) fn place_of(&self, cell: [usize; 2]) -> [f64; 2] {
        cell.map(|index| self.middle(index))
    }

    /// The middle of a column or row of the coarse picture, px of the full picture.
    pub(crate) fn middle(&self, index: usize) -> f64 {
        let side = self.coarseness as f64;
        index as f64 * side + (side - 1.0) / 2.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search_memory::Background;

    #[test]
    fn the_empty_scene_is_subtracted_where_it_has_moved_to_and_not_where_the_target_hid_it() {
        let scene = Plane::from_fn(7, 5, |x, y| (x + 10 * y) as f32 - 12.0);
        let hidden = [2..4, 1..3];
        let empty = EmptyScene { ratios: &scene, by: [2, -1], hidden };
        let mut ratios = Plane::from_fn(7, 5, |_, _| 100.0);
        empty.subtract_from(&mut ratios);
        for (row, column) in (0..5).flat_map(|row| (0..7).map(move |column| (row, column))) {
            let left = 100.0 - empty.at([column, row]);
            assert_eq!(ratios.row(row)[column], left, "column {column}, row {row}");
        }
        // Cell (1, 3) was cell (3, 2) then: 3 + 20 - 12.
        assert_eq!(empty.at([1, 3]), 11.0);
        assert_eq!(empty.at([2, 2]), 0.0, "the target hid it");
        assert_eq!(empty.at([6, 0]), 0.0, "unlike the target: 6 - 12");
    }

    /// A cell is where the scene had its middle then, by the turns of the scene.
    #[test]
    fn the_empty_scene_moves_as_the_camera_turns_and_hides_what_the_target_hid() {
        let area = SearchArea {
            ranges: [0..20, 0..15],
            predicted: [20.0, 15.0],
            half: [20.0, 15.0],
            sides: [5, 3],
            coarseness: 2,
        };
        let ratios = Plane::from_fn(20, 15, |x, y| 1.0 + (x + 100 * y) as f32);
        let background = Background { coarseness: 2, ratios, turned: [1.0, 2.0] };
        let mut memory = SearchMemory::default();
        memory.background = Some(background);
        let seen = ImagePoint { x: 16.0, y: 14.0 };
        let (turned, sides) = ([7.3, -1.6], [20, 15]);
        let empty = area.empty_scene(sides, turned, seen, &memory).unwrap();
        for (row, column) in (0..15).flat_map(|row| (0..20).map(move |column| (row, column))) {
            let then = [area.middle(column) + 6.3, area.middle(row) - 3.6];
            let hidden = (then[0] - seen.x).abs() <= 5.0 && (then[1] - seen.y).abs() <= 3.0;
            let [x, y] = then.map(|then| ((then + 0.5) / 2.0 - 0.5).round());
            let was = 1.0 + (x.clamp(0.0, 19.0) + 100.0 * y.clamp(0.0, 14.0)) as f32;
            let expected = if hidden { 0.0 } else { was };
            assert_eq!(empty.at([column, row]), expected, "column {column}, row {row}");
        }
    }
}
