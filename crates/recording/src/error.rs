use std::path::PathBuf;

use thiserror::Error;

/// What can go wrong with a recording.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// The file cannot be opened or made.
    #[error("cannot open {}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// The file cannot be written, often as the disk is full. What was flushed before can be read.
    #[error("cannot write the recording; what was flushed before is readable")]
    Write(#[source] mcap::McapError),
    /// The file is no MCAP file from its first byte on.
    #[error("{} is no MCAP file", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// The file cannot be read, not even as a torn one.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
}
