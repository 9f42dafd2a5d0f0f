//! The motion that most of what moves has in common: it is the scene's. Where a camera turns over a
//! scene too bare to be registered, all that stands out moves, and nothing else shows the turn.

use crate::{ImagePoint, ImageTrackId};

/// Fewest things that make a scene. With half of it four drones that fly side by side across the
/// image are taken for the scene; with twice as much a sky with a few clouds is none.
const LEAST_THINGS: usize = 8;
/// Least share of all that moves. With half of it one of two ranks of a swarm that fly past each
/// other is taken for the scene.
const LEAST_SHARE: f64 = 0.6;
/// A scene's things lie across the image, a formation's in one place: on one axis at least, their
/// standard deviation is no less than this share of the one of things that lie anywhere, with the
/// same probability. With half of it a formation as wide as a quarter of the image is the scene.
const LEAST_SPREAD: f64 = 0.5;
/// Velocities are alike within this many standard deviations, ... With half of it noise alone keeps
/// six in ten of the scene's things apart from the others (`exp(-1/2)`), instead of one in seven.
const ALIKE_SDS: f64 = 2.0;
/// ... and within this share of their speed: what is near to a camera that turns about another
/// point, or that rolls, moves a little otherwise. With half of it the corners of a wide image are
/// no part of the scene (reasoned, not measured).
const ALIKE_SHARE: f64 = 0.1;
/// At most this many things, evenly chosen, propose a motion: each is compared with all. With half
/// of it nothing changes but where hundreds of things move.
const MOST_PROPOSALS: usize = 64;

/// Averaging time of a known target's velocity in the image, s. With half of it a pixel's error in
/// its place is 15 px/s.
const VELOCITY_S: f64 = 0.15;
/// A known target is the scene if it has moved with it for at least this share of the time since it
/// was found, ... With half of it a drone whose way is the scene's for a while is given up.
const LEAST_TIME: f64 = 0.5;
/// ... and was found no longer than this before most things began to move alike, s: what was found
/// earlier has moved by itself. With half of it what comes into view just before is followed to
/// the end of the turn (reasoned, not measured).
const BEFORE_ALIKE_S: f64 = 0.5;

/// Something that may move in the image.
#[derive(Clone, Copy, Debug)]
pub(super) struct MovingThing {
    pub(super) place: ImagePoint,
    /// Velocity, px/s.
    pub(super) velocity: [f64; 2],
    /// Its standard deviation on either axis, px/s.
    pub(super) sd: f64,
}

impl MovingThing {
    fn speed(&self) -> f64 {
        self.velocity[0].hypot(self.velocity[1])
    }

    /// Whether it moves by more than the noise of its place, as one in ten of those at rest does.
    fn is_moving(&self) -> bool {
        !self.is_like(&Self { velocity: [0.0; 2], sd: 0.0, ..*self })
    }

    fn is_like(&self, other: &Self) -> bool {
        let apart = [0, 1].map(|i| self.velocity[i] - other.velocity[i]);
        let within =
            ALIKE_SDS * self.sd.hypot(other.sd) + ALIKE_SHARE * self.speed().max(other.speed());
        apart[0].hypot(apart[1]) <= within
    }
}

/// The motion of the scene, by what moves in the image.
#[derive(Clone, Copy, Debug)]
pub(super) struct CommonMotion(MovingThing);

impl CommonMotion {
    /// The motion that most of what moves has in common, in an image of `sides`; `None` if there is
    /// none.
    pub(super) fn of(all: impl Iterator<Item = MovingThing>, sides: [usize; 2]) -> Option<Self> {
        // What was found in this image has moved, but nobody knows yet how.
        let (found_now, others): (Vec<_>, Vec<_>) = all.partition(|thing| thing.sd.is_infinite());
        let moving: Vec<MovingThing> = others.into_iter().filter(MovingThing::is_moving).collect();
        if moving.len() < LEAST_THINGS {
            return None;
        }
        let alike = |one: &MovingThing| moving.iter().filter(|other| one.is_like(other)).count();
        let proposed = moving.iter().step_by(moving.len().div_ceil(MOST_PROPOSALS));
        let first = proposed.max_by_key(|one| alike(one))?;
        // The proposal that is known worst is like most: their mean is judged in its place.
        let common = Self(mean(moving.iter().filter(|one| first.is_like(one)))?);
        let places: Vec<ImagePoint> =
            moving.iter().filter(|one| common.holds(one)).map(|one| one.place).collect();
        let is_most = places.len() >= LEAST_THINGS
            && places.len() as f64 > LEAST_SHARE * (moving.len() + found_now.len()) as f64;
        (is_most && lie_across(&places, sides)).then_some(common)
    }

