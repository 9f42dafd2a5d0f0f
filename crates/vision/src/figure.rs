//! Figure and ground: the part of an image that stands out from its surroundings, brighter or
//! darker.

use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::ops::RangeInclusive;

use crossfix_correlation::Plane;

use crate::crop::replace_invalid;
use crate::noise::{OF_MEDIAN, median};
use crate::{ImagePoint, PixelBox};

/// The figure ends where it stands out by less than this share of its highest pixel (its top), or
/// by less than [`ABOVE_GROUND`]. With half of it the blur about a thing is part of it.
const SHARE_OF_TOP: f32 = 0.3;
/// The figure ends where it stands out by less than this many standard deviations of the ground.
/// With half of it one pixel of the ground in twenty is part of it, and figures run on to the
/// border.
const ABOVE_GROUND: f32 = 4.0;
/// The threshold at which the figure ends is at most this share of the top. With half of it a faint
/// figure ends in the ground.
const MOST_OF_TOP: f32 = 0.5;
/// Gap over which parts count as one thing, as a share of the longer side: rotors, legs and the
/// body. With half of it rotors count as other things than the body, with twice as much two birds
/// as one.
const GAP: f64 = 0.35;
/// How far a given box may lie beside its target, standard deviations: what is further off is
/// another thing. With half of it one box in five, per axis, lies further off and is not put right.
const FURTHEST: f64 = 2.5;
/// Number of windows in which a box's figure is sought, from one that reaches as far as `FURTHEST`
/// down to the box itself: what stands out beside the box (a house below a drone) is outside of the
/// last ones. With half of it only the first and the last are left, and what shows in those between
/// is missed.
const WINDOWS: u32 = 4;
/// Least and greatest side of such a window, px: a figure has room in the least, and a target of 50
/// px in a box twice as large in the greatest; a window twice as wide takes a second.
pub(crate) const SIDES: RangeInclusive<usize> = 5..=129;
/// Ground about a figure that the widest window has in addition, px. With half of it a figure as
/// far off as that, a pixel wider by smoothing, touches the border and is refused.
const GROUND_PX: f64 = 2.0;
/// A figure is taken for the target if its top is at least this many standard deviations of the
/// noise: in noise alone the highest of a thousand pixels is 4. With half of it boxes in noise are
/// moved by noise, with twice as much only boxes on what the eye sees at once are corrected.
const LEAST_TOP: f32 = 9.0;
/// ... and if at least this share of all that stands out is the figure's own: else nobody knows
/// which of two things was meant. With half of it the larger of two like things is chosen.
const LEAST_SHARE: f32 = 0.8;
/// A box is right as it is if neither it nor its figure is shorter than this share of the other, on
/// both axes (with half of it a box three times as large as its target is kept), ...
const LEAST_FILLED: f64 = 0.6;
/// ... and if their middles are apart by at most this share of the box's side, and a pixel: figures
/// are known no better. With half of it a box of 20 px is moved for 2.5 px instead of 4.
const MOST_OFF: f64 = 0.15;

/// A connected part of a window: its corners, the middle of its weights, and their sum.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ConnectedRegion {
    low: [usize; 2],
    high: [usize; 2],
    middle: [f64; 2],
    weight: f64,
}

impl ConnectedRegion {
    /// Its box in the image, with sides of at least `least`; `corner` is the place of the window's
    /// first pixel in the image.
    ///
    /// The box is centred on the middle of what stands out, which is the same for cameras on all
    /// sides; the middle of the corners is not.
    pub(crate) fn place(&self, corner: [isize; 2], least: [f64; 2]) -> PixelBox {
        let [x, y] = [0, 1].map(|i| corner[i] as f64 + self.middle[i]);
        let [width, height] = [0, 1].map(|i| self.side(i).max(least[i]));
        PixelBox::about(ImagePoint { x, y }, width, height)
    }

    /// Side of its box on an axis.
    fn side(&self, i: usize) -> f64 {
        // Half side: the farther of the two corners from the middle.
        let reach = (self.middle[i] - self.low[i] as f64).max(self.high[i] as f64 - self.middle[i]);
        (2.0 * reach + 1.0).ceil()
    }
}

/// Threshold of a figure with a given top, on ground with standard deviation `spread`.
fn threshold(top: f32, spread: f32) -> f32 {
    (SHARE_OF_TOP * top).max(ABOVE_GROUND * spread).min(MOST_OF_TOP * top)
}

