//! Pages that this program serves itself: requests are answered on a thread of their own.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use hyper::body::{Body, Bytes, Incoming};
use hyper::service::service_fn;
use hyper::{Request, Response};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::time::{sleep, timeout};

/// Most requests served at the same time; further ones wait. Each takes a file descriptor, and the
/// camera and the network need some, too. With half as many the status page's clients of events, of
/// which there may be twelve, would take them all.
pub const ASKING: usize = 16;
/// How long a request may take to arrive. With half of it clients across a slow network are cut
/// off; with twice as much a silent one holds its place for two seconds.
const ASKED_WITHIN: Duration = Duration::from_secs(1);
/// Pause after a connection could not be accepted because descriptors are short. With half of it
/// the same; without it the loop would take a whole core.
const PAUSE: Duration = Duration::from_millis(100);

/// Answers all requests at an address until the process ends. From the first byte of a request to
/// the last of its answer at most `within` may pass, so that a slow client cannot keep a
/// connection.
///
/// # Errors
/// If the address cannot be listened on.
pub fn serve<B, F>(
    what: &'static str,
    address: SocketAddr,
    within: Duration,
    answer: F,
) -> anyhow::Result<()>
where
    F: Fn(&Request<Incoming>) -> Response<B> + Send + Sync + 'static,
    B: Body<Data = Bytes, Error = Infallible> + Send + 'static,
{
    let listener = std::net::TcpListener::bind(address)
        .and_then(|listener| listener.set_nonblocking(true).map(|()| listener))
        .with_context(|| format!("cannot serve {what} on {address}"))?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .with_context(|| format!("cannot serve {what}"))?;
    let answer = Arc::new(answer);
    std::thread::Builder::new().name(what.into()).spawn(move || {
        runtime.block_on(async {
            match TcpListener::from_std(listener) {
                Ok(listener) => accept(&listener, within, &answer).await,
                Err(error) => tracing::warn!("no {what}: {error}"),
            }
        });
    })?;
    Ok(())
}

async fn accept<B, F>(listener: &TcpListener, within: Duration, answer: &Arc<F>)
where
    F: Fn(&Request<Incoming>) -> Response<B> + Send + Sync + 'static,
    B: Body<Data = Bytes, Error = Infallible> + Send + 'static,
{
    let room = Arc::new(Semaphore::new(ASKING));
    loop {
        let Ok(place) = Arc::clone(&room).acquire_owned().await else { return };
        match listener.accept().await {
            Ok((stream, _)) => {
                let answer = Arc::clone(answer);
                tokio::spawn(async move {
                    // A failure of one client's connection concerns nobody else.
                    let _ = timeout(within, answer_one(stream, &*answer)).await;
                    drop(place);
                });
            }
            Err(_) => sleep(PAUSE).await,
        }
    }
}

async fn answer_one<B, F>(stream: TcpStream, answer: &F) -> hyper::Result<()>
where
    F: Fn(&Request<Incoming>) -> Response<B>,
    B: Body<Data = Bytes, Error = Infallible> + Send + 'static,
{
    let page = service_fn(|request| async move { Ok::<_, Infallible>(answer(&request)) });
    hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(ASKED_WITHIN)
        .keep_alive(false)
        .serve_connection(TokioIo::new(stream), page)
        .await
}
