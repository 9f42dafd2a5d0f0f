//! What is drawn on a camera's images.

use crossfix_geometry::Camera;
use crossfix_message::{BearingTrack, Track, TrackNumber};
use nalgebra::{Point3, Vector2};
use rerun::RecordingStream;
use rerun_types::archetypes::{Boxes2D, LineStrips2D, Points2D};
use rerun_types::components::Radius;

use crate::draw::{SIGMAS, across_sd};
use crate::paths::image_path;
use crate::{ViewError, colour};

/// Smallest radius of a ring, pixels of the camera: a target of a few pixels must be visible inside
/// it. With half of it a target of 12 pixels fills its ring.
const LEAST_RING_PX: f64 = 12.0;
/// Number of line segments of a ring. With half of it a segment lies up to 3 % of the radius inside
/// the circle and not 1 %, which is seen in large rings.
const CORNERS: usize = 24;

/// The part of a camera's image in which targets were, pixels of the camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TargetRegion {
    low: Vector2<f64>,
    high: Vector2<f64>,
}

impl TargetRegion {
    /// Enlarges the region to contain a pixel; a pixel that is not finite is ignored.
    pub(crate) fn include(region: &mut Option<Self>, [x, y]: [f64; 2]) {
        let place = Vector2::new(x, y);
        if place.iter().all(|v| v.is_finite()) {
            let region = region.get_or_insert(Self { low: place, high: place });
            region.low = region.low.inf(&place);
            region.high = region.high.sup(&place);
        }
    }

    /// Low and high corner of the part of a picture to show, in pixels of the picture, which has
    /// this scale: the region with room for rings about it, inside the image.
    pub(crate) fn shown(&self, camera: &Camera, scale: f64) -> [[f64; 2]; 2] {
        let size = camera.model().intrinsics().size;
        let side = Vector2::new(f64::from(size.width), f64::from(size.height));
        let room = Vector2::repeat(4.0 * LEAST_RING_PX);
        // The same share of width and height, so that the part fills its view.
        let share = (self.high - self.low + 2.0 * room).component_div(&side).max().min(1.0);
        let half = 0.5 * share * side;
        let middle = 0.5 * (self.low + self.high);
        // Moves the centre so that the part stays within the image.
        let middle = middle.sup(&half).inf(&(side - half));
        [middle - half, middle + half].map(|corner| [scale * corner.x, scale * corner.y])
    }
}

/// Sides of the papers' gate, the region in which a target is looked for, over the target's
/// (Herasymenko 2021, section 1). An agent adds its reference's margin, and looks farther where it
/// is less sure of its prediction: its messages do not say either. With half of it what is drawn is
/// hardly larger than the box.
const GATE_SIDES: f64 = 3.0;

/// Draws the boxes of an agent's targets and, fainter, the gates about them.
pub(crate) fn boxes(
    stream: &RecordingStream,
    camera: &str,
    index: u64,
    tracks: &[BearingTrack],
    scale: f64,
) -> Result<(), ViewError> {
    let boxes = || tracks.iter().filter(|track| track.width > 0.0);
    let scaled = |value: f64| (value * scale) as f32;
    // Rerun counts pixels from the upper left corner of the first, not from its middle.
    let centres = boxes().map(|t| (scaled(t.pixel_x + 0.5), scaled(t.pixel_y + 0.5)));
    let sizes = boxes().map(|t| (scaled(t.width), scaled(t.height)));
    stream.log(
        format!("{}/targets", image_path(camera)),
        &Boxes2D::from_centers_and_sizes(centres, sizes)
            .with_labels(boxes().map(|t| t.track_id.to_string()))
            // Labels would hide targets of a few pixels.
            .with_show_labels(false)
            .with_colors([colour::of(index)])
            .with_radii([Radius::new_ui_points(0.6)]),
    )?;
    let centres = boxes().map(|t| (scaled(t.pixel_x + 0.5), scaled(t.pixel_y + 0.5)));
    let sizes = boxes().map(|t| (scaled(GATE_SIDES * t.width), scaled(GATE_SIDES * t.height)));
    stream.log(
        format!("{}/gates", image_path(camera)),
        &Boxes2D::from_centers_and_sizes(centres, sizes)
            .with_colors([colour::faint(index, 110)])
            .with_radii([Radius::new_ui_points(0.5)]),
    )?;
    Ok(())
}

/// A ring drawn where a camera should see a track.
pub(crate) struct Ring {
    /// Centre, pixels of the camera.
    pub(crate) centre: [f64; 2],
    radius: f64,
    id: u64,
}

