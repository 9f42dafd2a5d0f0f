//! Plots of one image: places where something stands out that did not before.

use crossfix_correlation::Plane;

use super::level::{LEAST_CHANGE, Level};
use crate::ImagePoint;

/// A plot stands out by at least this share of its change; if it does not, something has not come,
/// but gone. With half of it ground that is a little dark is a plot where a bright thing has left
/// it.
const LEAST_OF_CHANGE: f32 = 0.5;
/// Least and largest share of what stands out that the background lacks: less is the scene itself,
/// and more lies where something of the opposite sign has gone. With 0.1 a slow target is found
/// when it has gone by a tenth of its size, with 3 the place that a target has left is another
/// target. With half of both a thing that has come whole is refused.
const SHARES: [f32; 2] = [0.02, 1.5];
/// Within this many cells one thing makes only one plot: it is two or three cells large. With half
/// of it one thing begins several candidates.
const APART: f64 = 3.0;
/// A bright plot's dark ring (and the other way round) reaches this many cells, as far from its
/// ends as its surroundings do. With half of it a ring is a plot of its own.
const RING: f64 = 7.0;
/// Largest share of a plot's strength that its ring has: that of a square of three cells in one of
/// nine, three times over for a thing of several parts. With half of it a ring is a plot of its
/// own.
const MOST_OF_RING: f32 = 0.4;
/// Most plots of an image: those that stand out most, enough for fifty targets and as much noise.
/// With half of it strong noise leaves no room for faint targets, whose plots rank last.
const MOST_PLOTS: usize = 200;

/// Something that stands out and did not before.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Plot {
    pub(super) place: ImagePoint,
    /// Where that was in the image to which the background is fixed.
    pub(super) in_scene: [f64; 2],
    /// Whether it is brighter or darker than its surroundings.
    pub(super) is_brighter: bool,
    /// The scale at which it stands out most: its number, and the side of its cells, px.
    pub(super) level: usize,
    pub(super) cell: f64,
    /// By how much it stands out, in spreads of the scale.
    pub(super) strength: f32,
    /// How much of that strength the background does not have, in spreads.
    pub(super) excess: f32,
    /// How much the scene about it stands out by itself beyond noise, in spreads.
    pub(super) texture: f32,
    /// Persistence of the noise from image to image, 0 to 1.
    pub(super) persistence: f32,
}

impl Plot {
    /// Rank of a plot: its strength, times the root of its cell. A target is two or three cells
    /// large on the scale where it stands out most; larger cells have less noise, which makes up
    /// for a part of what they dilute.
    fn rank(&self) -> f64 {
        f64::from(self.strength) * self.cell.sqrt()
    }

    /// Whether this plot is made by the thing of another plot that stands out more, or is the ring
    /// about it.
    fn is_of(&self, other: &Self) -> bool {
        let is_ring =
            self.is_brighter != other.is_brighter && self.strength < MOST_OF_RING * other.strength;
        let apart = APART * self.cell.max(other.cell);
        let reach = if is_ring { apart.max(RING * other.cell) } else { apart };
        (self.place.x - other.place.x).abs() < reach && (self.place.y - other.place.y).abs() < reach
    }

    /// Variance of its place, px^2 per axis.
    pub(super) fn variance(&self) -> f64 {
        // A maximum is located to a third of its cell, and a little worse where the target's middle
        // is not its maximum.
        (0.35 * self.cell).powi(2) + 0.1
    }
}

/// The plots of an image, those that stand out most first; images come `usual_interval` s apart.
pub(super) fn find(levels: &mut [Level], usual_interval: f64, plots: &mut Vec<Plot>) {
    plots.clear();
    for (index, level) in levels.iter_mut().enumerate() {
        let least_images = level.background().least_known(usual_interval);
        let side = level.change.width();
        for y in 1..level.change.height().saturating_sub(1) {
            let changes = level.change.row(y).iter();
            // Most rows have no change that is large enough: they are passed over by their maximum.
            if changes.fold(0.0_f32, |most, change| most.max(change.abs())) < LEAST_CHANGE {
                continue;
            }
            for x in 1..side.saturating_sub(1) {
                if level.change.row(y)[x].abs() >= LEAST_CHANGE {
                    plots.extend(plot_at(level, index, [x, y], least_images));
                }
            }
        }
    }
    // Greedy suppression across scales: a plot is kept if no plot of higher rank explains it.
    plots.sort_by(|a, b| b.rank().total_cmp(&a.rank()));
    let mut kept = 0;
    for index in 0..plots.len() {
        if kept < MOST_PLOTS && !plots[..kept].iter().any(|other| plots[index].is_of(other)) {
            plots.swap(kept, index);
            kept += 1;
        }
    }
    plots.truncate(kept);
}

/// The plot of a change that is the greatest within a cell, if something stands out there and the
/// background has been learnt from so many images.
fn plot_at(level: &mut Level, index: usize, at: [usize; 2], least_images: f32) -> Option<Plot> {
    let change = level.change.row(at[1])[at[0]];
    // Its top need not be known: a followed target may have covered that until now.
    let is_known = level.background().has_learnt(at, least_images);
    if !is_known || greatest_about(&level.change, at, f32::abs) != at {
        return None;
    }
    let sign = change.signum();
    let standing = |value: f32| sign * value;
    // What moves changes most at its edge: its top is two cells away at most.
    let mut top = at;
    for _ in 0..2 {
        top = greatest_about(&level.now, top, standing);
    }
    // If the top has the sign opposite to the change or is much lower than it, something has gone
    // and nothing has come; what is on the lens has been there before.
    let strength = standing(level.now.row(top[1])[top[0]]) / level.spread;
    let share = level.new_share(top);
    if strength < level.least_strength().max(LEAST_OF_CHANGE * change.abs())
        || !(SHARES[0]..SHARES[1]).contains(&share)
        || level.is_on_lens(top)
    {
        return None;
    }
    let (place, in_scene) =
        level.background().place_of([0, 1].map(|axis| refined(&level.now, top, axis, sign)));
    // The measured texture contains the noise: one spread squared is subtracted.
    let texture = (level.texture_about(top).powi(2) - 1.0).max(0.0).sqrt();
    Some(Plot {
        place,
        in_scene,
        is_brighter: sign > 0.0,
        level: index,
        cell: level.cell() as f64,
        strength,
        excess: strength * share.min(1.0),
        texture,
        persistence: level.persistence,
    })
}

/// Where a plane, times a sign, has its top on an axis, between the cells: the top of a parabola
/// through three of them.
fn refined(plane: &Plane, top: [usize; 2], axis: usize, sign: f32) -> f64 {
    let [before, here, after] = [-1, 0, 1].map(|step| {
        let mut place = top.map(|at| at as isize);
        place[axis] += step;
        sign * plane.clamped(place[0], place[1])
    });
    let bend = before - 2.0 * here + after;
    let off = if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    top[axis] as f64 + f64::from(off)
}

/// Where a plane is greatest, up to one cell from a place.
fn greatest_about(plane: &Plane, [x, y]: [usize; 2], of: impl Fn(f32) -> f32) -> [usize; 2] {
    let mut best = [x, y];
    let mut most = of(plane.row(y)[x]);
    for ny in y.saturating_sub(1)..=(y + 1).min(plane.height() - 1) {
        for nx in x.saturating_sub(1)..=(x + 1).min(plane.width() - 1) {
            let value = of(plane.row(ny)[nx]);
            if value > most {
                (best, most) = ([nx, ny], value);
            }
        }
    }
    best
}
