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
        let Moment { share, young, is_first, turning_px_s, interval, .. } = moment;
        let passed = (turning_px_s * interval / LENS_PX).min(interval / LENS_S);
        let share = share.max(young).max(1.0 - (-passed).exp() as f32);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detector::straight::Straightening;
    use crate::scene_turn::SceneTurn;

    #[test]
    fn what_keeps_its_place_is_on_the_lens_whether_bright_or_dark() {
        let mut on_lens = OnLens::default();
        for image in 0..60 {
            // One thing is always bright, and one dark before what is bright; what is elsewhere
            // passes.
            let stands_out = Plane::from_fn(20, 20, |x, y| match [x, y] {
                [5, 5] => 40.0,
                [14, 5] => 40.0 * if image / 10 % 2 == 0 { 1.0 } else { -1.0 },
                [x, 14] if x == image % 20 => 40.0,
                _ => 0.0,
            });
            let moment = Moment {
                view: Straightening::new(SceneTurn::none(), [40, 40]),
                turning_px_s: 100.0,
                interval: 1.0 / 30.0,
                share: 0.01,
                young: 1.0 / (image as f32 + 1.0),
                is_first: image == 0,
            };
            on_lens.learn(&stands_out, moment, &[]);
        }
        for (at, now, is_on_lens) in [
            ([5.0, 5.0], 40.0, true),
            ([5.0, 5.0], 100.0, false),
            ([14.0, 5.0], 40.0, true),
            ([14.0, 5.0], -40.0, true),
            ([10.0, 14.0], 40.0, false),
        ] {
            assert_eq!(on_lens.explains(at, now, now), is_on_lens, "{at:?}: {now}");
        }
    }
}
