use std::path::PathBuf;

use thiserror::Error;

/// What can go wrong with a recording.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// The file cannot be made.
    #[error("cannot write {}", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// The file cannot be opened.
    #[error("cannot open {}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// The file is there already, and is not to be replaced.
    #[error("{} is there already", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// A message is longer than readers take: it is left out, and the recording goes on.
    #[error("a message of {bytes} bytes on `{topic}` is too long for a recording")]
    TooLong {
        /// Where it was published.
        topic: String,
        /// How long it is.
        bytes: usize,
    },
    /// The file cannot be written, often as the disk is full. What was flushed before can be read.
    #[error("cannot write the recording; what was flushed before is readable")]
    Write(#[source] mcap::McapError),
    /// The file has not a single byte.
    #[error("{} is empty: nothing was recorded", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The file is no MCAP file: neither its beginning nor anything in it looks like one.
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

impl RecordingError {
    /// Whether what it is written to does not take it: a full disk, and not a file that holds no more.
    pub fn is_of_disk(&self) -> bool {
        matches!(self, Self::Write(mcap::McapError::Io(_)))
    }
}
