use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant};

use crossfix_message::{Key, MAX_MESSAGE_BYTES};
use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};

use crate::Origin;

/// Messages, and their bytes, that wait for the program before new ones are dropped and counted:
/// two minutes of a site of 16 cameras at 30 Hz, half as many pictures.
const MAX_WAITING: usize = 1 << 16;
const MAX_WAITING_BYTES: usize = 64 << 20;

/// A message that came over a key of Crossfix.
#[derive(Clone, Debug)]
pub struct Received {
    /// The key.
    pub key: Key,
    /// The bytes.
    pub data: Vec<u8>,
    /// Who sent it; `None` of a program that does not say.
    pub origin: Option<Origin>,
    /// When it came.
    pub at: Instant,
}

/// What a subscription did not hand on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Refused {
    /// Messages that came while the program was too slow.
    pub dropped: u64,
    /// Messages longer than any true one.
    pub too_long: u64,
}

#[derive(Debug, Default)]
struct Counts {
    waiting_bytes: AtomicUsize,
    dropped: AtomicU64,
    too_long: AtomicU64,
}

/// What comes in over some key expressions.
#[derive(Debug)]
pub struct Subscription {
    receiver: Receiver<Received>,
    counts: Arc<Counts>,
    subscribers: Vec<Subscriber<()>>,
}

/// Where the receiving threads put what comes.
#[derive(Clone)]
pub(crate) struct Intake {
    sender: SyncSender<Received>,
    counts: Arc<Counts>,
}

impl Intake {
    /// A queue, and the subscription that it belongs to.
    pub(crate) fn new() -> (Self, Subscription) {
        let (sender, receiver) = sync_channel(MAX_WAITING);
        let counts = Arc::new(Counts::default());
        let subscription =
            Subscription { receiver, counts: Arc::clone(&counts), subscribers: Vec::new() };
        (Self { sender, counts }, subscription)
    }

    /// Runs on Zenoh's receiving thread: it must not wait for the program.
    pub(crate) fn take(&self, sample: &Sample) {
        if sample.kind() != SampleKind::Put {
            return;
        }
        let Ok(key) = sample.key_expr().as_str().parse::<Key>() else {
            return;
        };
        let length = sample.payload().len();
        if length > MAX_MESSAGE_BYTES {
            self.counts.too_long.fetch_add(1, Ordering::Relaxed);
            return;
        }
        let before = self.counts.waiting_bytes.fetch_add(length, Ordering::Relaxed);
        let fits = before + length <= MAX_WAITING_BYTES;
        let origin = || Origin::from_bytes(&sample.attachment()?.to_bytes());
        let received = || Received {
            key,
            // Copied: a payload of a few bytes would hold on to the transport's whole buffer.
            data: sample.payload().to_bytes().into_owned(),
            origin: origin(),
            at: Instant::now(),
        };
        if !fits || self.sender.try_send(received()).is_err() {
            self.counts.waiting_bytes.fetch_sub(length, Ordering::Relaxed);
            self.counts.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Subscription {
    pub(crate) fn add(&mut self, subscriber: Subscriber<()>) {
        self.subscribers.push(subscriber);
    }

    /// The next message, if one comes in time.
    pub fn next(&self, patience: Duration) -> Option<Received> {
        let received = self.receiver.recv_timeout(patience).ok()?;
        self.counts.waiting_bytes.fetch_sub(received.data.len(), Ordering::Relaxed);
        Some(received)
    }

    /// Takes nothing in any more; what came before can still be had from [`Self::next`].
    pub fn stop(&mut self) {
        self.subscribers.clear();
    }

    /// Counts what still waits as dropped: there is no time for it.
    pub fn give_up(&self) {
        while self.next(Duration::ZERO).is_some() {
            self.counts.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// What was not handed on so far.
    pub fn refused(&self) -> Refused {
        Refused {
            dropped: self.counts.dropped.load(Ordering::Relaxed),
            too_long: self.counts.too_long.load(Ordering::Relaxed),
        }
    }
}
