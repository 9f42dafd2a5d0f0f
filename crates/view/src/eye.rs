//! The point from which the 3D view looks at a site.

use nalgebra::{Point3, Vector3};
use rerun_types::blueprint::archetypes::EyeControls3D;
use rerun_types::blueprint::components::Eye3DKind;

use crate::extent::BoundingBox;

/// Tangent of half of Rerun's vertical field of view (55 degrees in all). With half of it the eye
/// would be twice as far away as it must.
const HALF_HEIGHT: f64 = 0.52;
/// The same horizontally, for a view that is wider than high. With half of it a wide site would be
/// seen from twice as far away.
const HALF_WIDTH: f64 = 1.5 * HALF_HEIGHT;
/// Factor on the distance that leaves room for labels at the borders. At 1 the labels of the
/// outermost cameras are cut off; with half of it half of the site is outside of the view.
const ROOM: f64 = 1.1;
/// Number of iterations: after these the target moves by less than a pixel. With half of it the
/// site lies a little beside the middle.
const CENTRINGS: u32 = 4;
/// Least distance of the eye, m. With half of it the eye would be
/// within a frustum, which is 12 m long.
const CLOSEST_M: f64 = 20.0;

/// An eye that has a whole box in view, from the south and above, so that north is up in the
/// picture.
pub(crate) fn on(extent: &BoundingBox) -> EyeControls3D {
    let f32s = |point: Point3<f64>| [point.x as f32, point.y as f32, point.z as f32];
    let EyePlace { eye, target } = place_eye(extent);
    EyeControls3D::new()
        .with_kind(Eye3DKind::Orbital)
        .with_position(f32s(eye))
        .with_look_target(f32s(target))
        .with_eye_up([0.0_f32, 0.0, 1.0])
}

/// A line of sight to a target.
struct Gaze {
    target: Point3<f64>,
    towards_eye: Vector3<f64>,
    /// Axes of the picture.
    right: Vector3<f64>,
    up: Vector3<f64>,
}

impl Gaze {
    /// The least distance of an eye that has a corner in view: its offset across divided by its
    /// depth is then at most the field's tangent.
    fn least_distance(&self, corner: Point3<f64>) -> f64 {
        let from = corner - self.target;
        let slope =
            (from.dot(&self.right).abs() / HALF_WIDTH).max(from.dot(&self.up).abs() / HALF_HEIGHT);
        from.dot(&self.towards_eye) + slope
    }

    /// A corner's tangent from the line of sight along an axis.
    fn seen(&self, corner: Point3<f64>, axis: &Vector3<f64>, distance: f64) -> f64 {
        let from = corner - self.target;
        // The depth is kept above a tenth of the distance.
        from.dot(axis) / (distance - from.dot(&self.towards_eye)).max(0.1 * distance)
    }

    /// Half-way between the outermost corners along an axis, as seen from a distance: as a length
    /// at the target.
    fn middle(&self, extent: &BoundingBox, axis: &Vector3<f64>, distance: f64) -> f64 {
        let seen = extent.corners().map(|corner| self.seen(corner, axis, distance));
        let (low, high) = seen.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), seen| {
            (low.min(seen), high.max(seen))
        });
        0.5 * (low + high) * distance
    }
}

/// Where the eye is, and the point in the middle of its view.
struct EyePlace {
    eye: Point3<f64>,
    target: Point3<f64>,
}

/// The eye that has a whole box in view.
fn place_eye(extent: &BoundingBox) -> EyePlace {
    let towards_eye = Vector3::new(-0.35, -1.0, 0.75).normalize();
    let right = Vector3::z().cross(&towards_eye).normalize();
    let up = towards_eye.cross(&right);
    let mut gaze = Gaze { target: extent.middle(), towards_eye, right, up };
    let mut distance = CLOSEST_M;
    // Near corners look larger, so the centre of the box is not the centre of the picture. The
    // target is moved to the picture's centre and the distance computed again.
    for _ in 0..CENTRINGS {
        let distances = extent.corners().map(|corner| gaze.least_distance(corner));
        distance = distances.fold(CLOSEST_M, f64::max);
        gaze.target +=
            gaze.middle(extent, &right, distance) * right + gaze.middle(extent, &up, distance) * up;
    }
    EyePlace { eye: gaze.target + ROOM * distance * towards_eye, target: gaze.target }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_corners_of_a_site_are_in_view_and_one_is_near_the_border() {
        for [width, depth, height] in
            [[100.0, 100.0, 30.0], [400.0, 20.0, 5.0], [10.0, 10.0, 300.0]]
        {
            let extent = BoundingBox::of([
                Point3::new(-50.0, 7.0, 2.0),
                Point3::new(width - 50.0, 7.0 + depth, height),
            ]);
            let EyePlace { eye: place, target } = place_eye(&extent);
            let forward = (target - place).normalize();
            let right = forward.cross(&Vector3::z()).normalize();
            let up = right.cross(&forward);
            let shares: Vec<f64> = extent
                .corners()
                .map(|corner| {
                    let from = corner - place;
                    let across = from.dot(&right).abs() / HALF_WIDTH;
                    across.max(from.dot(&up).abs() / HALF_HEIGHT) / from.dot(&forward)
                })
                .collect();
            let most = shares.into_iter().fold(0.0, f64::max);
            assert!((0.7..1.0).contains(&most), "{most}");
        }
    }
}
