//! Drawing into an image: targets, dark silhouettes with soft edges that are smeared along their
//! motion during the exposure; and clutter, strips and discs of one brightness.

use std::ops::Range;

/// Difference of brightness between the sky and a target, 8-bit levels. With half of it targets are
/// no darker than clouds may be, 43 levels; twice as much is more than the darkest sky has.
const DARKNESS: f32 = 85.0;
/// Number of copies of a target that make up its motion blur. Three show separately where a target
/// moves by more than three of its spans during the exposure; one, as with half of it, would be no
/// blur.
const SMEAR_STEPS: usize = 3;
/// Number of sub-samples per pixel and axis. With half of it a copy covers a pixel in steps of a
/// quarter instead of a sixteenth, and small targets flicker as they move.
const SUPERSAMPLING: usize = 4;

/// A frame as a camera of the scene delivers it.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedFrame {
    /// Number of the frame, from 0.
    pub index: u64,
    /// True time of its mid-exposure, s from the scene's start.
    pub true_s: f64,
    /// What the camera's clock shows at mid-exposure, s.
    pub own_s: f64,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// 8-bit brightness, row by row.
    pub brightness: Vec<u8>,
}

/// A target as it appears in an image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RenderedTarget {
    /// Where its centre is at the start and the end of the exposure, px.
    pub(crate) from: [f64; 2],
    pub(crate) to: [f64; 2],
    /// Its span in the image, px.
    pub(crate) span: f64,
    /// Standard deviation of the blur, px.
    pub(crate) blur: f64,
}

/// A thing of one brightness in an image: the pieces that it is made of, px.
#[derive(Clone, Debug)]
pub(crate) struct RenderedThing {
    pub(crate) pieces: Vec<Piece>,
    /// Its brightness, 8-bit levels.
    pub(crate) level: f32,
}

/// A piece of a thing, px.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Piece {
    /// A straight strip.
    Strip {
        /// Its ends.
        from: [f64; 2],
        to: [f64; 2],
        width: f64,
    },
    /// A disc whose edge is as wide as this.
    Disc { centre: [f64; 2], radius: f64, edge: f64 },
}

impl RenderedThing {
    /// Draws it over an image that a lens blurs with this standard deviation, px.
    pub(crate) fn draw(&self, image: &mut [f32], width: usize, blur: f64) {
        // A box of length h has the variance h^2 / 12, the pixel's own box 1 / 12; together they
        // have the blur's.
        let soft = (12.0 * blur * blur - 1.0).max(1e-6).sqrt();
        // Where pieces meet the shares of a pixel that they cover add up, before it is painted.
        let mut covered = vec![0.0_f32; image.len()];
        for piece in &self.pieces {
            piece.cover(&mut covered, width, soft);
        }
        for (pixel, covered) in image.iter_mut().zip(covered) {
            *pixel += covered.min(1.0) * (self.level - *pixel);
        }
    }
}

/// The pixels of an axis with `side` of them that lie within a range.
fn within([low, high]: [f64; 2], side: usize) -> Range<usize> {
    (low.clamp(0.0, side as f64) as usize)..(high.clamp(0.0, side as f64) as usize)
}

impl Piece {
    /// Adds the share of each pixel that it covers.
    fn cover(&self, shares: &mut [f32], width: usize, soft: f64) {
        let height = shares.len() / width.max(1);
        let [columns, rows] = self.reach(soft);
        for y in within(rows, height) {
            for x in within(columns, width) {
                shares[y * width + x] += self.share([x as f64, y as f64], soft) as f32;
            }
        }
    }

    /// The first and the last column, then row, that it may cover, the last one excluded.
    fn reach(&self, soft: f64) -> [[f64; 2]; 2] {
        let beyond = soft + 2.0;
        [0, 1].map(|axis| self.reach_on(axis, beyond))
    }

    /// What it and `beyond` pixels about it cover of an axis, px.
    fn reach_on(&self, axis: usize, beyond: f64) -> [f64; 2] {
        match *self {
            Self::Strip { from, to, width } => {
                let reach = width / 2.0 + beyond;
                [from[axis].min(to[axis]) - reach, from[axis].max(to[axis]) + reach]
            }
            Self::Disc { centre, radius, edge } => {
                let reach = radius + edge + beyond;
                [centre[axis] - reach, centre[axis] + reach]
            }
        }
    }

    /// The share of a pixel that it covers.
    fn share(&self, [x, y]: [f64; 2], soft: f64) -> f64 {
        match *self {
            Self::Strip { from, to, width } => {
                let along = [to[0] - from[0], to[1] - from[1]];
                let length = along[0].hypot(along[1]).max(f64::MIN_POSITIVE);
                let off = [x - from[0], y - from[1]];
                // Components along the strip and across it.
                let s = (off[0] * along[0] + off[1] * along[1]) / length;
                let d = (off[0] * along[1] - off[1] * along[0]) / length;
                let across = covered([d - width / 2.0, d + width / 2.0], soft);
                // Sharp ends: where the next piece begins both add up to one.
                across * covered([s - length, s], 1e-3)
            }
            Self::Disc { centre, radius, edge } => {
                let far = (x - centre[0]).hypot(y - centre[1]);
                // Linear over the edge, the blur and the pixel.
                ((radius - far) / (edge + soft + 1.0) + 0.5).clamp(0.0, 1.0)
            }
        }
    }
}

/// The share of the pixel about zero that an interval covers when it is blurred by a box of length
/// `soft`: the interval, the blur's box and the pixel's folded. So the shares of all pixels add up
/// to the interval's length.
fn covered([low, high]: [f64; 2], soft: f64) -> f64 {
    let from = |edge: f64| twice_integrated(edge + 0.5, soft) - twice_integrated(edge - 0.5, soft);
    from(high) - from(low)
}

