//! The table of tracks: a row for each target and frame.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use anyhow::Context;
use crossfix_vision::{ImageTrack, PixelBox, TargetFeatures, TrackPhase};

/// Titles of the table's columns, in order; the boxes are in pixels, `us` in microseconds.
const COLUMNS: [&str; 16] = [
    "frame",
    "x",
    "y",
    "w",
    "h",
    "ok",
    "us",
    "id",
    "certainty",
    "sd_x",
    "sd_y",
    "vx",
    "vy",
    "contrast",
    "flicker",
    "straightness",
];

pub(super) struct FollowedTable {
    writer: csv::Writer<Box<dyn Write>>,
}

impl FollowedTable {
    /// A table in a file, or on stdout.
    pub(super) fn new(path: Option<&Path>) -> anyhow::Result<Self> {
        let sink: Box<dyn Write> = match path {
            Some(path) => Box::new(
                File::create(path).with_context(|| format!("cannot write {}", path.display()))?,
            ),
            None => Box::new(io::stdout().lock()),
        };
        let mut writer = csv::Writer::from_writer(sink);
        writer.write_record(COLUMNS)?;
        Ok(Self { writer })
    }

    /// Writes the rows of a frame; if there is no target, one row without a box.
    pub(super) fn write(
        &mut self,
        frame: u64,
        tracks: &[ImageTrack],
        microseconds: f64,
    ) -> anyhow::Result<()> {
        if tracks.is_empty() {
            let mut row = [const { String::new() }; COLUMNS.len()];
            (row[0], row[5], row[6]) =
                (frame.to_string(), "0".to_owned(), format!("{microseconds:.1}"));
            self.writer.write_record(row)?;
        }
        for track in tracks {
            self.writer.write_record(row(frame, track, microseconds))?;
        }
        Ok(())
    }

    pub(super) fn finish(mut self) -> anyhow::Result<()> {
        self.writer.flush().context("cannot write the table")
    }
}

/// Standard deviation of a track's position along an axis, pixels, if it is known.
fn deviation(track: &ImageTrack, axis: usize) -> String {
    let covariances = track.covariances.as_ref();
    covariances.map_or_else(String::new, |both| format!("{:.3}", both[axis].m11.max(0.0).sqrt()))
}

fn row(frame: u64, track: &ImageTrack, microseconds: f64) -> [String; COLUMNS.len()] {
    let place = PixelBox::about(track.position, track.width, track.height);
    let ok = u8::from(track.phase != TrackPhase::Searching);
    let feature = |of: fn(TargetFeatures) -> f64| {
        track.features.map_or_else(String::new, |features| format!("{:.3}", of(features)))
    };
    [
        frame.to_string(),
        format!("{:.3}", place.x),
        format!("{:.3}", place.y),
        format!("{:.3}", place.width),
        format!("{:.3}", place.height),
        ok.to_string(),
        format!("{microseconds:.1}"),
        track.id.to_string(),
        format!("{:.3}", track.certainty),
        deviation(track, 0),
        deviation(track, 1),
        format!("{:.2}", track.velocity.x),
        format!("{:.2}", track.velocity.y),
        feature(|features| features.contrast),
        feature(|features| features.flicker),
        feature(|features| features.straightness),
    ]
}
