use std::error::Error;
use std::io;
use std::net::TcpListener;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant, SystemTime};

use crossfix_message::{AreaName, Channel, Key, MAX_MESSAGE_BYTES, SiteName};
use thiserror::Error;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Config, Session, Wait};

use crate::config::address;
use crate::security::{
    Credentials, CredentialsError, HandshakeError, Identity, Security, Validity, access_control,
    days, handshake,
};
use crate::subscription::Intake;
use crate::{Mode, NetworkConfig, NetworkError, Origin, Presence, Role, RunId, Subscription};

/// Batches of 64 kB that wait for one slow receiver of bearings and tracks before it loses the
/// next: 1 MB, the most that Zenoh takes. With half of it, a good receiver loses part of a burst of
/// a thousand tracks.
const QUEUED_BATCHES: u32 = 16;
/// The same for pictures, so that what a slow receiver sees is at most this much old.
const PICTURE_BATCHES: u32 = 4;
/// Bytes that the operating system holds for one receiver besides that. Its own default is four
/// megabytes: then a receiver behind 5 kB per second would get tracks a quarter of an hour old
/// before it loses one.
const SEND_BUFFER_BYTES: u32 = 256 << 10;
/// How long opening a link may take, ms: with a one-way delay of 700 ms two exchanges take three
/// seconds. A program that waits for a router that does not answer at all can report that within
/// five seconds.
const OPEN_TIMEOUT_MS: u32 = 4000;
/// A peer that has not been heard for this long is taken as gone, ms.
const LEASE_MS: u32 = 3000;
/// Interval at which a router that does not answer is tried again.
const RETRY_PERIOD: Duration = Duration::from_millis(500);

/// How long a liveliness query may take; while waiting it is repeated.
const ALIVE_PERIOD: Duration = Duration::from_millis(200);

