//! What shines like a star in a picture.

use crossfix_geometry::Pixel;
use tetra3::{CentroidExtractionConfig, DeblendMode, extract_centroids_from_raw};

use crate::StarError;

/// A picture's brightness, row by row, in any unit.
#[derive(Clone, Copy, Debug)]
pub struct Picture<'a> {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `width * height` numbers.
    pub brightness: &'a [f32],
}

/// Something that shines like a star.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spot {
    /// Its middle.
    pub pixel: Pixel,
    /// What it adds to the background, summed over its pixels, in the picture's unit.
    pub brightness: f64,
}

/// More than this many spots are lights of a town, or noise; the brightest are kept.
const MOST_SPOTS: usize = 600;

/// Finds what shines like a star: small, round, against what is round it. Brightest first.
///
/// # Errors
/// [`StarError::Picture`], for one without pixels.
pub fn find_spots(picture: &Picture<'_>) -> Result<Vec<Spot>, StarError> {
    let Picture { width, height, brightness } = *picture;
    let config = CentroidExtractionConfig {
        max_centroids: Some(MOST_SPOTS),
        // Two stars in one spot have their middle beside both.
        deblend: DeblendMode::Reject,
        ..CentroidExtractionConfig::default()
    };
    let found = extract_centroids_from_raw(brightness, width, height, &config)
        .map_err(|error| StarError::Picture(error.to_string()))?;
    // Counted from the middle of the image there, from the first pixel's middle here.
    let spot = |centroid: &tetra3::Centroid| Spot {
        pixel: Pixel::new(
            f64::from(centroid.x) + (f64::from(width) - 1.0) / 2.0,
            f64::from(centroid.y) + (f64::from(height) - 1.0) / 2.0,
        ),
        brightness: centroid.mass.map_or(0.0, f64::from),
    };
    let mut spots: Vec<Spot> = found.centroids.iter().map(spot).collect();
    spots.sort_by(|a, b| b.brightness.total_cmp(&a.brightness));
    Ok(spots)
}
