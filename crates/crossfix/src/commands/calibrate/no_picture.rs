//! In the place of the picture, in a build that leaves it out.

use std::path::Path;

use crossfix_calibration::FlightResult;

use crate::parts;

/// Says that there is none.
pub fn draw(_: &FlightResult, _: &Path) -> anyhow::Result<()> {
    Err(parts::no_pictures())
}
