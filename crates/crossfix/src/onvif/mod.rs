//! Network cameras by ONVIF: what they are called, where their streams are, and what turns them.

mod head;
#[cfg(test)]
mod stub;
mod transport;

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, anyhow, bail, ensure};
use crossfix_video::Login;
use oxvif::{OnvifClient, OnvifError};
use tokio::runtime::Runtime;
use url::Url;

pub use head::OnvifMount;
use transport::ToCamera;

/// A camera answers within this, or it is not there, s.
const ANSWERS_WITHIN: Duration = Duration::from_secs(3);
/// Of a camera's own words so many letters are shown.
const MOST_LETTERS: usize = 200;

/// A camera that has been asked what it is.
struct Device {
    client: OnvifClient,
    /// Its media service.
    media: Option<Url>,
    /// The service of what turns it.
    head: Option<Url>,
    address: Url,
}

/// What a camera is and has.
#[derive(Debug, serde::Serialize)]
pub struct Described {
    /// Maker and model.
    pub name: String,
    /// Its pictures.
    pub streams: Vec<Stream>,
    /// Where its mount says that it points, pan and tilt from -1 to 1, if it has one that says it.
    pub position: Option<[f32; 2]>,
}

/// One of the ways in which a camera shows its pictures.
#[derive(Debug, PartialEq, serde::Serialize)]
pub struct Stream {
    /// What the camera calls it.
    pub profile: String,
    pub url: String,
}

/// Lets a future end on this thread.
fn wait<T>(what: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    runtime()?.block_on(what)
}

fn runtime() -> anyhow::Result<Runtime> {
    let built = tokio::runtime::Builder::new_current_thread().enable_all().build();
    built.context("cannot begin to ask cameras")
}

/// The device services of cameras that answer on this host's networks, each with its name.
///
/// # Errors
/// If nobody can be asked.
pub fn cameras(answered_within: Duration) -> anyhow::Result<Vec<(String, String)>> {
    const NAME: &str = "onvif://www.onvif.org/name/";
    let found = wait(async { Ok(oxvif::discovery::probe_result(answered_within).await?) })?;
    let named = found.into_iter().filter_map(|device| {
        let scope = device.scopes.iter().find_map(|scope| scope.strip_prefix(NAME));
        let name = scope.unwrap_or("without a name").replace("%20", " ");
        Some((printable(device.xaddrs.first()?), printable(&name)))
    });
    Ok(named.collect())
}

/// What a camera says of itself.
///
/// # Errors
/// If it does not answer, or refuses.
pub fn describe(address: &Url, login: Option<&Login>) -> anyhow::Result<Described> {
    wait(async {
        let device = Device::connect(address, login).await?;
        let info = answered(device.client.get_device_info()).await?;
        let mut streams = Vec::new();
        let media = device.media.as_ref().context("it has no pictures")?;
        for profile in answered(device.client.get_profiles(media.as_str())).await? {
            let asked = device.client.get_stream_uri(media.as_str(), &profile.token);
            let address = answered(asked).await?.uri;
            streams.push(Stream { profile: printable(&profile.name), url: printable(&address) });
        }
        let position = match device.profile_of_head().await {
            Ok((head, profile)) => {
                let status =
                    answered(device.client.ptz_get_status(head.as_str(), &profile)).await?;
                status.pan.zip(status.tilt).map(|(pan, tilt)| [pan, tilt])
            }
            Err(_) => None,
        };
        let name = printable(&format!("{} {}", info.manufacturer, info.model));
        Ok(Described { name, streams, position })
    })
}

impl Device {
    /// Asks a camera what it is.
    async fn connect(address: &Url, login: Option<&Login>) -> anyhow::Result<Self> {
        let named = !address.username().is_empty() || address.password().is_some();
        ensure!(!named, "who asks does not belong into its address, which is shown");
        let mut client =
            OnvifClient::new(address.as_str()).with_transport(Arc::new(ToCamera::new(login)?));
        if let Some(login) = login {
            // Who asks is proved with the time, by the camera's clock.
            let ahead_s = match answered(client.get_system_date_and_time()).await {
                Ok(time) => time.utc_offset_secs(),
                Err(error) => return Err(error.context("it does not say what time it has")),
            };
            client =
                client.with_credentials(login.user(), login.password()).with_utc_offset(ahead_s);
        }
        let services = answered(client.get_capabilities()).await?;
        let reached = |service: Option<String>| reached(&service?, address);
        let (media, head) = (reached(services.media.url), reached(services.ptz.url));
        Ok(Self { client, media, head, address: address.clone() })
    }

    /// The service that turns it, and the profile by which it is asked.
    async fn profile_of_head(&self) -> anyhow::Result<(Url, String)> {
        let (Some(head), Some(media)) = (&self.head, &self.media) else {
            bail!("nothing turns the camera at {}", self.address);
        };
        let profiles = answered(self.client.get_profiles(media.as_str())).await?;
        let turned = profiles.into_iter().find(|profile| profile.ptz_config_token.is_some());
        let turned = turned.context("none of its profiles is of something that turns")?;
        Ok((head.clone(), turned.token))
    }
}

/// A service as it is reached from here: cameras say addresses that are true where they are, and who
/// asks is to be told to no other host.
fn reached(service: &str, address: &Url) -> Option<Url> {
    let mut service = Url::parse(service).ok()?;
    service.set_scheme(address.scheme()).ok()?;
    service.set_host(address.host_str()).ok()?;
    service.set_port(address.port()).ok()?;
    Some(service)
}

/// What a camera answers in time, with its own words where it refuses.
async fn answered<T>(asked: impl Future<Output = Result<T, OnvifError>>) -> anyhow::Result<T> {
    match tokio::time::timeout(ANSWERS_WITHIN, asked).await {
        Ok(Ok(answer)) => Ok(answer),
        Ok(Err(error)) => Err(anyhow!("{}", printable(&error.to_string()))),
        Err(_) => bail!("it does not answer within {} s", ANSWERS_WITHIN.as_secs()),
    }
}

/// The beginning of what a camera says, in one line.
fn printable(text: &str) -> String {
    let shown = text.chars().map(|letter| if letter.is_control() { ' ' } else { letter });
    shown.take(MOST_LETTERS).collect()
}