/// The figure about a place (`seed`): all that stands out and is connected with the place over
/// gaps; `None` if it goes on beyond the window.
///
/// `off` is by how much each pixel differs from the ground, whose standard deviation is `spread`;
/// `gap` is the least gap, px.
pub(crate) fn figure(
    off: &Plane,
    seed: [usize; 2],
    spread: f32,
    mut gap: usize,
) -> Option<ConnectedRegion> {
    let threshold = threshold(off.row(seed[1])[seed[0]], spread);
    loop {
        let region = connected(off, seed, gap, threshold)?;
        // The gap grows with the region until it bridges nothing more: a large thing has large gaps
        // between its parts.
        let longest = (region.high[0] - region.low[0]).max(region.high[1] - region.low[1]) + 1;
        let wider = (GAP * longest as f64) as usize;
        if wider <= gap {
            return Some(region);
        }
        gap = wider;
    }
}

/// What is above a threshold and connected with a place, over gaps of up to `gap` pixels; `None` if
/// it reaches the window's border.
fn connected(off: &Plane, seed: [usize; 2], gap: usize, threshold: f32) -> Option<ConnectedRegion> {
    let (width, height) = (off.width(), off.height());
    let weight = |level: &f32| if *level >= threshold { *level } else { 0.0 };
    let mut weights: Vec<f32> = off.samples().iter().map(weight).collect();
    let (mut low, mut high) = (seed, seed);
    let (mut sum, mut moments) = (0.0, [0.0; 2]);
    // Flood fill: a pixel's weight is set to 0 when it is counted.
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
    (sum > 0.0).then(|| ConnectedRegion {
        low,
        high,
        middle: moments.map(|moment| moment / sum),
        weight: sum,
    })
}

/// Means of three by three pixels over a part of an image; beyond the image's border its border
/// pixels are repeated.
pub(crate) fn smoothed(image: &Plane, corner: [isize; 2], [width, height]: [usize; 2]) -> Plane {
    let mut part = image.crop(corner[0] - 1, corner[1] - 1, width + 2, height + 2);
    replace_invalid(&mut part);
    Plane::from_fn(width, height, |x, y| {
        (y..y + 3).map(|y| part.row(y)[x..x + 3].iter().sum::<f32>()).sum::<f32>() / 9.0
    })
}

/// Prominence of each pixel of a window: how far one has to climb, or to descend, at least on every
/// path from it to the border. What goes on beyond the border (a horizon, a mast) does not stand
/// out, however bright or dark.
fn standing_out(window: &Plane) -> Plane {
    // What is dark fills with water; what is bright does so upside down.
    let upside_down = Plane::from_fn(window.width(), window.height(), |x, y| -window.row(y)[x]);
    let [dark, bright] = [window, &upside_down].map(depths);
    Plane::from_fn(window.width(), window.height(), |x, y| dark.row(y)[x].max(bright.row(y)[x]))
}

/// A pixel that the water has reached, at a level.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Shore {
    level: f32,
    place: [usize; 2],
}

impl Eq for Shore {}

impl Ord for Shore {
    /// The lowest pixel is the greatest: it is the next to be flooded.
    fn cmp(&self, other: &Self) -> Ordering {
        other.level.total_cmp(&self.level)
    }
}

impl PartialOrd for Shore {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

/// How deep the water is on each pixel if it is poured over a landscape and runs off at its border
/// (priority flood).
fn depths(landscape: &Plane) -> Plane {
    let (width, height) = (landscape.width(), landscape.height());
    let mut surface = Plane::from_fn(width, height, |_, _| f32::INFINITY);
    let mut shores = BinaryHeap::new();
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
        if x == 0 || y == 0 || x + 1 == width || y + 1 == height {
            let level = landscape.row(y)[x];
            surface.row_mut(y)[x] = level;
            shores.push(Shore { level, place: [x, y] });
        }
    }
    // The lowest shore floods its neighbours: water stands there at its level, or at the ground's
    // if that is higher.
    while let Some(Shore { level, place: [x, y] }) = shores.pop() {
        for ny in y.saturating_sub(1)..=(y + 1).min(height - 1) {
            for nx in x.saturating_sub(1)..=(x + 1).min(width - 1) {
                let reached = &mut surface.row_mut(ny)[nx];
                if reached.is_infinite() {
                    *reached = level.max(landscape.row(ny)[nx]);
                    shores.push(Shore { level: *reached, place: [nx, ny] });
                }
            }
        }
    }
    Plane::from_fn(width, height, |x, y| surface.row(y)[x] - landscape.row(y)[x])
}

/// How far beyond a given box its figure is looked for, px; `given_sd` as in [`meant`].
pub(crate) fn farthest(given_sd: f64) -> f64 {
    FURTHEST * given_sd + GROUND_PX
}

