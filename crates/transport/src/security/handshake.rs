//! A TLS handshake with another component, to find out why there is no link: Zenoh only waits.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::sync::Arc;
use std::time::Duration;

use rustls::pki_types::ServerName;
use rustls::{AlertDescription, CertificateError, ClientConnection, StreamOwned};
use thiserror::Error;
use x509_parser::parse_x509_certificate;

use super::Credentials;
use super::credentials::common_name;

/// How long the other side may take to answer. With half of it a host that takes longer than a
/// second counts as absent.
const ANSWER: Duration = Duration::from_secs(2);
/// How long the other side may then take to refuse a certificate. With half of it a refusal that
/// takes 200 ms would count as consent.
const REFUSAL: Duration = Duration::from_millis(300);

/// Why there is no link.
#[derive(Debug, Error)]
pub enum HandshakeError {
    /// No connection.
    #[error("nobody answers")]
    Connect(#[source] io::Error),
    /// It answers, but not by TLS.
    #[error("it does not speak TLS: does it run without [security]?")]
    NoTls,
    /// Its certificate has expired.
    #[error("its certificate has ended: renew it on that host")]
    TheirsExpired,
    /// Its certificate is signed by another authority.
    #[error("its certificate is by another authority than this site's")]
    TheirsForeign,
    /// Its certificate is for another host.
    #[error(
        "its certificate is not for this address: has the network file changed since `enroll`?"
    )]
    TheirsElsewhere,
    /// It refuses our certificate.
    #[error("it refuses our certificate: {0}")]
    OursRefused(&'static str),
    /// Something else.
    #[error("the handshake failed")]
    Other(#[source] io::Error),
}

/// A TCP connection with whoever listens at `HOST:PORT`, trying each of its addresses; each step
/// waits for two seconds at most.
///
/// # Errors
/// What the system says of the last address.
pub fn connect(address: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::other("it has no address");
    for address in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, ANSWER) {
            Ok(stream) => {
                stream.set_read_timeout(Some(ANSWER))?;
                stream.set_write_timeout(Some(ANSWER))?;
                return Ok(stream);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// The cause of a failed handshake.
fn explain(error: io::Error) -> HandshakeError {
    let tls = error.get_ref().and_then(|inner| inner.downcast_ref::<rustls::Error>());
    match tls {
        Some(rustls::Error::InvalidCertificate(why)) => match why {
            CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
                HandshakeError::TheirsExpired
            }
            CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
                HandshakeError::TheirsElsewhere
            }
            _ => HandshakeError::TheirsForeign,
        },
        Some(rustls::Error::AlertReceived(alert)) => HandshakeError::OursRefused(match alert {
            AlertDescription::CertificateExpired => "it has ended",
            AlertDescription::UnknownCA | AlertDescription::DecryptError => {
                "it is by another authority"
            }
            AlertDescription::CertificateRequired => "there is none",
            _ => "it does not say why",
        }),
        Some(_) => HandshakeError::NoTls,
        None if matches!(
            error.kind(),
            io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::UnexpectedEof
        ) =>
        {
            HandshakeError::NoTls
        }
        None => HandshakeError::Other(error),
    }
}

/// Does a handshake with whoever listens at `HOST:PORT`, and returns the common name of the
/// certificate that it shows.
///
/// # Errors
/// [`HandshakeError`] saying whose certificate is refused, and why.
pub fn handshake(credentials: &Credentials, address: &str) -> Result<String, HandshakeError> {
    let other = |source| HandshakeError::Other(io::Error::other(source));
    let config = credentials.client().map_err(|source| other(Box::new(source)))?;
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
    let host = host.trim_matches(['[', ']']).to_owned();
    let name = ServerName::try_from(host)
        .map_err(|source| HandshakeError::Other(io::Error::other(source)))?;
    let stream = connect(address).map_err(HandshakeError::Connect)?;
    let connection =
        ClientConnection::new(Arc::new(config), name).map_err(|source| other(Box::new(source)))?;
    let mut tls = StreamOwned::new(connection, stream);
    while tls.conn.is_handshaking() {
        tls.conn.complete_io(&mut tls.sock).map_err(explain)?;
    }
    tls.flush().map_err(explain)?;
    // The server checks our certificate after our side is done, and sends nothing if it is good: so
    // a refusal is waited for.
    tls.sock.set_read_timeout(Some(REFUSAL)).map_err(HandshakeError::Other)?;
    match tls.read(&mut [0]) {
        Err(error) if is_tls(&error) => return Err(explain(error)),
        _ => {}
    }
    let theirs = tls.conn.peer_certificates().and_then(|chain| chain.first());
    let name = theirs.and_then(|own| common_name(&parse_x509_certificate(own).ok()?.1));
    Ok(name.unwrap_or_default())
}

fn is_tls(error: &io::Error) -> bool {
    error.get_ref().is_some_and(|inner| inner.is::<rustls::Error>())
}