/// The second integral of a box of unit area and this length about zero: 0 before it, `t` after it,
/// a parabola in between.
fn twice_integrated(t: f64, length: f64) -> f64 {
    match t {
        t if t <= -length / 2.0 => 0.0,
        t if t >= length / 2.0 => t,
        t => (t + length / 2.0).powi(2) / (2.0 * length),
    }
}

/// Whether a silhouette covers a place, in units of half its span: a body, two arms and four rotors
/// seen from the side, symmetric about its centre.
fn silhouette(u: f64, v: f64) -> bool {
    let body = (u / 0.34).powi(2) + (v / 0.30).powi(2) < 1.0;
    let arms = v.abs() < 0.08 && u.abs() < 0.9;
    let rotors = ((u.abs() - 0.72) / 0.28).powi(2) + (v / 0.16).powi(2) < 1.0;
    body || arms || rotors
}

/// Darkens an image where a target is.
pub(crate) fn draw(image: &mut [f32], width: usize, height: usize, target: &RenderedTarget) {
    let half = target.span / 2.0;
    let soft = target.blur.max(0.3);
    // The blur's outer nodes lie at 1.7 deviations: nothing is covered beyond this.
    let reach = half + 3.0 * soft + 1.0;
    let [low_x, high_x] =
        [target.from[0].min(target.to[0]) - reach, target.from[0].max(target.to[0]) + reach];
    let [low_y, high_y] =
        [target.from[1].min(target.to[1]) - reach, target.from[1].max(target.to[1]) + reach];
    if high_x < 0.0 || high_y < 0.0 || low_x > width as f64 || low_y > height as f64 {
        return;
    }
    let columns = low_x.max(0.0) as usize..(high_x.min(width as f64 - 1.0) as usize + 1);
    let rows = low_y.max(0.0) as usize..(high_y.min(height as f64 - 1.0) as usize + 1);
    for y in rows {
        for x in columns.clone() {
            image[y * width + x] -= DARKNESS * cover(x, y, half, soft, target) as f32;
        }
    }
}

/// Share of a pixel that the smeared, blurred silhouette covers.
fn cover(x: usize, y: usize, half: f64, soft: f64, target: &RenderedTarget) -> f64 {
    /// The blur as a 3x3 quadrature of the Gaussian: nodes at 0 and +-sqrt(3) sigma, each with its
    /// weight. With half of the distance the blur would have a quarter of its variance.
    const NODES: [(f64, f64); 3] =
        [(-1.732_050_8, 1.0 / 6.0), (0.0, 2.0 / 3.0), (1.732_050_8, 1.0 / 6.0)];
    let mut sum = 0.0;
    for step in 0..SMEAR_STEPS {
        let along = (step as f64 + 0.5) / SMEAR_STEPS as f64;
        let cx = target.from[0] + (target.to[0] - target.from[0]) * along;
        let cy = target.from[1] + (target.to[1] - target.from[1]) * along;
        for (nx, wx) in NODES {
            for (ny, wy) in NODES {
                let mut inside = 0;
                for sub in 0..SUPERSAMPLING * SUPERSAMPLING {
                    let offset = |i: usize| (i as f64 + 0.5) / SUPERSAMPLING as f64 - 0.5;
                    let px = x as f64 + offset(sub % SUPERSAMPLING) + nx * soft - cx;
                    let py = y as f64 + offset(sub / SUPERSAMPLING) + ny * soft - cy;
                    inside += usize::from(silhouette(px / half, py / half));
                }
                sum += wx * wy * inside as f64;
            }
        }
    }
    sum / (SMEAR_STEPS * SUPERSAMPLING * SUPERSAMPLING) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_targets_centre_of_darkness_is_its_centre() {
        let (width, height) = (60, 50);
        let mut image = vec![200.0_f32; width * height];
        let target = RenderedTarget { from: [30.3, 24.6], to: [30.3, 24.6], span: 14.0, blur: 0.7 };
        draw(&mut image, width, height, &target);
        let (mut sum, mut x, mut y) = (0.0, 0.0, 0.0);
        for (index, value) in image.iter().enumerate() {
            let dark = f64::from(200.0 - value);
            sum += dark;
            x += dark * (index % width) as f64;
            y += dark * (index / width) as f64;
        }
        assert!(
            (x / sum - 30.3).abs() < 0.03 && (y / sum - 24.6).abs() < 0.03,
            "{} {}",
            x / sum,
            y / sum
        );
    }

    #[test]
    fn a_strip_covers_as_much_as_its_length_and_width_wherever_it_lies() {
        for (from, to) in [([10.2, 10.7], [40.9, 33.1]), ([12.5, 5.5], [12.5, 45.0])] {
            let mut image = vec![100.0_f32; 60 * 50];
            let pieces = vec![Piece::Strip { from, to, width: 0.6 }];
            RenderedThing { pieces, level: 200.0 }.draw(&mut image, 60, 0.8);
            let sum: f64 = image.iter().map(|v| f64::from(v - 100.0) / 100.0).sum();
            let length = (to[0] - from[0]).hypot(to[1] - from[1]);
            // Sampled at whole pixels: a hundredth.
            assert!((sum / (0.6 * length) - 1.0).abs() < 0.01, "{sum} {length}");
        }
    }

    #[test]
    fn a_target_outside_the_image_changes_nothing() {
        let mut image = vec![100.0_f32; 400];
        draw(
            &mut image,
            20,
            20,
            &RenderedTarget { from: [-50.0, 5.0], to: [-50.0, 5.0], span: 10.0, blur: 1.0 },
        );
        assert!(image.iter().all(|v| *v == 100.0));
    }
}
