//! Stands in for the picture in a build without the viewer.

use std::path::Path;

use crossfix_evaluation::bound::PlannedCamera;

use super::report::PlanReport;
use crate::parts;

/// Fails, as there are no pictures.
pub fn draw(_: &PlanReport, _: &[PlannedCamera], _: &Path) -> anyhow::Result<()> {
    Err(parts::no_pictures())
}
