//! What a camera sees beside its targets: masts, wires, birds, clouds with edges.

use std::f64::consts::TAU;

use crossfix_geometry::Camera;
use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::FlightPath;
use crate::render::RenderedShape;

/// A thing of a scene that is no target. Metres, world; brightness in 8-bit levels.
///
/// ```
/// use crossfix_simulation::SceneClutter;
///
/// let mast: SceneClutter = toml::from_str(
///     "kind = \"mast\"\nfoot_m = [0.0, 80.0, 0.0]\nheight_m = 40.0\nwidth_m = 0.4\nlevel = 235.0",
/// )?;
/// assert!(matches!(mast, SceneClutter::Mast { .. }));
/// # Ok::<(), toml::de::Error>(())
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum SceneClutter {
    /// An upright mast.
    Mast {
        /// Its foot.
        foot_m: [f64; 3],
        /// Its height.
        height_m: f64,
        /// Its diameter.
        width_m: f64,
        /// Its brightness.
        level: f32,
    },
    /// A wire that sags between its ends as a parabola.
    Wire {
        /// One end.
        from_m: [f64; 3],
        /// The other end.
        to_m: [f64; 3],
        /// How far its middle hangs below the line between them.
        sag_m: f64,
        /// Its diameter.
        width_m: f64,
        /// Its brightness.
        level: f32,
    },
    /// A bird: two wings that beat.
    Bird {
        /// Its span.
        span_m: f64,
        /// Beats of its wings per second.
        beats_per_s: f64,
        /// Its brightness.
        level: f32,
        /// Its path.
        path: FlightPath,
    },
    /// A round cloud, or a crest, with an edge.
    Cloud {
        /// Its middle.
        centre_m: [f64; 3],
        /// Its radius.
        radius_m: f64,
        /// How wide its edge is.
        edge_m: f64,
        /// Its brightness.
        level: f32,
    },
}

/// Straight pieces of which a mast or a wire consists in the image: lenses bend it. With half of
/// them a wire's corners show in an image of 640 columns.
const PIECES: u32 = 24;
/// Thickness of a bird's wing, as a share of its span. With half of it a bird of ten pixels has
/// wings of half a pixel, and hardly shows.
const WING: f64 = 0.14;
/// Largest angle of a wing above and below the horizontal, rad. With half of it a bird's outline
/// changes by a third as it beats its wings, instead of two thirds.
const BEAT_RAD: f64 = 0.9;

impl SceneClutter {
    /// Whether every number is one that a thing can have.
    pub(crate) fn is_possible(&self) -> bool {
        let positive = |values: &[f64]| values.iter().all(|v| v.is_finite() && *v > 0.0);
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        let (numbers, level) = match self {
            Self::Mast { foot_m, height_m, width_m, level } => {
                (finite(foot_m) && positive(&[*height_m, *width_m]), level)
            }
            Self::Wire { from_m, to_m, sag_m, width_m, level } => (
                finite(from_m) && finite(to_m) && finite(&[*sag_m]) && positive(&[*width_m]),
                level,
            ),
            Self::Bird { span_m, beats_per_s, level, path } => {
                (positive(&[*span_m, *beats_per_s]) && path.is_possible(), level)
            }
            Self::Cloud { centre_m, radius_m, edge_m, level } => {
                (finite(centre_m) && positive(&[*radius_m, *edge_m]), level)
            }
        };
        numbers && (0.0..=255.0).contains(level)
    }

    /// How it appears in a camera's image at a time (s from the scene's start), each shape with its
    /// distance from the camera, m. What is behind the camera is left out.
    pub(crate) fn shapes(&self, camera: &Camera, t: f64) -> Vec<(f64, RenderedShape)> {
        match self {
            Self::Mast { foot_m, height_m, width_m, level } => {
                let foot = Point3::from(*foot_m);
                let at = |share: f64| foot + Vector3::z() * (share * height_m);
                pieces(camera, at, *width_m, *level)
            }
            Self::Wire { from_m, to_m, sag_m, width_m, level } => {
                let ends = [Point3::from(*from_m), Point3::from(*to_m)];
                pieces(camera, |share| wire_point(ends, *sag_m, share), *width_m, *level)
            }
            Self::Bird { span_m, beats_per_s, level, path } => {
                let up = BEAT_RAD * (TAU * beats_per_s * t).sin();
                wings(camera, path.state(t).0, *span_m, up, *level)
            }
            Self::Cloud { centre_m, radius_m, edge_m, level } => {
                let centre = Point3::from(*centre_m);
                let Some(seen) = Seen::of(camera, centre) else { return Vec::new() };
                let shape = RenderedShape::Disc {
                    centre: seen.pixel,
                    radius: radius_m * seen.scale,
                    edge: edge_m * seen.scale,
                    level: *level,
                };
                vec![(seen.range, shape)]
            }
        }
    }
}

/// The point of a wire at a share of the way between its ends.
fn wire_point([from, to]: [Point3<f64>; 2], sag_m: f64, share: f64) -> Point3<f64> {
    // z -= 4 sag s (1 - s): 0 at both ends, `sag` in the middle.
    from + (to - from) * share - Vector3::z() * (4.0 * sag_m * share * (1.0 - share))
}

/// A point as a camera sees it.
struct Seen {
    pixel: [f64; 2],
    /// Distance from the camera, m, and pixels per metre there.
    range: f64,
    scale: f64,
}

impl Seen {
    fn of(camera: &Camera, point: Point3<f64>) -> Option<Self> {
        let pixel = camera.project(point)?;
        let range = (point - camera.pose().position()).norm();
        Some(Self {
            pixel: [pixel.x(), pixel.y()],
            range,
            scale: camera.model().intrinsics().fx / range,
        })
    }
}

/// A line through space (`at`, from 0 to 1) as strips of an image.
fn pieces(
    camera: &Camera,
    at: impl Fn(f64) -> Point3<f64>,
    width_m: f64,
    level: f32,
) -> Vec<(f64, RenderedShape)> {
    let points: Vec<Option<Seen>> = (0..=PIECES)
        .map(|piece| Seen::of(camera, at(f64::from(piece) / f64::from(PIECES))))
        .collect();
    let strips = points.windows(2).filter_map(|ends| {
        let [Some(from), Some(to)] = ends else { return None };
        let width = width_m * (from.scale + to.scale) / 2.0;
        let strip = RenderedShape::Strip { from: from.pixel, to: to.pixel, width, level };
        Some(((from.range + to.range) / 2.0, strip))
    });
    strips.collect()
}

/// The two wings of a bird that flies across the image, `up` rad above the horizontal.
fn wings(
    camera: &Camera,
    place: Point3<f64>,
    span_m: f64,
    up: f64,
    level: f32,
) -> Vec<(f64, RenderedShape)> {
    let Some(seen) = Seen::of(camera, place) else { return Vec::new() };
    let [x, y] = seen.pixel;
    let span = span_m * seen.scale;
    let tip = |side: f64| [x + side * span / 2.0 * up.cos(), y - span / 2.0 * up.sin()];
    [-1.0, 1.0]
        .map(|side| {
            let width = WING * span;
            let wing = RenderedShape::Strip { from: seen.pixel, to: tip(side), width, level };
            (seen.range, wing)
        })
        .into()
}
