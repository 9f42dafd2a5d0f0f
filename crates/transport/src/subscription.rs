use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use crossfix_message::{Key, MOST_MESSAGE_BYTES};
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use crate::Origin;

/// Messages that may wait for the program before new ones are dropped and counted: two minutes of a
/// site of 16 cameras at 30 Hz. With half of them messages are lost where a program stops for
/// longer than one minute.
const MAX_WAITING: usize = 1 << 16;
/// Bytes that may wait for the program before new messages are dropped and counted, as pictures are
/// large. With half of them a program that shows pictures loses messages after half the time.
const MAX_WAITING_BYTES: usize = 64 << 20;

/// A message that came on a key of Crossfix.
#[derive(Clone, Debug)]
pub struct Received {
    /// The key.
    pub key: Key,
    /// The bytes.
    pub data: Vec<u8>,
    /// Who sent it; `None` if the sender did not state it.
    pub origin: Option<Origin>,
    /// When it came.
    pub at: Instant,
}

impl Received {
    fn of(key: Key, sample: &Sample) -> Self {
        let origin = sample.attachment().and_then(|bytes| Origin::from_bytes(&bytes.to_bytes()));
        // Copied: otherwise a payload of a few bytes would keep the transport's whole buffer alive.
        let data = sample.payload().to_bytes().into_owned();
        Self { key, data, origin, at: Instant::now() }
    }
}

/// Counts of messages that a subscription did not hand on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RefusedCounts {
    /// Messages that were dropped as too many waited for the program.
    pub dropped: u64,
    /// Messages longer than any valid one.
    pub too_long: u64,
}

#[derive(Debug, Default)]
struct Counts {
    waiting_bytes: AtomicUsize,
    dropped: AtomicU64,
    too_long: AtomicU64,
}

/// The messages on several key expressions.
#[derive(Debug)]
pub struct Subscription {
    receiver: Receiver<Received>,
    counts: Arc<Counts>,
    subscribers: Vec<Subscriber<()>>,
}

/// The queue into which Zenoh's receiving threads put messages.
#[derive(Clone)]
pub(crate) struct Intake {
    sender: SyncSender<Received>,
    counts: Arc<Counts>,
}

impl Intake {
    /// Creates a queue and the subscription that reads from it.
    pub(crate) fn new() -> (Self, Subscription) {
        let (sender, receiver) = sync_channel(MAX_WAITING);
        let counts = Arc::new(Counts::default());
        let subscription =
            Subscription { receiver, counts: Arc::clone(&counts), subscribers: Vec::new() };
        (Self { sender, counts }, subscription)
    }

    /// Takes a message. Runs on Zenoh's receiving thread, so it must not wait for the program.
    pub(crate) fn take(&self, sample: &Sample) {
        if sample.kind() != SampleKind::Put {
            return;
        }
        let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
            return;
        };
        let length = sample.payload().len();
        if length > MOST_MESSAGE_BYTES {
            self.counts.too_long.fetch_add(1, Ordering::Relaxed);
            return;
        }
        let before = self.counts.waiting_bytes.fetch_add(length, Ordering::Relaxed);
        let fits = before + length <= MAX_WAITING_BYTES;
        if !fits || self.sender.try_send(Received::of(key, sample)).is_err() {
            self.counts.waiting_bytes.fetch_sub(length, Ordering::Relaxed);
            self.counts.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Subscription {
    pub(crate) fn add(&mut self, subscriber: Subscriber<()>) {
        self.subscribers.push(subscriber);
    }

    /// The next message, if one comes within `patience`.
    pub fn next(&self, patience: Duration) -> Option<Received> {
        let received = self.receiver.recv_timeout(patience).ok()?;
        self.counts.waiting_bytes.fetch_sub(received.data.len(), Ordering::Relaxed);
        Some(received)
    }

    /// Stops receiving; messages that have arrived can still be had from [`Self::next`].
    pub fn stop(&mut self) {
        self.subscribers.clear();
    }

    /// Drops all waiting messages and counts them as dropped, for when there is no time for them.
    pub fn give_up(&self) {
        while self.next(Duration::ZERO).is_some() {
            self.counts.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Counts so far.
    pub fn refused(&self) -> RefusedCounts {
        RefusedCounts {
            dropped: self.counts.dropped.load(Ordering::Relaxed),
            too_long: self.counts.too_long.load(Ordering::Relaxed),
        }
    }
}
