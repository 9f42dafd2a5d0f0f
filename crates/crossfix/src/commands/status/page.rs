//! The site on one page: what its parts say of themselves, and a plan with tracks and events.

use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use futures_util::stream;
use http_body_util::combinators::BoxBody;
use http_body_util::{BodyExt, Full, StreamBody};
use hyper::body::{Bytes, Frame};
use hyper::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HOST, HeaderValue};
use hyper::{Method, Request, Response, StatusCode};
use serde::Serialize;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::board::Status;
use super::plan::Plan;
use crate::http;

/// The page, whole: no other file, and nothing from elsewhere.
const PAGE: &str = include_str!("page.html");
/// It runs its own script and asks its own server, and nothing else.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
                      connect-src 'self'; img-src data:";
/// Who may be told at the same time; the others are told to come again. What else is asked needs places
/// of its own ([`http::ASKING`]).
const TOLD: usize = 12;
/// Who is told comes again after so long: whoever takes nothing holds no place for longer.
const TOLD_FOR: Duration = Duration::from_secs(60);
/// How often the page is told how the site does.
pub const PERIOD: Duration = Duration::from_millis(200);

/// What the page is told.
#[derive(Debug, Serialize)]
pub struct Shown {
    pub status: Status,
    pub plan: Plan,
}

/// The page; whoever looks at it sees what it was shown last.
#[derive(Debug)]
pub struct Page {
    shown: watch::Sender<Bytes>,
}

impl Page {
    /// Serves it.
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub fn serve(address: SocketAddr) -> anyhow::Result<Self> {
        let (sender, receiver) = watch::channel(Bytes::new());
        let places = Arc::new(Semaphore::new(TOLD));
        let is_local = address.ip().is_loopback();
        http::serve("page", address, TOLD_FOR, move |request| {
            if is_local && !names_this_host(request) {
                return refused(StatusCode::MISDIRECTED_REQUEST, "ask for it by its address\n");
            }
            answer(request, &receiver, &places)
        })?;
        Ok(Self { shown: sender })
    }

    /// Shows how the site does now. Who looks on slowly misses what lies between.
    pub fn show(&self, shown: &Shown) -> anyhow::Result<()> {
        let event = format!("data: {}\n\n", serde_json::to_string(shown)?);
        self.shown.send_replace(event.into());
        Ok(())
    }
}

type Answer = Response<BoxBody<Bytes, Infallible>>;

/// Whether a page that listens on loopback is asked for as such: a name of somebody else's that leads here
/// is that of a page elsewhere, which must not read this one.
fn names_this_host<B>(request: &Request<B>) -> bool {
    let host = request.headers().get(HOST).and_then(|host| host.to_str().ok()).unwrap_or_default();
    let name = host.rsplit_once(':').map_or(host, |(name, port)| {
        if port.bytes().all(|digit| digit.is_ascii_digit()) { name } else { host }
    });
    name == "localhost" || name.trim_matches(['[', ']']).parse::<IpAddr>().is_ok()
}

fn refused(status: StatusCode, why: &'static str) -> Answer {
    respond(status, "text/plain", Full::new(Bytes::from_static(why.as_bytes())).boxed())
}

fn respond(status: StatusCode, kind: &'static str, body: BoxBody<Bytes, Infallible>) -> Answer {
    let mut response = Response::new(body);
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
    headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
    response
}

fn answer<B>(
    request: &Request<B>,
    shown: &watch::Receiver<Bytes>,
    places: &Arc<Semaphore>,
) -> Answer {
    match (request.method(), request.uri().path()) {
        (&Method::GET, "/") => {
            let page = Full::new(Bytes::from_static(PAGE.as_bytes())).boxed();
            respond(StatusCode::OK, "text/html; charset=utf-8", page)
        }
        (&Method::GET, "/events") => match Arc::clone(places).try_acquire_owned() {
            Ok(place) => respond(StatusCode::OK, "text/event-stream", events(shown.clone(), place)),
            Err(_) => refused(StatusCode::SERVICE_UNAVAILABLE, "too many look on already\n"),
        },
        _ => refused(StatusCode::NOT_FOUND, "GET / or /events\n"),
    }
}

/// What is shown, as server-sent events, from the newest on, for as long as the place is held.
fn events(
    mut shown: watch::Receiver<Bytes>,
    place: OwnedSemaphorePermit,
) -> BoxBody<Bytes, Infallible> {
    shown.mark_changed();
    let events = stream::unfold((shown, place), |(mut shown, place)| async move {
        shown.changed().await.ok()?;
        let event = shown.borrow_and_update().clone();
        Some((Ok::<_, Infallible>(Frame::data(event)), (shown, place)))
    });
    BodyExt::boxed(StreamBody::new(events))
}
