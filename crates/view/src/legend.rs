use rerun::RecordingStream;
use rerun_types::archetypes::TextDocument;
use rerun_types::components::MediaType;

use crate::ViewError;
use crate::draw::{ENLARGED, ENLARGED_UP_TO_M, SIGMAS};

/// Draws the legend: what the colours and shapes in a site's picture mean.
pub(crate) fn draw(stream: &RecordingStream) -> Result<(), ViewError> {
    let text = format!(
        "**Orange, blue, green, yellow**: a camera, its sight lines, its boxes and its residuals.\n\n\
         **Red, violet, pink**: a track, its way of the last ten seconds, and in the images a ring where the \
         camera should see it, with its number. See-through: not sure, or not seen at present.\n\n\
         **Ellipsoid**: {SIGMAS} standard deviations, drawn {ENLARGED} times too large where they are below \
         {ENLARGED_UP_TO_M} m.\n\n\
         **White dots**: the truth, where a recording holds it. The grid lies at the lowest height; \
         its arrow points north."
    );
    stream.log_static("legend", &TextDocument::new(text).with_media_type(MediaType::markdown()))?;
    Ok(())
}
