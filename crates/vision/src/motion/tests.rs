use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;

const INTERVAL: f64 = 1.0 / 30.0;
const NOISE_SD: f64 = 0.1;
/// Sides of a picture that nothing leaves, px.
const SKY: [usize; 2] = [10_000_000; 2];

/// A simulated target with white acceleration, seen through a reference that is the mean of its
/// images, and the filters that follow it.
struct Flight {
    rng: ChaCha8Rng,
    position: [f64; 2],
    velocity: [f64; 2],
    offset: [f64; 2],
    motion: ImageMotion,
    images: f64,
}

impl Flight {
    fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let position = SKY.map(|side| side as f64 / 2.0);
        let given = position.map(|at| AxisMeasurement {
            position: at + 0.05 * normal(),
            variance: 0.05f64.powi(2),
        });
        // The first image's own noise puts the target beside the reference's middle.
        let offset = [0, 1].map(|i| given[i].position - position[i] - NOISE_SD * normal());
        let velocity = [20.0 * normal(), 20.0 * normal()];
        let motion = ImageMotion::at_rest(given, 20.0, 900.0);
        Self { position, velocity, offset, motion, images: 1.0, rng }
    }

    /// Simulates and filters the next image, whose noise is `noise_over` times the expected one;
    /// returns the squared normalised innovation.
    fn step(&mut self, acceleration_sd: f64, noise_over: f64) -> f64 {
        let mut normal = || -> f64 { StandardNormal.sample(&mut self.rng) };
        for i in 0..2 {
            let acceleration = acceleration_sd * normal();
            self.position[i] += INTERVAL * (self.velocity[i] + INTERVAL / 2.0 * acceleration);
            self.velocity[i] += INTERVAL * acceleration;
        }
        self.motion.predict(INTERVAL, SKY);
        let noise = [0, 1].map(|_| noise_over * NOISE_SD * normal());
        let variance = self.motion.noise_factor() * NOISE_SD.powi(2);
        let at = [0, 1].map(|i| AxisMeasurement {
            position: self.position[i] + self.offset[i] + noise[i],
            variance,
        });
        self.motion.add_noise_of_learned([variance; 2]);
        let nis = self.motion.nis(at);
        self.motion.update(&PlaceEvidence { near: 1.0, at, elsewhere: 0.0, elsewhere_at: at });
        self.motion.match_noise(nis);
        let place = self.motion.position();
        let share = if self.images < 20.0 { 1.0 / (self.images + 1.0) } else { 0.0 };
        for (i, at) in [place.x, place.y].into_iter().enumerate() {
            self.offset[i] =
                (1.0 - share) * self.offset[i] + share * (at - self.position[i] - noise[i]);
        }
        self.motion.learn(place, share, Some([variance; 2]));
        self.images += 1.0;
        nis
    }

    /// Squared normalised error of position and velocity over both axes: chi-square with four
    /// degrees of freedom.
    fn error(&self) -> f64 {
        let (place, velocity) = (self.motion.position(), self.motion.velocity());
        let off = [(place.x, velocity.x), (place.y, velocity.y)];
        (0..2)
            .map(|i| {
                let error = nalgebra::Vector2::new(
                    off[i].0 - self.position[i],
                    off[i].1 - self.velocity[i],
                );
                (error.transpose() * self.motion.covariances()[i].try_inverse().unwrap() * error).x
            })
            .sum()
    }
}

/// Mean squared innovation and mean squared error, both normalised, over runs and over the last
/// third of a second of a flight of two seconds.
fn consistency(acceleration_sd: f64) -> (f64, f64) {
    let (mut innovations, mut errors, mut count) = (0.0, 0.0, 0.0);
    for seed in 0..400 {
        let mut flight = Flight::new(seed);
        for image in 0..60 {
            let nis = flight.step(acceleration_sd, 1.0);
            if image >= 50 {
                innovations += nis;
                errors += flight.error();
                count += 1.0;
            }
        }
    }
    (innovations / count, errors / count)
}

#[test]
fn what_is_believed_is_as_sure_as_it_is_right() {
    // The errors of one flight count as one sample, of variance 8: a standard error of 0.14. At an
    // acceleration between two models' the innovations are smaller than the livelier one expects
    // and larger than the calmer one does; on average over all they are as they should be.
    let livelinesses = [900.0, 600.0, 400.0, 180.0, 90.0, 36.0];
    let mut sum = 0.0;
    for acceleration_sd in livelinesses {
        let (innovation, error) = consistency(acceleration_sd);
        assert!((innovation - 2.0).abs() < 0.6, "{acceleration_sd} px/s^2: NIS {innovation}");
        assert!((error - 4.0).abs() < 0.8, "{acceleration_sd} px/s^2: NEES {error}");
        sum += innovation / livelinesses.len() as f64;
    }
    assert!((sum - 2.0).abs() < 0.2, "mean NIS {sum}");
    // An even flight may end at any moment, so the stated covariance is larger than the actual
    // error.
    let (innovation, error) = consistency(0.0);
    assert!((innovation - 2.0).abs() < 0.2 && (1.0..4.0).contains(&error), "{innovation}, {error}");
}

#[test]
fn noise_that_is_less_than_expected_is_matched() {
    let mut sum = 0.0;
    for seed in 0..20 {
        let mut flight = Flight::new(seed);
        for _ in 0..900 {
            flight.step(0.0, 0.3);
        }
        sum += flight.motion.noise_factor().ln() / 20.0;
    }
    let found = (sum / 2.0).exp();
    assert!((found / 0.3).ln().abs() < 0.1, "0.3 times the deviation is taken for {found} times");
}

#[test]
fn the_noise_is_not_taken_for_less_where_motion_is_most_of_the_innovations() {
    for acceleration_sd in [900.0, 400.0, 60.0] {
        let mut sum = 0.0;
        for seed in 0..8 {
            let mut flight = Flight::new(seed);
            for _ in 0..1800 {
                flight.step(acceleration_sd, 1.0);
            }
            sum += flight.motion.noise_factor().ln() / 8.0;
        }
        let found = (sum / 2.0).exp();
        assert!(
            found.ln().abs() < 0.3,
            "{acceleration_sd} px/s^2: the deviation is taken for {found} times itself"
        );
    }
}

#[test]
fn a_place_that_somebody_knows_tells_the_offset() {
    let mut flight = Flight::new(3);
    for _ in 0..60 {
        flight.step(90.0, 1.0);
    }
    let before = flight.motion.offset()[0];
    let given = flight.position.map(|position| AxisMeasurement { position, variance: 1e-6 });
    flight.motion.take_place(given);
    let after = flight.motion.offset()[0];
    assert!((flight.motion.position().x - flight.position[0]).abs() < 1e-2);
    // What remains is the uncertainty that one image's noise leaves.
    assert!(after.variance < 0.5 * before.variance, "{before:?} {after:?}");
    assert!((after.position - flight.offset[0]).abs() < 3.0 * after.variance.sqrt());
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
