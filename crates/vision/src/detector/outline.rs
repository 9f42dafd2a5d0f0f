//! The box of what has been found: all that differs from what is about it, brighter or darker, and is connected with
//! the plot.

use crossfix_correlation::Plane;

use super::filter::{OF_MEDIAN, median};
use super::plots::Plot;
use crate::mend::mend;
use crate::{ImagePoint, PixelBox};

/// Half sides of the window, the first in cells and the largest in pixels: doubled until what is found lies inside. A target of
/// 50 px and its surroundings fit.
const FIRST_REACH_CELLS: f64 = 4.0;
const MOST_REACH: usize = 64;
/// What is found reaches to where it stands out by less than this share of its top ...
const SHARE_OF_TOP: f32 = 0.3;
/// ... or by less than so many standard deviations of what is about it, but not further up than half of the top.
const ABOVE_SURROUNDINGS: f32 = 4.0;
const MOST_OF_TOP: f32 = 0.5;
/// Parts that are apart by less than this share of its longer side are one thing: rotors, legs and the body.
const GAP: f64 = 0.35;
/// Sides of the box where no outline ends, in cells, and the least sides, px.
const UNKNOWN_CELLS: f64 = 3.0;
const LEAST_SIDE: f64 = 4.0;

/// A box about what stands out at a plot.
pub(super) fn outline(image: &Plane, plot: &Plot) -> PixelBox {
    let first = (FIRST_REACH_CELLS * plot.cell) as usize;
    let reaches =
        std::iter::successors(Some(first), |reach| Some(2 * reach)).take_while(|reach| *reach <= MOST_REACH);
    let unknown = PixelBox::about(plot.place, UNKNOWN_CELLS * plot.cell, UNKNOWN_CELLS * plot.cell);
    reaches.filter_map(|reach| outline_within(image, plot, reach)).next().unwrap_or(unknown)
}

/// The box, if it ends within so many pixels of the plot.
fn outline_within(image: &Plane, plot: &Plot, reach: usize) -> Option<PixelBox> {
    let corner = [plot.place.x, plot.place.y].map(|at| at.round() as isize - reach as isize);
    let side = 2 * reach + 1;
    let window = smoothed(image, corner, side);
    let border = (0..side).flat_map(|i| [[i, 0], [i, side - 1], [0, i], [side - 1, i]]);
    let mut border: Vec<f32> = border.map(|[x, y]| window.row(y)[x]).collect();
    let around = median(&mut border);
    border.iter_mut().for_each(|level| *level = (*level - around).abs());
    let spread = OF_MEDIAN * median(&mut border);

    let sign = if plot.is_brighter { 1.0 } else { -1.0 };
    let height = |[x, y]: [usize; 2]| sign * (window.row(y)[x] - around);
    let near = reach - reach.min((1.5 * plot.cell).ceil() as usize)
        ..side.min(reach + (1.5 * plot.cell).ceil() as usize + 1);
    let places = near.clone().flat_map(|y| near.clone().map(move |x| [x, y]));
    let seed = places.max_by(|one, other| height(*one).total_cmp(&height(*other)))?;
    let top = height(seed);
    let threshold = (SHARE_OF_TOP * top).max(ABOVE_SURROUNDINGS * spread).min(MOST_OF_TOP * top);

    let mut gap = (plot.cell / 4.0).ceil() as usize;
    loop {
        let [low, high] = connected(&window, seed, gap, |level| (level - around).abs() >= threshold)?;
        let sides = [0, 1].map(|i| high[i] - low[i] + 1);
        let wider = (GAP * sides[0].max(sides[1]) as f64) as usize;
        if wider <= gap {
            let [width, height] = sides.map(|side| (side as f64).max(LEAST_SIDE));
            let [x, y] = [0, 1].map(|i| corner[i] as f64 + (low[i] + high[i]) as f64 / 2.0);
            return Some(PixelBox::about(ImagePoint { x, y }, width, height));
        }
        gap = wider;
    }
}

/// Means of three by three pixels about those of a square.
fn smoothed(image: &Plane, corner: [isize; 2], side: usize) -> Plane {
    let mut part = image.crop(corner[0] - 1, corner[1] - 1, side + 2, side + 2);
    mend(&mut part);
    Plane::from_fn(side, side, |x, y| {
        (y..y + 3).map(|y| part.row(y)[x..x + 3].iter().sum::<f32>()).sum::<f32>() / 9.0
    })
}

/// The corners of what counts and is connected with a place, over gaps of so many pixels; `None` if it reaches the border.
fn connected(
    window: &Plane,
    seed: [usize; 2],
    gap: usize,
    counts: impl Fn(f32) -> bool,
) -> Option<[[usize; 2]; 2]> {
    let (width, height) = (window.width(), window.height());
    let mut is_open: Vec<bool> = window.samples().iter().map(|level| counts(*level)).collect();
    let mut stack = vec![seed];
    let (mut low, mut high) = (seed, seed);
    while let Some([x, y]) = stack.pop() {
        if x.min(y) == 0 || x == width - 1 || y == height - 1 {
            return None;
        }
        (low, high) = ([low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)]);
        for ny in y.saturating_sub(gap)..=(y + gap).min(height - 1) {
            for nx in x.saturating_sub(gap)..=(x + gap).min(width - 1) {
                if std::mem::take(&mut is_open[ny * width + nx]) {
                    stack.push([nx, ny]);
                }
            }
        }
    }
    Some([low, high])
}
