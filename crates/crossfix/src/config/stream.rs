use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail, ensure};
use crossfix_video::{
    GstreamerOptions, Login, RtspOptions, RtspTransport, StreamAddress, StreamLatency,
};
use serde::{Deserialize, Serialize, Serializer};

/// The live stream of a network camera.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StreamConfig {
    /// The stream's address, `rtsp://HOST/PATH`; a user and a password may stand before the host,
    /// `rtsp://USER:PASSWORD@HOST/PATH`.
    pub url: StreamUrl,
    /// User name to log in with, if it is not in `url`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// The file whose first line is the password, if it is not in `url`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// `tcp` (default) or `udp`.
    #[serde(default)]
    pub transport: StreamTransport,
    /// Time from the exposure to the arrival, s, for images that are timed by their arrival: those
    /// before the camera has said what its clock shows, and all with the clock `arrival`. 0 to 10.
    /// Default 0.1.
    #[serde(default = "usual_latency_s")]
    pub latency_s: f64,
}

/// Address of a stream; its login is never shown. A malformed address is kept as a message saying
/// what is wrong, since a parser's error would show the line and with it the password.
#[derive(Clone, Debug, Deserialize)]
#[serde(from = "String")]
pub struct StreamUrl(Result<(StreamAddress, Option<Login>), String>);

/// Transport of a stream: within the RTSP connection (TCP), or in datagrams (UDP).
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StreamTransport {
    #[default]
    Tcp,
    Udp,
}

fn usual_latency_s() -> f64 {
    StreamLatency::default().mean_s
}

impl From<String> for StreamUrl {
    fn from(text: String) -> Self {
        Self(StreamAddress::parse(&text).map_err(|error| error.to_string()))
    }
}

impl Serialize for StreamUrl {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match &self.0 {
            Ok((address, _)) => serializer.collect_str(address),
            Err(_) => serializer.serialize_str(""),
        }
    }
}

impl StreamConfig {
    /// A stream that needs no login.
    #[cfg(all(feature = "centre", feature = "viewer"))]
    pub fn open_to_all(url: String) -> Self {
        Self {
            url: url.into(),
            user: None,
            password_file: None,
            transport: StreamTransport::Tcp,
            latency_s: usual_latency_s(),
        }
    }

    pub(super) fn check(&self) -> anyhow::Result<()> {
        ensure!(
            (0.0..=10.0).contains(&self.latency_s),
            "key `source.latency_s` is {}: it must be from 0 to 10 s",
            self.latency_s
        );
        self.address().map(drop)
    }

    /// Options for opening the stream. `by_arrival_sd_s`, s, is given if its images are to be timed
    /// by their arrival and the camera's own clock is not to be trusted.
    pub(super) fn options(&self, by_arrival_sd_s: Option<f64>) -> anyhow::Result<RtspOptions> {
        let (address, login) = self.address()?;
        Ok(RtspOptions {
            address: address.clone(),
            login: self.login(login.as_ref())?,
            transport: match self.transport {
                StreamTransport::Tcp => RtspTransport::Tcp,
                StreamTransport::Udp => RtspTransport::Udp,
            },
            heeds_reports: by_arrival_sd_s.is_none(),
            latency: StreamLatency {
                mean_s: self.latency_s,
                sd_s: by_arrival_sd_s.unwrap_or(StreamLatency::default().sd_s),
            },
        })
    }

    fn address(&self) -> anyhow::Result<&(StreamAddress, Option<Login>)> {
        self.url.0.as_ref().map_err(|what| anyhow!("key `source.url`: {what}"))
    }

    fn login(&self, in_url: Option<&Login>) -> anyhow::Result<Option<Login>> {
        let by_file = login("source.", self.user.as_deref(), self.password_file.as_deref())?;
        ensure!(
            in_url.is_none() || by_file.is_none(),
            "the user is in `source.url`: leave out `source.user` and `source.password_file`"
        );
        Ok(in_url.cloned().or(by_file))
    }
}

/// Login of a user with the password in the first line of a file; `prefix` begins the keys that
/// errors name.
pub fn login(
    prefix: &str,
    user: Option<&str>,
    password_file: Option<&Path>,
) -> anyhow::Result<Option<Login>> {
    match (user, password_file) {
        (None, None) => Ok(None),
        (Some(user), Some(file)) => {
            let text = std::fs::read_to_string(file)
                .with_context(|| format!("key `{prefix}password_file`: {}", file.display()))?;
            Ok(Some(Login::new(user, text.lines().next().unwrap_or_default())))
        }
        _ => bail!("give both `{prefix}user` and `{prefix}password_file`"),
    }
}

