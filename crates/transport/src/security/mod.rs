//! Who may join a site's network, and what each may say there.
//!
//! A site has a certificate authority of its own, and each component a certificate by it, whose
//! common name says which component it is ([`Identity`]). All links are mutual TLS, and every
//! component takes from each other one only what that one may say (`access`): an agent its own
//! camera's messages, the fusion centre the tracks, the recorder its health, a viewer nothing.
//!
//! Zenoh itself says nothing where a link fails for a certificate; [`Credentials`] and [`handshake`]
//! say why.

mod access;
mod authority;
mod credentials;
mod handshake;
mod identity;

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub(crate) use access::access_control;
pub use authority::{Authority, AuthorityError, Issued};
pub(crate) use credentials::days;
pub use credentials::{Credentials, CredentialsError, Validity};
pub use handshake::{HandshakeError, connect, handshake};
pub use identity::{Identity, IdentityError};

/// `[security]` of a network file: the site's links are encrypted, and both ends of each show who
/// they are. `crossfix enroll` makes the certificates and adds this section.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Security {
    /// The folder of the certificates: `authority.pem` and, of the components that run on this host,
    /// `NAME.pem` and `NAME.key`. In a file it is relative to the file.
    pub certificates: PathBuf,
    /// How often a component's certificates have been revoked: those issued before are believed by
    /// nobody that has read this.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub revoked: BTreeMap<Identity, u32>,
}

/// The name of the certificate authority's file in [`Security::certificates`].
pub const AUTHORITY_FILE: &str = "authority.pem";

impl Security {
    /// The common name of the certificates of a component that are believed: its own, and with a
    /// number where earlier ones have been revoked.
    pub fn common_name(&self, identity: &Identity) -> String {
        match self.revoked.get(identity) {
            None | Some(0) => identity.to_string(),
            Some(times) => format!("{identity}.{times}"),
        }
    }

    /// The authority's certificate.
    pub fn authority_file(&self) -> PathBuf {
        self.certificates.join(AUTHORITY_FILE)
    }

    /// A component's certificate.
    pub fn certificate_file(&self, identity: &Identity) -> PathBuf {
        self.certificates.join(format!("{identity}.pem"))
    }

    /// The private key of a component's certificate.
    pub fn key_file(&self, identity: &Identity) -> PathBuf {
        self.certificates.join(format!("{identity}.key"))
    }
}
