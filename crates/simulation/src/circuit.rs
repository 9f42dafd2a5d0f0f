//! Flights that stay within a volume: straight or gently turning, and turning back at its border.

use std::f64::consts::{FRAC_PI_4, PI, TAU};

use nalgebra::{Point3, Vector2, Vector3};
use rand::{Rng, RngExt};

/// Duration of one arc, after which a target decides again how to go on, s. With half of it twice
/// as many arcs are kept; with twice as much, a target at 20 m/s flies up to 20 m beyond the inner
/// border before it turns back.
const LEG_S: f64 = 0.5;
/// Mean time after which a gently turning target chooses another rate of turn, s. With half of it
/// flights change their turn twice as often, which filters follow less well.
const MOOD_S: f64 = 10.0;
/// Lowest rate of turn at which a target turns back at the border, rad/s. With half of it a target
/// at 20 m/s turns within 200 m, so that the inner border of the default site lies 90 m and not 190
/// m from the middle.
const LEAST_TURN_BACK: f64 = 0.2;

/// The volume that targets stay within, and how they fly in it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Airspace {
    /// Half of each side of the area, east and north, m.
    pub(crate) half: Vector2<f64>,
    /// Lowest and highest altitude, m.
    pub(crate) heights: [f64; 2],
    /// Slowest and fastest, m/s.
    pub(crate) speeds: [f64; 2],
    /// Greatest rate of turn away from the border, rad/s; 0 is straight.
    pub(crate) turn: f64,
}

/// One arc of a flight: its start and its rate of turn.
#[derive(Clone, Copy, Debug)]
struct Leg {
    place: Vector2<f64>,
    /// Direction of the velocity at the start, from east towards north, rad.
    heading: f64,
    /// Rate of turn to the left, rad/s.
    turn: f64,
}

/// One target's flight: consecutive arcs at constant speed; its height oscillates slowly.
#[derive(Clone, Debug)]
pub(crate) struct Circuit {
    speed: f64,
    legs: Vec<Leg>,
    middle: f64,
    swing: f64,
    /// Period of the height's oscillation, s.
    period: f64,
    phase: f64,
}

impl Circuit {
    /// A random flight of at least `duration_s` seconds.
    pub(crate) fn random(airspace: &Airspace, duration_s: f64, rng: &mut impl Rng) -> Self {
        let Airspace { half, heights: [low, high], speeds: [slow, fast], turn } = *airspace;
        let speed = rng.random_range(slow..=fast);
        let turn_back = turn.max(LEAST_TURN_BACK);
        // Across a side a target goes beyond the inner border by at most one leg plus the radius of
        // its turn back; in a corner by up to as much again (0.751 of it was observed).
        let margin = speed * LEG_S + speed / turn_back;
        let inner = half.map(|side| side - margin.min(0.75 * side));
        let mut place = Vector2::from_fn(|axis, _| inner[axis] * rng.random_range(-1.0..=1.0));
        let mut heading = rng.random_range(0.0..TAU);
        let mut mood = turn * rng.random_range(-1.0..=1.0);
        let mut legs = Vec::new();
        for _ in 0..=(duration_s / LEG_S).ceil() as usize {
            // On average once in MOOD_S.
            if rng.random_bool(LEG_S / MOOD_S) {
                mood = turn * rng.random_range(-1.0..=1.0);
            }
            let back = way_back(place, heading, inner).map(|side| side * turn_back);
            let leg = Leg { place, heading, turn: back.unwrap_or(mood) };
            legs.push(leg);
            (place, heading) = leg.after(LEG_S, speed);
        }
        let room = (high - low) / 2.0;
        let swing = room * rng.random_range(0.0..=0.5);
        Self {
            speed,
            legs,
            middle: low + room + (room - swing) * rng.random_range(-1.0..=1.0),
            swing,
            // The greatest rate of climb is 2 pi swing / period: no more than 1 m/s.
            period: (TAU * swing).max(60.0),
            phase: rng.random_range(0.0..TAU),
        }
    }

    /// Position and velocity at a time from the start; after the end of the last leg its arc
    /// continues.
    pub(crate) fn state(&self, t: f64) -> (Point3<f64>, Vector3<f64>) {
        let index = ((t / LEG_S).max(0.0) as usize).min(self.legs.len() - 1);
        let (place, heading) = self.legs[index].after(t - index as f64 * LEG_S, self.speed);
        let rate = TAU / self.period;
        let angle = rate * t + self.phase;
        let position = Point3::new(place.x, place.y, self.middle + self.swing * angle.sin());
        let climb = self.swing * rate * angle.cos();
        (position, Vector3::new(self.speed * heading.cos(), self.speed * heading.sin(), climb))
    }
}

impl Leg {
    /// Place and heading `t` seconds on.
    fn after(&self, t: f64, speed: f64) -> (Vector2<f64>, f64) {
        let heading = self.heading + self.turn * t;
        // The chord of an arc points along the middle heading and has the length v t sin(h) / h,
        // with h half the angle turned.
        let half = self.turn * t / 2.0;
        let shorter = if half.abs() < 1e-6 { 1.0 } else { half.sin() / half };
        let middle = self.heading + half;
        (self.place + Vector2::new(middle.cos(), middle.sin()) * (speed * t * shorter), heading)
    }
}

/// Direction in which to turn (1 left, -1 right) to come back within the inner border; `None`
/// inside it, or if the heading is within 45 degrees of the way home.
fn way_back(place: Vector2<f64>, heading: f64, inner: Vector2<f64>) -> Option<f64> {
    let beyond =
        Vector2::from_fn(|axis, _| place[axis] - place[axis].clamp(-inner[axis], inner[axis]));
    if beyond == Vector2::zeros() {
        return None;
    }
    let home = (-beyond.y).atan2(-beyond.x);
    let off = (home - heading + PI).rem_euclid(TAU) - PI;
    (off.abs() > FRAC_PI_4).then_some(off.signum())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn nobody_leaves_the_volume_or_jumps(seed in 0u64..1000, turn in 0.0..0.3) {
            let airspace =
                Airspace { half: Vector2::new(300.0, 200.0), heights: [40.0, 120.0], speeds: [5.0, 20.0], turn };
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let flight = Circuit::random(&airspace, 120.0, &mut rng);
            for step in 0..1200 {
                let t = f64::from(step) * 0.1;
                let (position, velocity) = flight.state(t);
                // In a corner a target may go beyond the border.
                let beyond = [position.x.abs() - 300.0, position.y.abs() - 200.0];
                prop_assert!(beyond.iter().all(|b| *b <= 110.0), "{position} at {t}");
                prop_assert!((40.0..=120.0).contains(&position.z));
                let (next, _) = flight.state(t + 1e-4);
                prop_assert!(((next - position) / 1e-4 - velocity).norm() < 1e-2, "{t}");
            }
        }
    }
}
