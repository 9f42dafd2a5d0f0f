use std::sync::atomic::{AtomicU64, Ordering};

use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::Publisher;

use crate::error::zenoh;
use crate::{LinkError, Origin, RunId};

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

/// A publisher on one key.
#[derive(Debug)]
pub struct LinkPublisher {
    pub(crate) publisher: Publisher<'static>,
    pub(crate) run: RunId,
    pub(crate) published: AtomicU64,
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
    pub(crate) _token: LivelinessToken,
}