    /// Whether something moves with the scene.
    pub(super) fn holds(&self, thing: &MovingThing) -> bool {
        thing.is_moving() && self.0.is_like(thing)
    }
}

/// The mean velocity, weighted by what each tells of the common one: no thing tells it better than
/// to [`ALIKE_SHARE`] of its own speed, however well that is known, as what is near or seen by a
/// camera that rolls moves otherwise.
fn mean<'a>(things: impl Iterator<Item = &'a MovingThing>) -> Option<MovingThing> {
    let (mut velocity, mut information, mut any) = ([0.0; 2], 0.0, None);
    for thing in things {
        let of_scene = thing.sd.hypot(ALIKE_SHARE * thing.speed());
        let weight = of_scene.powi(2).max(f64::MIN_POSITIVE).recip();
        velocity = [0, 1].map(|i| velocity[i] + weight * thing.velocity[i]);
        information += weight;
        any = Some(*thing);
    }
    let velocity = velocity.map(|sum: f64| sum / information);
    any.map(|any| MovingThing { velocity, sd: information.sqrt().recip(), ..any })
}

/// Whether places lie across an image, and not in one part of it.
fn lie_across(places: &[ImagePoint], sides: [usize; 2]) -> bool {
    let number = places.len() as f64;
    let spread = |axis: usize| {
        let along = places.iter().map(|place| [place.x, place.y][axis]);
        let mean = along.clone().sum::<f64>() / number;
        (along.map(|at| (at - mean).powi(2)).sum::<f64>() / number).sqrt()
    };
    // Of a uniform distribution over a side s the standard deviation is s / sqrt(12).
    (0..2).any(|axis| spread(axis) >= LEAST_SPREAD * sides[axis] as f64 / 12.0_f64.sqrt())
}

/// A target that the detector has found, and how it has moved since.
#[derive(Clone, Copy, Debug)]
pub(super) struct FoundTarget {
    pub(super) id: ImageTrackId,
    /// In the image, with a running mean of the velocity there.
    pub(super) now: MovingThing,
    age_s: f64,
    /// For how long it has moved with the scene, s.
    with_scene_s: f64,
}

impl FoundTarget {
    pub(super) fn new(id: ImageTrackId, place: ImagePoint) -> Self {
        let now = MovingThing { place, velocity: [0.0; 2], sd: f64::INFINITY };
        Self { id, now, age_s: 0.0, with_scene_s: 0.0 }
    }

    /// Takes its next place; `sd` is how well its velocity is known, px/s.
    pub(super) fn take(&mut self, place: ImagePoint, sd: f64, interval: f64) {
        self.age_s += interval;
        // A plain mean at first: v += a (step / T - v), a = T / age and at least that of the mean.
        let share = (1.0 - (-interval / VELOCITY_S).exp()).max(interval / self.age_s);
        let step = [place.x - self.now.place.x, place.y - self.now.place.y];
        for (velocity, step) in self.now.velocity.iter_mut().zip(step) {
            *velocity += share * (step / interval - *velocity);
        }
        (self.now.place, self.now.sd) = (place, sd);
    }

