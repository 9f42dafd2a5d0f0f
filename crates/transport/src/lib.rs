//! Zenoh: sessions by explicit endpoints, publishers that lose nothing or may
//! drop, subscribers, liveliness, gap counters.
//!
//! # Topology
//!
//! Peer to peer, one link a pair, all endpoints in one [`NetworkConfig`]:
//! cameras listen; the fusion centre listens and connects to the cameras;
//! observers (recorder, viewer) connect to all. Nothing is found by multicast
//! or gossip. With `mode = "client"` everybody connects to the given routers
//! instead.
//!
//! # Delivery
//!
//! Bearings, calibrations, tracks and events block the publisher rather than
//! being dropped ([`Delivery::Every`]); pictures may be dropped
//! ([`Delivery::MayDrop`]). A published message that nobody subscribes to is
//! gone: file sources wait with [`Link::wait_for`] until those who must hear
//! them are alive.

mod config;
mod gaps;
mod link;

pub use config::{Mode, NetworkConfig, NetworkError, Role};
pub use gaps::GapCounter;
pub use link::{AliveToken, Delivery, Link, LinkError, LinkPublisher, Received, Subscription};
