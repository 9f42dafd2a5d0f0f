//! Certificate and key by which a component shows its identity, read from files and checked.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, RootCertStore};
use thiserror::Error;
use x509_parser::parse_x509_certificate;
use x509_parser::prelude::X509Certificate;

use super::{Identity, Security};

/// Why a component cannot show its identity.
#[derive(Debug, Error)]
pub enum CredentialsError {
    /// A file is missing.
    #[error(
        "{} is not there: run `crossfix enroll`, and copy what it says to this host",
        path.display()
    )]
    Missing {
        /// The file.
        path: PathBuf,
    },
    /// A file cannot be read.
    #[error(
        "cannot read {}: it must be readable to whoever runs this \
         (chown root:crossfix, chmod 640)",
        path.display()
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: io::Error,
    },
    /// A file holds something else.
    #[error("{} holds no {what} in PEM", path.display())]
    Form {
        /// The file.
        path: PathBuf,
        /// What should be in it.
        what: &'static str,
    },
    /// The certificate has expired.
    #[error("the certificate {} ended {} ago: run `crossfix enroll`", path.display(), days(*ago))]
    Expired {
        /// The file.
        path: PathBuf,
        /// How long ago it expired.
        ago: Duration,
    },
    /// The certificate is not valid yet.
    #[error(
        "the certificate {} begins in {}: is this host's clock right?",
        path.display(),
        days(*ahead)
    )]
    NotYet {
        /// The file.
        path: PathBuf,
        /// How long until it is valid.
        ahead: Duration,
    },
    /// It is another component's, or revoked: a number after the name counts the revocations.
    #[error(
        "the certificate {} is of `{found}`, and the network file believes `{believed}` alone: it \
         was revoked, or is another component's; copy the new one here",
        path.display()
    )]
    Name {
        /// The file.
        path: PathBuf,
        /// Its common name.
        found: String,
        /// The one that is believed.
        believed: String,
    },
    /// It is signed by another authority.
    #[error(
        "the certificate {} is not by the authority of {}: copy both of one site",
        path.display(), authority.display()
    )]
    Foreign {
        /// The certificate.
        path: PathBuf,
        /// The authority's certificate.
        authority: PathBuf,
    },
    /// The key belongs to another certificate.
    #[error("{} is not the key of {}", key.display(), path.display())]
    Key {
        /// The certificate.
        path: PathBuf,
        /// The key.
        key: PathBuf,
        /// What the library says.
        #[source]
        source: rustls::Error,
    },
}

/// A duration in words for people.
pub(crate) fn days(time: Duration) -> String {
    let (minutes, hours) = (time.as_secs() / 60, time.as_secs() / 3600);
    match hours {
        0 => format!("{minutes} minutes"),
        1..48 => format!("{hours} hours"),
        _ => format!("{} days", hours / 24),
    }
}

/// A component's certificate, checked, with its key.
pub struct Credentials {
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
    authority: CertificateDer<'static>,
    not_before: SystemTime,
    not_after: SystemTime,
}

fn read(path: &Path) -> Result<Vec<u8>, CredentialsError> {
    std::fs::read(path).map_err(|source| match source.kind() {
        io::ErrorKind::NotFound => CredentialsError::Missing { path: path.to_owned() },
        _ => CredentialsError::Read { path: path.to_owned(), source },
    })
}

fn certificate(path: &Path) -> Result<CertificateDer<'static>, CredentialsError> {
    let what = "certificate";
    CertificateDer::from_pem_slice(&read(path)?)
        .map_err(|_| CredentialsError::Form { path: path.to_owned(), what })
}

fn system_time(seconds: i64) -> SystemTime {
    UNIX_EPOCH + Duration::from_secs(u64::try_from(seconds).unwrap_or(0))
}

/// The common name of a certificate.
pub(super) fn common_name(parsed: &X509Certificate<'_>) -> Option<String> {
    parsed.subject().iter_common_name().next()?.as_str().ok().map(str::to_owned)
}

impl Credentials {
    /// Reads a component's credentials and checks that others believe them at a time, as far as
    /// that can be seen without contacting anybody.
    ///
    /// # Errors
    /// [`CredentialsError`] naming the file and what is wrong with it.
    pub fn load(
        security: &Security,
        identity: &Identity,
        now: SystemTime,
    ) -> Result<Self, CredentialsError> {
        let path = security.certificate_file(identity);
        let key_file = security.key_file(identity);
        let authority = certificate(&security.authority_file())?;
        let own = certificate(&path)?;
        let form = || CredentialsError::Form { path: path.clone(), what: "certificate" };
        let (_, parsed) = parse_x509_certificate(&own).map_err(|_| form())?;
        let key = PrivateKeyDer::from_pem_slice(&read(&key_file)?)
            .map_err(|_| CredentialsError::Form { path: key_file.clone(), what: "private key" })?;
        let believed = security.common_name(identity);
        let found = common_name(&parsed).unwrap_or_default();
        if found != believed {
            return Err(CredentialsError::Name { path, found, believed });
        }
        let authority_file = security.authority_file();
        let (_, by) = parse_x509_certificate(&authority).map_err(|_| CredentialsError::Form {
            path: authority_file.clone(),
            what: "certificate",
        })?;
        if parsed.verify_signature(Some(by.public_key())).is_err() {
            return Err(CredentialsError::Foreign { path, authority: authority_file });
        }
        let not_before = system_time(parsed.validity().not_before.timestamp());
        let not_after = system_time(parsed.validity().not_after.timestamp());
        if let Ok(ago) = now.duration_since(not_after) {
            return Err(CredentialsError::Expired { path, ago });
        }
        if let Ok(ahead) = not_before.duration_since(now) {
            return Err(CredentialsError::NotYet { path, ahead });
        }
        let credentials = Self { chain: vec![own], key, authority, not_before, not_after };
        credentials.client().map_err(|source| CredentialsError::Key {
            path,
            key: key_file,
            source,
        })?;
        Ok(credentials)
    }

    /// TLS settings of a client that shows these credentials and believes only what this site's
    /// authority has signed.
    pub(super) fn client(&self) -> Result<ClientConfig, rustls::Error> {
        let mut roots = RootCertStore::empty();
        roots.add(self.authority.clone())?;
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&rustls::version::TLS13])?
            .with_root_certificates(roots)
            .with_client_auth_cert(self.chain.clone(), self.key.clone_key())
    }

    /// Time left until they expire, if that is less than a third of their whole validity: time to
    /// renew them.
    pub fn ending(&self, now: SystemTime) -> Option<Duration> {
        self.validity().ending(now)
    }

    /// The period in which they are valid.
    pub fn validity(&self) -> Validity {
        Validity { not_before: self.not_before, not_after: self.not_after }
    }

    /// When they expire.
    pub fn not_after(&self) -> SystemTime {
        self.not_after
    }
}

/// The period in which a certificate is valid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Validity {
    not_before: SystemTime,
    not_after: SystemTime,
}

impl Validity {
    /// Time left until its end, if that is less than a third of the whole period.
    pub fn ending(&self, now: SystemTime) -> Option<Duration> {
        let left = self.not_after.duration_since(now).unwrap_or_default();
        let whole = self.not_after.duration_since(self.not_before).unwrap_or_default();
        (left < whole / 3).then_some(left)
    }
}
