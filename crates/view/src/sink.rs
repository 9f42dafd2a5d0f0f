use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::time::Duration;

use rerun::{RecordingStream, RecordingStreamBuilder, RecordingStreamError, SpawnOptions};
use thiserror::Error;

/// Most memory that a viewer started by us takes.
const VIEWER_MEMORY: &str = "1GB";

/// What can go wrong with the picture.
#[derive(Debug, Error)]
pub enum ViewError {
    /// Rerun says no.
    #[error("Rerun does not take the picture")]
    Rerun(#[source] Box<RecordingStreamError>),
    /// No viewer is installed.
    #[error(
        "no Rerun viewer can be started: install it with `pip install rerun-sdk==0.36.3`, \
         or save the picture with `crossfix view --save FILE.rrd`"
    )]
    NoViewer(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// Nobody listens at the address.
    #[error("no Rerun viewer listens at {0}")]
    NobodyListens(SocketAddr),
    /// What was drawn did not all arrive.
    #[error("the picture is not complete: {0}")]
    Flush(String),
}

impl From<RecordingStreamError> for ViewError {
    fn from(error: RecordingStreamError) -> Self {
        Self::Rerun(Box::new(error))
    }
}

fn builder() -> RecordingStreamBuilder {
    RecordingStreamBuilder::new("crossfix")
}

/// A picture that is written to an `.rrd` file.
///
/// # Errors
/// [`ViewError::Rerun`] if the file cannot be made.
pub fn save(path: &Path) -> Result<RecordingStream, ViewError> {
    Ok(builder().save(path)?)
}

/// A picture in a viewer that listens at an address of this machine or another.
///
/// # Errors
/// [`ViewError::NobodyListens`]: the stream would wait for ever.
pub fn connect(address: SocketAddr) -> Result<RecordingStream, ViewError> {
    TcpStream::connect_timeout(&address, Duration::from_millis(500))
        .map_err(|_| ViewError::NobodyListens(address))?;
    Ok(builder().connect_grpc_opts(format!("rerun+http://{address}/proxy"))?)
}

/// Starts a viewer on this machine, with bounded memory, for this machine only; one that runs
/// already is used.
///
/// # Errors
/// [`ViewError::NoViewer`] if none is installed.
pub fn spawn_viewer() -> Result<SocketAddr, ViewError> {
    let options = SpawnOptions {
        memory_limit: VIEWER_MEMORY.into(),
        wait_for_bind: true,
        hide_welcome_screen: true,
        // The viewer's own default is all interfaces.
        extra_args: vec!["--bind=127.0.0.1".into()],
        ..SpawnOptions::default()
    };
    let address = SocketAddr::from(([127, 0, 0, 1], options.port));
    rerun::spawn(&options).map_err(|error| ViewError::NoViewer(Box::new(error)))?;
    Ok(address)
}
