//! Labelled video: what was followed and found in it, against its labels.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use crate::FollowedRow;

/// Frames per second of the labelled clips.
pub const RATE_HZ: f64 = 30.0;

/// Boxes by their frames: left edge, upper edge, columns, rows.
pub type Labels = BTreeMap<u64, [f64; 4]>;

/// The labels beside a clip.
pub fn labels(clip: &Path) -> Labels {
    let mut labels = BTreeMap::new();
    for row in csv::Reader::from_path(clip.with_extension("csv")).unwrap().deserialize() {
        let (frame, x, y, w, h): (u64, Option<f64>, Option<f64>, Option<f64>, Option<f64>) =
            row.unwrap();
        if let (Some(x), Some(y), Some(w), Some(h)) = (x, y, w, h) {
            labels.insert(frame, [x, y, w, h]);
        }
    }
    labels
}

/// How far the middle of a followed box is from that of a label, px on either axis.
pub fn off(row: &FollowedRow, [x, y, w, h]: [f64; 4]) -> Option<[f64; 2]> {
    let middle = row.middle()?;
    Some([middle[0] - x - w / 2.0, middle[1] - y - h / 2.0])
}

/// What is found without a box in some clips, of which one target is labelled.
#[derive(Debug, Default)]
pub struct Finds {
    labelled: usize,
    /// Labelled frames with a box within 10 px.
    near: usize,
    frames: u64,
    boxes_elsewhere: usize,
    /// Tracks that are elsewhere for most of their time.
    tracks_elsewhere: usize,
}

impl Finds {
    /// Adds what was found in a clip of so many frames.
    pub fn add(&mut self, labels: &Labels, rows: &[FollowedRow], frames: u64) {
        let mut near = BTreeSet::new();
        // Of each track its boxes, and those at the target.
        let mut tracks: BTreeMap<u64, (usize, usize)> = BTreeMap::new();
        for row in rows.iter().filter(|row| row.certainty.is_some_and(|certainty| certainty > 0.5))
        {
            let label = labels.get(&row.frame);
            let off = label.and_then(|label| off(row, *label));
            if off.is_some_and(|[x, y]| x.hypot(y) <= 10.0) {
                near.insert(row.frame);
            }
            let is_at = label.zip(off).is_some_and(|([_, _, w, h], [x, y])| {
                x.abs() <= w / 2.0 + 12.0 && y.abs() <= h / 2.0 + 12.0
            });
            let (boxes, at) = tracks.entry(row.id.unwrap()).or_default();
            *boxes += 1;
            *at += usize::from(is_at);
        }
        self.labelled += labels.len();
        self.near += near.len();
        self.frames += frames;
        self.boxes_elsewhere += tracks.values().map(|(boxes, at)| boxes - at).sum::<usize>();
        self.tracks_elsewhere += tracks.values().filter(|(boxes, at)| 2 * at < *boxes).count();
    }

    /// Share of the labelled frames with a box within 10 px.
    pub fn share(&self) -> f64 {
        self.near as f64 / self.labelled as f64
    }

    /// Boxes elsewhere per frame.
    pub fn boxes_a_frame(&self) -> f64 {
        self.boxes_elsewhere as f64 / self.frames as f64
    }

    /// Tracks elsewhere per minute.
    pub fn tracks_a_minute(&self) -> f64 {
        self.tracks_elsewhere as f64 / (self.frames as f64 / RATE_HZ / 60.0)
    }
}
