//! Network of a site over Zenoh: sessions with explicit endpoints, publishers that no slow receiver
//! delays, subscribers that count what they lost, and liveliness.
//!
//! # Topology
//!
//! Peer to peer, one link per pair, all endpoints in one [`NetworkConfig`]: cameras listen; the
//! fusion centre listens and connects to the cameras; observers (recorder, viewer) connect to all.
//! Nothing is found by multicast or gossip. With `mode = "client"` all connect to the given routers
//! instead.
//!
//! With `[security]` in the [`NetworkConfig`] every link is mutual TLS by the site's own
//! certificates, and each component may publish only its own messages ([`Identity`]).
//!
//! # Delivery
//!
//! A slow receiver delays nobody else: each receiver has a queue of its own in the publisher's
//! session, and loses what does not fit ([`Delivery::Queued`]). Each message carries the run that
//! sent it and its number on its key ([`Origin`]), so that the receiver counts what it lost and
//! notices a second publisher ([`Reception`]). Only sources that are played as fast as possible
//! wait for the slowest receiver ([`Delivery::Every`]). A published message without a subscriber is
//! lost: a program that plays a file watches ([`Link::presence`]) until its receivers are there.
//!
//! A receiver whose connection is lost blocks one of Zenoh's receiving threads for up to ten
//! seconds, and by default Zenoh has two. A program should give it more before its first thread is
//! started, as `crossfix` does by the variable `ZENOH_RUNTIME`.
//!
//! # Example
//!
//! A camera and an observer on one computer:
//!
//! ```
//! use std::collections::BTreeMap;
//! use std::time::Duration;
//!
//! use crossfix_message::{BearingFrame, Channel, Payload, decode};
//! use crossfix_transport::{Delivery, Link, Mode, NetworkConfig, Role};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let free = || -> std::io::Result<String> {
//! #     Ok(format!("tcp/{}", std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?))
//! # };
//! let network = NetworkConfig {
//!     site: "field".parse()?,
//!     mode: Mode::Peer,
//!     routers: Vec::new(),
//!     unsecured: false,
//!     security: None,
//!     anchor: None,
//!     fusion: Some(free()?),
//!     areas: BTreeMap::new(),
//!     cameras: BTreeMap::from([("north".parse()?, free()?)]),
//! };
//! let north = Link::open(&network, &Role::Camera("north".parse()?))?;
//! let _alive = north.declare_alive(Channel::Alive("north".parse()?))?;
//! let bearings = Channel::Bearings("north".parse()?);
//! let publisher = north.publisher(bearings.clone(), Delivery::Queued)?;
//!
//! let observer = Link::open(&network, &Role::Observer)?;
//! let subscription = observer.subscribe(&[observer.key(bearings).to_string()])?;
//! observer.wait_for(&[Channel::Alive("north".parse()?)], Duration::from_secs(10), || true)?;
//!
//! // A subscription takes a moment to reach the publisher: what is sent before is lost.
//! let received = (0..100).find_map(|sequence| {
//!     let frame = BearingFrame { camera: "north".to_owned(), sequence, ..Default::default() };
//!     publisher.put(frame.encode()).ok()?;
//!     subscription.next(Duration::from_millis(100))
//! });
//! let frame: BearingFrame = decode(&received.ok_or("nothing came")?.data)?;
//! assert_eq!(frame.camera, "north");
//! # Ok(()) }
//! ```

mod config;
mod error;
mod link;
mod origin;
mod presence;
mod publisher;
mod reception;
mod security;
mod session_config;
mod subscription;

pub use config::{Anchor, Area, Mode, NetworkConfig, NetworkError, Role, address, host_of};
pub use error::LinkError;
pub use link::Link;
pub use origin::{Origin, RunId};
pub use presence::Presence;
pub use publisher::{AliveToken, Delivery, LinkPublisher};
pub use reception::Reception;
pub use security::{
    AUTHORITY_FILE, Authority, AuthorityError, Credentials, CredentialsError, HandshakeError,
    Identity, IdentityError, Issued, OwnCertificate, Security, Validity, connect, handshake,
};
pub use subscription::{Received, RefusedCounts, Subscription};
