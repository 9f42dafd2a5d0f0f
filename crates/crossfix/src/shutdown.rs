//! Stopping: Ctrl-C, SIGTERM, or, for children of `demo`, the end of stdin. Also SIGHUP, on which
//! long-running commands read their configuration again.

use std::io::{IsTerminal, Read};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use crate::output;

/// How long a command may take to end after it was asked to stop: people wait for it. By itself it
/// takes [`LAST_WORDS`] plus half a second to leave the network. With half of it commands would be
/// abandoned before they have left the network.
const GRACE: Duration = Duration::from_millis(1800);
/// How long after the request to stop a command still accepts messages that are on their way. With
/// half of it those that take longer than 0.35 s are lost.
pub const LAST_WORDS: Duration = Duration::from_millis(700);
/// How long after the request to stop it still handles accepted messages; the rest is counted. With
/// half of it, less than [`LAST_WORDS`], all that is queued then would be lost.
pub const LAST_WORK: Duration = Duration::from_millis(1100);
/// How long it tries to take leave of peers that do not answer. With half of it peers across a slow
/// network learn of the end by silence alone.
pub const LEAVE: Duration = Duration::from_millis(500);
/// As [`LEAVE`], for a command that has come to its end by itself: nothing may be lost. With half
/// of it what a slow receiver has not received in five seconds would be.
pub const LONG_LEAVE: Duration = Duration::from_secs(10);
/// How often it is checked whether the time is up. With half of it the same.
const POLL: Duration = Duration::from_millis(20);
/// The commands run on a thread of their own, with the stack of a main thread. With half of it what
/// runs on a main thread might overflow it.
const STACK_BYTES: usize = 8 << 20;

/// The signal state: the system has one handler per process.
static ASKED: OnceLock<Arc<Asked>> = OnceLock::new();

/// Requests that the program has received.
#[derive(Debug, Default)]
struct Asked {
    /// Request to stop, and when it came.
    stop: OnceLock<Instant>,
    /// Request to read the configuration again, and whether the command can do that.
    reload: AtomicBool,
    can_reload: AtomicBool,
    /// Whether the command checks whether it has been asked to stop.
    is_heeded: AtomicBool,
}

/// Tells whether the program has been asked to stop, or to read its configuration again.
#[derive(Clone, Debug)]
pub struct Shutdown(Arc<Asked>);

impl Shutdown {
    /// For a command that ends by itself when it is asked to stop. Others are ended by
    /// [`supervise`].
    pub fn listen() -> Self {
        let shutdown = Self::begin();
        shutdown.0.is_heeded.store(true, Ordering::SeqCst);
        shutdown
    }

    /// Listens for Ctrl-C, SIGTERM and SIGHUP; a second signal ends the program at once.
    fn begin() -> Self {
        Self(Arc::clone(ASKED.get_or_init(listen_for_signals)))
    }

    /// Makes SIGHUP mean that the configuration is to be read again. Not on a terminal, where it
    /// means that the terminal is gone.
    pub fn with_reload(self) -> Self {
        self.0.can_reload.store(!std::io::stdin().is_terminal(), Ordering::SeqCst);
        self
    }

    /// Whether the configuration is to be read again; true once per request.
    pub fn take_reload(&self) -> bool {
        self.0.reload.swap(false, Ordering::SeqCst)
    }

    /// Also stops when stdin ends, that is, when the parent closes it or dies.
    pub fn with_stdin(self, wanted: bool) -> Self {
        if wanted {
            let asked = Arc::clone(&self.0);
            std::thread::spawn(move || {
                let mut sink = [0; 64];
                while std::io::stdin().read(&mut sink).is_ok_and(|n| n > 0) {}
                asked.stop.get_or_init(Instant::now);
            });
        }
        self
    }

    /// Whether to stop.
    pub fn requested(&self) -> bool {
        self.0.stop.get().is_some()
    }

    /// Whether the request to stop came longer ago than `patience`, so that pending messages are to
    /// be dropped.
    pub fn overdue(&self, patience: Duration) -> bool {
        self.0.stop.get().is_some_and(|asked| asked.elapsed() > patience)
    }
}

/// Starts the thread that listens for signals; without it the program still works.
fn listen_for_signals() -> Arc<Asked> {
    let asked = Arc::new(Asked::default());
    let heard = Arc::clone(&asked);
    let listening = Signals::new([SIGINT, SIGTERM, SIGHUP]).and_then(|signals| {
        std::thread::Builder::new().name("signals".into()).spawn(move || heed(signals, &heard))
    });
    if let Err(error) = listening {
        tracing::warn!("cannot listen for Ctrl-C: {error}");
    }
    asked
}

/// Records what signals ask for.
fn heed(mut signals: Signals, asked: &Asked) {
    let mut is_second = false;
    for signal in &mut signals {
        if signal == SIGHUP && asked.can_reload.load(Ordering::SeqCst) {
            asked.reload.store(true, Ordering::SeqCst);
        } else if is_second {
            std::process::exit(130);
        } else {
            asked.stop.get_or_init(Instant::now);
            is_second = true;
        }
    }
}

/// Runs a command, and abandons it if it does not end in time after a request to stop, so that a
/// hanging disk or a long computation cannot keep the process alive. One that does not check
/// whether it is asked to stop is abandoned at once, and what it was writing is removed.
pub fn supervise(
    command: impl FnOnce() -> anyhow::Result<()> + Send + 'static,
) -> anyhow::Result<()> {
    let Shutdown(asked) = Shutdown::begin();
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
        let Some(since) = asked.stop.get() else { continue };
        if !asked.is_heeded.load(Ordering::SeqCst) {
            output::remove_drafts();
            bail!("asked to stop: what was not complete is removed");
        }
        if since.elapsed() > GRACE {
            output::remove_drafts();
            bail!("it was busy and did not end within 2 s: what was not complete is removed");
        }
    }
}
