//! The motion that most of what moves has in common: it is the scene's. Where a camera turns over a
//! scene too bare to be registered, all that stands out moves, and nothing else shows the turn.

use crate::ImagePoint;

/// Fewest things that make a scene. With half of it four drones that fly side by side across the
/// image are taken for the scene. Where heads pan over bare skies (four real clips), 4, 8
/// and 16 leave as many false boxes.
const LEAST_THINGS: usize = 8;
/// Least share of all that moves. With half of it a quarter of a swarm that happens to fly alike is
/// taken for the scene.
const LEAST_SHARE: f64 = 0.5;
/// A scene's things lie across the image, a formation's in one place: on one axis at least, their
/// standard deviation is no less than this share of the one of things that lie anywhere, with the
/// same probability. With half of it a formation as wide as a quarter of the image is the scene.
const LEAST_SPREAD: f64 = 0.5;
/// Velocities are alike within this many standard deviations, ... With half of it 129 false tracks
/// per minute are left in those clips instead of 108.
const ALIKE_SDS: f64 = 2.0;
/// ... and within this share of their speed: what is near to a camera that turns about another
/// point, or that rolls, moves a little otherwise. With none 130 false tracks per minute are left.
const ALIKE_SHARE: f64 = 0.1;

/// How something moves in the image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ImageMotion {
    pub(crate) place: ImagePoint,
    /// Velocity, px/s.
    pub(crate) velocity: [f64; 2],
    /// Its standard deviation on either axis, px/s.
    pub(crate) sd: f64,
}

impl ImageMotion {
    fn speed(&self) -> f64 {
        self.velocity[0].hypot(self.velocity[1])
    }

    /// Whether it moves for sure, and not by the noise of its place.
    fn is_sure(&self) -> bool {
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
pub(super) struct CommonMotion(ImageMotion);

impl CommonMotion {
    /// The motion that most of what moves has in common, in an image of `sides`; `None` if there is
    /// none.
    pub(super) fn of(all: impl Iterator<Item = ImageMotion>, sides: [usize; 2]) -> Option<Self> {
        let moving: Vec<ImageMotion> = all.filter(ImageMotion::is_sure).collect();
        let alike = |one: &ImageMotion| moving.iter().filter(|other| one.is_like(other)).count();
        let (count, most) =
            moving.iter().map(|one| (alike(one), one)).max_by_key(|(count, _)| *count)?;
        let is_most = count >= LEAST_THINGS && count as f64 > LEAST_SHARE * moving.len() as f64;
        let places = moving.iter().filter(|other| most.is_like(other)).map(|other| other.place);
        (is_most && lie_across(places, sides)).then_some(Self(*most))
    }

    /// Whether something moves with the scene.
    pub(super) fn holds(&self, motion: &ImageMotion) -> bool {
        self.0.is_like(motion)
    }
}

/// Whether places lie across an image, and not in one part of it.
fn lie_across(places: impl Iterator<Item = ImagePoint> + Clone, sides: [usize; 2]) -> bool {
    let number = places.clone().count() as f64;
    let spread = |axis: usize| {
        let along = places.clone().map(move |place| [place.x, place.y][axis]);
        let mean = along.clone().sum::<f64>() / number;
        (along.map(|at| (at - mean).powi(2)).sum::<f64>() / number).sqrt()
    };
    // Of a uniform distribution over a side s the standard deviation is s / sqrt(12).
    (0..2).any(|axis| spread(axis) >= LEAST_SPREAD * sides[axis] as f64 / 12.0_f64.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDES: [usize; 2] = [640, 512];

    fn motion(at: f64, velocity: [f64; 2]) -> ImageMotion {
        ImageMotion { place: ImagePoint { x: at, y: 200.0 }, velocity, sd: 5.0 }
    }

    #[test]
    fn the_scene_moves_as_most_of_what_moves() {
        let scene = |count: u32, apart: f64| {
            (0..count).map(f64::from).map(move |i| motion(40.0 + apart * i, [i - 150.0, 2.0]))
        };
        let others = [[40.0, 0.0], [0.0, -60.0], [-150.0, 90.0]].map(|v| motion(300.0, v));
        let at_rest = (0..40).map(|i| motion(9.0 * f64::from(i), [f64::from(i % 7) - 3.0, 4.0]));
        let common = |all: &mut dyn Iterator<Item = ImageMotion>| CommonMotion::of(all, SIDES);
        let found = common(&mut scene(8, 60.0).chain(others).chain(at_rest)).unwrap();
        assert!(found.holds(&motion(0.0, [-140.0, -8.0])));
        assert!(!others.iter().any(|one| found.holds(one)));
        assert!(common(&mut scene(7, 60.0).chain(others)).is_none(), "few");
        assert!(common(&mut scene(20, 8.0).chain(others)).is_none(), "a formation");
        let many = (0..9).map(|i| motion(300.0, [60.0 * f64::from(i), 300.0]));
        assert!(common(&mut scene(8, 60.0).chain(many)).is_none(), "less than half");
    }
}
