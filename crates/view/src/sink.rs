use std::any::Any;
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rerun::log::ChunkBatcherConfig;
use rerun::sink::{FileSink, FileSinkOptions, GrpcSink, GrpcSinkConnectionState};
use rerun::{RecordingStream, RecordingStreamBuilder, RecordingStreamError, SpawnOptions};
use thiserror::Error;

/// Bytes that may be on their way to a viewer before drawing waits for it, as Rerun counts them
/// (they take several times as much): some seconds of a site of three cameras. With half of it
/// drawing waits sooner where a network stalls; with twice as much the picture may lag twice as far
/// behind.
const MOST_IN_FLIGHT: u64 = 8 << 20;
/// Memory at which a viewer started by us forgets its oldest data; the viewer takes half as much
/// again. With half of it the past is gone twice as soon.
const VIEWER_MEMORY: &str = "1GB";
/// Memory in which that viewer keeps a second copy for other viewers that may connect to it.
/// Rerun's default is a gigabyte. With half of it a viewer that connects later sees half as much of
/// the past.
const FOR_OTHER_VIEWERS: &str = "64MB";

/// What can go wrong with drawing a picture.
#[derive(Debug, Error)]
pub enum ViewError {
    /// Rerun reports an error.
    #[error("Rerun does not take the picture")]
    Rerun(#[source] Box<RecordingStreamError>),
    /// No viewer is installed.
    #[error(
        "no Rerun viewer can be started: install it with `pip install rerun-sdk==0.36.3`, \
         or save the picture with `crossfix view --save FILE.rrd`"
    )]
    NoViewer(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// No viewer listens at the address.
    #[error("no Rerun viewer listens at {0}")]
    NobodyListens(SocketAddr),
    /// The file cannot be created.
    #[error("cannot write {}", path.display())]
    Create {
        /// The file.
        path: std::path::PathBuf,
        /// What Rerun says.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// Not everything that was drawn arrived.
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

/// A stream that is written to an `.rrd` file.
///
/// # Errors
/// [`ViewError::Rerun`] if the file cannot be created.
pub fn save(path: &Path) -> Result<RecordingStream, ViewError> {
    Ok(builder().save(path)?)
}

/// A stream of unlimited length that is written to an `.rrd` file. The file has no index, which
/// Rerun would keep in memory until the file's end and which grows by a gigabyte per hour.
///
/// # Errors
/// [`ViewError`] if the file cannot be created.
pub fn save_without_end(path: &Path) -> Result<RecordingStream, ViewError> {
    let create = |source| ViewError::Create { path: path.to_owned(), source };
    let sink = FileSink::with_options(path, FileSinkOptions { write_footer: false })
        .map_err(|error| create(Box::new(error)))?;
    let stream = builder().buffered()?;
    stream.set_sink(Box::new(sink));
    Ok(stream)
}

/// A stream to a viewer that listens at an address of this or another machine. If the viewer does
/// not take the data, drawing waits; the waiting data are bounded.
///
/// # Errors
/// [`ViewError::NobodyListens`] if no viewer listens: the stream would wait for ever.
pub fn connect(address: SocketAddr) -> Result<RecordingStream, ViewError> {
    TcpStream::connect_timeout(&address, Duration::from_millis(500))
        .map_err(|_| ViewError::NobodyListens(address))?;
    let bounded = ChunkBatcherConfig {
        max_bytes_in_flight: MOST_IN_FLIGHT,
        ..ChunkBatcherConfig::LOW_LATENCY
    };
    Ok(builder()
        .batcher_config(bounded)
        .connect_grpc_opts(format!("rerun+http://{address}/proxy"))?)
}

/// Watches whether the viewer at the end of a stream is gone for good: Rerun does not reconnect.
#[derive(Clone, Debug, Default)]
pub struct ViewerWatch(Arc<AtomicBool>);

impl ViewerWatch {
    /// Checks again. The result comes later, when the stream's own thread gets to it.
    pub fn check(&self, stream: &RecordingStream) {
        let gone = Arc::clone(&self.0);
        stream.inspect_sink(move |sink| {
            let sink: &dyn Any = sink;
            if let Some(viewer) = sink.downcast_ref::<GrpcSink>()
                && matches!(viewer.status(), GrpcSinkConnectionState::Disconnected(_))
            {
                gone.store(true, Ordering::Relaxed);
            }
        });
    }

    /// Whether it was gone at the last check.
    pub fn is_gone(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Starts a viewer on this machine that only this machine can reach, with bounded memory. A viewer
/// that already runs is used.
///
/// # Errors
/// [`ViewError::NoViewer`] if none is installed.
pub fn spawn_viewer() -> Result<SocketAddr, ViewError> {
    let options = SpawnOptions {
        memory_limit: VIEWER_MEMORY.into(),
        server_memory_limit: FOR_OTHER_VIEWERS.into(),
        wait_for_bind: true,
        hide_welcome_screen: true,
        // The viewer's default is to listen on all interfaces.
        extra_args: vec!["--bind=127.0.0.1".into()],
        ..SpawnOptions::default()
    };
    let address = SocketAddr::from(([127, 0, 0, 1], options.port));
    rerun::spawn(&options).map_err(|error| ViewError::NoViewer(Box::new(error)))?;
    Ok(address)
}
