//! The site on one page: what its parts say of themselves, and a plan with tracks and events.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::time::Duration;

use futures_util::stream;
use http_body_util::combinators::BoxBody;
use http_body_util::{BodyExt, Full, StreamBody};
use hyper::body::{Bytes, Frame};
use hyper::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderValue};
use hyper::{Method, Request, Response, StatusCode};
use serde::Serialize;
use tokio::sync::watch;

use super::board::Status;
use super::plan::Plan;
use crate::http::{self, Answers};

/// The page, whole: no other file, and nothing from elsewhere.
const PAGE: &str = include_str!("page.html");
/// It runs its own script and asks its own server, and nothing else.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
                      connect-src 'self'; img-src data:";
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
        http::serve("page", address, Answers::GoOn, move |request| answer(request, &receiver))?;
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

fn answer<B>(request: &Request<B>, shown: &watch::Receiver<Bytes>) -> Answer {
    let of = |status, kind: &'static str, body| {
        let mut response = Response::new(body);
        *response.status_mut() = status;
        let headers = response.headers_mut();
        headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
        headers.insert(CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY));
        headers.insert(CACHE_CONTROL, HeaderValue::from_static("no-store"));
        response
    };
    let text = |text: &'static str| Full::new(Bytes::from_static(text.as_bytes())).boxed();
    match (request.method(), request.uri().path()) {
        (&Method::GET, "/") => of(StatusCode::OK, "text/html; charset=utf-8", text(PAGE)),
        (&Method::GET, "/events") => of(StatusCode::OK, "text/event-stream", events(shown.clone())),
        _ => of(StatusCode::NOT_FOUND, "text/plain", text("GET / or /events\n")),
    }
}

/// What is shown, as server-sent events, from the newest on.
fn events(mut shown: watch::Receiver<Bytes>) -> BoxBody<Bytes, Infallible> {
    shown.mark_changed();
    let events = stream::unfold(shown, |mut shown| async move {
        shown.changed().await.ok()?;
        let event = shown.borrow_and_update().clone();
        Some((Ok::<_, Infallible>(Frame::data(event)), shown))
    });
    BodyExt::boxed(StreamBody::new(events))
}
