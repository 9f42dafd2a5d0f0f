use std::path::PathBuf;

use thiserror::Error;

/// Errors of writing and reading recordings.
#[derive(Debug, Error)]
pub enum RecordingError {
    /// The file cannot be created.
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
    /// The file exists already, and is not to be replaced.
    #[error("{} is there already", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// A message is longer than readers accept: it is left out, and the recording goes on.
    #[error("a message of {bytes} bytes on `{topic}` is too long for a recording")]
    TooLong {
        /// Where it was published.
        topic: String,
        /// Its length.
        bytes: usize,
    },
    /// The file cannot be written, often because the disk is full. What was flushed before can be
    /// read.
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
    /// Whether the medium written to refused the data, as a full disk does; `false` where the file
    /// itself can hold no more.
    pub fn is_of_disk(&self) -> bool {
        matches!(self, Self::Write(mcap::McapError::Io(_)))
    }
}
