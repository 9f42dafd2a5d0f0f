//! Joining a site's network.

use std::time::{Duration, Instant};

use crossfix_transport::{Link, NetworkConfig, Role, RunId};

use crate::shutdown::Shutdown;

/// How long a router may be silent before that is logged. With half of it a router that is starting
/// would be logged as silent.
const PATIENCE: Duration = Duration::from_secs(2);
/// How often it is logged again. With half of it a night without a router costs twice as many
/// lines.
const PERIOD: Duration = Duration::from_secs(60);

/// Number of threads of Zenoh's pools, unless the environment sets it. Zenoh closes the connection
/// to a lost receiver on a thread that receives for all, and there the system waits for up to ten
/// seconds for data not yet sent (eclipse-zenoh issue 1101). By default Zenoh receives on two
/// threads: a switch that died with two recorders behind it stopped a site for ten seconds. With
/// half of these threads, one with a dozen recorders would.
const ZENOH_THREADS: &str = "(rx: (worker_threads: 32), tx: (worker_threads: 4), \
                             acc: (worker_threads: 4), net: (worker_threads: 4))";
/// Environment variable from which Zenoh reads this, once per process, when its first thread
/// starts.
const ZENOH_THREADS_VARIABLE: &str = "ZENOH_RUNTIME";

/// Gives Zenoh enough threads that lost receivers delay nobody else. Only to be called at the very
/// beginning, while the program has no other thread.
#[expect(unsafe_code, reason = "Zenoh takes this from its environment alone")]
pub fn give_zenoh_threads() {
    if std::env::var_os(ZENOH_THREADS_VARIABLE).is_none() {
        // SAFETY: the main thread is the only one so far, so no other reads the environment
        // meanwhile.
        unsafe { std::env::set_var(ZENOH_THREADS_VARIABLE, ZENOH_THREADS) };
    }
}

/// Opens a session; `None` if the program was asked to stop before a router answered.
pub fn open(
    network: &NetworkConfig,
    role: &Role,
    shutdown: &Shutdown,
) -> anyhow::Result<Option<Link>> {
    say_how_secure(network, role);
    let begun = Instant::now();
    let mut said: Option<Instant> = None;
    let opened = Link::open_while(network, role, |error| {
        if begun.elapsed() >= PATIENCE && said.is_none_or(|said| said.elapsed() >= PERIOD) {
            said = Some(Instant::now());
            let why = std::error::Error::source(error)
                .map_or_else(String::new, |why| format!(" ({why})"));
            tracing::warn!("{error}{why}: trying again until one does");
        }
        !shutdown.requested()
    });
    match opened {
        Ok(link) => Ok(Some(link)),
        Err(_) if shutdown.requested() => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Logs at the start who may join the site's network.
fn say_how_secure(network: &NetworkConfig, role: &Role) {
    if network.security.is_some() {
        return;
    }
    match network.unencrypted(role) {
        _ if network.unsecured => tracing::warn!(
            "nothing on this network is encrypted, and whoever reaches it can add cameras and \
             tracks: `crossfix enroll` mends it"
        ),
        Some(endpoint) => tracing::warn!(
            "what goes to {endpoint} is not encrypted, and who answers there may be anybody: \
             `crossfix enroll` mends it"
        ),
        None => tracing::info!("without [security] nothing listens beyond this host"),
    }
}

/// This host and process, in a form that people can look up: `camera-host-2:4711`.
pub fn host() -> String {
    format!("{}:{}", gethostname::gethostname().to_string_lossy(), std::process::id())
}

/// The warning that two runs publish on one key.
pub fn rivalry(key: &crossfix_message::Key, runs: [RunId; 2]) -> String {
    let [one, other] = runs;
    format!("two programs publish on `{key}`: the runs {one} and {other}; is one started twice?")
}
