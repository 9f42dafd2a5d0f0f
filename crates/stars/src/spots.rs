//! Detection of what looks like a star in a picture.

use crossfix_geometry::Pixel;
use tetra3::{Centroid, CentroidExtractionConfig, DeblendMode, extract_centroids_from_raw};

use crate::StarError;

/// A picture's brightness, row by row, in any unit.
#[derive(Clone, Copy, Debug)]
pub struct StarPicture<'a> {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `width * height` numbers.
    pub brightness: &'a [f32],
}

/// Something that looks like a star.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spot {
    /// Its centre.
    pub pixel: Pixel,
    /// Its excess over the background, summed over its pixels, in the picture's unit.
    pub brightness: f64,
}

/// Largest number of spots: more are lights of a town, or noise; the brightest are kept. With half
/// of it a wide picture of a dark sky determines its lens by half as many stars.
const MOST_SPOTS: usize = 600;

/// Finds what looks like a star: small, round, brighter than its surroundings. Brightest first.
///
/// # Errors
/// [`StarError::Picture`], for a picture without pixels.
pub fn find_spots(picture: &StarPicture<'_>) -> Result<Vec<Spot>, StarError> {
    let StarPicture { width, height, brightness } = *picture;
    let config = CentroidExtractionConfig {
        max_centroids: Some(MOST_SPOTS),
        // The centroid of two stars in one spot would lie on neither.
        deblend: DeblendMode::Reject,
        ..CentroidExtractionConfig::default()
    };
    let found = extract_centroids_from_raw(brightness, width, height, &config)
        .map_err(|error| StarError::Picture(error.to_string()))?;
    let mut spots: Vec<Spot> =
        found.centroids.iter().map(|centroid| spot(centroid, width, height)).collect();
    spots.sort_by(|a, b| b.brightness.total_cmp(&a.brightness));
    Ok(spots)
}

fn spot(centroid: &Centroid, width: u32, height: u32) -> Spot {
    // The library counts from the middle of the image, pixels here from the middle of the first.
    Spot {
        pixel: Pixel::new(
            f64::from(centroid.x) + (f64::from(width) - 1.0) / 2.0,
            f64::from(centroid.y) + (f64::from(height) - 1.0) / 2.0,
        ),
        brightness: centroid.mass.map_or(0.0, f64::from),
    }
}
