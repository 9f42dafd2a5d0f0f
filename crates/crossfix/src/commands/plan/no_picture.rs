//! In the place of the picture, in a build that leaves it out.

use std::path::Path;

use crossfix_evaluation::bound::PlannedCamera;

use super::report::Report;
use crate::parts;

/// Says that there is none.
pub fn draw(_: &Report, _: &[PlannedCamera], _: &Path) -> anyhow::Result<()> {
    Err(parts::no_pictures())
}
