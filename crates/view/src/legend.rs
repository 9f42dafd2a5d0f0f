use rerun::RecordingStream;
use rerun_types::archetypes::TextDocument;
use rerun_types::components::MediaType;

use crate::ViewError;
use crate::draw::{ENLARGED, ENLARGED_UP_TO_M, SIGMAS};

/// Draws the legend: what the colours and shapes in a site's picture mean.
pub(crate) fn draw(stream: &RecordingStream) -> Result<(), ViewError> {
    let text = format!(
        "**Orange, blue, green, yellow**: a camera, its sight lines, boxes and residuals.\n\n\
         **Red, violet, pink**: a track, its last ten seconds; in images a ring where the camera \
         should see it. See-through: not sure, or not seen now. Faint rectangles: the \
         least gates about boxes.\n\n\
         **Ellipsoid**: {SIGMAS} standard deviations, {ENLARGED} times too large below \
         {ENLARGED_UP_TO_M} m. **White**: the truth. The arrow points north; \
         small ones are a camera's own axes."
    );
    stream.log_static("legend", &TextDocument::new(text).with_media_type(MediaType::markdown()))?;
    Ok(())
}
