//! A picture of the tracker's work, for Rerun.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, bail};
use crossfix_correlation::Plane;
use crossfix_video::Frame;
use crossfix_view::{FollowedTarget, ImageBox, Sight, TrackingPicture};
use crossfix_vision::{ImageTrack, PixelBox, TrackPhase};
use csv::StringRecord;

use crate::eye;

/// A picture of the tracker's work, with labels to compare it with.
pub(super) struct Picture {
    picture: TrackingPicture,
    labels: BTreeMap<u64, ImageBox>,
}

impl Picture {
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
        let label = self.labels.get(&frame.index).copied();
        self.picture.show(frame.capture.time, jpeg, &targets, label).context("cannot draw a frame")
    }
}

fn followed(track: &ImageTrack) -> FollowedTarget {
    let PixelBox { x, y, width, height } =
        PixelBox::about(track.position, track.width, track.height);
    FollowedTarget {
        number: track.id.0,
        place: ImageBox { x, y, width, height },
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

const LABEL_COLUMNS: [&str; 5] = ["frame", "x", "y", "w", "h"];

/// The boxes of a table of labels; a row without a box is a frame without a target.
fn read_labels(path: &Path) -> anyhow::Result<BTreeMap<u64, ImageBox>> {
    let context = || format!("cannot read the labels in {}", path.display());
    let mut reader = csv::Reader::from_path(path).with_context(context)?;
    let columns: Vec<String> =
        reader.headers().with_context(context)?.iter().map(str::to_owned).collect();
    for name in LABEL_COLUMNS {
        if !columns.iter().any(|column| column.trim() == name) {
            bail!("{} has no column `{name}`; it needs frame,x,y,w,h", path.display());
        }
    }
    let mut labels = BTreeMap::new();
    for record in reader.records() {
        let record = record.with_context(context)?;
        let row = LABEL_COLUMNS.map(|name| value(&record, &columns, name));
        if let [Some(frame), Some(x), Some(y), Some(width), Some(height)] = row {
            labels.insert(frame as u64, ImageBox { x, y, width, height });
        }
    }
    Ok(labels)
}

/// The number that a row has in a column.
fn value(record: &StringRecord, columns: &[String], name: &str) -> Option<f64> {
    let index = columns.iter().position(|column| column.trim() == name)?;
    record.get(index)?.trim().parse().ok()
}
