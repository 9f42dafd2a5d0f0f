//! The certificate authority of a site, which signs its certificates.

use std::time::Duration;

use crossfix_message::SiteName;
use rcgen::{
    BasicConstraints, CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, IsCa,
    Issuer, KeyPair, KeyUsagePurpose, PublicKeyData,
};
use rustls::pki_types::CertificateDer;
use rustls::pki_types::pem::PemObject;
use thiserror::Error;
use time::OffsetDateTime;
use x509_parser::parse_x509_certificate;

use super::credentials::common_name;

/// How long the authority itself is valid. Whoever has its key can join the site, so the key stays
/// where `enroll` is run; at the authority's end all certificates must be issued again by a new
/// one. With half of it that is due after five years.
const AUTHORITY_HOLDS: Duration = Duration::from_secs(10 * 365 * 24 * 3600);
/// Prefix of the site's name in the authority's common name.
const OF_SITE: &str = "Crossfix site ";
/// How far a host's clock may be behind that of the issuing host. With half of it a host that is 30
/// to 60 minutes behind refuses a new certificate at first.
const CLOCKS: Duration = Duration::from_secs(3600);

/// What can go wrong with an authority.
#[derive(Debug, Error)]
pub enum AuthorityError {
    /// Key and certificate do not match: nobody would believe what the key signs.
    #[error("the authority's key is not that of its certificate: they are of two authorities")]
    OtherKey,
    /// Something could not be created or read.
    #[error("{what}")]
    Certificate {
        /// What was tried.
        what: String,
        /// What the library says.
        #[source]
        source: rcgen::Error,
    },
}

fn certificate(what: impl Into<String>) -> impl FnOnce(rcgen::Error) -> AuthorityError {
    let what = what.into();
    move |source| AuthorityError::Certificate { what, source }
}

/// A site's certificate authority: what it signs is believed by the whole site.
pub struct Authority {
    issuer: Issuer<'static, KeyPair>,
    certificate: String,
    key: String,
}

/// A certificate and its private key, as PEM.
#[derive(Clone)]
pub struct Issued {
    /// The certificate.
    pub certificate: String,
    /// Its private key (PKCS #8): whoever has it counts as the component.
    pub key: String,
    /// When it expires.
    pub not_after: OffsetDateTime,
}

/// Whether a key is that of a certificate (PEM).
fn is_key_of(pair: &KeyPair, pem: &str) -> bool {
    let Ok(der) = CertificateDer::from_pem_slice(pem.as_bytes()) else { return false };
    let parsed = parse_x509_certificate(&der);
    parsed.is_ok_and(|(_, parsed)| parsed.public_key().raw == pair.subject_public_key_info())
}

impl Authority {
    /// Creates an authority of a site, valid from a time on.
    ///
    /// # Errors
    /// [`AuthorityError`] if no key can be made.
    pub fn create(site: &SiteName, now: OffsetDateTime) -> Result<Self, AuthorityError> {
        let what = || certificate("cannot make a certificate authority");
        let mut params = CertificateParams::default();
        params.distinguished_name = DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, format!("{OF_SITE}{site}"));
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        params.not_before = now - CLOCKS;
        params.not_after = now + AUTHORITY_HOLDS;
        let pair = KeyPair::generate().map_err(what())?;
        let pem = params.self_signed(&pair).map_err(what())?.pem();
        let key = pair.serialize_pem();
        Ok(Self { issuer: Issuer::new(params, pair), certificate: pem, key })
    }

    /// The authority with a certificate and a key, both as PEM.
    ///
    /// # Errors
    /// [`AuthorityError`] if they are not a certificate and its key.
    pub fn load(pem: &str, key: &str) -> Result<Self, AuthorityError> {
        let pair =
            KeyPair::from_pem(key).map_err(certificate("the authority's key is no private key"))?;
        if !is_key_of(&pair, pem) {
            return Err(AuthorityError::OtherKey);
        }
        let issuer = Issuer::from_ca_cert_pem(pem, pair)
            .map_err(certificate("the authority's certificate is none"))?;
        Ok(Self { issuer, certificate: pem.to_owned(), key: key.to_owned() })
    }

    /// The site that it was made for, if its certificate says so.
    pub fn site(&self) -> Option<String> {
        let der = CertificateDer::from_pem_slice(self.certificate.as_bytes()).ok()?;
        let (_, parsed) = parse_x509_certificate(&der).ok()?;
        common_name(&parsed)?.strip_prefix(OF_SITE).map(str::to_owned)
    }

    /// Its certificate, as PEM; copied to every host.
    pub fn certificate(&self) -> &str {
        &self.certificate
    }

    /// Its private key, as PEM; must not be copied anywhere.
    pub fn key(&self) -> &str {
        &self.key
    }

    /// Issues a certificate with a new key for a common name, valid from `now` on for `holds`.
    /// `hosts` are the names or addresses under which others connect to its holder.
    ///
    /// # Errors
    /// [`AuthorityError`] if a host is no valid name or no key can be made.
    pub fn issue(
        &self,
        common_name: &str,
        hosts: &[String],
        now: OffsetDateTime,
        holds: Duration,
    ) -> Result<Issued, AuthorityError> {
        let what = || certificate(format!("cannot issue a certificate for `{common_name}`"));
        let mut params = CertificateParams::new(hosts).map_err(what())?;
        params.distinguished_name = DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, common_name);
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.use_authority_key_identifier_extension = true;
        params.not_before = now - CLOCKS;
        params.not_after = now + holds;
        let pair = KeyPair::generate().map_err(what())?;
        let issued = params.signed_by(&pair, &self.issuer).map_err(what())?;
        Ok(Issued {
            certificate: issued.pem(),
            key: pair.serialize_pem(),
            not_after: params.not_after,
        })
    }
}
