//! Stopping: Ctrl-C, SIGTERM, or, for children of `demo`, the end of stdin.

use std::io::Read;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};

/// How long a command may take to end after it has been asked to: people wait for it. What it does
/// then of its own accord takes [`LAST_WORDS`] and half a second to take its leave of the network.
const GRACE: Duration = Duration::from_millis(1800);
/// How long a command that was asked to stop still takes in what is on its way to it.
pub const LAST_WORDS: Duration = Duration::from_millis(700);
/// How long after it was asked to stop it still handles what has come; the rest is counted.
pub const LAST_WORK: Duration = Duration::from_millis(1100);
/// How long it takes its leave of peers that do not listen.
pub const LEAVE: Duration = Duration::from_millis(500);
/// The same of a command that has come to its end by itself: nothing is to be lost.
pub const LONG_LEAVE: Duration = Duration::from_secs(10);
/// How often is looked whether the time is up.
const POLL: Duration = Duration::from_millis(20);
/// The commands run on a thread of their own, with the stack of a main thread.
const STACK_BYTES: usize = 8 << 20;

/// The system has one handler a process; it holds when the program was asked to stop.
static ASKED: OnceLock<Arc<OnceLock<Instant>>> = OnceLock::new();

/// Whether the program has been asked to stop.
#[derive(Clone, Debug)]
pub struct Shutdown(Arc<OnceLock<Instant>>);

impl Shutdown {
    /// Listens for Ctrl-C and SIGTERM; a second one ends the program at once.
    pub fn listen() -> Self {
        let asked = ASKED.get_or_init(|| {
            let asked = Arc::new(OnceLock::new());
            let handled = Arc::clone(&asked);
            let is_second = AtomicBool::new(false);
            let installed = ctrlc::set_handler(move || {
                handled.get_or_init(Instant::now);
                if is_second.swap(true, Ordering::SeqCst) {
                    std::process::exit(130);
                }
            });
            if let Err(error) = installed {
                tracing::warn!("cannot listen for Ctrl-C: {error}");
            }
            asked
        });
        Self(Arc::clone(asked))
    }

    /// Stops as well when stdin ends: when the parent closes it, or dies.
    pub fn with_stdin(self, wanted: bool) -> Self {
        if wanted {
            let asked = Arc::clone(&self.0);
            std::thread::spawn(move || {
                let mut sink = [0; 64];
                while std::io::stdin().read(&mut sink).is_ok_and(|n| n > 0) {}
                asked.get_or_init(Instant::now);
            });
        }
        self
    }

    /// Whether to stop.
    pub fn requested(&self) -> bool {
        self.0.get().is_some()
    }

    /// Whether to stop without looking at what still comes: it was asked for longer ago than this.
    pub fn overdue(&self, patience: Duration) -> bool {
        self.0.get().is_some_and(|asked| asked.elapsed() > patience)
    }
}

/// Runs a command, and leaves it behind if it does not end in time after it has been asked to: a
/// disk that hangs, or a step that computes for long, must not make it immortal.
pub fn supervise(
    command: impl FnOnce() -> anyhow::Result<()> + Send + 'static,
) -> anyhow::Result<()> {
    let (done, result) = channel();
    let worker = std::thread::Builder::new()
        .stack_size(STACK_BYTES)
        .spawn(move || done.send(command()))
        .context("cannot start a thread")?;
    loop {
        match result.recv_timeout(POLL) {
            Ok(result) => return result,
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => {
                if let Err(panic) = worker.join() {
                    std::panic::resume_unwind(panic);
                }
                bail!("the command ended without a result");
            }
        }
        let asked = ASKED.get().and_then(|asked| asked.get());
        if asked.is_some_and(|asked| asked.elapsed() > GRACE) {
            bail!(
                "it was busy and did not end within 2 s: ended without it; what it was writing is not complete"
            );
        }
    }
}
