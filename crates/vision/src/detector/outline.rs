//! The box of what has been found: all that differs from what is about it, brighter or darker, and
//! is connected with the plot.

use crossfix_correlation::Plane;

use super::plots::Plot;
use crate::PixelBox;
use crate::figure::{figure, smoothed};
use crate::noise::{OF_MEDIAN, median};

/// Half side of the first window, cells; it is doubled until the figure lies inside. With half of
/// it one try more is needed.
const FIRST_REACH_CELLS: f64 = 4.0;
/// Largest half side of the window, px: a target of 50 px and its surroundings fit. With half of it
/// the finds of the coarsest scale have no window.
const MOST_REACH: usize = 64;
/// Sides of the box if no outline closes, cells. With half of it the box cuts off parts of the
/// target.
const UNKNOWN_CELLS: f64 = 3.0;
/// Least sides of any box, px. With half of it hardly a box changes, as smoothing makes three
/// pixels of one.
const LEAST_SIDE: f64 = 4.0;

/// The box of what stands out at a plot.
pub(super) fn outline(image: &Plane, plot: &Plot) -> PixelBox {
    let first = (FIRST_REACH_CELLS * plot.cell) as usize;
    let reaches = std::iter::successors(Some(first), |reach| Some(2 * reach))
        .take_while(|reach| *reach <= MOST_REACH);
    let unknown = PixelBox::about(plot.place, UNKNOWN_CELLS * plot.cell, UNKNOWN_CELLS * plot.cell);
    reaches.filter_map(|reach| outline_within(image, plot, reach)).next().unwrap_or(unknown)
}

/// The box, if its outline closes within `reach` pixels of the plot.
fn outline_within(image: &Plane, plot: &Plot, reach: usize) -> Option<PixelBox> {
    let corner = [plot.place.x, plot.place.y].map(|at| at.round() as isize - reach as isize);
    let side = 2 * reach + 1;
    let mut window = smoothed(image, corner, [side; 2]);
    // Background and its spread from the window's border, by medians: a target that reaches out of
    // the window must not count.
    let border = (0..side).flat_map(|i| [[i, 0], [i, side - 1], [0, i], [side - 1, i]]);
    let mut border: Vec<f32> = border.map(|[x, y]| window.row(y)[x]).collect();
    let around = median(&mut border);
    border.iter_mut().for_each(|level| *level = (*level - around).abs());
    let spread = OF_MEDIAN * median(&mut border);

    let sign = if plot.is_brighter { 1.0 } else { -1.0 };
    let height = |[x, y]: [usize; 2]| sign * (window.row(y)[x] - around);
    // The figure grows from what stands out most near the plot.
    let near = reach - reach.min((1.5 * plot.cell).ceil() as usize)
        ..side.min(reach + (1.5 * plot.cell).ceil() as usize + 1);
    let places = near.clone().flat_map(|y| near.clone().map(move |x| [x, y]));
    let seed = places.max_by(|one, other| height(*one).total_cmp(&height(*other)))?;
    // The seed has the plot's sign; the figure itself may be brighter in one part and darker in
    // another.
    window.samples_mut().iter_mut().for_each(|level| *level = (*level - around).abs());
    let region = figure(&window, seed, spread, (plot.cell / 4.0).ceil() as usize)?;
    Some(region.place(corner, [LEAST_SIDE; 2]))
}
