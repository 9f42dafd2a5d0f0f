//! Going onto a site's network.

use std::time::{Duration, Instant};

use crossfix_transport::{Link, NetworkConfig, Role, RunId};

use crate::shutdown::Shutdown;

/// How long a router may be silent before that is said, and how often it is said again.
const PATIENCE: Duration = Duration::from_secs(2);
const PERIOD: Duration = Duration::from_secs(60);

/// Opens a session; `None` if the program was asked to stop before a router answered.
pub fn open(
    network: &NetworkConfig,
    role: &Role,
    shutdown: &Shutdown,
) -> anyhow::Result<Option<Link>> {
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

/// This host and process, as people look for them: `camera-host-2:4711`.
pub fn host() -> String {
    format!("{}:{}", gethostname::gethostname().to_string_lossy(), std::process::id())
}

/// Names two runs that publish on one key.
pub fn rivalry(key: &crossfix_message::Key, runs: [RunId; 2]) -> String {
    let [one, other] = runs;
    format!("two programs publish on `{key}`: the runs {one} and {other}; is one started twice?")
}
