use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use crossfix_message::Key;
use zenoh::pubsub::Subscriber;
use zenoh::sample::SampleKind;

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
        let watch = |expression: &String| {
            let heard = Arc::clone(&alive);
            // Runs on Zenoh's receiving thread.
            let note = move |sample: zenoh::sample::Sample| {
                let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
                    return;
                };
                let mut alive = heard.lock().unwrap_or_else(PoisonError::into_inner);
                match sample.kind() {
                    SampleKind::Put if alive.len() < MAX_COMPONENTS => alive.insert(key),
                    SampleKind::Put => false,
                    SampleKind::Delete => alive.remove(&key),
                };
            };
            let liveliness = session.liveliness();
            liveliness.declare_subscriber(expression).history(true).callback(note).wait()
        };
        let subscribers = expressions.iter().map(watch).collect::<zenoh::Result<Vec<_>>>()?;
        Ok(Self { alive, _subscribers: Arc::new(subscribers) })
    }

    /// Whether a component is alive; the channel of `key` is one of the `..Alive`.
    pub fn is_alive(&self, key: &Key) -> bool {
        self.alive.lock().unwrap_or_else(PoisonError::into_inner).contains(key)
    }
}
