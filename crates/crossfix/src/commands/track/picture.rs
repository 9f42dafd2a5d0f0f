//! A picture of the tracker's work, for Rerun.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;
use crossfix_correlation::Plane;
use crossfix_video::Frame;
use crossfix_view::{FollowedTarget, ImageBox, Sight, TrackingPicture};
use crossfix_vision::{ImageTrack, PixelBox, TrackPhase};

use crate::commands::labels::read_labels;
use crate::eye;

/// A picture of the tracker's work, with labels to compare it with.
pub(super) struct TrackPicture {
    picture: TrackingPicture,
    labels: BTreeMap<u64, PixelBox>,
}

impl TrackPicture {
    pub(super) fn new(path: &Path, labels: Option<&Path>) -> anyhow::Result<Self> {
        let labels = labels.map(read_labels).transpose()?.unwrap_or_default();
        Ok(Self { picture: TrackingPicture::new(crossfix_view::save(path)?)?, labels })
    }

    /// Waits until everything is written.
    pub(super) fn finish(self) -> anyhow::Result<()> {
        Ok(self.picture.finish()?)
    }

    pub(super) fn show(
        &self,
        frame: &Frame,
        image: &Plane,
        tracks: &[ImageTrack],
    ) -> anyhow::Result<()> {
        let bytes: Vec<u8> = image.samples().iter().map(|v| v.clamp(0.0, 255.0) as u8).collect();
        let jpeg =
            eye::jpeg(&bytes, image.width(), image.height()).context("cannot encode a picture")?;
        let targets: Vec<FollowedTarget> = tracks.iter().map(followed).collect();
        let label = self.labels.get(&frame.index).map(|label| image_box(*label));
        self.picture.show(frame.capture.time, jpeg, &targets, label).context("cannot draw a frame")
    }
}

fn followed(track: &ImageTrack) -> FollowedTarget {
    FollowedTarget {
        number: track.id.0,
        place: image_box(PixelBox::about(track.position, track.width, track.height)),
        // In Rerun whole numbers are the upper left corners of pixels, not their centres.
        measured: track.measured.map(|m| [m.place.x + 0.5, m.place.y + 0.5]),
        sight: match track.phase {
            TrackPhase::Tentative | TrackPhase::Tracking => Sight::Seen,
            TrackPhase::Coasting => Sight::Coasting,
            TrackPhase::Searching => Sight::Lost,
        },
        score: track.score,
        certainty: track.certainty,
        nis: track.nis,
    }
}

fn image_box(PixelBox { x, y, width, height }: PixelBox) -> ImageBox {
    ImageBox { x, y, width, height }
}
