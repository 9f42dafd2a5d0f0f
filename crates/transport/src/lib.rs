//! Zenoh: sessions by explicit endpoints, publishers whom no slow receiver holds
//! up, subscribers that count what they lost, liveliness.
//!
//! # Topology
//!
//! Peer to peer, one link a pair, all endpoints in one [`NetworkConfig`]:
//! cameras listen; the fusion centre listens and connects to the cameras;
//! observers (recorder, viewer) connect to all. Nothing is found by multicast
//! or gossip. With `mode = "client"` everybody connects to the given routers
//! instead.
//!
//! With `[security]` in the [`NetworkConfig`] every link is mutual TLS by the site's own certificates,
//! and each component may say only what is its own ([`Identity`]).
//!
//! # Delivery
//!
//! Nobody's slowness holds another up: each receiver has a queue of its own in
//! the publisher's session, and loses what does not fit ([`Delivery::Queued`]).
//! Each message goes with the run that sent it and its number on its key
//! ([`Origin`]), so that the receiver counts what it lost and notices a second
//! publisher ([`Reception`]). Only what is played as fast as it goes waits for
//! the slowest ([`Delivery::Every`]). A published message that nobody
//! subscribes to is gone: who plays a file watches ([`Link::presence`]) until
//! those who must hear it are there.
//!
//! A receiver that is lost costs one of Zenoh's receiving threads up to ten seconds, and of its own
//! accord Zenoh has two: a program gives it more before its first thread is started, as `crossfix`
//! does by the variable `ZENOH_RUNTIME`.

mod config;
mod link;
mod origin;
mod presence;
mod reception;
mod security;
mod subscription;

pub use config::{Anchor, Area, Mode, NetworkConfig, NetworkError, Role, address, host_of};
pub use link::{AliveToken, Delivery, Link, LinkError, LinkPublisher, OwnCertificate};
pub use origin::{Origin, RunId};
pub use presence::Presence;
pub use reception::Reception;
pub use security::{
    AUTHORITY_FILE, Authority, AuthorityError, Credentials, CredentialsError, HandshakeError,
    Identity, IdentityError, Issued, Security, Validity, connect, handshake,
};
pub use subscription::{Received, Refused, Subscription};
