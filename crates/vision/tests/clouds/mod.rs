//! Images of clouds with a small target, and a tracker on it.

#![allow(dead_code, reason = "not every test needs all")]

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_vision::{ImageTrack, ImageTracker, PixelBox, TrackerConfig};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

pub const WIDTH: usize = 240;
pub const HEIGHT: usize = 180;

/// Clouds, noise, and a target of 10 by 6 pixels.
pub struct Scene {
    pub rng: ChaCha8Rng,
    /// Standard deviations of the clouds and of the noise, and the target's contrast, levels.
    clouds: f32,
    noise: f32,
    pub contrast: f32,
    /// Frequencies and phases of the clouds' waves.
    waves: Vec<[f32; 3]>,
}

impl Scene {
    pub fn new(seed: u64, clouds: f32, noise: f32, contrast: f32) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let waves = (0..24)
            .map(|_| {
                let angle = rng.random_range(0.0..std::f32::consts::TAU);
                let frequency = std::f32::consts::TAU / rng.random_range(18.0..90.0_f32);
                [frequency * angle.cos(), frequency * angle.sin(), rng.random_range(0.0..6.3)]
            })
            .collect();
        Self { rng, clouds, noise, contrast, waves }
    }

    /// The image of a camera that looks `turned` pixels further right and down, with the target at
    /// a place in the scene.
    pub fn image(&mut self, target: Option<[f32; 2]>, turned: [f32; 2]) -> Plane {
        self.image_with(target, turned, |_, _| 0.0)
    }

    /// The image of a camera that rolls, with the target at a place of the image and something that
    /// looks just like it at a place of the scene; and where that is in the image.
    pub fn image_rolled(
        &mut self,
        target: Option<[f32; 2]>,
        roll_rad: f32,
        alike: [f32; 2],
    ) -> (Plane, [f32; 2]) {
        let straight = self.image_with(None, [0.0; 2], |_, _| 0.0);
        let at = rolled(alike, -roll_rad);
        let blob = |place: [f32; 2], [x, y]: [f32; 2]| {
            let (u, v) = ((x - place[0]) / 4.0, (y - place[1]) / 2.4);
            self.contrast * (-0.5 * (u * u + v * v).powi(2)).exp()
        };
        let image = Plane::from_fn(WIDTH, HEIGHT, |column, row| {
            let here = [column as f32, row as f32];
            let [x, y] = rolled(here, roll_rad);
            let scene = straight.clamped(x.round() as isize, y.round() as isize);
            scene + blob(at, here) + target.map_or(0.0, |target| blob(target, here))
        });
        (image, at)
    }

    /// The same, and what is added to it by a function of column and row of the image.
    pub fn image_with(
        &mut self,
        target: Option<[f32; 2]>,
        turned: [f32; 2],
        more: impl Fn(f32, f32) -> f32,
    ) -> Plane {
        let per_wave = self.clouds * (2.0 / self.waves.len() as f32).sqrt();
        let (waves, contrast, noise) = (&self.waves, self.contrast, self.noise);
        let rng = &mut self.rng;
        Plane::from_fn(WIDTH, HEIGHT, |column, row| {
            let (x, y) = (column as f32 + turned[0], row as f32 + turned[1]);
            let cloud: f32 =
                waves.iter().map(|[fx, fy, phase]| (fx * x + fy * y + phase).sin()).sum();
            let body = target.map_or(0.0, |[tx, ty]| {
                let (u, v) = ((x - tx) / 4.0, (y - ty) / 2.4);
                contrast * (-0.5 * (u * u + v * v).powi(2)).exp()
            });
            let normal: f32 = StandardNormal.sample(rng);
            128.0 + per_wave * cloud + body + more(column as f32, row as f32) + noise * normal
        })
    }
}

/// Where what is at a place of the image of a camera that rolls by an angle is in the scene.
fn rolled([x, y]: [f32; 2], roll_rad: f32) -> [f32; 2] {
    let middle = [WIDTH as f32 / 2.0, HEIGHT as f32 / 2.0];
    let ([right, down], (sin, cos)) = ([x - middle[0], y - middle[1]], roll_rad.sin_cos());
    [middle[0] + cos * right - sin * down, middle[1] + sin * right + cos * down]
}

pub fn tracker_on([x, y]: [f32; 2]) -> ImageTracker {
    let mut tracker = ImageTracker::new(TrackerConfig::default()).unwrap();
    let centre = crossfix_vision::ImagePoint { x: f64::from(x), y: f64::from(y) };
    tracker.take_up(PixelBox::about(centre, 10.0, 6.0));
    tracker
}

pub fn step(tracker: &mut ImageTracker, image: &Plane, frame: u32) -> ImageTrack {
    let tracks = tracker.step(image, Timestamp::from_seconds(f64::from(frame) / 25.0));
    assert!(tracks.len() == 1 && tracks[0].id.0 == 1, "image {frame}: {tracks:?}");
    tracks[0]
}

pub fn off(track: &ImageTrack, [x, y]: [f32; 2]) -> f64 {
    (track.position.x - f64::from(x)).hypot(track.position.y - f64::from(y))
}
