//! A component's health report, published every second: to the site, to Prometheus, and to systemd.

use std::net::SocketAddr;
use std::time::{Duration, Instant, SystemTime};

use crossfix_message::{Channel, Health, Payload};
use crossfix_transport::{Delivery, Link, LinkPublisher, OwnCertificate};

use crate::host::HostWatch;
use crate::metrics::MetricsPage;
use crate::network;

/// Interval of health reports. With twice as much a single report that is late makes a component
/// silent to `crossfix status`.
pub const PERIOD: Duration = Duration::from_secs(1);

/// Where a component's health can be seen beside the site's network.
#[derive(Debug, clap::Args)]
pub struct HealthArgs {
    /// Serve metrics for Prometheus at http://ADDRESS/metrics, e.g. 127.0.0.1:9464.
    #[arg(long, value_name = "ADDRESS")]
    metrics: Option<SocketAddr>,
}

/// Publishes a component's health.
#[derive(Debug)]
pub struct HealthReporter {
    publisher: LinkPublisher,
    run: u64,
    host: HostWatch,
    page: Option<MetricsPage>,
    /// Time of the last report, and the number handled by then.
    before: Option<(Instant, u64)>,
    certificate: Option<WatchedCertificate>,
}

/// A component's certificate, read again now and then; a problem is logged when it first appears.
#[derive(Debug)]
pub struct WatchedCertificate {
    own: OwnCertificate,
    looked_at: Instant,
    problem: Option<String>,
}

impl WatchedCertificate {
    pub fn new(own: OwnCertificate) -> Self {
        let mut watched = Self { own, looked_at: Instant::now(), problem: None };
        watched.check();
        watched
    }

    fn check(&mut self) {
        self.looked_at = Instant::now();
        let problem = self.own.problem(SystemTime::now());
        if let Some(problem) = problem.as_ref().filter(|_| self.problem.is_none()) {
            tracing::warn!("{problem}");
        }
        self.problem = problem;
    }

    /// The certificate's current problem, if any.
    pub fn problem(&mut self) -> Option<String> {
        if self.looked_at.elapsed() >= CERTIFICATE_PERIOD {
            self.check();
        }
        self.problem.clone()
    }
}

/// How often a component checks whether its certificate needs renewal. With twice as much its
/// problem is known a minute later.
const CERTIFICATE_PERIOD: Duration = Duration::from_secs(60);

impl HealthReporter {
    /// A reporter for the component whose health is published on `channel`.
    ///
    /// # Errors
    /// If the channel cannot be published on, or the metrics' address cannot be listened on.
    pub fn new(
        args: &HealthArgs,
        link: &Link,
        channel: Channel,
        delivery: Delivery,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            publisher: link.publisher(channel, delivery)?,
            run: link.run().0,
            host: HostWatch::start(),
            page: args.metrics.map(MetricsPage::serve).transpose()?,
            before: None,
            certificate: link.certificate().cloned().map(WatchedCertificate::new),
        })
    }

    /// A component's health report, completed with its run, process and host.
    pub fn completed(&mut self, health: Health) -> Health {
        let now = Instant::now();
        let rate_hz = self.before.map_or(0.0, |(at, handled)| {
            let new = health.handled.saturating_sub(handled);
            new as f64 / now.saturating_duration_since(at).as_secs_f64().max(f64::EPSILON)
        });
        self.before = Some((now, health.handled));
        let (run, host) = (self.run, network::host());
        let mut problems = health.problems;
        problems.extend(self.certificate.as_mut().and_then(WatchedCertificate::problem));
        Health { run, host, rate_hz, load: self.host.measure(), problems, ..health }
    }

    /// Publishes a report.
    ///
    /// # Errors
    /// If the session is closed.
    pub fn say(&self, health: &Health) -> anyhow::Result<()> {
        if let Some(page) = &self.page {
            page.show(health);
        }
        Ok(self.publisher.put(health.encode())?)
    }
}
