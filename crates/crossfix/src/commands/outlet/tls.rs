//! TLS to other programs' servers, with their certificates, not the site's.

use std::io;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, ensure};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};

/// An encrypted stream.
pub type TlsStream = StreamOwned<ClientConnection, TcpStream>;

/// The files of a server's TLS.
#[derive(Clone, Debug, clap::Args)]
pub struct TlsFiles {
    /// With tls://: the certificates (PEM) of the authorities that the server's is by.
    #[arg(long, value_name = "FILE")]
    tls_ca: Option<PathBuf>,
    /// With tls://: this client's certificate (PEM), where the server wants one.
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    tls_certificate: Option<PathBuf>,
    /// With tls://: its private key (PEM).
    #[arg(long, value_name = "FILE", requires = "tls_certificate")]
    tls_key: Option<PathBuf>,
}

/// A client for TLS connections.
pub struct TlsClient {
    config: Arc<ClientConfig>,
}

fn certificates(path: &Path) -> anyhow::Result<Vec<CertificateDer<'static>>> {
    let read = || CertificateDer::pem_file_iter(path)?.collect::<Result<Vec<_>, _>>();
    let found =
        read().with_context(|| format!("cannot read certificates of {}", path.display()))?;
    ensure!(!found.is_empty(), "{} holds no certificate in PEM", path.display());
    Ok(found)
}

impl TlsFiles {
    /// A TLS client that uses these files.
    pub fn client(&self) -> anyhow::Result<TlsClient> {
        let authorities = self.tls_ca.as_deref().context("tls:// needs --tls-ca FILE")?;
        let mut roots = RootCertStore::empty();
        for certificate in certificates(authorities)? {
            let wrong = || format!("{} holds no authority's certificate", authorities.display());
            roots.add(certificate).with_context(wrong)?;
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .context("TLS cannot be set up")?
            .with_root_certificates(roots);
        let config = match (&self.tls_certificate, &self.tls_key) {
            (Some(certificate), Some(key)) => {
                let private = PrivateKeyDer::from_pem_file(key)
                    .with_context(|| format!("cannot read the key {}", key.display()))?;
                builder
                    .with_client_auth_cert(certificates(certificate)?, private)
                    .with_context(|| format!("{} is not the key of it", key.display()))?
            }
            _ => builder.with_no_client_auth(),
        };
        Ok(TlsClient { config: Arc::new(config) })
    }
}

impl TlsClient {
    /// Performs the TLS handshake over a connection to `HOST:PORT`.
    pub fn connect(&self, mut stream: TcpStream, address: &str) -> io::Result<TlsStream> {
        let host = address.rsplit_once(':').map_or(address, |(host, _)| host);
        let name = ServerName::try_from(host.trim_matches(['[', ']']).to_owned());
        let name = name.map_err(io::Error::other)?;
        let mut connection =
            ClientConnection::new(Arc::clone(&self.config), name).map_err(io::Error::other)?;
        stream.set_read_timeout(stream.write_timeout()?)?;
        while connection.is_handshaking() {
            connection.complete_io(&mut stream)?;
        }
        Ok(StreamOwned::new(connection, stream))
    }
}
