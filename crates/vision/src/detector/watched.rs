//! Known targets that are watched: where the background shows the same as they do, they were the
//! scene.

use crossfix_correlation::Plane;

use super::KnownTarget;
use super::filter::{self, StandOutScratch, between, halve, stand_out};
use super::level::Level;
use crate::{ImagePoint, ImageTrackId};

/// Sides of a target in cells of the scale at which it stands out most. With half of it a target is
/// watched on the next coarser scale, stands out less there and is sooner mistaken for the scene.
const TARGET_CELLS: f64 = 2.5;
/// Half side of the part of the image from which it is computed how much a target stands out,
/// cells: the surroundings of the target's own cell and its neighbours'. With half of it the
/// surroundings are cut off, and the part's border is repeated in their place.
const PART_CELLS: usize = filter::SURROUNDINGS + 2;
/// A watched target is new in an image if the background lacks at least this share of what stands
/// out there (with half of it clouds and changing light make the scene new, with twice as much a
/// target in front of its like is mistaken for the scene), ...
const NEW: f32 = 0.35;
/// ... and if it stands out by at least this share of the least strength of a plot. With half of it
/// noise alone, of 1.2 spreads, makes it new in one case of five.
const STANDS_OUT: f32 = 0.7;
/// Least share of the latest images in which a watched target must be new: with a smaller share it
/// is the scene, and given up. That is so after 0.6 s; with half of it after 0.95.
const LEAST_NEW: f64 = 0.3;
/// Averaging time of that share, s. With half of it the scene is given up after 0.3 s instead of
/// 0.6, and so is a target that flies in front of its like for as long.
const NEW_S: f64 = 0.5;

/// A known target that may turn out to be the scene.
#[derive(Clone, Copy, Debug)]
struct SceneSuspect {
    id: ImageTrackId,
    /// Index of the scale that fits its size.
    level: usize,
    place: ImagePoint,
    /// By how much it stands out in this image, levels.
    stands_out: f32,
    /// Running share of the images in which it was new.
    share_new: f64,
}

/// The targets that are watched.
#[derive(Debug, Default)]
pub(super) struct Watched(Vec<SceneSuspect>);

impl Watched {
    /// Forgets all.
    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    /// Notes by how much each watched target stands out, before it is covered.
    pub(super) fn note(&mut self, known: &[KnownTarget], levels: &[Level]) {
        self.0.retain(|watch| known.iter().any(|known| known.id == watch.id && known.is_watched));
        for known in known.iter().filter(|known| known.is_watched) {
            let side = known.place.width.max(known.place.height) / TARGET_CELLS;
            // Sizes differ by ratios: the nearest scale has the least |ln(cell / side)|.
            let off = |level: &Level| (level.cell() as f64 / side).ln().abs();
            let nearest = (0..levels.len())
                .min_by(|one, other| off(&levels[*one]).total_cmp(&off(&levels[*other])));
            let Some(level) = nearest else { return };
            let place = known.place.centre();
            let stands_out = stands_out_at(&levels[0].reduced, level, levels[level].cell(), place);
            match self.0.iter_mut().find(|watch| watch.id == known.id) {
                Some(watch) => {
                    (watch.level, watch.place, watch.stands_out) = (level, place, stands_out);
                }
                None => self.0.push(SceneSuspect {
                    id: known.id,
                    level,
                    place,
                    stands_out,
                    share_new: 1.0,
                }),
            }
        }
    }

    /// Removes those of the watched targets that are the scene, and returns them.
    pub(super) fn take_scene(&mut self, levels: &[Level], interval: f64) -> Vec<ImageTrackId> {
        let share = 1.0 - (-interval / NEW_S).exp();
        for watch in &mut self.0 {
            let level = &levels[watch.level];
            // What stands out now, less what the background without the target would show there.
            let excess = watch.stands_out - level.expected(watch.place);
            let is_new = watch.stands_out.abs()
                > STANDS_OUT * level.least_strength() * level.spread
                && excess.abs() >= NEW * watch.stands_out.abs();
            // s += a (new - s), a = 1 - exp(-T / tau), new = 0 or 1.
            watch.share_new += share * (f64::from(u8::from(is_new)) - watch.share_new);
        }
        self.0.extract_if(.., |watch| watch.share_new < LEAST_NEW).map(|watch| watch.id).collect()
    }
}

/// By how much a place stands out on a scale, computed from the finest scale's means.
fn stands_out_at(finest: &Plane, level: usize, cell: usize, place: ImagePoint) -> f32 {
    let place = [place.x, place.y];
    let corner = place.map(|at| (at / cell as f64).floor() as isize - PART_CELLS as isize);
    let side = 2 * PART_CELLS + 1;
    // Only this part of the finest scale is averaged down; one cell of the scale is 2^level cells
    // there.
    let fine = 1 << level;
    let mut part =
        finest.crop(corner[0] * fine as isize, corner[1] * fine as isize, side * fine, side * fine);
    for _ in 0..level {
        let mut halved = Plane::default();
        halve(&part, &mut halved);
        part = halved;
    }
    let mut out = Plane::default();
    stand_out(&part, &mut out, &mut StandOutScratch::default());
    // From pixels to cells of the part; the middle of a cell is a whole number on both sides.
    between(&out, [0, 1].map(|i| (place[i] + 0.5) / cell as f64 - 0.5 - corner[i] as f64))
}
