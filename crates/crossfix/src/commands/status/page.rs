//! The web page of a site: its components' reports, and a plan with tracks and events.

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

/// The complete page: it loads no other file, and nothing from other hosts.
const PAGE: &str = include_str!("page.html");
/// Security policy: the page runs its own script and contacts its own server, and nothing else.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
                      connect-src 'self'; img-src data:";
/// Most clients that receive events at the same time; further ones are asked to try again later.
/// Other requests need connections of their own ([`http::ASKING`]). With half as many the seventh
/// client would be told so.
const TOLD: usize = 12;
/// A client must connect again after this time, so that one that reads nothing frees its place.
/// With twice as much such a place is free after two minutes.
const TOLD_FOR: Duration = Duration::from_secs(60);
/// Interval of the events sent to the page. With half of it each client receives twice as much;
/// with twice as much a target at 20 m/s jumps by 8 m.
pub const PERIOD: Duration = Duration::from_millis(200);

/// Data of one event for the page.
#[derive(Debug, Serialize)]
pub struct PageEvent {
    pub status: Status,
    pub plan: Plan,
}

/// The page; each client sees the state that was last shown.
#[derive(Debug)]
pub struct Page {
    shown: watch::Sender<Bytes>,
}

impl Page {
    /// Serves the page.
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

    /// Sends the site's current state to all clients. Slow clients miss the states in between.
    pub fn show(&self, shown: &PageEvent) -> anyhow::Result<()> {
        let event = format!("data: {}\n\n", serde_json::to_string(shown)?);
        self.shown.send_replace(event.into());
        Ok(())
    }
}

type Answer = Response<BoxBody<Bytes, Infallible>>;

/// Whether a request to a page on loopback names this host. Another name that resolves to here may
/// belong to a foreign web page, which must not read this one (DNS rebinding).
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

/// The shown states as server-sent events, beginning with the newest, as long as the place is kept.
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