/// What can go wrong with the network.
#[derive(Debug, Error)]
pub enum LinkError {
    /// The configuration is impossible.
    #[error("the network's configuration is impossible")]
    Config(#[source] NetworkError),
    /// This component's certificate cannot be used.
    #[error("this component cannot show who it is")]
    Credentials(#[source] CredentialsError),
    /// Zenoh reports an error.
    #[error("{what}")]
    Zenoh {
        /// What was tried.
        what: String,
        /// What Zenoh says.
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
    /// One of this component's own endpoints cannot be listened on.
    #[error("cannot listen on {endpoint}: {}", why_not(source))]
    Listen {
        /// The endpoint.
        endpoint: String,
        /// What the system says.
        source: io::Error,
    },
    /// No router answers.
    #[error("no Zenoh router answers at {}", routers.join(", "))]
    NoRouter {
        /// Their endpoints.
        routers: Vec<String>,
        /// What Zenoh says.
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
    /// A component did not come in time.
    #[error("`{0}` is not alive")]
    NotAlive(String),
}

fn zenoh(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> LinkError {
    let what = what.into();
    move |source| LinkError::Zenoh { what, source: said(&source) }
}

/// Zenoh's message, without the position in its own source code.
fn said(error: &zenoh::Error) -> Box<dyn Error + Send + Sync> {
    let text = error.to_string();
    text.split(" at /").next().unwrap_or(&text).trim().to_owned().into()
}

/// In words: what people can do about an endpoint that cannot be listened on.
fn why_not(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::AddrInUse => "another program on this machine uses it".to_owned(),
        io::ErrorKind::AddrNotAvailable => "it is no address of this machine".to_owned(),
        io::ErrorKind::PermissionDenied => "ports below 1024 are the system's".to_owned(),
        _ => format!("{error}: is the host's name right?"),
    }
}

/// What happens to a message if a receiver is slow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The message waits for that receiver. If too many wait, that receiver loses the message and
    /// counts it. Nobody else is delayed: for all that is published live.
    Queued,
    /// The publisher waits, and so do all other receivers: for sources that are played as fast as
    /// possible.
    Every,
    /// As queued, but behind all other messages: pictures.
    Picture,
}

/// A session with the site's network. Lost connections are restored automatically.
#[derive(Debug)]
pub struct Link {
    session: Session,
    site: SiteName,
    /// The area of a fusion centre that is one of several.
    area: Option<AreaName>,
    run: RunId,
    shown: Option<OwnCertificate>,
}

/// The certificate by which a component shows who it is.
#[derive(Clone, Debug)]
pub struct OwnCertificate {
    security: Security,
    identity: Identity,
    /// Validity of the certificate at the start, which a listening component goes on showing.
    at_start: Validity,
    listens: bool,
}

impl OwnCertificate {
    /// What is wrong with the certificate at a time, in words: it must be renewed, or cannot be
    /// read.
    ///
    /// A component that connects reads its file for each connection; one that listens reads it at
    /// its start only.
    pub fn problem(&self, now: SystemTime) -> Option<String> {
        let mend = "run `crossfix enroll`, copy it here, and start this again";
        let shown = match Credentials::load(&self.security, &self.identity, now) {
            Ok(credentials) => credentials.validity(),
            Err(error) => return Some(format!("{error}")),
        };
        let shown = if self.listens { self.at_start } else { shown };
        let left = shown.ending(now)?;
        Some(match left {
            Duration::ZERO => format!("the certificate that it shows has ended: {mend}"),
            _ => format!("the certificate that it shows ends in {}: {mend}", days(left)),
        })
    }

    /// Why there is no link with the component at an endpoint, in words; `None` if nobody answers,
    /// or nothing is wrong with either certificate. Takes some seconds at worst (two for each
    /// address, and for each step of the handshake), so it is not for a main loop.
    pub fn why_no_link(&self, endpoint: &str) -> Option<String> {
        let credentials = match Credentials::load(&self.security, &self.identity, SystemTime::now())
        {
            Ok(credentials) => credentials,
            Err(error) => return Some(error.to_string()),
        };
        match handshake(&credentials, address(endpoint)) {
            Ok(_) | Err(HandshakeError::Connect(_) | HandshakeError::Other(_)) => None,
            Err(error) => Some(error.to_string()),
        }
    }
}

/// Zenoh's settings by which this component shows its identity, and accepts from others only what
/// each may publish.
fn secured(network: &NetworkConfig, role: &Role) -> Result<Vec<(String, String)>, LinkError> {
    let Some(security) = &network.security else {
        return Ok(Vec::new());
    };
    let identity = role.identity().ok_or(LinkError::Config(NetworkError::NobodysIdentity))?;
    let (authority, own, key) = (
        security.authority_file(),
        security.certificate_file(&identity),
        security.key_file(&identity),
    );
    let tls = serde_json::json!({
        "root_ca_certificate": authority,
        "listen_certificate": own, "listen_private_key": key,
        "connect_certificate": own, "connect_private_key": key,
        "enable_mtls": true, "verify_name_on_connect": true,
        // A link is closed when its certificate ends.
        "close_link_on_expiration": true,
        "so_sndbuf": SEND_BUFFER_BYTES,
    });
    let access = access_control(security, network);
    Ok(vec![
        ("transport/link/tls".to_owned(), tls.to_string()),
        ("access_control".to_owned(), access.to_string()),
    ])
}

/// The certificate that a session shows, checked; `None` if the network has none.
fn own_certificate(
    network: &NetworkConfig,
    role: &Role,
) -> Result<Option<OwnCertificate>, LinkError> {
    let Some((security, identity)) = network.security.clone().zip(role.identity()) else {
        return Ok(None);
    };
    let credentials = Credentials::load(&security, &identity, SystemTime::now())
        .map_err(LinkError::Credentials)?;
    let (listen, _) = network.endpoints(role).map_err(LinkError::Config)?;
    let (at_start, listens) = (credentials.validity(), !listen.is_empty());
    Ok(Some(OwnCertificate { security, identity, at_start, listens }))
}

fn config(network: &NetworkConfig, role: &Role) -> Result<Config, LinkError> {
    network.validate().map_err(LinkError::Config)?;
    let (listen, connect) = network.endpoints(role).map_err(LinkError::Config)?;
    let is_router = matches!(role, Role::Router { .. });
    // A client is told at once that no router is there, and this program tries again: Zenoh itself
    // would not.
    let (mode, patience) = match network.mode {
        _ if is_router => ("router", "-1"),
        Mode::Peer => ("peer", "-1"),
        Mode::Client => ("client", "0"),
    };
    let mut config = Config::default();
    let queue = |priority: &str| format!("transport/link/tx/queue/size/{priority}");
    let settings = [
        ("mode".to_owned(), format!("{mode:?}")),
        // Always set: the default listens on all interfaces.
        ("listen/endpoints".to_owned(), format!("{listen:?}")),
        ("connect/endpoints".to_owned(), format!("{connect:?}")),
        ("connect/timeout_ms".to_owned(), patience.to_owned()),
        ("connect/exit_on_failure".to_owned(), "false".to_owned()),
        (
            "connect/retry".to_owned(),
            "{period_init_ms: 200, period_max_ms: 1000, period_increase_factor: 1.5}".to_owned(),
        ),
        ("transport/unicast/open_timeout".to_owned(), OPEN_TIMEOUT_MS.to_string()),
        ("transport/link/tx/lease".to_owned(), LEASE_MS.to_string()),
        (queue("data"), QUEUED_BATCHES.to_string()),
        (queue("data_low"), PICTURE_BATCHES.to_string()),
        ("transport/link/tcp/so_sndbuf".to_owned(), SEND_BUFFER_BYTES.to_string()),
        // A message that gets longer than this is discarded before it is whole.
        ("transport/link/rx/max_message_size".to_owned(), (2 * MAX_MESSAGE_BYTES).to_string()),
        ("scouting/multicast/enabled".to_owned(), "false".to_owned()),
        ("scouting/gossip/enabled".to_owned(), "false".to_owned()),
        // How long opening waits for peers that are not up yet, ms.
        ("scouting/delay".to_owned(), "200".to_owned()),
    ];
    for (key, value) in settings.into_iter().chain(secured(network, role)?) {
        config.insert_json5(&key, &value).map_err(zenoh(format!("cannot set Zenoh's `{key}`")))?;
    }
    Ok(config)
}

impl Link {
    /// Opens a session. The components that it connects to need not be up yet, except for a router.
    ///
    /// # Errors
    /// [`LinkError`] if the configuration is impossible, an endpoint cannot be listened on, or no
    /// router answers.
    pub fn open(network: &NetworkConfig, role: &Role) -> Result<Self, LinkError> {
        let config = config(network, role)?;
        let shown = own_certificate(network, role)?;
        let session =
            zenoh::open(config).wait().map_err(|source| explain(network, role, &source))?;
        // The run is the first half of the random identity that Zenoh draws for every session.
        let bytes = session.zid().to_le_bytes();
        let run = bytes.first_chunk().map_or(0, |half| u64::from_le_bytes(*half));
        let area = match role {
            Role::Fusion(area) => area.clone(),
            _ => None,
        };
        Ok(Self { session, site: network.site.clone(), area, run: RunId(run), shown })
    }

    /// Opens a session; while no router answers, tries again as long as `go_on` returns `true`.
    ///
    /// # Errors
    /// [`LinkError`] of the last try.
    pub fn open_while(
        network: &NetworkConfig,
        role: &Role,
        mut go_on: impl FnMut(&LinkError) -> bool,
    ) -> Result<Self, LinkError> {
        loop {
            match Self::open(network, role) {
                Err(error @ LinkError::NoRouter { .. }) if go_on(&error) => {
                    std::thread::sleep(RETRY_PERIOD);
                }
                opened => return opened,
            }
        }
    }

    /// This session's run.
    pub fn run(&self) -> RunId {
        self.run
    }

    /// The site's name.
    pub fn site(&self) -> &SiteName {
        &self.site
    }

    /// The certificate that it shows to others, if the network has certificates.
    pub fn certificate(&self) -> Option<&OwnCertificate> {
        self.shown.as_ref()
    }

    /// The key of a channel as this component publishes it; that of a fusion centre that is one of
    /// several includes its area.
    pub fn key(&self, channel: Channel) -> Key {
        Key::of_centre(self.site.clone(), self.area.clone(), channel)
    }

    /// A publisher on a channel of the site.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn publisher(
        &self,
        channel: Channel,
        delivery: Delivery,
    ) -> Result<LinkPublisher, LinkError> {
        self.publisher_of(self.area.clone(), channel, delivery)
    }

    /// The same as if by the fusion centre of `area`.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn publisher_of(
        &self,
        area: Option<AreaName>,
        channel: Channel,
        delivery: Delivery,
    ) -> Result<LinkPublisher, LinkError> {
        let key = Key::of_centre(self.site.clone(), area, channel).to_string();
        let (control, priority) = match delivery {
            Delivery::Queued => (CongestionControl::Drop, Priority::Data),
            Delivery::Every => (CongestionControl::Block, Priority::Data),
            Delivery::Picture => (CongestionControl::Drop, Priority::DataLow),
        };
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .congestion_control(control)
            .priority(priority)
            .wait()
            .map_err(zenoh(format!("cannot publish on `{key}`")))?;
        Ok(LinkPublisher { publisher, run: self.run, published: AtomicU64::new(0) })
    }

    /// Publishes one message on any key of any site without an origin, as other programs do.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn put(&self, key: &Key, data: Vec<u8>) -> Result<(), LinkError> {
        self.session
            .put(key.to_string(), data)
            .congestion_control(CongestionControl::Block)
            .wait()
            .map_err(zenoh(format!("cannot publish on `{key}`")))
    }

