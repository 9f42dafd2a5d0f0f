//! A component's health for Prometheus: `GET /metrics` on a separate address.

use std::net::SocketAddr;
use std::sync::{Arc, PoisonError, RwLock};
use std::time::{Duration, Instant};

use crossfix_message::{CameraStanding, Health};
use http_body_util::Full;
use hyper::body::Bytes;
use hyper::header::{CONTENT_TYPE, HeaderValue};
use hyper::{Method, Request, Response, StatusCode};
use prometheus::{CounterVec, GaugeVec, Opts, Registry, TextEncoder};

use crate::http;

/// How long an exchange may take, from the first byte of the request to the last of the answer, so
/// that a slow or silent client cannot keep a connection. With half of it a scrape across a slow
/// network may fail.
const ANSWERED_WITHIN: Duration = Duration::from_secs(1);
/// A report older than this means that the component no longer reports its health. They are due
/// every second: with half of it one that is delayed by three seconds would seem dead.
const STALE: Duration = Duration::from_secs(5);

/// The metrics page; it disappears when the process ends.
#[derive(Debug)]
pub struct MetricsPage {
    shown: Arc<RwLock<PageText>>,
}

/// The page's text, and when it was set.
#[derive(Debug)]
struct PageText {
    text: String,
    at: Instant,
}

impl MetricsPage {
    /// Serves an empty page.
    ///
    /// # Errors
    /// If the address cannot be listened on.
    pub fn serve(address: SocketAddr) -> anyhow::Result<Self> {
        let shown = Arc::new(RwLock::new(PageText { text: String::new(), at: Instant::now() }));
        let page = Self { shown: Arc::clone(&shown) };
        http::serve("metrics", address, ANSWERED_WITHIN, move |request| answer(request, &shown))?;
        tracing::info!("metrics at http://{address}/metrics");
        Ok(page)
    }

    /// Serves a report from now on.
    pub fn show(&self, health: &Health) {
        match exposition(health) {
            Ok(text) => {
                let mut shown = self.shown.write().unwrap_or_else(PoisonError::into_inner);
                *shown = PageText { text, at: Instant::now() };
            }
            Err(error) => tracing::debug!("a report is not shown as metrics: {error}"),
        }
    }
}

fn answer<B>(request: &Request<B>, shown: &RwLock<PageText>) -> Response<Full<Bytes>> {
    let is_there = request.uri().path() == "/metrics" && request.method() == Method::GET;
    let shown = shown.read().unwrap_or_else(PoisonError::into_inner);
    let (status, text) = if !is_there {
        (StatusCode::NOT_FOUND, "GET /metrics\n".to_owned())
    } else if shown.at.elapsed() > STALE {
        (StatusCode::SERVICE_UNAVAILABLE, "it does not say any more how it does\n".to_owned())
    } else {
        (StatusCode::OK, shown.text.clone())
    };
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    let kind = HeaderValue::from_static("text/plain; version=0.0.4; charset=utf-8");
    response.headers_mut().insert(CONTENT_TYPE, kind);
    response
}

/// The metrics made of one report.
struct Metrics {
    registry: Registry,
    component: String,
}

impl Metrics {
    fn count(&self, name: &str, help: &str, value: u64) -> prometheus::Result<()> {
        let counter =
            CounterVec::new(Opts::new(format!("crossfix_{name}_total"), help), &["component"])?;
        counter.with_label_values(&[&self.component]).inc_by(value as f64);
        self.registry.register(Box::new(counter))
    }

    fn gauge(&self, name: &str, help: &str, value: f64) -> prometheus::Result<()> {
        let gauge = GaugeVec::new(Opts::new(format!("crossfix_{name}"), help), &["component"])?;
        gauge.with_label_values(&[&self.component]).set(value);
        self.registry.register(Box::new(gauge))
    }

    /// A gauge with one value for each camera that the fusion centre knows.
    fn gauges(
        &self,
        name: &str,
        help: &str,
        health: &Health,
        value: impl Fn(&crossfix_message::CameraHealth) -> f64,
    ) -> prometheus::Result<()> {
        let gauge = GaugeVec::new(Opts::new(format!("crossfix_camera_{name}"), help), &["camera"])?;
        for camera in &health.cameras {
            gauge.with_label_values(&[&camera.camera]).set(value(camera));
        }
        self.registry.register(Box::new(gauge))
    }
}

/// A report in Prometheus' text format, in base units.
fn exposition(health: &Health) -> prometheus::Result<String> {
    let metrics = Metrics { registry: Registry::new(), component: health.component.clone() };
    let handled = "Frames or messages handled since the start.";
    metrics.count("handled", handled, health.handled)?;
    metrics.gauge("handled_per_second", "The same in the last second.", health.rate_hz)?;
    metrics.gauge("tracks", "Tracks that live.", f64::from(health.tracks))?;
    let problems = "Things that a person should look at: they are in the log.";
    metrics.gauge("problems", problems, health.problems.len() as f64)?;
    for counter in &health.counters {
        counted(&metrics, &counter.name, counter.value)?;
    }
    if !health.cameras.is_empty() {
        of_cameras(&metrics, health)?;
    }
    if let Some(load) = &health.load {
        of_host(&metrics, load)?;
    }
    TextEncoder::new().encode_to_string(&metrics.registry.gather())
}

