use std::fmt;
use std::str::FromStr;

use thiserror::Error;

use crate::name::{FUSION, RECORDER, TRUTH};
use crate::{AreaName, CameraName, NameError, SiteName};

/// The kind of data that is published under a key, which determines its message type.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Channel {
    /// `<camera>/bearings`: [`crate::BearingFrame`].
    Bearings(CameraName),
    /// `<camera>/calibration`: [`crate::CameraCalibration`], on change and every two seconds.
    Calibration(CameraName),
    /// `<camera>/preview`: [`crate::Preview`], a few per second; some may be lost.
    Preview(CameraName),
    /// `<camera>/health`: [`crate::Health`], once a second.
    CameraHealth(CameraName),
    /// `<camera>/alive`: a liveliness token, no message.
    Alive(CameraName),
    /// `fusion/tracks`: [`crate::TrackFrame`].
    Tracks,
    /// `fusion/smoothed`: [`crate::TrackFrame`], each some time after that of `fusion/tracks`,
    /// improved by the bearings that have come since.
    Smoothed,
    /// `fusion/events`: [`crate::TrackEvent`].
    Events,
    /// `fusion/cues`: [`crate::CueFrame`], what each camera that takes cues should search for.
    Cues,
    /// `fusion/health`: [`crate::Health`], once a second.
    FusionHealth,
    /// `fusion/alive`: a liveliness token, no message.
    FusionAlive,
    /// `truth/states`: [`crate::TruthFrame`].
    Truth,
    /// `recorder/health`: [`crate::Health`], once a second.
    RecorderHealth,
    /// `recorder/alive`: a liveliness token, no message.
    RecorderAlive,
}

/// A key expression of Crossfix: `crossfix/<site>/<component>/<kind>`, and where a site has several
/// fusion centres `crossfix/<site>/fusion/<area>/<kind>` for each of them.
///
/// ```
/// use crossfix_message::{Channel, Key};
/// let key: Key = "crossfix/airfield/north/bearings".parse()?;
/// assert_eq!(key.channel, Channel::Bearings("north".parse()?));
/// assert_eq!(key.to_string(), "crossfix/airfield/north/bearings");
/// let of_an_area: Key = "crossfix/airfield/fusion/west/tracks".parse()?;
/// assert_eq!((of_an_area.area, of_an_area.channel), (Some("west".parse()?), Channel::Tracks));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key {
    /// The site.
    pub site: SiteName,
    /// The area whose fusion centre it belongs to; `None` if the site has only one fusion centre,
    /// and for keys that are not a fusion centre's.
    pub area: Option<AreaName>,
    /// The component and kind.
    pub channel: Channel,
}

/// Why a text is not a key of Crossfix.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum KeyError {
    /// Not of the form `crossfix/<site>/<component>/<kind>`.
    #[error("`{0}` is not of the form crossfix/<site>/<component>/<kind>")]
    Form(String),
    /// An impossible name of a site, area or camera.
    #[error("`{key}` holds an impossible name")]
    Name {
        /// The text.
        key: String,
        /// What is wrong with the name.
        #[source]
        source: NameError,
    },
}

impl Channel {
    /// The camera whose channel it is, if it is a camera's.
    pub fn camera(&self) -> Option<&CameraName> {
        match self {
            Self::Bearings(camera)
            | Self::Calibration(camera)
            | Self::Preview(camera)
            | Self::CameraHealth(camera)
            | Self::Alive(camera) => Some(camera),
            _ => None,
        }
    }
}

impl Key {
    /// The key of a channel of a site.
    pub fn new(site: SiteName, channel: Channel) -> Self {
        Self { site, area: None, channel }
    }

    /// The key of a channel of a fusion centre: of an area's, or of the only one of a site.
    pub fn of_centre(site: SiteName, area: Option<AreaName>, channel: Channel) -> Self {
        Self { site, area, channel }
    }

    /// The key expression that matches everything of a site.
    pub fn everything_of(site: &SiteName) -> String {
        format!("crossfix/{site}/**")
    }

    /// The key expression that matches one kind of channel of all cameras of a site.
    ///
    /// `kind` is the last part of a key: `bearings`, `calibration`, `preview`, `health`, `alive`.
    pub fn of_all_cameras(site: &SiteName, kind: &str) -> String {
        format!("crossfix/{site}/*/{kind}")
    }

    /// The key expression that matches one kind of channel of the fusion centres of a site's areas.
    /// That of a site without areas is matched by [`Self::of_all_cameras`].
    pub fn of_all_areas(site: &SiteName, kind: &str) -> String {
        format!("crossfix/{site}/{FUSION}/*/{kind}")
    }

    /// The key expression that matches one kind of channel of all fusion centres of a site.
    ///
    /// `kind` is the last part of a key: `tracks`, `smoothed`, `events`, `cues`, `health`, `alive`.
    pub fn of_all_centres(site: &SiteName, kind: &str) -> String {
        format!("crossfix/{site}/{FUSION}/**/{kind}")
    }