    /// Subscribes to key expressions; messages on keys that are not Crossfix's are left out.
    /// Messages of one peer come in the order in which they were sent, whatever their keys.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn subscribe(&self, expressions: &[String]) -> Result<Subscription, LinkError> {
        let (intake, mut subscription) = Intake::new();
        for expression in expressions {
            let intake = intake.clone();
            let subscriber = self
                .session
                .declare_subscriber(expression.clone())
                .callback(move |sample| intake.take(&sample))
                .wait()
                .map_err(zenoh(format!("cannot subscribe to `{expression}`")))?;
            subscription.add(subscriber);
        }
        Ok(subscription)
    }

    /// Watches which components are alive.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn presence(&self) -> Result<Presence, LinkError> {
        // The first covers the cameras, the recorder and an only fusion centre, the second the
        // areas' fusion centres.
        let expressions =
            [Key::of_all_cameras, Key::of_all_areas].map(|of_all| of_all(&self.site, "alive"));
        Presence::watch(&self.session, &expressions)
            .map_err(zenoh(format!("cannot watch who is there on `{}`", expressions.join("`, `"))))
    }

    /// Declares that this component is alive, for as long as the token lives.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn declare_alive(&self, channel: Channel) -> Result<AliveToken, LinkError> {
        self.declare_alive_of(self.area.clone(), channel)
    }

    /// The same as if by the fusion centre of `area`.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn declare_alive_of(
        &self,
        area: Option<AreaName>,
        channel: Channel,
    ) -> Result<AliveToken, LinkError> {
        let key = Key::of_centre(self.site.clone(), area, channel).to_string();
        let token = self
            .session
            .liveliness()
            .declare_token(key.clone())
            .wait()
            .map_err(zenoh(format!("cannot declare `{key}` alive")))?;
        Ok(AliveToken { _token: token })
    }

    /// Whether a component is alive now.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    fn is_alive(&self, channel: &Channel) -> Result<bool, LinkError> {
        let key = self.key(channel.clone()).to_string();
        let replies = self
            .session
            .liveliness()
            .get(key.clone())
            .timeout(ALIVE_PERIOD)
            .wait()
            .map_err(zenoh(format!("cannot ask whether `{key}` is alive")))?;
        Ok(replies.recv().is_ok_and(|reply| reply.result().is_ok()))
    }

    /// Waits until all of several components are alive; gives up after `patience`, or when `go_on`
    /// returns `false`.
    ///
    /// # Errors
    /// [`LinkError::NotAlive`] naming the first component that did not come in time.
    pub fn wait_for(
        &self,
        channels: &[Channel],
        patience: Duration,
        mut go_on: impl FnMut() -> bool,
    ) -> Result<(), LinkError> {
        let deadline = Instant::now() + patience;
        for channel in channels {
            while !self.is_alive(channel)? {
                if Instant::now() > deadline || !go_on() {
                    let key = self.key(channel.clone());
                    return Err(LinkError::NotAlive(key.to_string()));
                }
                std::thread::sleep(ALIVE_PERIOD / 4);
            }
        }
        Ok(())
    }

    /// Sends what still waits and closes the session; gives up after `patience` on peers that do
    /// not take it.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`] if Zenoh cannot close it.
    pub fn close(self, patience: Duration) -> Result<(), LinkError> {
        let (done, closed) = channel();
        // Zenoh's own limit is ten seconds, and it does not keep to it: so another thread closes
        // the session, and this one waits for `patience` at most.
        std::thread::spawn(move || done.send(self.session.close().wait()));
        match closed.recv_timeout(patience) {
            Ok(result) => result.map_err(zenoh("the Zenoh session did not close")),
            Err(_) => {
                tracing::debug!("a peer did not take what was sent to it last");
                Ok(())
            }
        }
    }
}

