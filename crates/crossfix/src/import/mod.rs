//! Readers of published data sets.

pub mod drone_tracking;
pub mod scenario;

use std::path::Path;

use anyhow::Context;
use crossfix_message::{Key, Timestamp};
use crossfix_recording::Entry;

/// An entry of data that were not recorded live: its arrival time is its data time.
pub fn imported(key: Key, time: Timestamp, data: Vec<u8>) -> Entry {
    Entry { key, data_time: time, arrival: time, data }
}

/// Reads a whole text file of a data set.
fn read_text(path: &Path) -> anyhow::Result<String> {
    std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}
