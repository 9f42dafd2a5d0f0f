use std::path::PathBuf;

use thiserror::Error;

/// What can go wrong with a video.
#[derive(Debug, Error)]
pub enum VideoError {
    /// The file or folder cannot be opened.
    #[error("cannot open {}", path.display())]
    Open {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// Neither a folder of images nor a file of a known kind.
    #[error(
        "{} is neither a folder of PNG or JPEG images nor a .mp4, .avi or .y4m file (`ffmpeg -i IN \
         -c:v libx264 -pix_fmt yuv420p OUT.mp4` makes most videos readable)",
        path.display()
    )]
    UnknownKind {
        /// The path.
        path: PathBuf,
    },
    /// A folder without a single image.
    #[error("{} holds no PNG or JPEG image", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// The file as a whole cannot be read.
    #[error(
        "{} cannot be read: {what} (`ffmpeg -i IN -c:v libx264 -pix_fmt yuv420p OUT.mp4` makes \
         most videos readable)",
        path.display()
    )]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// One frame cannot be decoded; the ones after it can.
    #[error("frame {index} of {} cannot be decoded: {what}", path.display())]
    Frame {
        /// The file.
        path: PathBuf,
        /// Number of the frame, from 0.
        index: u64,
        /// What is wrong.
        what: String,
    },
    /// Not the address of a stream.
    #[error("it is no address of a stream, rtsp://HOST/PATH: {what}")]
    Address {
        /// What is wrong; never the address, which may hold a password.
        what: String,
    },
    /// A stream cannot be opened, or breaks off.
    #[error("{url}: {what}")]
    Stream {
        /// Its address, without user and password.
        url: String,
        /// What is wrong.
        what: String,
    },
    /// A camera refuses the user or the password.
    #[error("{url}: the camera refuses: user or password are wrong")]
    Refused {
        /// Its address, without user and password.
        url: String,
    },
    /// A stream that should run sends nothing.
    #[error("{url} has sent no frame for {seconds:.1} s")]
    Silent {
        /// Its address, without user and password.
        url: String,
        /// For how long, s.
        seconds: f64,
    },
    /// This host's clock, by which a live source's frames are timed, was set: the source must be
    /// reopened.
    #[error("this host's clock was set by {by_s:+.1} s")]
    HostClockSet {
        /// How far it was set forward, s.
        by_s: f64,
    },
    /// A live source ended.
    #[error("the stream has ended")]
    Ended,
    /// One frame of a stream cannot be decoded; the ones after it may.
    #[error("frame {index} of {url} cannot be decoded: {what}")]
    StreamFrame {
        /// Its address, without user and password.
        url: String,
        /// Number of the frame, from 0.
        index: u64,
        /// What is wrong.
        what: String,
    },
}

impl VideoError {
    /// Whether only one frame is lost and the source goes on.
    pub fn is_one_frame(&self) -> bool {
        matches!(self, Self::Frame { .. } | Self::StreamFrame { .. })
    }
}