/// The box of the target that somebody meant by a given box: the given one where it fits the one
/// thing that stands out there, and else that of the thing; `None` if nothing stands out, or more
/// than one thing does.
///
/// `given_sd` is how well a given box lies on its target, px, and `noise_sd` the standard deviation
/// of the image's noise.
pub(crate) fn meant(
    image: &Plane,
    given: PixelBox,
    given_sd: f64,
    noise_sd: f32,
) -> Option<PixelBox> {
    let windows = (0..WINDOWS).rev().map(|window| f64::from(window) / f64::from(WINDOWS - 1));
    let mut figures = windows.filter_map(|share| {
        figure_within(image, given, given_sd, share * farthest(given_sd), noise_sd)
    });
    // From the widest window down: the first that shows a single thing decides.
    figures.next().map(|figure| if fits(given, figure) { given } else { figure })
}

/// Whether a box fits its figure well enough to be kept.
fn fits(given: PixelBox, figure: PixelBox) -> bool {
    let sides = [(given.width, figure.width), (given.height, figure.height)];
    let is_filled = sides
        .iter()
        .all(|(side, filled)| *filled >= LEAST_FILLED * side && *side >= LEAST_FILLED * filled);
    is_filled && is_centred(given, figure)
}

/// Whether the middle of a box is that of its figure, as well as figures are known.
pub(crate) fn is_centred(given: PixelBox, figure: PixelBox) -> bool {
    let (at, is) = (given.centre(), figure.centre());
    let sides = [(given.width, is.x - at.x), (given.height, is.y - at.y)];
    sides.iter().all(|(side, off)| off.abs() <= MOST_OFF * side + 1.0)
}

/// The box of the one thing that stands out in a window that is wider than the given box by
/// `beside` pixels on each side.
fn figure_within(
    image: &Plane,
    given: PixelBox,
    given_sd: f64,
    beside: f64,
    noise_sd: f32,
) -> Option<PixelBox> {
    let (centre, sides) = (given.centre(), [given.width, given.height]);
    let at = [centre.x, centre.y];
    let image_sides = [image.width(), image.height()];
    let ranges = [0, 1].map(|i| {
        let reach = sides[i] / 2.0 + beside;
        let first = (at[i] - reach).ceil().max(0.0) as usize;
        let end = ((at[i] + reach).floor().max(0.0) as usize + 1).min(image_sides[i]);
        first..end.max(first)
    });
    if !ranges.iter().all(|range| SIDES.contains(&range.len())) {
        return None;
    }
    let corner = [0, 1].map(|i| ranges[i].start as isize);
    let off = standing_out(&smoothed(image, corner, [ranges[0].len(), ranges[1].len()]));
    // The mean of nine pixels has a third of their noise's standard deviation.
    let spread = (OF_MEDIAN * median(&mut off.samples().to_vec())).max(noise_sd / 3.0);

    let level = |[x, y]: [usize; 2]| off.row(y)[x];
    let places = (0..off.height()).flat_map(|y| (0..off.width()).map(move |x| [x, y]));
    // The seed of the figure is the pixel with the largest product of prominence and probability.
    let in_image = |[x, y]: [usize; 2]| [ranges[0].start + x, ranges[1].start + y];
    let score = |at: [usize; 2]| level(at) * likely_meant(given, given_sd, in_image(at));
    let seed = places.max_by(|one, other| score(*one).total_cmp(&score(*other)))?;
    let top = level(seed);
    if top < LEAST_TOP * spread {
        return None;
    }
    let region = figure(&off, seed, spread, 1)?;
    let threshold = threshold(top, spread);
    let all: f32 = off.samples().iter().filter(|level| **level >= threshold).sum();
    // Where the noise ends the figure early its size is unknown, and is at least that of the given
    // box.
    let least = if ABOVE_GROUND * spread <= SHARE_OF_TOP * top { [1.0; 2] } else { sides };
    (region.weight >= f64::from(LEAST_SHARE * all)).then(|| region.place(corner, least))
}

/// Probability, up to a factor, that a pixel was meant by a given box: inside it as great as that
/// of any other pixel there; outside, it falls off with the distance as a Gaussian.
#[inline]
fn likely_meant(given: PixelBox, given_sd: f64, [x, y]: [usize; 2]) -> f32 {
    let centre = given.centre();
    let beside_x = ((x as f64 - centre.x).abs() - given.width / 2.0).max(0.0);
    let beside_y = ((y as f64 - centre.y).abs() - given.height / 2.0).max(0.0);
    (-0.5 * (beside_x.powi(2) + beside_y.powi(2)) / given_sd.powi(2)).exp() as f32
}
