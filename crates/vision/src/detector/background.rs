//! The background of one scale: how much each cell of the scene stands out, learnt over the last
//! seconds.

use crossfix_correlation::Plane;

use super::cell_update::{BackgroundRow, CellUpdate};
use super::cells::{Cells, CellsInView, free_of};
use super::filter::{SURROUNDINGS, between, clear_beyond, clear_border, moved, resample};
use super::straight::Straightening;
use super::{WARM_UP_IMAGES, WARM_UP_S};
use crate::ImagePoint;
use crate::scene_turn::SceneTurn;

/// Cells at the border that are not learnt once the camera has turned: those whose surroundings are
/// cut off. With half of it 1.3 more tracks per minute are begun on what comes into a panning
/// thermal camera's view.
pub(super) const MARGIN: usize = SURROUNDINGS;

/// What stands out of one scale of the scene, and how that varies.
///
/// Its cells are fixed to the scene: when the camera turns they move over the image by whole cells,
/// and for the rest the straightened image is sampled between its own cells. From then on a cell is
/// learnt only where all of its surroundings are in view.
#[derive(Debug)]
pub(super) struct Background {
    /// Side of a cell, px.
    cell: usize,
    /// Mean and variance of by how much the cells stand out, levels.
    pub(super) mean: Plane,
    pub(super) variance: Plane,
    /// From how many images each cell has been learnt, and how many there were.
    learnt_images: Plane,
    images: f32,
    /// How the latest image lies against that to which the cells are fixed, and which of a row's
    /// cells are in view.
    view: Straightening,
    in_view: CellsInView,
    /// Shift of the cells against the straightened image, in cells: the whole ones, and the rest.
    whole: [isize; 2],
    rest: [f32; 2],
    /// Whether the cells have ever moved over the image.
    has_moved: bool,
    scratch: Plane,
    textures: Vec<f32>,
}

impl Background {
    pub(super) fn new(cell: usize) -> Self {
        Self {
            cell,
            mean: Plane::default(),
            variance: Plane::default(),
            learnt_images: Plane::default(),
            images: 0.0,
            view: Straightening::new(SceneTurn::none(), [0; 2]),
            in_view: CellsInView::default(),
            whole: [0; 2],
            rest: [0.0; 2],
            has_moved: false,
            scratch: Plane::default(),
            textures: Vec::new(),
        }
    }

    /// Begins it with so many cells, of which nothing is known.
    pub(super) fn begin(&mut self, [width, height]: [usize; 2]) {
        self.images = 0.0;
        for plane in [&mut self.mean, &mut self.variance, &mut self.learnt_images] {
            plane.reshape(width, height);
            plane.samples_mut().fill(0.0);
        }
    }

    /// Whether the scene has turned since the background was begun.
    pub(super) fn has_turned(&self) -> bool {
        self.has_moved || self.rest != [0.0; 2] || !self.view.is_none()
    }

    /// Where the middle of a cell is in the image, px, and where that was in the image to which the
    /// cells are fixed.
    pub(super) fn place_of(&self, cell: [f64; 2]) -> (ImagePoint, [f64; 2]) {
        let side = self.cell as f64;
        let [x, y] = [0, 1].map(|i| (cell[i] - f64::from(self.rest[i]) + 0.5) * side - 0.5);
        let straight = ImagePoint { x, y };
        (self.view.in_image(straight), self.view.in_scene(straight))
    }

    /// A place of the straightened image in cells, whose middles are the whole numbers.
    fn cell_of(&self, ImagePoint { x, y }: ImagePoint) -> [f64; 2] {
        let place = [x, y];
        [0, 1].map(|i| (place[i] + 0.5) / self.cell as f64 - 0.5 + f64::from(self.rest[i]))
    }

    /// The cells in which what has its corners at these places of the straightened image is.
    pub(super) fn cells_between(&self, corners: [ImagePoint; 2]) -> Cells {
        let [first, last] = corners.map(|corner| self.cell_of(corner).map(f64::round));
        let range =
            |axis: usize| [first[axis].max(0.0) as usize, (last[axis] + 1.0).max(0.0) as usize];
        Cells { columns: range(0), rows: range(1) }
    }

    /// By how much a place of the image stands out in the mean, levels.
    pub(super) fn mean_at(&self, place: ImagePoint) -> f32 {
        between(&self.mean, self.cell_of(self.view.straight(place)))
    }

    /// Whether a cell has been learnt from at least so many images.
    pub(super) fn has_learnt(&self, [x, y]: [usize; 2], least_images: f32) -> bool {
        self.learnt_images.row(y)[x] >= least_images
    }

    /// From how many images a cell must have been learnt to be known: as many as warm up the whole,
    /// or as many as there were.
    pub(super) fn least_known(&self, usual_interval: f64) -> f32 {
        let images = (WARM_UP_S / usual_interval).max(f64::from(WARM_UP_IMAGES)) as f32;
        images.min(self.images)
    }

    /// Whether a cell, by its number, is in view and has been learnt from a few images, or from all
    /// that there were: what it changes by says something of the whole image.
    pub(super) fn is_telling(&self, cell: usize) -> bool {
        let least = (WARM_UP_IMAGES as f32).min(self.images);
        self.in_view.hold(cell) && self.learnt_images.samples()[cell] >= least
    }

