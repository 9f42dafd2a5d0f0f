use std::time::{Duration, SystemTime};

use super::credentials::days;
use super::{Credentials, HandshakeError, Identity, Security, Validity, handshake};
use crate::config::address;
use crate::{LinkError, NetworkConfig, Role};

/// The certificate by which a component shows who it is.
#[derive(Clone, Debug)]
pub struct OwnCertificate {
    security: Security,
    identity: Identity,
    /// Validity of the certificate at the start, which a listening component goes on showing.
    at_start: Validity,
    listens: bool,
}

impl OwnCertificate {
    /// What is wrong with the certificate at a time, in words: it must be renewed, or cannot be
    /// read.
    ///
    /// A component that connects reads its file for each connection; one that listens reads it at
    /// its start only.
    pub fn problem(&self, now: SystemTime) -> Option<String> {
        let remedy = "run `crossfix enroll`, copy it here, and start this again";
        let shown = match Credentials::load(&self.security, &self.identity, now) {
            Ok(credentials) => credentials.validity(),
            Err(error) => return Some(format!("{error}")),
        };
        let shown = if self.listens { self.at_start } else { shown };
        let left = shown.ending(now)?;
        Some(match left {
            Duration::ZERO => format!("the certificate that it shows has ended: {remedy}"),
            _ => format!("the certificate that it shows ends in {}: {remedy}", days(left)),
        })
    }

    /// Why there is no link with the component at an endpoint, in words; `None` if nobody answers,
    /// or nothing is wrong with either certificate. Takes some seconds at worst (two for each
    /// address, and for each step of the handshake), so it is not for a main loop.
    pub fn why_no_link(&self, endpoint: &str) -> Option<String> {
        let credentials = match Credentials::load(&self.security, &self.identity, SystemTime::now())
        {
            Ok(credentials) => credentials,
            Err(error) => return Some(error.to_string()),
        };
        match handshake(&credentials, address(endpoint)) {
            Ok(_) | Err(HandshakeError::Connect(_) | HandshakeError::Other(_)) => None,
            Err(error) => Some(error.to_string()),
        }
    }
}

/// The certificate that a session shows, checked; `None` if the network has none.
pub(crate) fn own_certificate(
    network: &NetworkConfig,
    role: &Role,
) -> Result<Option<OwnCertificate>, LinkError> {
    let Some((security, identity)) = network.security.clone().zip(role.identity()) else {
        return Ok(None);
    };
    let credentials = Credentials::load(&security, &identity, SystemTime::now())
        .map_err(LinkError::Credentials)?;
    let (listen, _) = network.endpoints(role).map_err(LinkError::Config)?;
    let (at_start, listens) = (credentials.validity(), !listen.is_empty());
    Ok(Some(OwnCertificate { security, identity, at_start, listens }))
}