    /// Whether it is the scene, in which most things have moved alike for `alike_s` seconds.
    pub(super) fn is_scene(&mut self, scene: &CommonMotion, alike_s: f64, interval: f64) -> bool {
        if !scene.holds(&self.now) {
            return false;
        }
        self.with_scene_s += interval;
        self.with_scene_s >= LEAST_TIME * self.age_s && self.age_s < alike_s + BEFORE_ALIKE_S
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDES: [usize; 2] = [640, 512];

    fn thing(at: [f64; 2], velocity: [f64; 2], sd: f64) -> MovingThing {
        MovingThing { place: ImagePoint { x: at[0], y: at[1] }, velocity, sd }
    }

    /// A row of things that move left, as many pixels apart on either axis.
    fn scene(count: u32, apart: [f64; 2]) -> Vec<MovingThing> {
        let at = |i: f64| apart.map(|apart| 30.0 + apart * i);
        (0..count).map(f64::from).map(|i| thing(at(i), [i - 150.0, 2.0], 5.0)).collect()
    }

    #[test]
    fn the_scene_moves_as_most_of_what_moves() {
        let others =
            [[40.0, 0.0], [0.0, -60.0], [-150.0, 90.0]].map(|v| thing([300.0, 9.0], v, 5.0));
        let at_rest: Vec<MovingThing> = (0..40)
            .map(f64::from)
            .map(|i| thing([9.0 * i, 8.0 * i], [i % 7.0 - 3.0, 4.0], 5.0))
            .collect();
        let unsure = [thing([90.0, 90.0], [250.0, 0.0], 130.0)];
        let common = |things: &[&[MovingThing]]| {
            CommonMotion::of(things.iter().copied().flatten().copied(), SIDES)
        };
        let found = common(&[&scene(8, [60.0, 0.0]), &others, &at_rest, &unsure]).unwrap();
        assert!(found.holds(&thing([0.0, 0.0], [-140.0, -8.0], 5.0)));
        assert!(!others.iter().any(|one| found.holds(one)));
        assert!(!found.holds(&thing([0.0, 0.0], [-20.0, 0.0], 120.0)), "nobody knows");
        assert!(common(&[&scene(7, [60.0, 0.0]), &others]).is_none(), "few");
        // The standard deviation of ten in a row is 2.87 of their distances; 92 and 74 px are
        // asked.
        for (apart, is_scene) in
            [([33.0, 0.0], true), ([31.0, 0.0], false), ([0.0, 27.0], true), ([0.0, 24.0], false)]
        {
            assert_eq!(common(&[&scene(10, apart), &others]).is_some(), is_scene, "{apart:?}");
        }
        let many: Vec<MovingThing> =
            (0..9).map(f64::from).map(|i| thing([300.0, 9.0], [60.0 * i, 300.0], 5.0)).collect();
        assert!(common(&[&scene(8, [60.0, 0.0]), &many]).is_none(), "too few of all");
    }

    #[test]
    fn a_target_whose_velocity_is_known_well_is_not_taken_for_the_scene() {
        let unsure = |number: u32| {
            let across = 600.0 / f64::from(number);
            let thing = move |i| thing([across * i, 9.0], [-150.0, 2.0 * (i % 5.0)], 20.0);
            (0..number).map(f64::from).map(thing)
        };
        let target = thing([300.0, 200.0], [-100.0, 0.0], 0.4);
        for number in [10, 20, 200] {
            let scene =
                CommonMotion::of(unsure(number).chain(std::iter::once(target)), SIDES).unwrap();
            assert!(scene.holds(&thing([0.0, 0.0], [-150.0, 0.0], 1.0)), "{number}: {scene:?}");
            assert!(!scene.holds(&target), "{number}: {scene:?}");
        }
    }

    #[test]
    fn what_moves_with_the_scene_is_the_scene_unless_it_was_there_before() {
        let turn = CommonMotion(thing([0.0, 0.0], [-150.0, 0.0], 2.0));
        for (before, beside, is_given_up) in [(3, 0, true), (60, 0, false), (3, 60, false)] {
            let mut found = FoundTarget::new(ImageTrackId(1), ImagePoint { x: 600.0, y: 9.0 });
            let mut x = 600.0;
            for _ in 0..before {
                found.take(ImagePoint { x, y: 9.0 }, 5.0, 1.0 / 30.0);
            }
            let mut is_scene = false;
            for image in 0..90 {
                // At first it flies otherwise.
                x += if image < beside { 2.0 } else { -5.0 };
                found.take(ImagePoint { x, y: 9.0 }, 5.0, 1.0 / 30.0);
                is_scene |= found.is_scene(&turn, f64::from(image) / 30.0, 1.0 / 30.0);
            }
            assert_eq!(is_scene, is_given_up, "{before} before, {beside} beside");
        }
    }
}
