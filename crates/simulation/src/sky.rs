//! A textured sky: a gradient, and clouds of value noise in octaves.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Brightness at the lower (horizon) and the upper (zenith) edge of the image, 8-bit levels:
/// between them clouds and targets fit above and below. With half of both, targets would be black.
const GRADIENT: [f32; 2] = [190.0, 130.0];
/// Amplitude of the coarsest clouds, 8-bit levels; each finer octave has half of it. All octaves
/// together reach 43; with twice as much clouds could be as dark as targets, with half of it they
/// are easily distinguished from them.
const CLOUDS: f32 = 22.0;
/// Size of the coarsest clouds, pixels. With half of it no cloud is as large as a quarter of a
/// picture of 640x480.
const COARSEST: usize = 160;
/// Number of octaves of clouds: the finest are of 10 pixels, as small as targets. With half of it
/// none is smaller than 40.
const OCTAVES: u32 = 5;

/// Period of a panorama's clouds in knots, in every octave: after this many the clouds repeat. With
/// half of it the finest clouds repeat every 320 pixels and not every 640.
const PERIOD: usize = 64;

/// A sky of `width` by `height` pixels, row by row.
pub(crate) fn sky(width: usize, height: usize, seed: u64) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut samples = gradient(width, height);
    for octave in 0..OCTAVES {
        let (cell, strength) = cell_and_strength(octave);
        // Value noise: random values at knots a cell apart, interpolated in between.
        let columns = width / cell + 2;
        let knots: Vec<f32> =
            (0..columns * (height / cell + 2)).map(|_| rng.random::<f32>() * 2.0 - 1.0).collect();
        for (index, sample) in samples.iter_mut().enumerate() {
            let (x, y) = (index % width, index / width);
            let corner = |dx: usize, dy: usize| knots[(y / cell + dy) * columns + x / cell + dx];
            *sample += strength * between(corner, [x % cell, y % cell], cell);
        }
    }
    samples
}

/// Brightness that falls from the lower edge to the upper one.
fn gradient(width: usize, height: usize) -> Vec<f32> {
    (0..width * height).map(|index| level(1.0 - (index / width) as f32 / height as f32)).collect()
}

/// Brightness at a share of the height, from the lower edge.
fn level(up: f32) -> f32 {
    GRADIENT[0] + (GRADIENT[1] - GRADIENT[0]) * up
}

/// Size (pixels) and strength (levels) of an octave's clouds.
fn cell_and_strength(octave: u32) -> (usize, f32) {
    ((COARSEST >> octave).max(2), CLOUDS / (1 << octave) as f32)
}

/// Interpolates between the knots at the corners of a cell, by smoothstep weights.
fn between(corner: impl Fn(usize, usize) -> f32, [x, y]: [usize; 2], cell: usize) -> f32 {
    let [tx, ty] = [x, y].map(|offset| smoothstep(offset as f32 / cell as f32));
    let upper = corner(0, 0) * (1.0 - tx) + corner(1, 0) * tx;
    let lower = corner(0, 1) * (1.0 - tx) + corner(1, 1) * tx;
    upper * (1.0 - ty) + lower * ty
}

/// From 0 to 1 as `t` does, level at both ends.
fn smoothstep(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

/// A periodic sky all around, of which a camera that turns sees a part.
#[derive(Clone, Debug)]
pub(crate) struct Panorama {
    octaves: Vec<Vec<f32>>,
}

impl Panorama {
    pub(crate) fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut knots = || (0..PERIOD * PERIOD).map(|_| rng.random::<f32>() * 2.0 - 1.0).collect();
        Self { octaves: (0..OCTAVES).map(|_| knots()).collect() }
    }

    /// The part that begins `left` pixels to the right of the panorama's origin and `top` pixels
    /// below it, row by row.
    pub(crate) fn part(&self, [left, top]: [i64; 2], width: usize, height: usize) -> Vec<f32> {
        let mut samples = gradient(width, height);
        for (octave, knots) in (0..).zip(&self.octaves) {
            let (cell, strength) = cell_and_strength(octave);
            let around = (cell * PERIOD) as i64;
            for (index, sample) in samples.iter_mut().enumerate() {
                let place =
                    |from: i64, offset: usize| (from + offset as i64).rem_euclid(around) as usize;
                let (x, y) = (place(left, index % width), place(top, index / width));
                let corner = |dx, dy| periodic_knot(knots, x / cell + dx, y / cell + dy);
                *sample += strength * between(corner, [x % cell, y % cell], cell);
            }
        }
        samples
    }
}

/// The knot of a panorama's octave in a column and a row, which repeat.
fn periodic_knot(knots: &[f32], column: usize, row: usize) -> f32 {
    knots[row % PERIOD * PERIOD + column % PERIOD]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panorama_seen_from_a_little_aside_is_the_same_sky_moved() {
        let panorama = Panorama::new(5);
        let (here, there) = (panorama.part([-70, 30], 60, 40), panorama.part([-60, 30], 60, 40));
        for y in 0..40 {
            assert_eq!(here[y * 60 + 10..y * 60 + 60], there[y * 60..y * 60 + 50]);
        }
        assert_ne!(here, there);
    }
}
