//! The area of a coarse picture in which a lost target is searched for: its cells, how likely each
//! is before the picture is looked at.

use std::ops::Range;

use crossfix_correlation::Plane;

use crate::lanes::greatest;
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

    /// All of a coarse picture of these sides, for a reference with sides in px, where nothing is
    /// predicted.
    #[cfg(test)]
    pub(crate) fn with_sides(picture: [usize; 2], sides: [usize; 2], coarseness: usize) -> Self {
        let ranges = picture.map(|side| 0..side);
        Self { ranges, predicted: [0.0; 2], half: [1.0; 2], sides, coarseness }
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

    /// The likeliest place, by the log likelihood ratios of its cells.
    pub(crate) fn best_cell(&self, prior: &AreaPrior, log_ratios: &Plane) -> BestCell {
        let Self { ranges, .. } = self;
        let (mut best, mut most) = ([0, 0], f64::NEG_INFINITY);
        let most_prior = prior.most().ln();
        for (y, row) in ranges[1].clone().enumerate() {
            let ratios = log_ratios.row(y);
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
        for y in 0..log_ratios.height() {
            let row = log_ratios.row(y);
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
        BestCell { cell: [column, row], margin: log_ratios.row(best[1])[best[0]] - rival }
    }

    /// Columns and rows of the cells in which a target is, or hides what is there, that is `seen`.
    pub(crate) fn cells_hidden_by(&self, seen: ImagePoint) -> [Range<usize>; 2] {
        let seen = [seen.x, seen.y];
        [0, 1].map(|i| {
            let Range { start, end } = self.ranges[i].clone();
            let off = |index: &usize| self.middle(*index) - seen[i];
            let reach = self.sides[i] as f64;
            let first = (start..end).find(|index| off(index) >= -reach).unwrap_or(end);
            first..(first..end).find(|index| off(index) > reach).unwrap_or(end)
        })
    }

    /// The middle of a cell of the coarse picture, px of the full picture.
    pub(crate) fn place_of(&self, cell: [usize; 2]) -> [f64; 2] {
        cell.map(|index| self.middle(index))
    }

    /// The middle of a column or row of the coarse picture, px of the full picture.
    pub(crate) fn middle(&self, index: usize) -> f64 {
        middle_of(index as f64, self.coarseness)
    }
}

/// The middle of a column or row of a picture with pixels of `coarseness` px, px of the image.
pub(crate) fn middle_of(index: f64, coarseness: usize) -> f64 {
    let side = coarseness as f64;
    index * side + (side - 1.0) / 2.0
}