    /// Writes the end of the key of a fusion centre's channel.
    fn write_of_centre(&self, f: &mut fmt::Formatter<'_>, kind: &str) -> fmt::Result {
        match &self.area {
            None => write!(f, "{FUSION}/{kind}"),
            Some(area) => write!(f, "{FUSION}/{area}/{kind}"),
        }
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "crossfix/{}/", self.site)?;
        match &self.channel {
            Channel::Bearings(camera) => write!(f, "{camera}/bearings"),
            Channel::Calibration(camera) => write!(f, "{camera}/calibration"),
            Channel::Preview(camera) => write!(f, "{camera}/preview"),
            Channel::CameraHealth(camera) => write!(f, "{camera}/health"),
            Channel::Alive(camera) => write!(f, "{camera}/alive"),
            Channel::Tracks => self.write_of_centre(f, "tracks"),
            Channel::Smoothed => self.write_of_centre(f, "smoothed"),
            Channel::Events => self.write_of_centre(f, "events"),
            Channel::Cues => self.write_of_centre(f, "cues"),
            Channel::FusionHealth => self.write_of_centre(f, "health"),
            Channel::FusionAlive => self.write_of_centre(f, "alive"),
            Channel::Truth => write!(f, "{TRUTH}/states"),
            Channel::RecorderHealth => write!(f, "{RECORDER}/health"),
            Channel::RecorderAlive => write!(f, "{RECORDER}/alive"),
        }
    }
}

impl FromStr for Key {
    type Err = KeyError;

    fn from_str(text: &str) -> Result<Self, KeyError> {
        let form = || KeyError::Form(text.to_owned());
        let name = |source| KeyError::Name { key: text.to_owned(), source };
        let parts: Vec<&str> = text.split('/').collect();
        let (site, component, area, kind) = match parts[..] {
            ["crossfix", site, component, kind] => (site, component, None, kind),
            ["crossfix", site, FUSION, area, kind] => (site, FUSION, Some(area), kind),
            _ => return Err(form()),
        };
        let camera = || component.parse::<CameraName>().map_err(name);
        let channel = match (component, kind) {
            (FUSION, "tracks") => Channel::Tracks,
            (FUSION, "smoothed") => Channel::Smoothed,
            (FUSION, "events") => Channel::Events,
            (FUSION, "cues") => Channel::Cues,
            (FUSION, "health") => Channel::FusionHealth,
            (FUSION, "alive") => Channel::FusionAlive,
            (TRUTH, "states") => Channel::Truth,
            (RECORDER, "health") => Channel::RecorderHealth,
            (RECORDER, "alive") => Channel::RecorderAlive,
            (FUSION, _) => return Err(form()),
            (_, "bearings") => Channel::Bearings(camera()?),
            (_, "calibration") => Channel::Calibration(camera()?),
            (_, "preview") => Channel::Preview(camera()?),
            (_, "health") => Channel::CameraHealth(camera()?),
            (_, "alive") => Channel::Alive(camera()?),
            _ => return Err(form()),
        };
        let area = area.map(str::parse).transpose().map_err(name)?;
        Ok(Self { site: site.parse().map_err(name)?, area, channel })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn channels() -> impl Strategy<Value = Channel> {
        let camera = "[A-Za-z0-9_-]{1,64}"
            .prop_filter_map("reserved", |text| text.parse::<CameraName>().ok());
        prop_oneof![
            camera.clone().prop_map(Channel::Bearings),
            camera.clone().prop_map(Channel::Calibration),
            camera.clone().prop_map(Channel::Preview),
            camera.clone().prop_map(Channel::CameraHealth),
            camera.prop_map(Channel::Alive),
            Just(Channel::Tracks),
            Just(Channel::Smoothed),
            Just(Channel::Events),
            Just(Channel::Cues),
            Just(Channel::FusionHealth),
            Just(Channel::FusionAlive),
            Just(Channel::Truth),
            Just(Channel::RecorderHealth),
            Just(Channel::RecorderAlive),
        ]
    }

    proptest! {
        #[test]
        fn a_key_survives_its_text(
            channel in channels(),
            site in "[a-z0-9]{1,10}",
            area in proptest::option::of("[a-z]{1,10}"),
        ) {
            let site: SiteName = site.parse()?;
            let key = Key::new(site.clone(), channel.clone());
            let text = key.to_string();
            prop_assert_eq!(text.parse::<Key>()?, key);
            let area: Option<AreaName> = area.map(|area| area.parse()).transpose()?;
            if text.contains("/fusion/") {
                let key = Key::of_centre(site, area, channel);
                prop_assert_eq!(key.to_string().parse::<Key>()?, key);
            }
        }

        #[test]
        fn any_text_is_a_key_or_an_error(text in ".{0,80}") {
            let _ = text.parse::<Key>();
        }
    }
}
