//! Identification of spots in a picture as stars.

use crossfix_geometry::{Camera, CameraModel, Pixel};
use nalgebra::{Unit, Vector3};
use tetra3::{CameraModel as Pinhole, Centroid, SolveConfig};

use crate::sky::{Sky, Star, pattern_width};
use crate::{Spot, StarError};

/// A spot and its star.
#[derive(Clone, Debug)]
pub struct NamedStar {
    /// The star's name.
    pub name: String,
    /// Where it is in the picture.
    pub pixel: Pixel,
    /// Direction of the star, local ENU.
    pub direction: Unit<Vector3<f64>>,
}

/// Least number of spots: with fewer no pattern with a star to spare can be made. With half of it
/// such a picture is searched in vain, and its error asks about the lens.
const FEWEST_SPOTS: usize = 5;
/// Largest error of the focal length in a lens file, as a share: zooms that are not touched keep it
/// to 2 %. With half of it such zooms lie at the end of the search, and those beyond are not named.
const SCALE_SHARE: f64 = 0.04;
/// Number of the brightest spots that patterns are made of: planets, lamps and aircraft are among
/// them. With half of it four lamps spoil three of four patterns; of 32 spots they spoil two of
/// five.
const PATTERN_SPOTS: u32 = 32;
/// A star is matched to a spot within this share of the image's width of where the pattern puts the
/// star. With half of it stars near the image's sides, where a lens file errs most, are left over
/// and count against a right answer.
const MATCH_SHARE: f32 = 0.01;
/// Sine of the least elevation (3 degrees): below it refraction is not known well enough. With half
/// of it stars at 1.4 degrees are used, but their refraction is stated as if they stood at 3.
const LOWEST_SINE: f64 = 0.05;
/// Stars below this sine of the elevation have set, whatever the refraction (at the horizon it is
/// half of this, with which a star that is just seen may count), ...
const SET_SINE: f64 = -0.02;
/// ... and if more than this share of the named stars has set, the time or the place is wrong: one
/// name in twenty may be wrong. With half of it such names alone may have a good picture refused.
const MOST_SET: f64 = 0.1;
/// Of two stars near a spot the brighter one is taken if the other is fainter by more than this, in
/// magnitudes. With half of it the brighter need only shine 2.5 times as much, and the spot may be
/// of the other one.
const OUTSHONE: f64 = 2.0;
/// Where stars are named by a pose and lens, those fainter by more than this many magnitudes than
/// the faintest that must be visible are not considered: a spot there is noise. With half of it
/// stars that are brighter to the camera than in the catalogue's colour are left out; with twice as
/// much, noise is named after stars near it.
const FAINTER: f64 = 1.0;

impl Sky {
    /// Names spots without knowing where the camera looks, by the patterns that they form.
    ///
    /// # Errors
    /// [`StarError`] where no part of the sky matches, or the stars cannot be seen at that time and
    /// place.
    pub fn identify(
        &self,
        spots: &[Spot],
        lens: &CameraModel,
    ) -> Result<Vec<NamedStar>, StarError> {
        let width = pattern_width(lens);
        let half = (width / 2.0).tan();
        let size = lens.intrinsics().size;
        let seen = in_plane(spots, lens, half);
        if seen.len() < FEWEST_SPOTS {
            return Err(StarError::TooFew { found: seen.len(), needed: FEWEST_SPOTS });
        }
        let focal = f64::from(size.width) / 2.0 / half;
        let centroids: Vec<Centroid> = seen
            .iter()
            .map(|(index, plane)| centroid(plane * focal, spots[*index].brightness))
            .collect();
        let config = SolveConfig {
            fov_max_error_rad: Some((width * SCALE_SHARE) as f32),
            match_radius: MATCH_SHARE,
            pattern_checking_stars: PATTERN_SPOTS,
            // Without a time limit a picture gets the same names on a slow host: the number of
            // patterns is the bound.
            solve_timeout_ms: None,
            ..SolveConfig::with_camera_model(Pinhole::from_fov(width, size.width, size.height))
        };
        let solution = self
            .database
            .solve_from_centroids(&centroids, &config)
            .map_err(|_| StarError::Unknown { spots: spots.len() })?;
        if solution.parity_flip {
            return Err(StarError::Mirrored);
        }
        let pairs = solution.matched_centroid_indices.iter().zip(&solution.matched_catalog_ids);
        let named: Vec<NamedStar> = pairs
            .filter_map(|(&centroid, id)| {
                let star = self.database.star_catalog_ids.iter().position(|known| known == id)?;
                Some(self.stars[star].named(&spots[seen[centroid].0]))
            })
            .collect();
        let count = named.len();
        let has_set = named.iter().filter(|star| star.direction.z < SET_SINE).count();
        let above: Vec<NamedStar> =
            named.into_iter().filter(|star| star.direction.z > LOWEST_SINE).collect();
        if above.is_empty() || has_set as f64 > MOST_SET * count as f64 {
            return Err(StarError::UnderHorizon);
        }
        Ok(above)
    }

