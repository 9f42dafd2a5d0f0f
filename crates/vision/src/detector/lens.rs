//! What is on the lens, or written over the picture: it keeps its place in the image, however the
//! camera turns.

use crossfix_correlation::Plane;

use super::cells::{Cells, free_of};
use super::filter::between;
use super::views::Moment;

/// What stands out is on the lens if the mean of what has kept its place in the image lacks less of
/// it than this share of what the background lacks. With half of it lines behind which the scene
/// changes are found; with twice as much a target that a turning camera keeps nearly in its place
/// is refused.
const LENS: f32 = 0.35;
/// What keeps its place in the image is a mean over this way of the scene, px, about as long as its
/// texture: the scene averages out of it. With four times as much what passes behind a reticle is
/// found.
const LENS_PX: f64 = 10.0;
/// ... and over this time at least, s. With half of it a target that a camera follows is on the
/// lens before it is found.
const LENS_S: f64 = 0.25;

/// What keeps its place in the image, in the image's cells: running means of how much each stands
/// out.
#[derive(Debug, Default)]
pub(super) struct OnLens {
    mean: Plane,
    /// The same of the absolute value: what is written over a picture so that it shows is dark
    /// before what is bright.
    size: Plane,
}

impl OnLens {
    /// Whether what keeps its place in the image explains what stands out at a place of it by
    /// `now`, and by `excess` more than the background.
    pub(super) fn explains(&self, at: [f64; 2], now: f32, excess: f32) -> bool {
        let [mean, size] = [&self.mean, &self.size].map(|of| between(of, at));
        // It hides the scene, or is in the surroundings of what stands out beside it.
        let offs = [now - mean, excess - mean, now.abs() - size];
        offs.iter().any(|off| off.abs() < LENS * excess.abs())
    }

    /// Takes in how much an image's cells stand out, except where `known` covers them: in the
    /// background's cells, which lie within a cell of the image's. Known targets are painted over,
    /// so that their edges are as empty as they.
    pub(super) fn learn(&mut self, stands_out: &Plane, moment: Moment, known: &[Cells]) {
        let Moment { share, is_first, turning_px_s, interval, .. } = moment;
        let passed = (turning_px_s * interval / LENS_PX).min(interval / LENS_S);
        let share = share.max(1.0 - (-passed).exp() as f32);
        if is_first {
            self.mean.copy_from(stands_out);
            self.size.copy_from(stands_out);
            self.size.samples_mut().iter_mut().for_each(|size| *size = size.abs());
        }
        let (width, height) = (stands_out.width(), stands_out.height());
        for y in 0..height {
            let now = stands_out.row(y);
            let (mean, size) = (self.mean.row_mut(y), self.size.row_mut(y));
            for [from, to] in free_of(known, y, width) {
                let cells = mean[from..to].iter_mut().zip(&mut size[from..to]).zip(&now[from..to]);
                cells.for_each(|((mean, size), now)| {
                    *mean += share * (now - *mean);
                    *size += share * (now.abs() - *size);
                });
            }
        }
    }
}
