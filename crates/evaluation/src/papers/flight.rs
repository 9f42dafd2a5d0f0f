//! Pictures of a flying silhouette, and a tracker that follows it.

use crossfix_correlation::Plane;
use crossfix_message::Timestamp;
use crossfix_simulation::Silhouette;
use crossfix_vision::{ImagePoint, ImageTrack, ImageTracker, PixelBox, TrackerConfig};
use nalgebra::{Matrix2, Vector2};

use super::runs::Noise;

/// Time between images in the papers ("tact"), s. They count everything in tacts, so with half of
/// it only the units of the configuration would change.
pub(crate) const TACT: f64 = 1.0 / 30.0;
/// Standard deviation of the places given to a tracker, about the true ones, px. It is in the
/// tracker's configuration, so that its covariance is true from the start; with half of it the
/// same.
const GIVEN_SD: f64 = 0.02;
/// Sides of the pictures, px. The straight flights end at 590 px; with half of it they would leave
/// the picture.
const SIDE: usize = 640;
/// Frames of a flight (Herasymenko 2021, section 3). With half of it fewer targets would be lost.
pub(crate) const FRAMES: usize = 20;

/// Places of the papers' target: from (100, 100) at 10 px per tact on each axis, with white
/// acceleration of SD `sigma_a` px/tact^2.
pub(crate) fn texts_path(noise: &mut Noise, frames: usize, sigma_a: f64) -> Vec<[f64; 2]> {
    let (mut position, mut velocity) = ([100.0; 2], [10.0; 2]);
    let mut path = vec![position];
    for _ in 1..frames {
        for axis in 0..2 {
            let acceleration = sigma_a * noise.normal();
            position[axis] += velocity[axis] + acceleration / 2.0;
            velocity[axis] += acceleration;
        }
        path.push(position);
    }
    path
}

/// How the silhouette is drawn into the picture.
#[derive(Clone, Debug)]
pub(crate) enum Stamp {
    /// The box alone, its mean replaced by a pedestal, at whole pixels (errata, "Noisy reference").
    Pasted { crop: Vec<f32>, width: usize },
    /// On its own background at its true place.
    Drawn(Silhouette),
}

impl Stamp {
    /// A silhouette's crop as the papers paste it.
    pub(crate) fn pasted(silhouette: &Silhouette, pedestal: f32) -> Self {
        let mut crop = silhouette.canvas(0);
        let mean = crop.iter().sum::<f32>() / crop.len() as f32;
        crop.iter_mut().for_each(|b| *b += pedestal - mean);
        Self::Pasted { crop, width: silhouette.sides()[0] }
    }
}

/// A picture that is painted repeatedly: noise is drawn only where a gate can reach.
pub(crate) struct Canvas {
    image: Plane,
    reach: [usize; 2],
    painted: Option<[std::ops::Range<usize>; 2]>,
}

/// The columns (or rows) of the picture within `reach` of a place.
fn pixels_about(at: f64, reach: usize) -> std::ops::Range<usize> {
    let middle = at.round().clamp(0.0, SIDE as f64 - 1.0) as usize;
    middle.saturating_sub(reach)..(middle + reach).min(SIDE)
}

impl Canvas {
    /// A picture for targets of given sides.
    pub(crate) fn new(sides: [usize; 2]) -> Self {
        let image = Plane::from_fn(SIDE, SIDE, |_, _| 0.0);
        Self { image, reach: sides.map(|side| 3 * side + 40), painted: None }
    }

    /// Paints a picture: the stamp `strength` times at a place, about which everything becomes
    /// brighter by `light` and gets noise of SD `sigma_n`.
    pub(crate) fn paint(
        &mut self,
        stamp: Option<&Stamp>,
        at: [f64; 2],
        strength: f32,
        light: f32,
        sigma_n: f64,
        noise: &mut Noise,
    ) -> &Plane {
        if let Some([columns, rows]) = self.painted.take() {
            for row in rows {
                self.image.row_mut(row)[columns.clone()].fill(0.0);
            }
        }
        let area = [0, 1].map(|axis| pixels_about(at[axis], self.reach[axis]));
        match stamp {
            Some(Stamp::Drawn(silhouette)) => {
                silhouette.draw(self.image.samples_mut(), SIDE, at, strength);
            }
            Some(Stamp::Pasted { crop, width }) => self.paste(crop, *width, at),
            None => {}
        }
        for row in area[1].clone() {
            let samples = &mut self.image.row_mut(row)[area[0].clone()];
            samples.iter_mut().for_each(|sample| *sample += light);
            noise.add_to(samples, sigma_n as f32);
        }
        self.painted = Some(area);
        &self.image
    }

