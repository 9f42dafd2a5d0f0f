//! A site's certificates.

use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use anyhow::{Context, ensure};
use crossfix_transport::{
    Authority, Credentials, Identity, Issued, NetworkConfig, Security, host_of,
};
use time::OffsetDateTime;
use toml_edit::{DocumentMut, Item, Table, value};

use crate::commands::examples;
use crate::config::load_network;
use crate::output;

/// Folder of the certificates, beside the network file, unless that names another.
const CERTIFICATES: &str = "certificates";
/// Folder of the certificate authority, beside the network file.
const AUTHORITY: &str = "authority";
/// File of the authority's private key, in its folder.
const AUTHORITY_KEY: &str = "authority.key";
/// A day, the unit in which the life of certificates is given.
const DAY: Duration = Duration::from_secs(24 * 3600);

/// Make or renew a site's certificates, and secure its network by them.
///
/// The first time it makes the site's certificate authority and adds `[security]` to the network
/// file: from then on every link is encrypted, and each component may say only what is its own.
#[derive(Debug, clap::Args)]
#[command(after_help = examples(&[
    "crossfix enroll -c my-site/network.toml",
    "crossfix enroll -c my-site/network.toml --only camera-north",
    "crossfix enroll -c my-site/network.toml --revoke camera-north",
]))]
pub struct Args {
    /// The network's file (TOML).
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// The folder of the authority, whose key can let anybody in: it stays here. Default:
    /// `authority` beside the network's file.
    #[arg(long, value_name = "FOLDER")]
    authority: Option<PathBuf>,
    /// How long the certificates hold, days. A component says that it is time to renew when a third
    /// is left.
    #[arg(
        long,
        value_name = "DAYS",
        default_value_t = 90,
        value_parser = clap::value_parser!(u32).range(1..=3650)
    )]
    days: u32,
    /// Only these: camera-NAME, fusion, recorder, router, viewer.
    #[arg(long, value_name = "NAME", conflicts_with = "revoke")]
    only: Vec<Identity>,
    /// Believe none of the certificates issued for it so far, and issue another.
    #[arg(long, value_name = "NAME")]
    revoke: Option<Identity>,
}