/// A GStreamer pipeline.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GstreamerConfig {
    /// Elements with `!` between them, as `gst-launch-1.0` takes them, up to the decoded video,
    /// without a sink. The text is shown in logs, so the login belongs into `user` and
    /// `password_file`.
    pub pipeline: String,
    /// User name to log in with: `user-id` of the element with `name=camera`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// The file whose first line is the password, `user-pw` of that element.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// As [`StreamConfig::latency_s`].
    #[serde(default = "usual_latency_s")]
    pub latency_s: f64,
}

/// Element properties whose names contain one of these are kept secret.
const SECRETS: [&str; 5] = ["-pw", "pass", "secret", "token", "key="];

/// Whether a word of a pipeline sets a property that must be kept secret.
fn is_secret(word: &str) -> bool {
    let name = word.split_inclusive('=').next().unwrap_or(word).to_lowercase();
    name.ends_with('=') && SECRETS.iter().any(|secret| name.contains(secret))
}

/// Whether a word of a pipeline may give a password away: a secret property, or an address with a
/// user or a query.
fn may_hold_password(word: &str) -> bool {
    let host = word.split_once("://").map(|(_, rest)| rest.split('/').next().unwrap_or(rest));
    is_secret(word)
        || word.contains("://") && word.contains('?')
        || host.is_some_and(|host| host.contains('@'))
}

impl GstreamerConfig {
    pub(super) fn check(&self) -> anyhow::Result<()> {
        ensure!(!self.pipeline.trim().is_empty(), "key `source.pipeline` is empty");
        ensure!(
            !self.pipeline.split_whitespace().any(may_hold_password),
            "key `source.pipeline` holds a password, and is shown in logs: give `source.user` and \
             `source.password_file`, and name=camera to the element that asks"
        );
        ensure!(
            (0.0..=10.0).contains(&self.latency_s),
            "key `source.latency_s` is {}: it must be from 0 to 10 s",
            self.latency_s
        );
        Ok(())
    }

    /// Options for opening it; as [`StreamConfig::options`].
    pub(super) fn options(&self, by_arrival_sd_s: Option<f64>) -> anyhow::Result<GstreamerOptions> {
        Ok(GstreamerOptions {
            pipeline: self.pipeline.clone(),
            login: login("source.", self.user.as_deref(), self.password_file.as_deref())?,
            heeds_reports: by_arrival_sd_s.is_none(),
            latency: StreamLatency {
                mean_s: self.latency_s,
                sd_s: by_arrival_sd_s.unwrap_or(StreamLatency::default().sd_s),
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> anyhow::Result<StreamConfig> {
        crate::config::parse(text, &[])
    }

    #[test]
    fn a_password_is_used_and_shown_nowhere() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("password");
        std::fs::write(&file, "hunter2\n").unwrap();
        let by_url = read("url = \"rtsp://eye:hunter2@10.0.0.5/live\"").unwrap();
        let by_file = read(&format!(
            "url = \"rtsp://10.0.0.5/live\"\nuser = \"eye\"\npassword_file = {file:?}"
        ))
        .unwrap();
        for stream in [by_url, by_file] {
            let login = stream.options(None).unwrap().login;
            assert_eq!(login, Some(Login::new("eye", "hunter2")));
            let shown = format!("{stream:?} {} {login:?}", toml::to_string(&stream).unwrap());
            assert!(
                !shown.contains("hunter2") && shown.contains("rtsp://10.0.0.5/live"),
                "{shown}"
            );
        }
    }

    #[test]
    fn a_pipeline_with_a_password_is_refused_as_it_is_shown() {
        for word in [
            "user-pw=hunter2",
            "proxy-pw=hunter2",
            "passphrase=hunter2",
            "location=rtsp://eye:hunter2@10.0.0.5/live",
            "location=rtsp://10.0.0.5/live?password=hunter2",
        ] {
            let text = format!("pipeline = \"rtspsrc {word} ! decodebin\"");
            let pipeline: GstreamerConfig = crate::config::parse(&text, &[]).unwrap();
            let error = format!("{:#}", pipeline.check().unwrap_err());
            assert!(error.contains("password_file") && !error.contains("hunter2"), "{error}");
        }
        let text = "pipeline = \"rtspsrc location=rtsp://10.0.0.5/live@home ! decodebin\"";
        let pipeline: GstreamerConfig = crate::config::parse(text, &[]).unwrap();
        assert!(pipeline.check().is_ok());
    }

    #[test]
    fn an_impossible_stream_is_refused_without_its_password() {
        for (url, says) in [
            ("http://eye:hunter2@10.0.0.5/", "it does not begin with rtsp://"),
            ("rtsp:///live", "host"),
            ("", "no address of a stream"),
        ] {
            let stream = read(&format!("url = {url:?}")).unwrap();
            let error = format!("{:#}", stream.check().unwrap_err());
            assert!(error.contains(says) && !error.contains("hunter2"), "{error}");
        }
        let half = read("url = \"rtsp://10.0.0.5/\"\nuser = \"eye\"").unwrap();
        assert!(half.options(None).is_err());
    }
}
