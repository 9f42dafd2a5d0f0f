//! Who may join a site's network, and what each component may publish there.
//!
//! A site has a certificate authority of its own, which signs a certificate for each component; its
//! common name says which component it is ([`Identity`]). All links are mutual TLS, and every
//! component accepts from each other one only what that one may publish (`access`): from an agent
//! its own camera's messages, from the fusion centre the tracks, from the recorder its health, from
//! a viewer nothing.
//!
//! Zenoh itself reports nothing if a link fails because of a certificate; [`Credentials`] and
//! [`handshake`] say why.

mod access;
mod authority;
mod credentials;
mod handshake;
mod identity;
mod shown;

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub(crate) use access::access_control;
pub use authority::{Authority, AuthorityError, Issued};
pub use credentials::{Credentials, CredentialsError, Validity};
pub use handshake::{HandshakeError, connect, handshake};
pub use identity::{Identity, IdentityError};
pub use shown::OwnCertificate;
pub(crate) use shown::own_certificate;

/// `[security]` of a network file: the site's links are encrypted, and both ends of each link show
/// who they are. `crossfix enroll` makes the certificates and adds this section.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Security {
    /// The folder of the certificates: `authority.pem` and, for the components that run on this
    /// host, `NAME.pem` and `NAME.key`. A relative path in a file is relative to that file.
    pub certificates: PathBuf,
    /// How often a component's certificates have been revoked: earlier certificates are believed by
    /// no component that has read this.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub revoked: BTreeMap<Identity, u32>,
}

/// Name of the authority's certificate file in [`Security::certificates`].
pub const AUTHORITY_FILE: &str = "authority.pem";

impl Security {
    /// The common name that a component's certificate must have to be believed: its identity, with
    /// a number after it if earlier certificates have been revoked.
    pub fn common_name(&self, identity: &Identity) -> String {
        match self.revoked.get(identity) {
            None | Some(0) => identity.to_string(),
            Some(times) => format!("{identity}.{times}"),
        }
    }

    /// File of the authority's certificate.
    pub fn authority_file(&self) -> PathBuf {
        self.certificates.join(AUTHORITY_FILE)
    }

    /// File of a component's certificate.
    pub fn certificate_file(&self, identity: &Identity) -> PathBuf {
        self.certificates.join(format!("{identity}.pem"))
    }

    /// File of the private key of a component's certificate.
    pub fn key_file(&self, identity: &Identity) -> PathBuf {
        self.certificates.join(format!("{identity}.key"))
    }
}