/// A counter of a report; one whose name ends in a unit is instead a time of the last second.
fn counted(metrics: &Metrics, name: &str, value: u64) -> prometheus::Result<()> {
    let words = name.replace('_', " ");
    let now = |words: &str| format!("{words}, in the last second.");
    if let Some(name) = name.strip_suffix("_us") {
        let help = now(&name.replace('_', " "));
        return metrics.gauge(&format!("{name}_seconds"), &help, value as f64 * 1e-6);
    }
    if let Some(name) = name.strip_suffix("_ms") {
        let help = now(&name.replace('_', " "));
        return metrics.gauge(&format!("{name}_seconds"), &help, value as f64 * 1e-3);
    }
    if name == "synchronised" {
        let help = "1 where images are timed by the camera's clock or its driver, else 0.";
        return metrics.gauge(name, help, value as f64);
    }
    metrics.count(name, &format!("{words}, since the start."), value)
}

fn of_cameras(metrics: &Metrics, health: &Health) -> prometheus::Result<()> {
    metrics.gauges("left_out", "1 where its bearings are not used.", health, |camera| {
        f64::from(u8::from(camera.standing() == CameraStanding::Excluded))
    })?;
    let factor = "What its reported covariances are multiplied with.";
    metrics.gauges("noise_factor", factor, health, |camera| camera.noise_factor)?;
    let offset = "How far its clock is ahead of the site's.";
    metrics.gauges("clock_offset_seconds", offset, health, |camera| camera.clock_offset_s)?;
    let sd = "Standard deviation of that.";
    metrics.gauges("clock_offset_sd_seconds", sd, health, |camera| camera.clock_relative_sd_s)
}

fn of_host(metrics: &Metrics, load: &crossfix_message::HostLoad) -> prometheus::Result<()> {
    let own = "Processor time of the process, in cores.";
    metrics.gauge("process_cores", own, load.process_cores)?;
    let memory = "Memory that the process holds.";
    metrics.gauge("process_memory_bytes", memory, load.process_memory as f64)?;
    let cores = "Share of the host's cores that is in use.";
    metrics.gauge("host_cores_in_use_ratio", cores, load.cores_in_use)?;
    let available = "Memory that programs of the host can still have.";
    metrics.gauge("host_memory_available_bytes", available, load.memory_available as f64)?;
    if let Some(celsius) = load.temperature_c {
        metrics.gauge("host_temperature_celsius", "Of the host's hottest part.", celsius)?;
    }
    if let Some(bound_s) = load.clock_bound_s {
        let help = "How far off the host's clock may be; absent where nothing keeps it.";
        metrics.gauge("host_clock_bound_seconds", help, bound_s)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};

    use crossfix_message::Counter;

    use super::*;
    use crate::http::ASKING;

    fn ask(address: SocketAddr, request: &str) -> String {
        let mut stream = std::net::TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    }

    fn free_address() -> SocketAddr {
        std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap()
    }

    #[test]
    fn a_report_is_counts_and_measurements_in_base_units() {
        let counter = |name: &str, value| Counter { name: name.to_owned(), value };
        let health = Health {
            component: "no\"rth\n".to_owned(),
            handled: 7,
            counters: vec![
                counter("frames_late", 3),
                counter("behind_ms", 250),
                counter("synchronised", 1),
            ],
            ..Health::default()
        };
        let text = exposition(&health).unwrap();
        let label = "{component=\"no\\\"rth\\n\"}";
        for line in [
            format!("crossfix_handled_total{label} 7"),
            format!("crossfix_frames_late_total{label} 3"),
            format!("crossfix_behind_seconds{label} 0.25"),
            format!("crossfix_synchronised{label} 1"),
            "# TYPE crossfix_frames_late_total counter".to_owned(),
        ] {
            assert!(text.lines().any(|said| said == line), "{line} in {text}");
        }
    }

    #[test]
    fn who_asks_for_metrics_gets_them_however_many_ask_for_nothing() {
        let address = free_address();
        let page = MetricsPage::serve(address).unwrap();
        page.show(&Health { component: "north".to_owned(), ..Health::default() });
        // Twice as many clients as may be served at the same time connect and say nothing.
        let silent: Vec<_> =
            (0..2 * ASKING).map(|_| std::net::TcpStream::connect(address).unwrap()).collect();
        let answer = ask(address, "GET /metrics HTTP/1.1\r\nHost: a\r\n\r\n");
        assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("crossfix_handled_total"));
        drop(silent);
        assert!(ask(address, "GET / HTTP/1.1\r\nHost: a\r\n\r\n").starts_with("HTTP/1.1 404"));
        assert!(ask(address, "\0\r\n\r\n").starts_with("HTTP/1.1 400"));
        assert!(MetricsPage::serve(address).is_err());
    }
}
