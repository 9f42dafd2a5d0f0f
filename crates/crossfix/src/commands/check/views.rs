//! How the cameras of a site look at one another's views: what no other camera sees is never found.

use std::collections::BTreeMap;

use crossfix_geometry::{Camera, Pixel};
use crossfix_message::CameraName;

/// A view is compared at this many places along each side of the image. With half of it a view that
/// crosses another one in a corner alone seems to cross none.
const PLACES: u32 = 9;
/// Nearest range at which it is compared, m. With half of it the same: nobody sees targets there.
const NEAREST_M: f64 = 5.0;
/// Farthest range, m: the fusion's default of the largest one. With half of it cameras whose views
/// cross beyond ten kilometres seem to be alone.
const FARTHEST_M: f64 = 20_000.0;

/// A camera as it is compared with the others.
pub(super) struct View<'a> {
    pub(super) camera: &'a Camera,
    /// Whether a mount turns it: then it may look anywhere.
    pub(super) turns: bool,
}

/// The cameras that see nothing that another one sees.
pub(super) fn alone<'a>(views: &BTreeMap<&'a CameraName, View<'_>>) -> Vec<&'a CameraName> {
    let all = || views.iter().map(|(name, view)| (*name, view));
    let is_alone = |&(name, view): &(&CameraName, &View<'_>)| {
        let mut others = all().filter(|(other, _)| *other != name);
        !view.turns && !others.any(|(_, other)| other.turns || cross(view.camera, other.camera))
    };
    if views.len() < 2 {
        return Vec::new();
    }
    all().filter(is_alone).map(|(name, _)| name).collect()
}

/// Whether one of two cameras sees any of the places in the other's view: a narrow view lies
/// between the places of a wide one.
fn cross(one: &Camera, other: &Camera) -> bool {
    sees_any(one, other) || sees_any(other, one)
}

/// Whether a camera sees any of the places in another one's view.
fn sees_any(other: &Camera, camera: &Camera) -> bool {
    let lens = other.model().intrinsics();
    let narrower =
        (f64::from(lens.size.width) / lens.fx).min(f64::from(lens.size.height) / lens.fy);
    // From range to range by half of the other's narrower view, so that it lies between no two; by
    // a fifth at most, and at least by a milliradian's, so that their number is bounded.
    let step = 1.0 + (narrower / 2.0).clamp(1e-3, 0.2);
    let size = camera.model().intrinsics().size;
    let along = |side: u32, k: u32| f64::from(side - 1) * f64::from(k) / f64::from(PLACES - 1);
    let pixels = (0..PLACES).flat_map(|x| (0..PLACES).map(move |y| (x, y)));
    let pixels = pixels.map(|(x, y)| Pixel::new(along(size.width, x), along(size.height, y)));
    let mut directions = pixels.filter_map(|pixel| camera.model().direction(pixel).ok());
    let pose = camera.pose();
    directions.any(|direction| {
        let towards = pose.rotation() * direction.into_inner();
        let ranges = std::iter::successors(Some(NEAREST_M), |range| Some(range * step));
        let mut ranges = ranges.take_while(|range| *range < FARTHEST_M);
        ranges.any(|range| other.sees(pose.position() + towards * range))
    })
}

/// The least and the greatest distance of two of the cameras, m.
pub(super) fn distances_m(views: &BTreeMap<&CameraName, View<'_>>) -> Option<[f64; 2]> {
    let places: Vec<_> = views.values().map(|view| view.camera.pose().position()).collect();
    let pairs = places.iter().enumerate();
    let pairs = pairs.flat_map(|(k, one)| places[..k].iter().map(move |two| (one - two).norm()));
    pairs.fold(None, |range: Option<[f64; 2]>, m| {
        Some(range.map_or([m, m], |[least, most]| [least.min(m), most.max(m)]))
    })
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{Distortion, ImageSize, Intrinsics, Pose};
    use nalgebra::Point3;

    use super::*;

    fn camera(at: [f64; 3], looking_at: [f64; 3]) -> Camera {
        camera_with(1000.0, at, looking_at)
    }

    /// A camera whose focal length is `f` (px).
    fn camera_with(f: f64, at: [f64; 3], looking_at: [f64; 3]) -> Camera {
        let size = ImageSize { width: 1280, height: 720 };
        let distortion = Distortion::None;
        let lens = Intrinsics { size, fx: f, fy: f, cx: 639.5, cy: 359.5, distortion };
        let pose = Pose::looking_at(Point3::from(at), Point3::from(looking_at)).unwrap();
        Camera::new(lens, pose).unwrap()
    }

    /// Who is alone, of cameras that stand and look there; those whose names begin with `t` turn.
    fn alone_of(cameras: &[(&str, [f64; 3], [f64; 3])]) -> Vec<String> {
        let known: Vec<(CameraName, Camera)> = cameras
            .iter()
            .map(|(name, at, looking_at)| (name.parse().unwrap(), camera(*at, *looking_at)))
            .collect();
        let views: BTreeMap<&CameraName, View<'_>> = known
            .iter()
            .map(|(name, camera)| (name, View { camera, turns: name.as_str().starts_with('t') }))
            .collect();
        alone(&views).into_iter().map(CameraName::to_string).collect()
    }

    #[test]
    fn a_camera_that_faces_away_from_the_others_is_alone() {
        let middle = [0.0, 0.0, 40.0];
        let [east, west] =
            [("east", [80.0, 0.0, 2.0], middle), ("west", [-80.0, 0.0, 2.0], middle)];
        let away = ("north", [0.0, 90.0, 2.0], [0.0, 400.0, 20.0]);
        assert_eq!(alone_of(&[east, west, ("north", [0.0, 90.0, 2.0], middle)]), [""; 0]);
        assert_eq!(alone_of(&[east, west, away]), ["north"]);
        // One that turns may look where the other looks.
        assert_eq!(alone_of(&[("turning", west.1, west.2), away]), [""; 0]);
        // A site of one camera is compared with nothing.
        assert_eq!(alone_of(&[east]), [""; 0]);
    }

    /// Views of 5 degrees lie between the places and ranges of a coarse comparison.
    #[test]
    fn narrow_views_that_cross_are_seen_to_cross() {
        let far = [313.0, 77.0, 41.0];
        let narrow = camera_with(14_000.0, [0.0, 0.0, 2.0], far);
        let across = camera_with(14_000.0, [313.0, -400.0, 2.0], far);
        let wide = camera([250.0, -100.0, 2.0], far);
        assert!(cross(&narrow, &across) && cross(&narrow, &wide) && cross(&wide, &narrow));
        // A hundred metres above it.
        let above = camera_with(14_000.0, [0.0, 0.0, 2.0], [313.0, 77.0, 141.0]);
        assert!(!cross(&above, &across));
    }

    #[test]
    fn cameras_that_look_past_each_other_are_all_alone() {
        let north = ("north", [-50.0, 0.0, 2.0], [-50.0, 100.0, 30.0]);
        let south = ("south", [50.0, 0.0, 2.0], [50.0, -100.0, 30.0]);
        assert_eq!(alone_of(&[north, south]), ["north", "south"]);
    }
}
