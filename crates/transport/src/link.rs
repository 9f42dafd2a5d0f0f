use std::error::Error;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::{Duration, Instant};

use crossfix_message::{Channel, Key, SiteName};
use thiserror::Error;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Config, Session, Wait};

use crate::{Mode, NetworkConfig, NetworkError, Role};

/// Messages that wait for the program before new ones are dropped and counted.
const QUEUE: usize = 1 << 16;
/// How often a liveliness query is repeated while waiting.
const ALIVE_PERIOD: Duration = Duration::from_millis(200);

/// What can go wrong with the network.
#[derive(Debug, Error)]
pub enum LinkError {
    /// The configuration.
    #[error("the network's configuration is impossible")]
    Config(#[source] NetworkError),
    /// Zenoh says no.
    #[error("{what}")]
    Zenoh {
        /// What was tried.
        what: String,
        /// What Zenoh says.
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
    /// Somebody did not come.
    #[error("`{0}` is not alive")]
    NotAlive(String),
}

fn zenoh(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> LinkError {
    let what = what.into();
    move |source| LinkError::Zenoh { what, source }
}

/// What becomes of a message when a receiver is slow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Delivery {
    /// The publisher waits.
    Every,
    /// The message is dropped.
    MayDrop,
}

/// A message that came over a key of Crossfix.
#[derive(Clone, Debug)]
pub struct Received {
    /// The key.
    pub key: Key,
    /// The bytes.
    pub data: Vec<u8>,
}

/// A session with the site's network. Lost connections are made again by themselves.
#[derive(Debug)]
pub struct Link {
    session: Session,
    site: SiteName,
}

fn config(network: &NetworkConfig, role: &Role) -> Result<Config, LinkError> {
    network.validate().map_err(LinkError::Config)?;
    let (listen, connect) = network.endpoints(role).map_err(LinkError::Config)?;
    let mode = match network.mode {
        Mode::Peer => "peer",
        Mode::Client => "client",
    };
    let mut config = Config::default();
    let settings = [
        ("mode", format!("{mode:?}")),
        // Always set: the default listens on all interfaces.
        ("listen/endpoints", format!("{listen:?}")),
        ("connect/endpoints", format!("{connect:?}")),
        ("connect/timeout_ms", "-1".to_owned()),
        ("connect/exit_on_failure", "false".to_owned()),
        (
            "connect/retry",
            "{period_init_ms: 200, period_max_ms: 1000, period_increase_factor: 1.5}".to_owned(),
        ),
        ("transport/unicast/open_timeout", "2000".to_owned()),
        ("transport/link/tx/lease", "3000".to_owned()),
        ("transport/link/tx/queue/size/data", "8".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/enabled", "false".to_owned()),
        // How long opening waits for peers that are not up yet.
        ("scouting/delay", "200".to_owned()),
    ];
    for (key, value) in settings {
        config.insert_json5(key, &value).map_err(zenoh(format!("cannot set Zenoh's `{key}`")))?;
    }
    Ok(config)
}

impl Link {
    /// Opens a session. Those it connects to need not be there yet.
    ///
    /// # Errors
    /// [`LinkError`] if the configuration is impossible or an endpoint is taken.
    pub fn open(network: &NetworkConfig, role: &Role) -> Result<Self, LinkError> {
        let config = config(network, role)?;
        let what = format!("cannot open a Zenoh session as {role:?}: is the endpoint taken?");
        let session = zenoh::open(config).wait().map_err(zenoh(what))?;
        Ok(Self { session, site: network.site.clone() })
    }

    /// The site's name.
    pub fn site(&self) -> &SiteName {
        &self.site
    }

    /// A publisher on a channel of the site.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn publisher(&self, channel: Channel, delivery: Delivery) -> Result<LinkPublisher, LinkError> {
        let key = Key::new(self.site.clone(), channel).to_string();
        let control = match delivery {
            Delivery::Every => CongestionControl::Block,
            Delivery::MayDrop => CongestionControl::Drop,
        };
        let publisher = self
            .session
            .declare_publisher(key.clone())
            .congestion_control(control)
            .wait()
            .map_err(zenoh(format!("cannot publish on `{key}`")))?;
        Ok(LinkPublisher { publisher })
    }

    /// Publishes one message on any key of any site: a replay.
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

    /// Subscribes to key expressions; foreign keys are left out. What one peer sends comes in the
    /// order in which it was sent, whatever the keys.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn subscribe(&self, expressions: &[String]) -> Result<Subscription, LinkError> {
        let (sender, receiver) = sync_channel(QUEUE);
        let dropped = Arc::new(AtomicU64::new(0));
        let mut subscribers = Vec::new();
        for expression in expressions {
            let (sender, counter) = (sender.clone(), Arc::clone(&dropped));
            // Runs on Zenoh's receiving thread: it must not wait for the program.
            let forward = move |sample: Sample| {
                if sample.kind() != SampleKind::Put {
                    return;
                }
                let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
                    return;
                };
                let data = sample.payload().to_bytes().into_owned();
                if sender.try_send(Received { key, data }).is_err() {
                    counter.fetch_add(1, Ordering::Relaxed);
                }
            };
            let subscriber = self
                .session
                .declare_subscriber(expression.clone())
                .callback(forward)
                .wait()
                .map_err(zenoh(format!("cannot subscribe to `{expression}`")))?;
            subscribers.push(subscriber);
        }
        Ok(Subscription { receiver, dropped, _subscribers: subscribers })
    }