    /// Moves the cells to where the scene is in a view.
    pub(super) fn turn_to(&mut self, view: Straightening) {
        let cells = view.shift().map(|shift| shift / self.cell as f64);
        // They move by whole cells: interpolated at every turn the background would be blurred more
        // and more. The image is interpolated instead, by the rest, and only once.
        let whole = cells.map(|cells| cells.round() as isize);
        let by = [0, 1].map(|i| whole[i] - self.whole[i]);
        self.rest = [0, 1].map(|i| (cells[i] - whole[i] as f64) as f32);
        (self.view, self.whole) = (view, whole);
        if !self.has_moved && (by != [0, 0] || !view.is_none()) {
            // What has been learnt at the border had its surroundings cut off by it.
            clear_border(&mut self.learnt_images, MARGIN);
            self.has_moved = true;
        }
        if by != [0, 0] {
            for plane in [&mut self.mean, &mut self.variance, &mut self.learnt_images] {
                moved(plane, by, &mut self.scratch);
                std::mem::swap(plane, &mut self.scratch);
            }
            clear_beyond(&mut self.learnt_images, by);
        }
        let sides = [self.mean.width(), self.mean.height()];
        let margin = if self.has_moved { MARGIN } else { 0 };
        self.in_view.see(view, sides, self.cell, margin);
    }

    /// From now on the cells are those of the image that this view is of. They count as learnt from
    /// as many images as make them known: a scene that is zoomed stands out of other surroundings.
    pub(super) fn fix_to(&mut self, view: Straightening, usual_interval: f64) {
        let most = self.least_known(usual_interval);
        self.turn_to(view);
        let [width, height] = [self.mean.width(), self.mean.height()];
        let middle = |at: usize| (at as f64 + 0.5) * self.cell as f64 - 0.5;
        // Where the middle of a cell of the image is in the cells until now.
        let was = |x: usize, y: usize| {
            self.cell_of(view.straight(ImagePoint { x: middle(x), y: middle(y) }))
        };
        // As long as the youngest of the four cells between which it was; 0 beyond the border.
        let learnt_images = Plane::from_fn(width, height, |x, y| {
            let [first, last] = [f64::floor, f64::ceil].map(|round| was(x, y).map(round));
            let is_in = |at: f64, count: usize| (0.0..count as f64).contains(&at);
            let corners = [first, [first[0], last[1]], [last[0], first[1]], last];
            let of = |[column, row]: [f64; 2]| {
                let is_in = is_in(column, width) && is_in(row, height);
                if is_in { self.learnt_images.row(row as usize)[column as usize] } else { 0.0 }
            };
            corners.map(of).into_iter().fold(most, f32::min)
        });
        let mean = Plane::from_fn(width, height, |x, y| between(&self.mean, was(x, y)));
        let variance = Plane::from_fn(width, height, |x, y| between(&self.variance, was(x, y)));
        (self.learnt_images, self.mean, self.variance) = (learnt_images, mean, variance);
        (self.whole, self.rest, self.has_moved) = ([0; 2], [0.0; 2], true);
    }

    /// Fills `now` with by how much the cells stand out in the straightened image, from its own,
    /// which are lost.
    pub(super) fn sample(&self, stands_out: &mut Plane, now: &mut Plane) {
        if self.rest == [0.0; 2] {
            std::mem::swap(now, stands_out);
        } else {
            // Cell i lies at i - rest in the image's cells.
            resample(stands_out, self.rest.map(|rest| -rest), now);
        }
    }

    /// Takes in by how much the cells stand out `now`, except those that `known` covers, and fills
    /// `change` with how far that is from the mean, in standard deviations; 0 where it is not
    /// known.
    pub(super) fn learn(
        &mut self,
        now: &Plane,
        update: CellUpdate,
        known: &[Cells],
        change: &mut Plane,
    ) {
        self.images += 1.0;
        let (width, height) = (now.width(), now.height());
        change.reshape(width, height);
        for y in 0..height {
            let (above, below) =
                (self.mean.row(y.saturating_sub(1)), self.mean.row((y + 1).min(height - 1)));
            update.textures(above, self.mean.row(y), below, &mut self.textures);
            let change = change.row_mut(y);
            change.fill(0.0);
            let in_view = self.in_view.of_row(y);
            for [from, to] in free_of(known, y, width) {
                let (from, to) = (from.max(in_view.start), to.min(in_view.end));
                if from >= to {
                    continue;
                }
                update.learn(BackgroundRow {
                    now: &now.row(y)[from..to],
                    textures: &self.textures[from..to],
                    mean: &mut self.mean.row_mut(y)[from..to],
                    variance: &mut self.variance.row_mut(y)[from..to],
                    learnt_images: &mut self.learnt_images.row_mut(y)[from..to],
                    change: &mut change[from..to],
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_is_known_after_the_warm_up_or_as_many_images_as_there_were() {
        for (images, interval, known) in [(100, 0.05, 5.0), (100, 1.0, 4.0), (3, 0.05, 3.0)] {
            let mut background = Background::new(2);
            background.begin([20, 20]);
            background.turn_to(Straightening::new(SceneTurn::none(), [40, 40]));
            let update = CellUpdate { share: 0.0, noise: 1.0, sway: 0.0, contrast: 1.0 };
            let now = Plane::from_fn(20, 20, |_, _| 0.0);
            for _ in 0..images {
                background.learn(&now, update, &[], &mut Plane::default());
            }
            assert_eq!(background.least_known(interval), known);
            assert!(background.has_learnt([10, 10], known), "what was always in view is");
        }
    }
}
