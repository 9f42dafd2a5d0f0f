//! How targets fly.

use std::f64::consts::TAU;

use nalgebra::{Point3, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::site::{DURATION_S, between};

/// How a target flies.
pub enum Flight {
    Straight {
        from: Point3<f64>,
        velocity: Vector3<f64>,
    },
    Hovering {
        at: Point3<f64>,
        sway_m: f64,
        rate: f64,
    },
    Circling {
        around: Point3<f64>,
        radius_m: f64,
        rate: f64,
    },
    /// Now here, now there, along a path that never closes.
    Wandering {
        around: Point3<f64>,
        reach_m: f64,
        rates: [f64; 3],
        phases: [f64; 3],
    },
    /// As autopilots fly: straight from one place to the next, with a rest at each.
    Legs(Vec<Leg>),
}

/// From rest to rest: gains speed, keeps it, brakes.
pub struct Leg {
    begins_s: f64,
    from: Point3<f64>,
    to: Point3<f64>,
    /// m/s^2.
    acceleration: f64,
    /// Greatest speed, m/s.
    speed: f64,
}

impl Leg {
    /// Time that it takes, s.
    fn takes_s(&self) -> f64 {
        (self.to - self.from).norm() / self.speed + self.speed / self.acceleration
    }

    fn at(&self, t: f64) -> Point3<f64> {
        let path = self.to - self.from;
        let takes_s = self.takes_s();
        let gains_s = self.speed / self.acceleration;
        let t = (t - self.begins_s).clamp(0.0, takes_s);
        let gained = |t: f64| self.acceleration * t.powi(2) / 2.0;
        let flown = if t < gains_s {
            gained(t)
        } else if t < takes_s - gains_s {
            gained(gains_s) + self.speed * (t - gains_s)
        } else {
            path.norm() - gained(takes_s - t)
        };
        self.from + path.normalize() * flown
    }

    /// Many, one after the other, within reach of a place.
    fn draw_many(around: Point3<f64>, reach_m: f64, random: &mut ChaCha8Rng) -> Vec<Self> {
        let mut place = || {
            around
                + Vector3::from_fn(|i, _| random.random_range(-1.0..1.0) * [1.0, 1.0, 0.3][i])
                    * reach_m
        };
        let places: Vec<_> = (0..40).map(|_| place()).collect();
        let (fastest, acceleration) = (between(3.0, 20.0, random), between(2.0, 12.0, random));
        let mut begins_s = 0.0;
        let pairs = places.windows(2).map(|pair| {
            let [from, to] = [pair[0], pair[1]];
            // Faster than this it could not brake in time.
            let speed = fastest.min((acceleration * (to - from).norm()).sqrt());
            let leg = Self { begins_s, from, to, acceleration, speed };
            begins_s += leg.takes_s() + 1.0;
            leg
        });
        pairs.collect()
    }
}

impl Flight {
    /// A flight near a place, before cameras that are so far away.
    pub fn draw(middle: Point3<f64>, radius_m: f64, random: &mut ChaCha8Rng) -> Self {
        let reach_m = 0.3 * radius_m;
        let around = middle + Vector3::from_fn(|_, _| random.random_range(-0.5..0.5)) * reach_m;
        // No faster than from the middle to the cameras in ten seconds, nor than such targets fly.
        let speed = random.random_range(0.02..0.1) * radius_m.min(300.0);
        match random.random_range(0..4) {
            0 => {
                let towards = random.random_range(0.0..TAU);
                let climb = random.random_range(-0.1..0.1);
                let velocity = Vector3::new(towards.cos(), towards.sin(), climb) * speed;
                Self::Straight { from: around - velocity * (DURATION_S / 2.0), velocity }
            }
            1 => {
                let sway_m = 10f64.powf(random.random_range(-2.0..0.0));
                Self::Hovering { at: around, sway_m, rate: random.random_range(0.2..1.0) }
            }
            2 => {
                let radius_m = random.random_range(0.3..1.0) * reach_m;
                Self::Circling { around, radius_m, rate: speed / radius_m }
            }
            _ => {
                let mut rates = [0.0; 3];
                rates.fill_with(|| speed / reach_m * random.random_range(0.5..1.5));
                let mut phases = [0.0; 3];
                phases.fill_with(|| random.random_range(0.0..TAU));
                Self::Wandering { around, reach_m, rates, phases }
            }
        }
    }

    /// One of a hard site: half fly as autopilots do.
    pub fn draw_hard(middle: Point3<f64>, radius_m: f64, random: &mut ChaCha8Rng) -> Self {
        if random.random() {
            let reach_m = 0.3 * radius_m.min(300.0);
            Self::Legs(Leg::draw_many(middle, reach_m, random))
        } else {
            Self::draw(middle, radius_m, random)
        }
    }

    /// Where it is at a time after the beginning, s.
    pub fn at(&self, t: f64) -> Point3<f64> {
        match self {
            Self::Legs(legs) => {
                let begun = legs.iter().rfind(|leg| leg.begins_s <= t);
                begun.or(legs.first()).map_or_else(Point3::origin, |leg| leg.at(t))
            }
            Self::Straight { from, velocity } => from + velocity * t,
            Self::Hovering { at, sway_m, rate } => {
                let sway =
                    Vector3::new((rate * t).sin(), (1.3 * rate * t).cos(), (0.7 * rate * t).sin());
                at + sway * *sway_m
            }
            Self::Circling { around, radius_m, rate } => {
                let (north, east) = (rate * t).sin_cos();
                around + Vector3::new(east, north, 0.0) * *radius_m
            }
            Self::Wandering { around, reach_m, rates, phases } => {
                let of = |axis: usize| (rates[axis] * t + phases[axis]).sin();
                around + Vector3::new(of(0), of(1), 0.3 * of(2)) * *reach_m
            }
        }
    }

    /// What it is called.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Straight { .. } => "straight",
            Self::Hovering { .. } => "hovering",
            Self::Circling { .. } => "circling",
            Self::Wandering { .. } => "wandering",
            Self::Legs(_) => "by legs",
        }
    }
}
