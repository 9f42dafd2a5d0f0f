//! Readers of published data sets.

pub mod drone_tracking;
pub mod scenario;

use std::path::Path;

use anyhow::Context;
use crossfix_geometry::{Bearing, Pixel};
use crossfix_message::{BearingTrack, ImageTrackState, Key, Timestamp};
use crossfix_recording::Entry;

/// An entry of data that were not recorded live: its arrival time is its data time.
pub fn imported(key: Key, time: Timestamp, data: Vec<u8>) -> Entry {
    Entry { key, data_time: time, arrival: time, data }
}

/// A target that was seen for sure at a pixel, as by a label, with its bearing.
pub fn labelled(track_id: u64, bearing: &Bearing, pixel: Pixel) -> BearingTrack {
    let covariance = bearing.covariance();
    BearingTrack {
        track_id,
        bearing: Some(bearing.direction().into_inner().into()),
        covariance_xx: covariance.m11,
        covariance_xy: covariance.m12,
        covariance_yy: covariance.m22,
        pixel_x: pixel.x(),
        pixel_y: pixel.y(),
        score: 1.0,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    }
}

/// Reads a whole text file of a data set.
fn read_text(path: &Path) -> anyhow::Result<String> {
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}
