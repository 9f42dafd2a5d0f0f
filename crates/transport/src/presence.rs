use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use crossfix_message::{Channel, Key};
use zenoh::pubsub::Subscriber;
use zenoh::sample::SampleKind;

/// Components that are kept count of; more is an attack.
const MAX_COMPONENTS: usize = 10_000;

/// Who is there: the components of a site that have said that they are alive and not been lost
/// since.
#[derive(Clone, Debug)]
pub struct Presence {
    alive: Alive,
    _subscriber: Arc<Subscriber<()>>,
}

type Alive = Arc<Mutex<BTreeSet<Channel>>>;

impl Presence {
    pub(crate) fn watch(session: &zenoh::Session, expression: &str) -> zenoh::Result<Self> {
        use zenoh::Wait;
        let alive = Alive::default();
        let heard = Arc::clone(&alive);
        // Runs on Zenoh's receiving thread.
        let note = move |sample: zenoh::sample::Sample| {
            let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
                return;
            };
            let mut alive = heard.lock().unwrap_or_else(PoisonError::into_inner);
            match sample.kind() {
                SampleKind::Put if alive.len() < MAX_COMPONENTS => alive.insert(key.channel),
                SampleKind::Put => false,
                SampleKind::Delete => alive.remove(&key.channel),
            };
        };
        let liveliness = session.liveliness();
        let subscriber =
            liveliness.declare_subscriber(expression).history(true).callback(note).wait()?;
        Ok(Self { alive, _subscriber: Arc::new(subscriber) })
    }

    /// Whether a component is there: its channel is one of the `..Alive`.
    pub fn is_alive(&self, channel: &Channel) -> bool {
        self.alive.lock().unwrap_or_else(PoisonError::into_inner).contains(channel)
    }
}
