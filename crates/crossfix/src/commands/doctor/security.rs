//! Whether the other components answer, and accept this one's certificate.

use std::error::Error;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::SystemTime;

use crossfix_transport::{
    Credentials, CredentialsError, HandshakeError, Identity, NetworkConfig, Role, address, connect,
    handshake,
};

use super::{CheckResult, Finding};

/// Seconds of a day.
const DAY_S: u64 = 24 * 3600;
/// Mode bit of a file that all users may read.
const OTHERS_READ: u32 = 0o004;
/// What to do about a certificate that has ended or is missing.
const RENEW: &str = "crossfix enroll -c network.toml, and copy what it says to this host";

/// Whether a component has a valid certificate to present.
pub fn of_own(network: &NetworkConfig, identity: &Identity) -> Vec<Finding> {
    let Some(security) = &network.security else {
        let is_open = network.unsecured || network.unencrypted(&Role::Observer).is_some();
        let found = if is_open {
            "nothing is encrypted, and whoever reaches this network can add cameras and tracks"
        } else {
            "no certificates: components listen on this host alone"
        };
        let verdict = if is_open { CheckResult::Warn } else { CheckResult::Pass };
        return vec![
            Finding::new("security", verdict, found).remedy("crossfix enroll -c network.toml"),
        ];
    };
    let now = SystemTime::now();
    let credentials = match Credentials::load(security, identity, now) {
        Ok(credentials) => credentials,
        Err(error) => {
            let remedy = match &error {
                CredentialsError::NotYet { .. } => "set this host's clock",
                CredentialsError::Key { .. } => "copy both files of one issue",
                CredentialsError::Read { .. } => "chown root:crossfix, chmod 640",
                _ => RENEW,
            };
            return vec![
                Finding::new("certificate", CheckResult::Fail, words(&error)).remedy(remedy),
            ];
        }
    };
    let left = credentials.not_after().duration_since(now).unwrap_or_default();
    let days = left.as_secs() / DAY_S;
    let verdict =
        if credentials.ending(now).is_some() { CheckResult::Warn } else { CheckResult::Pass };
    let found = format!("{} for {days} more days", security.common_name(identity));
    let mut findings = vec![Finding::new("certificate", verdict, found).remedy(RENEW)];
    findings.extend(of_key(&security.key_file(identity)));
    findings
}

/// A finding if all users of this host can read a private key.
fn of_key(path: &Path) -> Option<Finding> {
    let mode = std::fs::metadata(path).ok()?.permissions().mode();
    (mode & OTHERS_READ != 0).then(|| {
        let found = format!("everybody on this host can read {}", path.display());
        Finding::new("key", CheckResult::Warn, found).remedy("chmod 640, or 600")
    })
}

/// The other components, as seen from one of them.
pub struct OtherComponents<'a> {
    network: &'a NetworkConfig,
    /// Credentials presented to the others; `None` where none are used, or none can be loaded.
    shown: Option<Credentials>,
}

impl<'a> OtherComponents<'a> {
    pub fn seen_by(network: &'a NetworkConfig, identity: &Identity) -> Self {
        let security = network.security.as_ref();
        let shown = security
            .and_then(|security| Credentials::load(security, identity, SystemTime::now()).ok());
        Self { network, shown }
    }

    /// Whether the wanted component listens at an endpoint, and accepts this one's certificate.
    pub fn of(&self, who: &str, endpoint: &str, wanted: &Identity) -> Finding {
        match &self.shown {
            Some(credentials) => self.by_handshake(credentials, who, endpoint, wanted),
            None => match connect(address(endpoint)) {
                Ok(_) => Finding::new(who, CheckResult::Pass, format!("{endpoint} answers")),
                Err(error) => unreachable(who, endpoint, &error),
            },
        }
    }

    fn by_handshake(
        &self,
        credentials: &Credentials,
        who: &str,
        endpoint: &str,
        wanted: &Identity,
    ) -> Finding {
        let believed = self.network.security.as_ref().map(|it| it.common_name(wanted));
        match handshake(credentials, address(endpoint)) {
            Ok(name) if believed.as_ref() == Some(&name) => {
                Finding::new(who, CheckResult::Pass, format!("{endpoint} answers as {name}"))
            }
            Ok(name) => Finding::new(
                who,
                CheckResult::Fail,
                format!("{endpoint} shows `{name}`, and `{wanted}` is wanted there"),
            )
            .remedy(
                "another's endpoint, a revoked certificate, or an older network file here or there",
            ),
            Err(HandshakeError::Connect(error)) => unreachable(who, endpoint, &error),
            Err(error) => {
                let remedy = match &error {
                    HandshakeError::OursRefused(_) => RENEW,
                    HandshakeError::NoTls => "give it the network file with [security]",
                    _ => {
                        "crossfix enroll, copy what it says to that host, and start it again there"
                    }
                };
                let found = format!("{endpoint}: {}", words(&error));
                Finding::new(who, CheckResult::Fail, found).remedy(remedy)
            }
        }
    }
}

/// An error and its causes.
fn words(error: &dyn Error) -> String {
    let mut words = error.to_string();
    let mut source = error.source();
    while let Some(inner) = source {
        words = format!("{words}: {inner}");
        source = inner.source();
    }
    words
}

fn unreachable(who: &str, endpoint: &str, error: &io::Error) -> Finding {
    let remedy = match error.kind() {
        io::ErrorKind::ConnectionRefused => "the host is there: start it on it",
        io::ErrorKind::TimedOut => "is that its address, and is the port open?",
        _ => "is that its address?",
    };
    Finding::new(who, CheckResult::Fail, format!("{endpoint}: {error}")).remedy(remedy)
}
