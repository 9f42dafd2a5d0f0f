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
        let [columns, rows] = [width / cell + 2, height / cell + 2];
        let values = (0..columns * rows).map(|_| rng.random::<f32>() * 2.0 - 1.0).collect();
        let knots = Knots { values, columns };
        let [across, down] = [(width, columns), (height, rows)].map(|(side, around)| {
            (0..side).map(|at| Between::knots(at, cell, around)).collect::<Vec<_>>()
        });
        knots.add(strength, &across, &down, &mut samples);
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

/// Random values at the knots of an octave, row by row.
#[derive(Clone, Debug)]
struct Knots {
    values: Vec<f32>,
    columns: usize,
}

/// Where a pixel lies between two knots of an axis, by smoothstep weights.
#[derive(Clone, Copy, Debug)]
struct Between {
    knots: [usize; 2],
    weights: [f32; 2],
}

impl Between {
    /// For the pixel `at`, with knots a cell apart that repeat after `around` of them.
    fn knots(at: usize, cell: usize, around: usize) -> Self {
        let after = smoothstep((at % cell) as f32 / cell as f32);
        let knot = at / cell;
        Self { knots: [knot % around, (knot + 1) % around], weights: [1.0 - after, after] }
    }

    fn of(&self, values: &[f32]) -> f32 {
        values[self.knots[0]] * self.weights[0] + values[self.knots[1]] * self.weights[1]
    }
}

impl Knots {
    /// Adds the clouds between the knots to an image whose columns and rows lie there.
    fn add(&self, strength: f32, across: &[Between], down: &[Between], samples: &mut [f32]) {
        let row = |row: usize| &self.values[row * self.columns..][..self.columns];
        for (line, down) in samples.chunks_exact_mut(across.len().max(1)).zip(down) {
            let [above, below] = down.knots.map(row);
            for (sample, across) in line.iter_mut().zip(across) {
                let (upper, lower) = (across.of(above), across.of(below));
                *sample += strength * (upper * down.weights[0] + lower * down.weights[1]);
            }
        }
    }
}

/// From 0 to 1 as `t` does, level at both ends.
fn smoothstep(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

/// A periodic sky all around, of which a camera that turns sees a part.
#[derive(Clone, Debug)]
pub(crate) struct Panorama {
    octaves: Vec<Knots>,
}

impl Panorama {
    pub(crate) fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut values = || (0..PERIOD * PERIOD).map(|_| rng.random::<f32>() * 2.0 - 1.0).collect();
        let octaves = (0..OCTAVES).map(|_| Knots { values: values(), columns: PERIOD }).collect();
        Self { octaves }
    }

    /// The part that begins `left` pixels to the right of the panorama's origin and `top` pixels
    /// below it, row by row.
    pub(crate) fn part(&self, [left, top]: [i64; 2], width: usize, height: usize) -> Vec<f32> {
        let mut samples = gradient(width, height);
        for (octave, knots) in (0..).zip(&self.octaves) {
            let (cell, strength) = cell_and_strength(octave);
            let around = (cell * PERIOD) as i64;
            let [across, down] = [(left, width), (top, height)].map(|(from, side)| {
                let places = (0..side as i64).map(|at| (from + at).rem_euclid(around) as usize);
                places.map(|at| Between::knots(at, cell, PERIOD)).collect::<Vec<_>>()
            });
            knots.add(strength, &across, &down, &mut samples);
        }
        samples
    }
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