impl Args {
    /// Whether a certificate is to be issued for it.
    fn means(&self, identity: &Identity) -> bool {
        match &self.revoke {
            Some(revoked) => identity == revoked,
            None => self.only.is_empty() || self.only.contains(identity),
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<()> {
    let folder = args.config.parent().unwrap_or(Path::new("."));
    let before = load_network(&args.config)?;
    let hosts = hosts_of(&before);
    let named = args.only.iter().chain(&args.revoke);
    for identity in named {
        ensure!(hosts.contains_key(identity), "the network has no `{identity}`");
    }
    let believed_until = args.revoke.as_ref().and_then(|revoked| end_of(&before, revoked));
    let secured = secured(&args.config, args.revoke.as_ref())?;
    let security = security_of(&secured, folder)?;
    let authority_folder = args.authority.clone().unwrap_or_else(|| folder.join(AUTHORITY));
    let authority = authority(&authority_folder, &security, &before.site)?;

    let holds = DAY * args.days;
    let mut rows = vec![["component", "host", "until", "files"].map(str::to_owned).to_vec()];
    for (identity, hosts) in hosts.iter().filter(|(identity, _)| args.means(identity)) {
        let name = security.common_name(identity);
        let issued = authority.issue(&name, hosts, OffsetDateTime::now_utc(), holds)?;
        write(&security, identity, &issued)?;
        rows.push(row(identity, hosts, &issued));
    }
    // Written last, because from then on the network file admits only components with a
    // certificate.
    if secured != read(&args.config)? {
        output::write_file(&args.config, &[], secured.as_bytes())?;
    }
    output::line(output::table(&rows));
    output::line(format!(
        "\nTo each host: {}, {} and the two files of what runs there, the key readable by it \
         alone. {} stays here.",
        args.config.display(),
        security.authority_file().display(),
        authority_folder.display()
    ));
    if let Some(revoked) = &args.revoke {
        let until = believed_until.map_or_else(String::new, |end| {
            format!(
                "; one that is not started again believes them until {}",
                OffsetDateTime::from(end).date()
            )
        });
        output::line(format!(
            "Earlier certificates of {revoked} are believed by each component until it is started \
             again with the new network file{until}."
        ));
    }
    Ok(())
}

/// Components of a network, each with the hosts under which others connect to it.
fn hosts_of(network: &NetworkConfig) -> BTreeMap<Identity, Vec<String>> {
    let host = |endpoint: &str| host_of(endpoint).to_owned();
    let cameras = network.cameras.iter();
    let mut hosts: BTreeMap<Identity, Vec<String>> = cameras
        .map(|(name, endpoint)| (Identity::Camera(name.clone()), vec![host(endpoint)]))
        .collect();
    let centres = network.centres();
    hosts.extend(centres.map(|(area, endpoint)| (Identity::Fusion(area), vec![host(endpoint)])));
    hosts.insert(Identity::Recorder, Vec::new());
    hosts.insert(Identity::Viewer, Vec::new());
    if !network.routers.is_empty() {
        let mut routers: Vec<String> = network.routers.iter().map(|router| host(router)).collect();
        routers.sort();
        routers.dedup();
        hosts.insert(Identity::Router, routers);
    }
    hosts
}

/// End of validity of a component's certificate on this host, if there is one.
fn end_of(network: &NetworkConfig, identity: &Identity) -> Option<SystemTime> {
    let security = network.security.as_ref()?;
    let credentials = Credentials::load(security, identity, SystemTime::now()).ok()?;
    Some(credentials.not_after())
}

fn read(path: &Path) -> anyhow::Result<String> {
    fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
}

/// Text of a network file with a `[security]` table added if it has none, and with a revocation
/// counted. All else in it stays as it was written.
fn secured(path: &Path, revoked: Option<&Identity>) -> anyhow::Result<String> {
    let mut file: DocumentMut =
        read(path)?.parse().with_context(|| format!("{} is no TOML", path.display()))?;
    let security = file.entry("security").or_insert_with(|| Item::Table(Table::new()));
    let security = security.as_table_like_mut().context("`security` is no section")?;
    security.entry("certificates").or_insert(value(CERTIFICATES));
    if let Some(revoked) = revoked {
        let counts = security.entry("revoked").or_insert_with(|| Item::Table(Table::new()));
        let counts = counts.as_table_like_mut().context("`security.revoked` is no section")?;
        let name = revoked.to_string();
        let times = counts.get(&name).and_then(Item::as_integer).unwrap_or(0);
        counts.insert(&name, value(times + 1));
    }
    Ok(file.to_string())
}

/// The security settings of a network file that lies in `folder`.
fn security_of(text: &str, folder: &Path) -> anyhow::Result<Security> {
    let network: NetworkConfig = crate::config::parse(text, &[])?;
    let security = network.security.context("the network file has no [security]")?;
    Ok(Security { certificates: folder.join(&security.certificates), ..security })
}

/// The site's authority: the existing one, or a new one.
fn authority(
    folder: &Path,
    security: &Security,
    site: &crossfix_message::SiteName,
) -> anyhow::Result<Authority> {
    let (key, public) = (folder.join(AUTHORITY_KEY), security.authority_file());
    if key.exists() {
        let authority = Authority::load(&read(&public)?, &read(&key)?)?;
        if let Some(other) = authority.site().filter(|other| *other != site.as_str()) {
            tracing::warn!(
                "the authority was made for site `{other}`: whoever has a certificate of that \
                 site is believed here, too. An authority of its own: remove {} and {}",
                public.display(),
                folder.display()
            );
        }
        return Ok(authority);
    }
    ensure!(
        !public.exists(),
        "{} is there and its key {} is not: enroll where that is, or remove it to begin again \
         with certificates for all",
        public.display(),
        key.display()
    );
    let authority = Authority::create(site, OffsetDateTime::now_utc())?;
    private_folder(folder)?;
    write_private(&key, authority.key())?;
    fs::create_dir_all(&security.certificates)
        .with_context(|| format!("cannot make {}", security.certificates.display()))?;
    output::write_file(&public, &[], authority.certificate().as_bytes())?;
    Ok(authority)
}

fn private_folder(folder: &Path) -> anyhow::Result<()> {
    let made = fs::DirBuilder::new().recursive(true).mode(0o700).create(folder);
    made.with_context(|| format!("cannot make {}", folder.display()))
}

/// Writes a file that only its owner may read.
fn write_private(path: &Path, text: &str) -> anyhow::Result<()> {
    try_to_write_private(path, text).with_context(|| format!("cannot write {}", path.display()))
}

fn try_to_write_private(path: &Path, text: &str) -> std::io::Result<()> {
    let part = path.with_extension("part");
    let _ = fs::remove_file(&part);
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&part)?;
    file.write_all(text.as_bytes())?;
    fs::rename(&part, path)
}

fn write(security: &Security, identity: &Identity, issued: &Issued) -> anyhow::Result<()> {
    write_private(&security.key_file(identity), &issued.key)?;
    output::write_file(&security.certificate_file(identity), &[], issued.certificate.as_bytes())
}

fn row(identity: &Identity, hosts: &[String], issued: &Issued) -> Vec<String> {
    let host = if hosts.is_empty() { "any".to_owned() } else { hosts.join(" ") };
    vec![
        identity.to_string(),
        host,
        issued.not_after.date().to_string(),
        format!("{identity}.pem {identity}.key"),
    ]
}
