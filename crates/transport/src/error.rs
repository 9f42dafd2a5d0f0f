use std::error::Error;
use std::io;

use thiserror::Error;

use crate::NetworkError;
use crate::security::CredentialsError;

/// What can go wrong with the network.
#[derive(Debug, Error)]
pub enum LinkError {
    /// The configuration is impossible.
    #[error("the network's configuration is impossible")]
    Config(#[source] NetworkError),
    /// This component's certificate cannot be used.
    #[error("this component cannot show who it is")]
    Credentials(#[source] CredentialsError),
    /// Zenoh reports an error.
    #[error("{what}")]
    Zenoh {
        /// What was tried.
        what: String,
        /// What Zenoh says.
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
    /// One of this component's own endpoints cannot be listened on.
    #[error("cannot listen on {endpoint}: {}", why_not(source))]
    Listen {
        /// The endpoint.
        endpoint: String,
        /// What the system says.
        source: io::Error,
    },
    /// No router answers.
    #[error("no Zenoh router answers at {}", routers.join(", "))]
    NoRouter {
        /// Their endpoints.
        routers: Vec<String>,
        /// What Zenoh says.
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
    /// A component did not come in time.
    #[error("`{0}` is not alive")]
    NotAlive(String),
}

pub(crate) fn zenoh(what: impl Into<String>) -> impl FnOnce(zenoh::Error) -> LinkError {
    let what = what.into();
    move |source| LinkError::Zenoh { what, source: said(&source) }
}

/// Zenoh's message, without the position in its own source code.
pub(crate) fn said(error: &zenoh::Error) -> Box<dyn Error + Send + Sync> {
    let text = error.to_string();
    text.split(" at /").next().unwrap_or(&text).trim().to_owned().into()
}

/// In words: what people can do about an endpoint that cannot be listened on.
fn why_not(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::AddrInUse => "another program on this machine uses it".to_owned(),
        io::ErrorKind::AddrNotAvailable => "it is no address of this machine".to_owned(),
        io::ErrorKind::PermissionDenied => "ports below 1024 are the system's".to_owned(),
        _ => format!("{error}: is the host's name right?"),
    }
}
