//! Stopping: Ctrl-C, SIGTERM, or, for children of `demo`, the end of stdin.

use std::io::Read;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

/// Whether the program has been asked to stop.
#[derive(Clone, Debug)]
pub struct Shutdown(Arc<AtomicBool>);

impl Shutdown {
    /// Listens for Ctrl-C and SIGTERM; a second one ends the program at once.
    pub fn listen() -> Self {
        // The system has one handler a process.
        static FLAG: OnceLock<Arc<AtomicBool>> = OnceLock::new();
        let flag = FLAG.get_or_init(|| {
            let flag = Arc::new(AtomicBool::new(false));
            let handled = Arc::clone(&flag);
            let installed = ctrlc::set_handler(move || {
                if handled.swap(true, Ordering::SeqCst) {
                    std::process::exit(130);
                }
            });
            if let Err(error) = installed {
                tracing::warn!("cannot listen for Ctrl-C: {error}");
            }
            flag
        });
        Self(Arc::clone(flag))
    }

    /// Stops as well when stdin ends: when the parent closes it, or dies.
    pub fn with_stdin(self, wanted: bool) -> Self {
        if wanted {
            let flag = Arc::clone(&self.0);
            std::thread::spawn(move || {
                let mut sink = [0; 64];
                while std::io::stdin().read(&mut sink).is_ok_and(|n| n > 0) {}
                flag.store(true, Ordering::SeqCst);
            });
        }
        self
    }

    /// Whether to stop.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::SeqCst)
    }
}