    /// Names the spots near which a camera sees a star, within `gate_px` pixels of its predicted
    /// place: those near which there is only one star, and which are the only spot near it.
    pub fn named(
        &self,
        spots: &[Spot],
        camera: &Camera,
        gate_px: impl Fn(Pixel) -> f64,
    ) -> Vec<NamedStar> {
        let faintest = self.faintest_of(spots.len(), camera);
        let seen: Vec<(&Star, Pixel, f64)> = self
            .stars
            .iter()
            .filter(|star| star.direction.z > LOWEST_SINE && star.magnitude < faintest)
            .filter_map(|star| {
                let direction = star.direction_from(camera);
                let is_seen = camera.model().sees(&direction);
                let at = is_seen.then(|| camera.model().project(&direction)).flatten()?;
                Some((star, at, gate_px(at)))
            })
            .collect();
        let apart = |a: Pixel, b: Pixel| (a.x() - b.x()).hypot(a.y() - b.y());
        let mut named = Vec::new();
        for spot in spots {
            let mut near = seen.iter().filter(|(_, at, gate)| apart(*at, spot.pixel) < 2.0 * gate);
            // The stars are sorted: brightest first.
            let Some((star, at, gate)) = near.next() else { continue };
            let is_alone =
                near.next().is_none_or(|(next, ..)| next.magnitude > star.magnitude + OUTSHONE);
            let rivals = spots.iter().filter(|other| apart(other.pixel, *at) < 2.0 * gate).count();
            if is_alone && rivals == 1 && apart(*at, spot.pixel) < *gate {
                named.push(star.named(spot));
            }
        }
        named
    }

    /// The magnitude of the faintest star that a camera can be seeing if it sees `count` spots.
    fn faintest_of(&self, count: usize, camera: &Camera) -> f64 {
        let stars = self.stars.iter().filter(|star| star.direction.z > LOWEST_SINE);
        let seen = stars.filter(|star| camera.model().sees(&star.direction_from(camera)));
        let last = seen.take(count.max(1)).last();
        last.map_or(f64::INFINITY, |star| star.magnitude + FAINTER)
    }
}

/// Spots in pinhole coordinates of focal length one, each with its index; the sides of a wide lens
/// are left out: what lies beyond `half` of the width.
fn in_plane(spots: &[Spot], lens: &CameraModel, half: f64) -> Vec<(usize, Vector3<f64>)> {
    let size = lens.intrinsics().size;
    let half_height = half * f64::from(size.height) / f64::from(size.width);
    spots
        .iter()
        .enumerate()
        .filter_map(|(index, spot)| Some((index, lens.direction(spot.pixel).ok()?.into_inner())))
        .filter(|(_, direction)| direction.z > 0.0)
        .map(|(index, direction)| (index, direction / direction.z))
        .filter(|(_, plane)| plane.x.abs() <= half && plane.y.abs() <= half_height)
        .collect()
}

fn centroid(plane: Vector3<f64>, brightness: f64) -> Centroid {
    Centroid { x: plane.x as f32, y: plane.y as f32, mass: Some(brightness as f32), cov: None }
}

impl Star {
    /// Its direction in a camera's frame.
    fn direction_from(&self, camera: &Camera) -> Vector3<f64> {
        camera.pose().rotation().inverse() * self.direction.into_inner()
    }

    fn named(&self, spot: &Spot) -> NamedStar {
        NamedStar { name: self.name.clone(), pixel: spot.pixel, direction: self.direction }
    }
}