/// Why a session did not open.
fn explain(network: &NetworkConfig, role: &Role, source: &zenoh::Error) -> LinkError {
    if network.mode == Mode::Client && !matches!(role, Role::Router { .. }) {
        return LinkError::NoRouter { routers: network.routers.clone(), source: said(source) };
    }
    let listened = network.endpoints(role).map(|(listen, _)| listen).unwrap_or_default();
    for endpoint in listened {
        if let Err(source) = TcpListener::bind(address(&endpoint)) {
            return LinkError::Listen { endpoint, source };
        }
    }
    LinkError::Zenoh { what: "cannot open a Zenoh session".to_owned(), source: said(source) }
}

/// A publisher on one key.
#[derive(Debug)]
pub struct LinkPublisher {
    publisher: Publisher<'static>,
    run: RunId,
    published: AtomicU64,
}

impl LinkPublisher {
    /// Publishes one message.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`] if the session is closed.
    pub fn put(&self, data: Vec<u8>) -> Result<(), LinkError> {
        let origin =
            Origin { run: self.run, sequence: self.published.fetch_add(1, Ordering::Relaxed) };
        let put = self.publisher.put(data).attachment(origin.to_bytes());
        put.wait().map_err(|source| {
            zenoh(format!("cannot publish on `{}`", self.publisher.key_expr()))(source)
        })
    }

    /// Whether anybody subscribes to the key.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`] if the session is closed.
    pub fn has_subscribers(&self) -> Result<bool, LinkError> {
        let status = self.publisher.matching_status().wait();
        status.map(|status| status.matching()).map_err(zenoh("cannot ask for subscribers"))
    }
}

/// Declares a component alive until it is dropped.
#[derive(Debug)]
pub struct AliveToken {
    _token: LivelinessToken,
}
