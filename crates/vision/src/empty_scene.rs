//! What the scene itself has at the places where a lost target is searched for: where the scene
//! alone already looks like the target, as a mast does to the reference of a target beside one, a
//! likeness says nothing.

use crossfix_correlation::Plane;

use crate::ImagePoint;
use crate::scene_turn::SceneTurn;
use crate::search_area::{SearchArea, middle_of};
use crate::uneven_turn;

/// What the scene looks like to a target's reference, in a picture in which it is known where the
/// target was.
#[derive(Clone, Debug)]
pub(crate) struct Background {
    coarseness: usize,
    /// The log likelihood ratios of the picture, made coarser, where they are above 0; 0 where
    /// targets were, whose own they are.
    ratios: Plane,
    /// `SceneMemory::turned` when the picture was taken.
    turned: SceneTurn,
}

/// Memory for the [`EmptyScene`], which all targets share.
#[derive(Debug, Default)]
pub(crate) struct EmptySceneBuffers {
    widened: Plane,
    between: Plane,
}

/// The scene without the target, as it may be in an image.
pub(crate) struct EmptyScene<'a> {
    /// Log likelihood ratios in the picture that was taken of it.
    ratios: &'a Plane,
    /// Where what is in the image now was in that picture.
    turn: SceneTurn,
    coarseness: usize,
}

impl Background {
    /// What the log likelihood ratios of a picture say of the scene, in which all targets were
    /// `seen`; with `SceneMemory::turned` when it was taken.
    pub(crate) fn new(
        ratios: &Plane,
        area: &SearchArea,
        seen: &[ImagePoint],
        turned: SceneTurn,
    ) -> Self {
        let mut ratios = ratios.clone();
        ratios.samples_mut().iter_mut().for_each(|ratio| *ratio = ratio.max(0.0));
        for [columns, rows] in seen.iter().map(|seen| area.cells_hidden_by(*seen)) {
            for row in rows {
                ratios.row_mut(row)[columns.clone()].fill(0.0);
            }
        }
        Self { coarseness: area.coarseness, ratios, turned }
    }

    pub(crate) fn coarseness(&self) -> usize {
        self.coarseness
    }

    /// What the scene has in an image, of which `SceneMemory::turned` is given: the greatest of
    /// what it had within the reach of the turn since, to the nearest cell.
    pub(crate) fn seen_at<'a>(
        &'a self,
        turned: SceneTurn,
        buffers: &'a mut EmptySceneBuffers,
    ) -> EmptyScene<'a> {
        let turn = turned.and_then(self.turned.inverse());
        let middle = [self.ratios.width(), self.ratios.height()].map(|n| (n as f64 - 1.0) / 2.0);
        let [x, y] = middle.map(|cell| middle_of(cell, self.coarseness));
        let reach_px = uneven_turn::reach_px(turn.moves(ImagePoint { x, y }));
        let reach = (reach_px / self.coarseness as f64).round() as usize;
        let ratios = if reach > 0 { buffers.widened(&self.ratios, reach) } else { &self.ratios };
        EmptyScene { ratios, turn, coarseness: self.coarseness }
    }
}

impl EmptySceneBuffers {
    /// The greatest of a plane within `reach` columns and rows of each place. It costs 3.7 ms for
    /// 1280x720 cells and a reach of 16, when a target of less than 10 px is searched for.
    fn widened(&mut self, plane: &Plane, reach: usize) -> &Plane {
        let Self { widened, between } = self;
        widened.copy_from(plane);
        between.reshape(plane.width(), plane.height());
        let last = plane.height().saturating_sub(1);
        let mut reached = 0;
        // The greatest within r of three places, each 2 r + 1 from the next, is that within 3 r + 1
        // of the middle one. A place beyond the border is replaced by the nearest within.
        while reached < reach {
            let step = (2 * reached + 1).min(reach - reached);
            for y in 0..plane.height() {
                take_greatest_beside(widened.row(y), step, between.row_mut(y));
            }
            for y in 0..plane.height() {
                let to = widened.row_mut(y);
                to.copy_from_slice(between.row(y));
                take_greatest(between.row(y.saturating_sub(step)), to);
                take_greatest(between.row((y + step).min(last)), to);
            }
            reached += step;
        }
        widened
    }
}

/// The greatest of each value of a row and of those `step` before and after it, beyond its ends of
/// the first and the last.
fn take_greatest_beside(row: &[f32], step: usize, to: &mut [f32]) {
    to.copy_from_slice(row);
    let (Some(first), Some(last)) = (row.first(), row.last()) else { return };
    let inside = row.len().saturating_sub(step);
    let beside = row.len() - inside;
    take_greatest(&row[beside..], &mut to[..inside]);
    to[inside..].iter_mut().for_each(|to| *to = to.max(*last));
    take_greatest(&row[..inside], &mut to[beside..]);
    to[..beside].iter_mut().for_each(|to| *to = to.max(*first));
}

fn take_greatest(values: &[f32], to: &mut [f32]) {
    for (to, value) in to.iter_mut().zip(values) {
        *to = to.max(*value);
    }
}

