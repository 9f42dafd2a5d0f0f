//! What is also written in Foxglove's schemas, beside our own.

use crossfix_geometry::Geodetic;
use crossfix_message::{SiteName, Timestamp};
use crossfix_outlet::foxglove::{FoxgloveView, PictureExport, file_descriptor_set};
use crossfix_recording::{Beside, Entry, RecordingError, RecordingWriter};

/// What of a site is written in Foxglove's schemas.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum WithFoxglove {
    /// Cameras, pictures and tracks.
    #[default]
    All,
    /// Cameras and tracks.
    Site,
    /// Nothing.
    None,
}

impl WithFoxglove {
    /// The view that converts messages, if any are to be converted.
    pub fn view(self, site: &SiteName, anchor: Option<Geodetic>) -> Option<FoxgloveView> {
        let pictures = match self {
            Self::All => PictureExport::Said,
            Self::Site => PictureExport::LeftOut,
            Self::None => return None,
        };
        Some(FoxgloveView::new(site, anchor, pictures))
    }
}

/// Writes an entry's contents in Foxglove's schemas, next to the entry itself.
pub fn write<W: std::io::Write + std::io::Seek>(
    writer: &mut RecordingWriter<W>,
    view: &mut FoxgloveView,
    entry: &Entry,
) -> Result<(), RecordingError> {
    let Entry { key, data_time, arrival, data } = entry;
    for message in view.of(key, data, *data_time) {
        writer.write_beside(&Beside {
            topic: &message.topic,
            schema: message.schema,
            definitions: file_descriptor_set(),
            data_time: Timestamp::max(message.time, Timestamp::EPOCH),
            arrival: *arrival,
            data: &message.data,
        })?;
    }
    Ok(())
}
