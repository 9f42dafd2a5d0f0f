//! Possible poses of a camera that sees its landmarks as it does: starts for the adjustment.

use nalgebra::{Matrix3, Point3, Rotation3, Unit, Vector3};

use super::seen::PoseAndLens;
use super::{LandmarkError, LandmarkPicture};
use crate::lens;
use crate::survey::LandmarkPlace;

/// Places are tried in this many directions from the landmarks' mean, evenly spread (26 degrees
/// apart; with half of it 37, and the true pose may not be reached from any of them) ...
const DIRECTIONS: usize = 60;
/// ... and at these multiples of the distance from which things of the landmarks' spread are seen
/// under the clicks' angles: nearer and farther, as not all landmarks are seen from the front.
const DISTANCES: [f64; 5] = [0.4, 0.7, 1.0, 1.4, 2.0];
/// Number of these that are adjusted, those with the least misfit. With half of it a second pose
/// that fits alike may go unnoticed.
const ADJUSTED: usize = 40;

/// Poses to adjust from. For each place the rotation that fits best is known in closed form.
pub(super) fn starts(picture: &LandmarkPicture) -> Result<Vec<PoseAndLens>, LandmarkError> {
    let mut clicked = Vec::with_capacity(picture.landmarks.len());
    for landmark in &picture.landmarks {
        let direction = lens::direction(&picture.intrinsics, landmark.pixel).ok_or_else(|| {
            LandmarkError::NoDirection {
                camera: picture.camera.clone(),
                landmark: landmark.name.clone(),
            }
        })?;
        clicked.push((direction.normalize(), landmark.at));
    }
    let intrinsics = picture.intrinsics;
    // With a known place only the rotation is open, which has one best value.
    if let Some(place) = &picture.place {
        let centre = place.position;
        let turned = turned(&clicked, centre).into_iter();
        let starts = turned.map(|(_, rotation)| PoseAndLens { rotation, centre, intrinsics });
        return Ok(starts.collect());
    }
    let mut tried: Vec<(f64, Rotation3<f64>, Point3<f64>)> = places(picture, angle_of(&clicked))
        .into_iter()
        .filter_map(|place| turned(&clicked, place).map(|(off, rotation)| (off, rotation, place)))
        .collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    tried.truncate(ADJUSTED);
    let starts = tried.into_iter();
    Ok(starts.map(|(_, rotation, centre)| PoseAndLens { rotation, centre, intrinsics }).collect())
}

/// Root mean square of the clicks' angles from their mean direction, rad.
fn angle_of(clicked: &[(Vector3<f64>, LandmarkPlace)]) -> f64 {
    let middle: Vector3<f64> = clicked.iter().map(|(direction, _)| direction).sum();
    let squares: f64 = clicked.iter().map(|(direction, _)| direction.angle(&middle).powi(2)).sum();
    (squares / clicked.len() as f64).sqrt().max(1e-4)
}

/// Places round the landmarks from which their spread is seen under an angle.
fn places(picture: &LandmarkPicture, angle: f64) -> Vec<Point3<f64>> {
    let known: Vec<Point3<f64>> = picture
        .landmarks
        .iter()
        .filter_map(|landmark| match landmark.at {
            LandmarkPlace::Place { position, .. } => Some(position),
            LandmarkPlace::Direction { .. } => None,
        })
        .collect();
    let count = known.len().max(1) as f64;
    let middle = Point3::from(known.iter().map(|place| place.coords).sum::<Vector3<f64>>() / count);
    let squares: f64 = known.iter().map(|place| (place - middle).norm_squared()).sum();
    let spread = (squares / count).sqrt();
    // Range = spread / angle: from there a thing of this spread is seen under this angle.
    let ranges = DISTANCES.into_iter().map(|distance| distance * spread / angle);
    let about = |range: f64| (0..DIRECTIONS).map(move |k| middle + spiral(k).into_inner() * range);
    ranges.flat_map(about).collect()
}

/// Directions evenly spread over the sphere, along a golden-angle spiral.
fn spiral(k: usize) -> Unit<Vector3<f64>> {
    let golden = std::f64::consts::PI * (3.0 - 5.0f64.sqrt());
    // Equal steps of the height are equal areas of the sphere.
    let up = 1.0 - (2.0 * k as f64 + 1.0) / DIRECTIONS as f64;
    let (sin, cos) = (golden * k as f64).sin_cos();
    let across = (1.0 - up * up).sqrt();
    Unit::new_normalize(Vector3::new(across * cos, across * sin, up))
}

/// The rotation that best turns the clicked directions towards the landmarks as seen from a place
/// (Wahba's problem, by singular values), with the sum of squares that remains (first).
fn turned(
    clicked: &[(Vector3<f64>, LandmarkPlace)],
    centre: Point3<f64>,
) -> Option<(f64, Rotation3<f64>)> {
    let mut pairs = Vec::with_capacity(clicked.len());
    for (direction, at) in clicked {
        let world = match at {
            LandmarkPlace::Place { position, .. } => Unit::try_new(position - centre, 1e-6)?,
            LandmarkPlace::Direction { direction, .. } => *direction,
        };
        pairs.push((*direction, world.into_inner()));
    }
    // B = sum of world own' = U S V': R = U diag(1, 1, det(U V')) V'.
    let sum: Matrix3<f64> = pairs.iter().map(|(own, world)| world * own.transpose()).sum();
    let factors = sum.svd(true, true);
    let (u, v_t) = (factors.u?, factors.v_t?);
    let handed = Vector3::new(1.0, 1.0, (u * v_t).determinant().signum());
    let matrix = u * Matrix3::from_diagonal(&handed) * v_t;
    let off = pairs.iter().map(|(own, world)| (matrix * own - world).norm_squared()).sum();
    Some((off, Rotation3::from_matrix_unchecked(matrix)))
}
