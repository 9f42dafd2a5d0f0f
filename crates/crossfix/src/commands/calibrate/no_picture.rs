//! Stands in for the picture in a build without the viewer.

use std::path::Path;

use crossfix_calibration::FlightResult;

use crate::parts;

/// Fails, as there are no pictures.
pub fn draw(_: &FlightResult, _: &Path) -> anyhow::Result<()> {
    Err(parts::no_pictures())
}
