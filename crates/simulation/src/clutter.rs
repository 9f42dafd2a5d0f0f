//! What a camera sees beside its targets: masts, wires, birds, clouds with edges.

use std::f64::consts::TAU;

use crossfix_geometry::Camera;
use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::FlightPath;
use crate::render::{Piece, RenderedThing};

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

/// Largest coordinate and size, m: nothing farther is seen from a site. With half of it the same.
const FARTHEST_M: f64 = 1e6;
/// Most beats of a wing per second: a hummingbird's. With half of it the same.
const MOST_BEATS: f64 = 80.0;
/// Straight pieces of which a mast or a wire consists in the image: lenses bend it. With half of
/// them a wire's corners show in an image of 640 columns.
const PIECES: u32 = 24;
/// Thickness of a bird's wing, as a share of its span. With half of it a bird of ten pixels has
/// wings of 0.7 px, and hardly shows.
const WING: f64 = 0.14;
/// Largest angle of a wing above and below the horizontal, rad. With half of it a bird's outline
/// changes by a third as it beats its wings, instead of two thirds.
const BEAT_RAD: f64 = 0.9;

impl SceneClutter {
    /// Whether every number is one that a thing can have.
    pub(crate) fn is_possible(&self) -> bool {
        // NaN is in no range.
        let is_size = |values: &[f64]| values.iter().all(|v| *v > 0.0 && *v <= FARTHEST_M);
        let is_place = |values: &[f64]| values.iter().all(|v| v.abs() <= FARTHEST_M);
        let (numbers, level) = match self {
            Self::Mast { foot_m, height_m, width_m, level } => {
                (is_place(foot_m) && is_size(&[*height_m, *width_m]), level)
            }
            Self::Wire { from_m, to_m, sag_m, width_m, level } => (
                is_place(from_m) && is_place(to_m) && is_place(&[*sag_m]) && is_size(&[*width_m]),
                level,
            ),
            Self::Bird { span_m, beats_per_s, level, path } => (
                is_size(&[*span_m])
                    && (0.0..=MOST_BEATS).contains(beats_per_s)
                    && path.is_possible(),
                level,
            ),
            Self::Cloud { centre_m, radius_m, edge_m, level } => {
                (is_place(centre_m) && is_size(&[*radius_m, *edge_m]), level)
            }
        };
        numbers && (0.0..=255.0).contains(level)
    }

    /// How it appears in a camera's image at a time (s from the scene's start), with its mean
    /// distance from the camera, m; `None` if no part of it is before the camera.
    pub(crate) fn appearance(&self, camera: &Camera, t: f64) -> Option<(f64, RenderedThing)> {
        let (seen, pieces, level) = match self {
            Self::Mast { foot_m, height_m, width_m, level } => {
                let foot = Point3::from(*foot_m);
                let at = |share: f64| foot + Vector3::z() * (share * height_m);
                let seen = seen_along(camera, at);
                let pieces = strips(&seen, *width_m);
                (seen, pieces, level)
            }
            Self::Wire { from_m, to_m, sag_m, width_m, level } => {
                let (from, to) = (Point3::from(*from_m), Point3::from(*to_m));
                // z -= 4 sag s (1 - s): 0 at both ends, `sag` in the middle.
                let sag = |share: f64| 4.0 * sag_m * share * (1.0 - share);
                let at = |share: f64| from + (to - from) * share - Vector3::z() * sag(share);
                let seen = seen_along(camera, at);
                let pieces = strips(&seen, *width_m);
                (seen, pieces, level)
            }
            Self::Bird { span_m, beats_per_s, level, path } => {
                let body = Seen::of(camera, path.state(t).0)?;
                let up_rad = BEAT_RAD * (TAU * beats_per_s * t).sin();
                let pieces = wings(&body, *span_m, up_rad);
                (vec![Some(body)], pieces, level)
            }
            Self::Cloud { centre_m, radius_m, edge_m, level } => {
                let centre = Seen::of(camera, Point3::from(*centre_m))?;
                let (radius, edge) = (radius_m * centre.scale, edge_m * centre.scale);
                let disc = Piece::Disc { centre: centre.pixel, radius, edge };
                (vec![Some(centre)], vec![disc], level)
            }
        };
        let ranges: Vec<f64> = seen.iter().flatten().map(|point| point.range).collect();
        let range = ranges.iter().sum::<f64>() / ranges.len() as f64;
        (!pieces.is_empty()).then_some((range, RenderedThing { pieces, level: *level }))
    }
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
        let scale = camera.model().intrinsics().fx / range;
        Some(Self { pixel: [pixel.x(), pixel.y()], range, scale })
    }
}

/// Points of a line through space (`at`, from 0 to 1) as a camera sees them; `None` where one is
/// not before it.
fn seen_along(camera: &Camera, at: impl Fn(f64) -> Point3<f64>) -> Vec<Option<Seen>> {
    let point = |piece| Seen::of(camera, at(f64::from(piece) / f64::from(PIECES)));
    (0..=PIECES).map(point).collect()
}

/// The strips between neighbouring points of a line of this diameter.
fn strips(points: &[Option<Seen>], width_m: f64) -> Vec<Piece> {
    let mut strips = Vec::new();
    for ends in points.windows(2) {
        if let [Some(from), Some(to)] = ends {
            let width = width_m * (from.scale + to.scale) / 2.0;
            strips.push(Piece::Strip { from: from.pixel, to: to.pixel, width });
        }
    }
    strips
}

/// The two wings of a bird that flies across the image, `up_rad` above the horizontal.
fn wings(body: &Seen, span_m: f64, up_rad: f64) -> Vec<Piece> {
    let [x, y] = body.pixel;
    let span = span_m * body.scale;
    let tip = |side: f64| [x + side * span / 2.0 * up_rad.cos(), y - span / 2.0 * up_rad.sin()];
    let wing = |side| Piece::Strip { from: body.pixel, to: tip(side), width: WING * span };
    [-1.0, 1.0].map(wing).into()
}