impl EmptyScene<'_> {
    /// The scene's own ratio in a cell; 0 where it is unlike the target, and where targets were.
    /// What the picture did not show has what its nearest border had: taken as 0, what comes into
    /// the image is sooner found for the target (a drone before a camera that turns over spots was
    /// covered in 68 % of the images instead of 86).
    pub(crate) fn at(&self, [column, row]: [usize; 2]) -> f32 {
        let [column, row] = self.then([column, row]).map(|at| at.round() as isize);
        self.ratios.clamped(column, row)
    }

    /// Where the middle of a cell was, in cells.
    fn then(&self, cell: [usize; 2]) -> [f64; 2] {
        let [x, y] = cell.map(|cell| middle_of(cell as f64, self.coarseness));
        let then = self.turn.place(ImagePoint { x, y });
        let first = middle_of(0.0, self.coarseness);
        [then.x, then.y].map(|at| (at - first) / self.coarseness as f64)
    }

    /// Subtracts the scene's own ratios: the reference found this much of the target in the empty
    /// scene already.
    pub(crate) fn subtract_from(&self, ratios: &mut Plane) {
        let last = [self.ratios.width(), self.ratios.height()].map(|side| side as f32 - 1.0);
        for y in 0..ratios.height() {
            let ([first, next], row) = ([0, 1].map(|x| self.then([x, y])), ratios.row_mut(y));
            let step = [0, 1].map(|i| (next[i] - first[i]) as f32);
            // Half a cell is added, so that the conversion rounds.
            let first = first.map(|at| at as f32 + 0.5);
            for (x, ratio) in row.iter_mut().enumerate() {
                let [column, row] =
                    [0, 1].map(|i| (first[i] + x as f32 * step[i]).clamp(0.0, last[i]) as usize);
                *ratio -= self.ratios.row(row)[column];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// A scene in cells of two pixels. A target seen in it hides columns 6 to 10 and rows 6 to 8;
    /// the scene had turned by 1 and 2 px then.
    fn background() -> Background {
        let area = SearchArea::with_sides([20, 15], [5, 3], 2);
        let ratios = Plane::from_fn(20, 15, |x, y| (x + 100 * y) as f32 - 10.0);
        Background::new(
            &ratios,
            &area,
            &[ImagePoint { x: 16.0, y: 14.0 }],
            SceneTurn::shift([1.0, 2.0]),
        )
    }

    fn then([x, y]: [isize; 2]) -> f32 {
        let is_hidden = (6..=10).contains(&x) && (6..=8).contains(&y);
        if is_hidden { 0.0 } else { ((x + 100 * y) as f32 - 10.0).max(0.0) }
    }

    /// Each cell has the greatest of what was about its place then; beyond the border, what was
    /// about the place nearest to it.
    fn assert_moved(turned: [f64; 2], by: [isize; 2], reach: isize) {
        let (background, mut buffers) = (background(), EmptySceneBuffers::default());
        let empty = background.seen_at(SceneTurn::shift(turned), &mut buffers);
        let mut ratios = Plane::from_fn(20, 15, |_, _| 5000.0);
        empty.subtract_from(&mut ratios);
        for (row, column) in (0..15).flat_map(|row| (0..20).map(move |column| (row, column))) {
            let about = |at: isize, last: isize| {
                let nearest = at.clamp(0, last);
                (nearest - reach).max(0)..=(nearest + reach).min(last)
            };
            let [x, y] = [about(column + by[0], 19), about(row + by[1], 14)];
            let within = y.flat_map(|y| x.clone().map(move |x| then([x, y])));
            let was = within.fold(0.0, f32::max);
            let cell = [column as usize, row as usize];
            assert_eq!(empty.at(cell), was, "{turned:?}: column {column}, row {row}");
            assert_eq!(ratios.row(cell[1])[cell[0]], 5000.0 - was, "{turned:?}: {cell:?}");
        }
    }

    #[test]
    fn the_scene_moves_as_the_camera_turns_and_what_the_target_hid_is_unknown() {
        assert_moved([1.0, 2.0], [0, 0], 0);
        assert_moved([3.1, -0.1], [1, -1], 0);
    }

    #[test]
    fn a_cell_that_has_rolled_has_what_was_there() {
        let (background, mut buffers) = (background(), EmptySceneBuffers::default());
        // About the middle of the cell (10, 7): what is five cells to the right was three to the
        // right and four down.
        let about = ImagePoint { x: 20.5, y: 14.5 };
        let turned = SceneTurn::about(about, [0.0; 2], 0.6 - 1.0, 0.8)
            .and_then(SceneTurn::shift([1.0, 2.0]));
        let empty = background.seen_at(turned, &mut buffers);
        let mut ratios = Plane::from_fn(20, 15, |_, _| 5000.0);
        empty.subtract_from(&mut ratios);
        for ([x, y], was) in [([10, 7], [10, 7]), ([15, 7], [13, 11]), ([0, 12], [0, 2])] {
            assert_eq!(empty.at([x, y]), then(was), "{x}, {y}");
            assert_eq!(ratios.row(y)[x], 5000.0 - then(was), "{x}, {y}");
        }
    }

    #[test]
    fn after_a_turn_the_greatest_within_its_reach_counts() {
        // A fifth of a turn by 10 px is a cell, of one by 17 px 1.7 cells.
        assert_moved([11.0, 2.0], [5, 0], 1);
        assert_moved([-9.0, 2.0], [-5, 0], 1);
        assert_moved([1.0, -14.9], [0, -8], 2);
    }

    #[test]
    fn a_widened_plane_has_the_greatest_within_reach() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut buffers = EmptySceneBuffers::default();
        for (width, height) in [(1, 1), (20, 1), (3, 15), (20, 15)] {
            let plane = Plane::from_fn(width, height, |_, _| rng.random_range(0.0..1.0));
            for reach in 1..=16 {
                let widened = buffers.widened(&plane, reach);
                for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
                    let about =
                        |at: usize, side| at.saturating_sub(reach)..(at + reach + 1).min(side);
                    let within = about(y, height)
                        .flat_map(|row| plane.row(row)[about(x, width)].iter().copied());
                    let greatest = within.fold(0.0, f32::max);
                    assert_eq!(widened.row(y)[x], greatest, "{width}x{height}, {reach}: {x}, {y}");
                }
            }
        }
    }
}
