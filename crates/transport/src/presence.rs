use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use crossfix_message::Key;
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

/// Most components that are tracked; more is an attack. With half of it the same.
const MAX_COMPONENTS: usize = 10_000;

/// The components of a site that are alive: they have declared it and have not been lost since.
#[derive(Clone, Debug)]
pub struct Presence {
    alive: Alive,
    _subscribers: Arc<Vec<Subscriber<()>>>,
}

type Alive = Arc<Mutex<BTreeSet<Key>>>;

impl Presence {
    pub(crate) fn watch(session: &zenoh::Session, expressions: &[String]) -> zenoh::Result<Self> {
        use zenoh::Wait;
        let alive = Alive::default();
        let mut subscribers = Vec::new();
        for expression in expressions {
            let heard = Arc::clone(&alive);
            let liveliness = session.liveliness();
            let subscriber = liveliness.declare_subscriber(expression).history(true);
            subscribers.push(subscriber.callback(move |sample| note(&heard, &sample)).wait()?);
        }
        Ok(Self { alive, _subscribers: Arc::new(subscribers) })
    }

    /// Whether a component is alive; the channel of `key` is one of the `..Alive`.
    pub fn is_alive(&self, key: &Key) -> bool {
        self.alive.lock().unwrap_or_else(PoisonError::into_inner).contains(key)
    }
}

/// Notes that a component has come or gone. Runs on Zenoh's receiving thread.
fn note(alive: &Alive, sample: &Sample) {
    let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
        return;
    };
    let mut alive = alive.lock().unwrap_or_else(PoisonError::into_inner);
    match sample.kind() {
        SampleKind::Put if alive.len() < MAX_COMPONENTS => alive.insert(key),
        SampleKind::Put => false,
        SampleKind::Delete => alive.remove(&key),
    };
}
