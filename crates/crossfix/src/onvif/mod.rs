//! Network cameras by ONVIF: their names, their streams, and their mounts.

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

/// A camera that does not answer within this time counts as absent. With half of it those that
/// take two seconds for an answer would be.
const ANSWERS_WITHIN: Duration = Duration::from_secs(3);
/// Most characters of a camera's own text that are shown. With half as many a long fault loses its
/// end.
const MOST_LETTERS: usize = 200;

/// A camera that has answered what services it has.
struct Device {
    client: OnvifClient,
    /// Its media service.
    media: Option<Url>,
    /// The service of its mount (PTZ).
    head: Option<Url>,
    address: Url,
}

/// What a camera is and has.
#[derive(Debug, serde::Serialize)]
pub struct Described {
    /// Maker and model.
    pub name: String,
    /// Its pictures.
    pub streams: Vec<OfferedStream>,
    /// Pan and tilt that its mount reports, each from -1 to 1, if it has one that reports them.
    pub position: Option<[f32; 2]>,
}

/// One of the streams that a camera offers.
#[derive(Debug, PartialEq, serde::Serialize)]
pub struct OfferedStream {
    /// The camera's name of the stream's profile.
    pub profile: String,
    pub url: String,
}

/// Runs a future to its end on this thread.
fn wait<T>(what: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    runtime()?.block_on(what)
}

fn runtime() -> anyhow::Result<Runtime> {
    let built = tokio::runtime::Builder::new_current_thread().enable_all().build();
    built.context("cannot begin to ask cameras")
}

/// The device services of the cameras that answer on this host's networks, each with its name.
///
/// # Errors
/// If the query cannot be sent.
pub fn cameras(answered_within: Duration) -> anyhow::Result<Vec<(String, String)>> {
    /// Beginning of the scope that holds a camera's name, by the ONVIF core specification.
    const NAME: &str = "onvif://www.onvif.org/name/";
    let found = wait(async { Ok(oxvif::discovery::probe_result(answered_within).await?) })?;
    let named = found.into_iter().filter_map(|device| {
        let scope = device.scopes.iter().find_map(|scope| scope.strip_prefix(NAME));
        let name = scope.unwrap_or("without a name").replace("%20", " ");
        Some((printable(device.xaddrs.first()?), printable(&name)))
    });
    Ok(named.collect())
}

/// A camera's description of itself.
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
            streams.push(OfferedStream {
                profile: printable(&profile.name),
                url: printable(&address),
            });
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
    /// Asks a camera what services it has.
    async fn connect(address: &Url, login: Option<&Login>) -> anyhow::Result<Self> {
        let named = !address.username().is_empty() || address.password().is_some();
        ensure!(!named, "who asks does not belong into its address, which is shown");
        let mut client =
            OnvifClient::new(address.as_str()).with_transport(Arc::new(ToCamera::new(login)?));
        if let Some(login) = login {
            // The login's proof includes the time by the camera's clock.
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

    /// The mount's service, and the profile to name in requests to it.
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

/// A service's address as it is reached from here: cameras state addresses that are valid in their
/// own network, and the login must not be sent to any other host.
fn reached(service: &str, address: &Url) -> Option<Url> {
    let mut service = Url::parse(service).ok()?;
    service.set_scheme(address.scheme()).ok()?;
    service.set_host(address.host_str()).ok()?;
    service.set_port(address.port()).ok()?;
    Some(service)
}

/// A camera's answer, if it comes in time; if it refuses, an error with its own words.
async fn answered<T>(asked: impl Future<Output = Result<T, OnvifError>>) -> anyhow::Result<T> {
    match tokio::time::timeout(ANSWERS_WITHIN, asked).await {
        Ok(Ok(answer)) => Ok(answer),
        Ok(Err(error)) => Err(anyhow!("{}", printable(&error.to_string()))),
        Err(_) => bail!("it does not answer within {} s", ANSWERS_WITHIN.as_secs()),
    }
}

/// The beginning of a camera's text, in one line.
fn printable(text: &str) -> String {
    let shown = text.chars().map(|letter| if letter.is_control() { ' ' } else { letter });
    shown.take(MOST_LETTERS).collect()
}
