//! How a camera that turns moves its image.

use nalgebra::{Point2, Similarity2, Translation2, UnitComplex, Vector2};

use crate::ImagePoint;

/// Most that one image may be larger than another: in single steps of a zoom that is more than any
/// lens makes, and rounding is still below 1e-9 px. With half of it the same.
const FARTHEST_SCALE: f64 = 1e4;

/// Where what is in an image was in another one. A camera that turns shifts its image; one that
/// looks up and pans rolls it too, and one that zooms scales it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SceneTurn(Similarity2<f64>);

impl Default for SceneTurn {
    fn default() -> Self {
        Self::none()
    }
}

impl SceneTurn {
    /// Nothing has moved.
    pub(crate) fn none() -> Self {
        Self(Similarity2::identity())
    }

    /// Everything is shifted by so many px.
    pub(crate) fn shift([x, y]: [f64; 2]) -> Self {
        Self(Similarity2::new(Vector2::new(x, y), 0.0, 1.0))
    }

    /// What is at `r` px from a place was at `r + shift + zoom r + roll (-r_y, r_x)` from it.
    pub(crate) fn about(place: ImagePoint, shift: [f64; 2], zoom: f64, roll: f64) -> Self {
        // (1 + zoom, roll) = scale (cos, sin) of the angle; the floor keeps the scale above 0.
        let (real, imaginary) = ((1.0 + zoom).max(0.1), roll);
        let (scale, angle) = (real.hypot(imaginary), imaginary.atan2(real));
        let about = Vector2::new(place.x, place.y);
        let rotated = UnitComplex::new(angle) * about * scale;
        let translation = about + Vector2::from(shift) - rotated;
        Self(Similarity2::from_parts(
            Translation2::from(translation),
            UnitComplex::new(angle),
            scale,
        ))
    }

    /// Where what is at a place was.
    pub(crate) fn place(self, ImagePoint { x, y }: ImagePoint) -> ImagePoint {
        let place = self.0.transform_point(&Point2::new(x, y));
        ImagePoint { x: place.x, y: place.y }
    }

    /// From a place to where it was, px.
    pub(crate) fn moves(self, place: ImagePoint) -> [f64; 2] {
        let then = self.place(place);
        [then.x - place.x, then.y - place.y]
    }

    /// The way there by way of a third image: first `self`, then `next`. Where one is
    /// [`FARTHEST_SCALE`] times as large as the other nothing is known of the way.
    pub(crate) fn and_then(self, next: Self) -> Self {
        let scale = self.scale() * next.scale();
        let is_known = (FARTHEST_SCALE.recip()..FARTHEST_SCALE).contains(&scale);
        if is_known { Self(next.0 * self.0) } else { Self::none() }
    }

    pub(crate) fn inverse(self) -> Self {
        Self(self.0.inverse())
    }

    /// How far roll and zoom move what is a px from where they move nothing, px.
    pub(crate) fn bend(self) -> f64 {
        let [zoom, roll] = self.zoom_and_roll();
        zoom.hypot(roll)
    }

    /// The zoom and the roll of [`Self::about`].
    pub(crate) fn zoom_and_roll(self) -> [f64; 2] {
        let (sin, cos) = self.roll_rad().sin_cos();
        [self.scale() * cos - 1.0, self.scale() * sin]
    }

    /// Size there over size here.
    pub(crate) fn scale(self) -> f64 {
        self.0.scaling()
    }

    /// Direction there of what is level here, x towards y.
    pub(crate) fn roll_rad(self) -> f64 {
        self.0.isometry.rotation.angle()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_near(one: ImagePoint, other: ImagePoint) {
        assert!((one.x - other.x).hypot(one.y - other.y) < 1e-9, "{one:?}, {other:?}");
    }

    #[test]
    fn a_turn_about_a_place_does_what_it_says() {
        let about = ImagePoint { x: 100.0, y: 50.0 };
        let turn = SceneTurn::about(about, [3.0, -2.0], 0.1, 0.2);
        // (10, 0) from the place: 10 + 3 + 0.1 * 10 to the right, -2 + 0.2 * 10 down.
        assert_near(turn.place(ImagePoint { x: 110.0, y: 50.0 }), ImagePoint { x: 114.0, y: 50.0 });
        assert_eq!(turn.moves(about).map(|by| (by * 1e9).round() / 1e9), [3.0, -2.0]);
        assert!((turn.scale() - 1.1_f64.hypot(0.2)).abs() < 1e-12);
        assert!((turn.roll_rad() - 0.2_f64.atan2(1.1)).abs() < 1e-12);
        assert!((turn.bend() - 0.1_f64.hypot(0.2)).abs() < 1e-12);
    }

    #[test]
    fn a_turn_and_its_inverse_lead_back() {
        let place = ImagePoint { x: 12.0, y: 300.0 };
        let turn = SceneTurn::about(ImagePoint { x: 1.0, y: 2.0 }, [30.0, 4.0], -0.1, 0.3);
        assert_near(turn.and_then(turn.inverse()).place(place), place);
        let next = SceneTurn::shift([5.0, 6.0]);
        assert_near(turn.and_then(next).place(place), next.place(turn.place(place)));
    }

    #[test]
    fn hours_of_zoom_end_in_no_turn_and_in_no_panic() {
        let step = SceneTurn::about(ImagePoint { x: 3.0, y: 4.0 }, [1.0, 0.0], -0.05, 0.01);
        let mut turn = SceneTurn::none();
        for _ in 0..100_000 {
            turn = step.and_then(turn);
            assert!(turn.inverse().place(ImagePoint { x: 9.0, y: 9.0 }).x.is_finite());
        }
    }
}