impl Ring {
    /// The ring of a track; `None` if the camera does not see the place.
    pub(crate) fn of(track: &Track, place: Point3<f64>, camera: &Camera) -> Option<Self> {
        if !camera.sees(place) {
            return None;
        }
        let pixel = camera.project(place)?;
        let line = place - camera.pose().position();
        // Bound on the standard deviation across the line of sight, in pixels. The part along the
        // line is left out: one camera alone knows nothing of it.
        let across = across_sd(track, &line);
        let deviation = across / line.norm() * camera.model().intrinsics().fx;
        let radius = (SIGMAS * deviation).max(LEAST_RING_PX);
        Some(Self { centre: [pixel.x(), pixel.y()], radius, id: track.id })
    }

    /// Where the ring's number is written: beside the ring.
    fn beside(&self, scale: f64) -> [f32; 2] {
        let [x, y] = self.centre;
        [x + 2.5 * self.radius, y - self.radius].map(|v| (v * scale) as f32)
    }

    fn strip(&self, scale: f64) -> Vec<[f32; 2]> {
        (0..=CORNERS).map(|corner| self.corner(corner, scale)).collect()
    }

    fn corner(&self, corner: usize, scale: f64) -> [f32; 2] {
        let (sine, cosine) = (std::f64::consts::TAU * corner as f64 / CORNERS as f64).sin_cos();
        let [x, y] = self.centre;
        let place = [x + 0.5 + self.radius * cosine, y + 0.5 + self.radius * sine];
        place.map(|v| (v * scale) as f32)
    }
}

/// Draws the rings where a camera should see the tracks, with their numbers.
pub(crate) fn rings(
    stream: &RecordingStream,
    camera: &str,
    rings: &[Ring],
    scale: f64,
) -> Result<(), ViewError> {
    stream.log(
        format!("{}/tracks", image_path(camera)),
        &LineStrips2D::new(rings.iter().map(|ring| ring.strip(scale)))
            .with_colors(rings.iter().map(|ring| colour::of_track(ring.id)))
            .with_radii([Radius::new_ui_points(1.0)]),
    )?;
    stream.log(
        format!("{}/numbers", image_path(camera)),
        &Points2D::new(rings.iter().map(|ring| ring.beside(scale)))
            .with_labels(rings.iter().map(|ring| TrackNumber(ring.id).to_string()))
            .with_show_labels(true)
            .with_colors(rings.iter().map(|ring| colour::of_track(ring.id)))
            .with_radii([Radius::new_ui_points(0.1)]),
    )?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{Distortion, ImageSize, Intrinsics, Pose};
    use nalgebra::Matrix3;

    use super::*;

    fn camera() -> Camera {
        let size = ImageSize { width: 1000, height: 500 };
        let lens = Intrinsics {
            size,
            fx: 800.0,
            fy: 800.0,
            cx: 499.5,
            cy: 249.5,
            distortion: Distortion::None,
        };
        Camera::new(lens, Pose::new(Matrix3::identity(), Point3::origin()).unwrap()).unwrap()
    }

    #[test]
    fn what_is_shown_has_the_images_form_and_lies_in_it() {
        let mut region = None;
        TargetRegion::include(&mut region, [10.0, 20.0]);
        TargetRegion::include(&mut region, [110.0, f64::NAN]);
        TargetRegion::include(&mut region, [110.0, 40.0]);
        let [[left, top], [right, bottom]] = region.unwrap().shown(&camera(), 0.5);
        assert_eq!([left, top], [0.0, 0.0]);
        assert_eq!((right - left) / (bottom - top), 2.0);
        assert!(right > 0.5 * 110.0 && bottom < 250.0);
    }

    #[test]
    fn a_ring_stands_where_the_camera_sees_the_track() {
        let track = Track { id: 7, covariance: vec![0.01; 36], ..Default::default() };
        let ring = Ring::of(&track, Point3::new(1.0, 0.0, 10.0), &camera()).unwrap();
        assert_eq!(ring.centre, [579.5, 249.5]);
        // The total deviation is 0.173 m, of which 0.109 m lie along the line (1, 0, 10): 0.134 m
        // remain, and three times that at 10 m is the radius.
        assert!((ring.radius - 32.05).abs() < 0.05, "{}", ring.radius);
        assert!(Ring::of(&track, Point3::new(1.0, 0.0, -10.0), &camera()).is_none());
    }

    #[test]
    fn a_range_that_is_not_known_makes_no_ring_larger() {
        let mut covariance = vec![0.0; 36];
        covariance[14] = 1e4;
        let track = Track { id: 7, covariance, ..Default::default() };
        let ring = Ring::of(&track, Point3::new(0.0, 0.0, 100.0), &camera()).unwrap();
        assert_eq!(ring.radius, LEAST_RING_PX);
    }
}
