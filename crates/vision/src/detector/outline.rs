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
        let off = |level: f32| (level - around).abs();
        let Region { low, high, middle } =
            connected(&window, seed, gap, |level| if off(level) >= threshold { off(level) } else { 0.0 })?;
        let longest = (high[0] - low[0]).max(high[1] - low[1]) + 1;
        let wider = (GAP * longest as f64) as usize;
        if wider <= gap {
            // About the middle of what stands out, which is the same for cameras on all sides; a box's own is not.
            let side = |i: usize| {
                let reach = (middle[i] - low[i] as f64).max(high[i] as f64 - middle[i]);
                (2.0 * reach + 1.0).ceil().max(LEAST_SIDE)
            };
            let [x, y] = [0, 1].map(|i| corner[i] as f64 + middle[i]);
            return Some(PixelBox::about(ImagePoint { x, y }, side(0), side(1)));
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

/// What is connected: its corners, and the middle of its weights.
#[derive(Clone, Copy, Debug)]
struct Region {
    low: [usize; 2],
    high: [usize; 2],
    middle: [f64; 2],
}

/// What has a weight and is connected with a place, over gaps of so many pixels; `None` if it reaches the border.
fn connected(window: &Plane, seed: [usize; 2], gap: usize, weight: impl Fn(f32) -> f32) -> Option<Region> {
    let (width, height) = (window.width(), window.height());
    let mut weights: Vec<f32> = window.samples().iter().map(|level| weight(*level)).collect();
    let (mut low, mut high) = (seed, seed);
    let (mut sum, mut moments) = (0.0, [0.0; 2]);
    let mut stack = vec![(seed, std::mem::take(&mut weights[seed[1] * width + seed[0]]))];
    while let Some(([x, y], weight)) = stack.pop() {
        if x.min(y) == 0 || x == width - 1 || y == height - 1 {
            return None;
        }
        let weight = f64::from(weight);
        sum += weight;
        moments = [moments[0] + weight * x as f64, moments[1] + weight * y as f64];
        (low, high) = ([low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)]);
        for ny in y.saturating_sub(gap)..=(y + gap).min(height - 1) {
            for nx in x.saturating_sub(gap)..=(x + gap).min(width - 1) {
                let weight = std::mem::take(&mut weights[ny * width + nx]);
                if weight > 0.0 {
                    stack.push(([nx, ny], weight));
                }
            }
        }
    }
    (sum > 0.0).then(|| Region { low, high, middle: moments.map(|moment| moment / sum) })
}