    /// Says that this component is alive for as long as the token lives.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`].
    pub fn declare_alive(&self, channel: Channel) -> Result<AliveToken, LinkError> {
        let key = Key::new(self.site.clone(), channel).to_string();
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
    pub fn is_alive(&self, channel: &Channel) -> Result<bool, LinkError> {
        let key = Key::new(self.site.clone(), channel.clone()).to_string();
        let replies = self
            .session
            .liveliness()
            .get(key.clone())
            .timeout(ALIVE_PERIOD)
            .wait()
            .map_err(zenoh(format!("cannot ask whether `{key}` is alive")))?;
        Ok(replies.recv().is_ok_and(|reply| reply.result().is_ok()))
    }

    /// Waits until all of some components are alive.
    ///
    /// # Errors
    /// [`LinkError::NotAlive`] naming the first that did not come in time.
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
                    let key = Key::new(self.site.clone(), channel.clone());
                    return Err(LinkError::NotAlive(key.to_string()));
                }
                std::thread::sleep(ALIVE_PERIOD / 4);
            }
        }
        Ok(())
    }

    /// Sends what still waits and says goodbye.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`] if that takes too long.
    pub fn close(self) -> Result<(), LinkError> {
        self.session.close().wait().map_err(zenoh("the Zenoh session did not close"))
    }
}

/// Publishes on one key.
#[derive(Debug)]
pub struct LinkPublisher {
    publisher: Publisher<'static>,
}

impl LinkPublisher {
    /// Publishes one message.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`] if the session is closed.
    pub fn put(&self, data: Vec<u8>) -> Result<(), LinkError> {
        let key = self.publisher.key_expr().to_string();
        self.publisher.put(data).wait().map_err(zenoh(format!("cannot publish on `{key}`")))
    }

    /// Whether anybody subscribes to it.
    ///
    /// # Errors
    /// [`LinkError::Zenoh`] if the session is closed.
    pub fn has_subscribers(&self) -> Result<bool, LinkError> {
        let status = self.publisher.matching_status().wait();
        status.map(|status| status.matching()).map_err(zenoh("cannot ask for subscribers"))
    }
}

/// What comes in over a key expression.
#[derive(Debug)]
pub struct Subscription {
    receiver: Receiver<Received>,
    dropped: Arc<AtomicU64>,
    _subscribers: Vec<Subscriber<()>>,
}

impl Subscription {
    /// The next message, if one comes in time.
    pub fn next(&self, patience: Duration) -> Option<Received> {
        self.receiver.recv_timeout(patience).ok()
    }

    /// Messages that were dropped as this program was too slow.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// Says that a component is alive until it is dropped.
#[derive(Debug)]
pub struct AliveToken {
    _token: LivelinessToken,
}
