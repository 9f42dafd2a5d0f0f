use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;

const INTERVAL: f64 = 1.0 / 30.0;
const NOISE_SD: f64 = 0.1;

/// A target whose acceleration has a standard deviation, seen through a reference that is the mean of its images, and what
/// is believed of it.
struct Flight {
    rng: ChaCha8Rng,
    sky: Plane,
    position: [f64; 2],
    velocity: [f64; 2],
    offset: [f64; 2],
    motion: Motion,
    images: f64,
}

impl Flight {
    fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let position = [1000.0, 1000.0];
        let given =
            position.map(|at| AxisMeasurement { position: at + 0.05 * normal(), variance: 0.05f64.powi(2) });
        // The first image's own noise puts the target beside the reference's middle.
        let offset = [0, 1].map(|i| given[i].position - position[i] - NOISE_SD * normal());
        let velocity = [20.0 * normal(), 20.0 * normal()];
        let motion = Motion::at_rest(given, 20.0, 900.0);
        Self {
            sky: Plane::from_fn(4000, 2000, |_, _| 0.0),
            position,
            velocity,
            offset,
            motion,
            images: 1.0,
            rng,
        }
    }

    /// The next image, its noise over what it is expected to be; returns the squared normalised innovation.
    fn step(&mut self, acceleration_sd: f64, noise_over: f64) -> f64 {
        let mut normal = || -> f64 { StandardNormal.sample(&mut self.rng) };
        for i in 0..2 {
            let acceleration = acceleration_sd * normal();
            self.position[i] += INTERVAL * (self.velocity[i] + INTERVAL / 2.0 * acceleration);
            self.velocity[i] += INTERVAL * acceleration;
        }
        self.motion.predict(INTERVAL, &self.sky);
        let noise = [0, 1].map(|_| noise_over * NOISE_SD * normal());
        let variance = self.motion.noise_factor() * NOISE_SD.powi(2);
        let at = [0, 1]
            .map(|i| AxisMeasurement { position: self.position[i] + self.offset[i] + noise[i], variance });
        self.motion.tell_noise([variance; 2]);
        let surprise = self.motion.surprise(at);
        self.motion.update(&Evidence::of(at));
        self.motion.match_noise(surprise);
        let place = self.motion.position();
        let share = if self.images < 20.0 { 1.0 / (self.images + 1.0) } else { 0.0 };
        for (i, at) in [place.x, place.y].into_iter().enumerate() {
            self.offset[i] = (1.0 - share) * self.offset[i] + share * (at - self.position[i] - noise[i]);
        }
        self.motion.learn(place, share, Some([variance; 2]));
        self.images += 1.0;
        surprise
    }

    /// Squared normalised error of position and velocity of both axes: chi-square with four degrees of freedom.
    fn error(&self) -> f64 {
        let (place, velocity) = (self.motion.position(), self.motion.velocity());
        let off = [(place.x, velocity.x), (place.y, velocity.y)];
        (0..2)
            .map(|i| {
                let error = nalgebra::Vector2::new(off[i].0 - self.position[i], off[i].1 - self.velocity[i]);
                (error.transpose() * self.motion.covariances()[i].try_inverse().unwrap() * error).x
            })
            .sum()
    }
}

/// Means over runs of the squared innovation and error in the last third of a second of a flight of two seconds.
fn consistency(acceleration_sd: f64) -> (f64, f64) {
    let (mut innovations, mut errors, mut count) = (0.0, 0.0, 0.0);
    for seed in 0..400 {
        let mut flight = Flight::new(seed);
        for image in 0..60 {
            let surprise = flight.step(acceleration_sd, 1.0);
            if image >= 50 {
                innovations += surprise;
                errors += flight.error();
                count += 1.0;
            }
        }
    }
    (innovations / count, errors / count)
}

#[test]
fn what_is_believed_is_as_sure_as_it_is_right() {
    // The errors of a flight are one sample, of variance 8: a standard error of 0.14. Between two ways of moving the
    // innovations are smaller than the livelier's and larger than the calmer's, and in the mean over all as they should be.
    let livelinesses = [900.0, 600.0, 400.0, 180.0, 90.0, 36.0];
    let mut sum = 0.0;
    for acceleration_sd in livelinesses {
        let (innovation, error) = consistency(acceleration_sd);
        assert!((innovation - 2.0).abs() < 0.5, "{acceleration_sd} px/s^2: NIS {innovation}");
        assert!((error - 4.0).abs() < 0.8, "{acceleration_sd} px/s^2: NEES {error}");
        sum += innovation / livelinesses.len() as f64;
    }
    assert!((sum - 2.0).abs() < 0.1, "mean NIS {sum}");
    // An even flight may end at any moment, so that less is believed of it than is known.
    let (innovation, error) = consistency(0.0);
    assert!((innovation - 2.0).abs() < 0.2 && (1.0..4.0).contains(&error), "{innovation}, {error}");
}

#[test]
fn noise_that_is_other_than_expected_is_matched() {
    for over in [0.3, 3.0] {
        let mut sum = 0.0;
        for seed in 0..20 {
            let mut flight = Flight::new(seed);
            for _ in 0..450 {
                flight.step(0.0, over);
            }
            sum += flight.motion.noise_factor().ln() / 20.0;
        }
        let found = (sum / 2.0).exp();
        assert!((found / over).ln().abs() < 0.2, "{over} times the deviation is taken for {found} times");
    }
}

#[test]
fn an_even_flight_is_known_better_and_a_turn_is_believed_at_once() {
    let mut flight = Flight::new(1);
    for _ in 0..90 {
        flight.step(0.0, 1.0);
    }
    let even = flight.motion.covariances()[0].m22.sqrt();
    for _ in 0..5 {
        flight.step(900.0, 1.0);
    }
    let lively = flight.motion.covariances()[0].m22.sqrt();
    assert!(even < 3.0 && lively > 10.0, "{even} and {lively} px/s");
}