    fn paste(&mut self, crop: &[f32], width: usize, at: [f64; 2]) {
        let height = crop.len() / width;
        // At whole pixels, the nearest to the place.
        let start = |at: f64, side: usize| (at - (side as f64 - 1.0) / 2.0).round() as isize;
        let (left, top) = (start(at[0], width), start(at[1], height));
        for (i, value) in crop.iter().enumerate() {
            let (x, y) = (left + (i % width) as isize, top + (i / width) as isize);
            if let (Ok(x), Ok(y)) = (usize::try_from(x), usize::try_from(y))
                && x < SIDE
                && y < SIDE
            {
                self.image.row_mut(y)[x] = *value;
            }
        }
    }
}

/// A tracker started from the true places in the first two pictures.
pub(crate) struct PaperFollower {
    tracker: ImageTracker,
    frame: usize,
    size: [f64; 2],
    last: Option<ImageTrack>,
    sigma_a: f64,
}

/// Errors of one picture's track, with the covariances that the filter stated.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrackErrors {
    /// Prediction less truth, px.
    pub(crate) prediction: [f64; 2],
    /// Variance of the prediction as the filter states it, per axis.
    pub(crate) prediction_variance: [f64; 2],
    /// Estimate less truth, px.
    pub(crate) estimate: [f64; 2],
    /// Variance of the estimate as the filter states it, per axis.
    pub(crate) estimate_variance: [f64; 2],
    /// Normalised innovation squared of both axes, if there was a measurement.
    pub(crate) nis: Option<f64>,
    /// Normalised estimation error squared of position and velocity, the mean of both axes.
    pub(crate) nees: f64,
}

impl PaperFollower {
    /// A tracker with a configuration, for brightness from 0 to 1.
    pub(crate) fn new(config: TrackerConfig, sides: [usize; 2]) -> Option<Self> {
        let sigma_a = config.acceleration_sd_px;
        let tracker = ImageTracker::new(TrackerConfig {
            noise_floor: 1.0 / 255.0,
            given_sd_px: GIVEN_SD,
            centre_sd_px: 0.0,
            ..config
        })
        .ok()?;
        Some(Self { tracker, frame: 0, size: sides.map(|s| s as f64), last: None, sigma_a })
    }

    /// Processes the next picture; `truth` and `velocity` (px/s) are the true ones. In the first
    /// two pictures the tracker is given the place, and there is no outcome.
    pub(crate) fn step(
        &mut self,
        image: &Plane,
        truth: [f64; 2],
        velocity: [f64; 2],
        noise: &mut Noise,
    ) -> Option<TrackErrors> {
        let [x, y] =
            if self.frame < 2 { truth.map(|at| at + GIVEN_SD * noise.normal()) } else { truth };
        let place = ImagePoint { x, y };
        match (self.frame, &self.last) {
            (0, _) => self.tracker.take_up(PixelBox::about(place, self.size[0], self.size[1])),
            (1, Some(track)) => self.tracker.cue(track.id, place),
            _ => {}
        }
        let time = Timestamp::from_seconds(self.frame as f64 * TACT);
        let before = self.last.take();
        self.last = self.tracker.step(image, time).first().copied();
        self.frame += 1;
        if self.frame <= 2 {
            return None;
        }
        self.outcome(&before?, &self.last?, truth, velocity)
    }

    fn outcome(
        &self,
        before: &ImageTrack,
        now: &ImageTrack,
        truth: [f64; 2],
        velocity: [f64; 2],
    ) -> Option<TrackErrors> {
        let of = |p: ImagePoint| [p.x, p.y];
        let (was, speed, is, is_speed) =
            (of(before.position), of(before.velocity), of(now.position), of(now.velocity));
        // Constant-velocity prediction F P F' + G G' sigma_a^2.
        let f = Matrix2::new(1.0, TACT, 0.0, 1.0);
        let g = Vector2::new(TACT * TACT / 2.0, TACT) * self.sigma_a;
        let (known, knows) = (before.covariances?, now.covariances?);
        let predicted = [0, 1].map(|i| was[i] + TACT * speed[i]);
        let spread = [0, 1].map(|i| (f * known[i] * f.transpose() + g * g.transpose()).m11);
        let nis = now.measured.and(now.nis);
        let nees = (0..2)
            .map(|i| {
                let error = Vector2::new(is[i] - truth[i], is_speed[i] - velocity[i]);
                knows[i]
                    .try_inverse()
                    .map_or(f64::INFINITY, |inverse| (error.transpose() * inverse * error).x)
            })
            .sum::<f64>()
            / 2.0;
        Some(TrackErrors {
            prediction: [0, 1].map(|i| predicted[i] - truth[i]),
            prediction_variance: spread,
            estimate: [0, 1].map(|i| is[i] - truth[i]),
            estimate_variance: knows.map(|covariance| covariance.m11),
            nis,
            nees,
        })
    }
}
