use std::net::TcpListener;
use std::sync::atomic::AtomicU64;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use crossfix_message::{AreaName, Channel, Key, SiteName};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use crate::config::address;
use crate::error::{said, zenoh};
use crate::security::own_certificate;
use crate::session_config::config;
use crate::subscription::Intake;
use crate::{
    AliveToken, Delivery, LinkError, LinkPublisher, Mode, NetworkConfig, OwnCertificate, Presence,
    Role, RunId, Subscription,
};

/// Interval at which a router that does not answer is tried again. With half of it a router that
/// starts is asked twice as often; with twice as much a component joins up to a second late.
const RETRY_PERIOD: Duration = Duration::from_millis(500);

/// How long a liveliness query may take; while waiting it is repeated. With half of it an answer
/// that takes longer than 100 ms is never heard.
const ALIVE_PERIOD: Duration = Duration::from_millis(200);

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
