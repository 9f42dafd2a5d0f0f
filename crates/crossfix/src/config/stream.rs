use std::path::PathBuf;

use anyhow::{Context, anyhow, bail, ensure};
use crossfix_video::{Latency, Login, RtspOptions, RtspTransport, StreamAddress};
use serde::{Deserialize, Serialize, Serializer};

/// A network camera's live stream.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StreamConfig {
    /// Where it is, `rtsp://HOST/PATH`; a user and a password may stand before the host,
    /// `rtsp://USER:PASSWORD@HOST/PATH`.
    pub url: StreamUrl,
    /// Who asks for it, if not in `url`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<String>,
    /// The file whose first line is the password, if it is not in `url`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// `tcp` (default) or `udp`.
    #[serde(default)]
    pub transport: StreamTransport,
    /// What it takes from the exposure to the arrival, s, for images that are timed by their arrival:
    /// until the camera has said what its clock shows, and for good with the clock `arrival`. 0 to 10.
    /// Default 0.1.
    #[serde(default = "usual_latency_s")]
    pub latency_s: f64,
}

/// The address of a stream; whoever may ask for it is shown nowhere. One that is none is kept as what
/// is wrong with it: a parser's error would show the line.
#[derive(Clone, Debug, Deserialize)]
#[serde(from = "String")]
pub struct StreamUrl(Result<(StreamAddress, Option<Login>), String>);

/// How a stream comes: within the connection, or in datagrams.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StreamTransport {
    #[default]
    Tcp,
    Udp,
}

fn usual_latency_s() -> f64 {
    Latency::default().mean_s
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
    /// A stream that anybody may watch.
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

    /// How to watch it; with a standard deviation, s, if its images are to be timed by their arrival and
    /// what the camera says of its clock is not to be believed.
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
            latency: Latency {
                mean_s: self.latency_s,
                sd_s: by_arrival_sd_s.unwrap_or(Latency::default().sd_s),
            },
        })
    }

    fn address(&self) -> anyhow::Result<&(StreamAddress, Option<Login>)> {
        self.url.0.as_ref().map_err(|what| anyhow!("key `source.url`: {what}"))
    }

    fn login(&self, in_url: Option<&Login>) -> anyhow::Result<Option<Login>> {
        match (in_url, &self.user, &self.password_file) {
            (login, None, None) => Ok(login.cloned()),
            (None, Some(user), Some(file)) => {
                let text = std::fs::read_to_string(file)
                    .with_context(|| format!("key `source.password_file`: {}", file.display()))?;
                Ok(Some(Login::new(user, text.lines().next().unwrap_or_default())))
            }
            (Some(_), ..) => {
                bail!(
                    "the user is in `source.url`: leave out `source.user` and `source.password_file`"
                )
            }
            (None, ..) => bail!("give both `source.user` and `source.password_file`"),
        }
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
