//! A textured sky: a gradient, and clouds of value noise in octaves.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Brightness at the horizon's side and the zenith's side of the image, 8-bit levels.
const GRADIENT: [f32; 2] = [190.0, 130.0];
/// Strength of the coarsest clouds, levels; each finer octave has half of it.
const CLOUDS: f32 = 22.0;
/// Size of the coarsest clouds, pixels.
const COARSEST: usize = 160;
const OCTAVES: u32 = 5;

/// A sky of a size, row by row.
pub(crate) fn sky(width: usize, height: usize, seed: u64) -> Vec<f32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut samples: Vec<f32> = (0..width * height)
        .map(|index| {
            let up = 1.0 - (index / width) as f32 / height as f32;
            GRADIENT[0] + (GRADIENT[1] - GRADIENT[0]) * up
        })
        .collect();
    for octave in 0..OCTAVES {
        let cell = (COARSEST >> octave).max(2);
        let strength = CLOUDS / (1 << octave) as f32;
        let columns = width / cell + 2;
        let knots: Vec<f32> =
            (0..columns * (height / cell + 2)).map(|_| rng.random::<f32>() * 2.0 - 1.0).collect();
        for (index, sample) in samples.iter_mut().enumerate() {
            let (x, y) = (index % width, index / width);
            let smooth = |offset: usize| {
                let t = offset as f32 / cell as f32;
                t * t * (3.0 - 2.0 * t)
            };
            let (tx, ty) = (smooth(x % cell), smooth(y % cell));
            let corner = |dx: usize, dy: usize| knots[(y / cell + dy) * columns + x / cell + dx];
            let upper = corner(0, 0) * (1.0 - tx) + corner(1, 0) * tx;
            let lower = corner(0, 1) * (1.0 - tx) + corner(1, 1) * tx;
            *sample += strength * (upper * (1.0 - ty) + lower * ty);
        }
    }
    samples
}
