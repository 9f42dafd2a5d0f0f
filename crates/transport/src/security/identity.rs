//! The component of a site that a certificate belongs to.

use std::fmt;
use std::str::FromStr;

use crossfix_message::{AreaName, CameraName, NameError};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// The component of a site that a certificate belongs to. Its text is the certificate's common name
/// and the name of its files: `camera-north`, `fusion` or `fusion-west`, `recorder`, `router`,
/// `viewer`.
///
/// ```
/// use crossfix_transport::Identity;
/// let north: Identity = "camera-north".parse()?;
/// assert_eq!(north, Identity::Camera("north".parse()?));
/// assert_eq!(north.to_string(), "camera-north");
/// assert!("somebody".parse::<Identity>().is_err());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Identity {
    /// A camera's agent: publishes what its camera sees, and receives what the fusion centre sends.
    Camera(CameraName),
    /// The fusion centre, an area's or the only one: receives everything, publishes the tracks.
    Fusion(Option<AreaName>),
    /// The recorder: receives everything, publishes its health.
    Recorder,
    /// A Zenoh router: carries everything, and enforces what each other component may publish.
    Router,
    /// An observer (`view`, `status`, `outlet`): receives everything, publishes nothing.
    Viewer,
}

/// Why a text is not an identity.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum IdentityError {
    /// It names none of the components.
    #[error("`{0}` is none of camera-NAME, fusion, fusion-AREA, recorder, router, viewer")]
    Unknown(String),
    /// It names an impossible camera or area.
    #[error("`{text}` names an impossible component")]
    Name {
        /// The text.
        text: String,
        /// What is wrong with the camera's or the area's name.
        #[source]
        source: NameError,
    },
}

/// Prefix of a camera's name, so that a camera may be called `viewer`.
const CAMERA: &str = "camera-";
/// Prefix of an area's name.
const CENTRE: &str = "fusion-";

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Camera(name) => write!(f, "{CAMERA}{name}"),
            Self::Fusion(None) => f.write_str("fusion"),
            Self::Fusion(Some(area)) => write!(f, "{CENTRE}{area}"),
            Self::Recorder => f.write_str("recorder"),
            Self::Router => f.write_str("router"),
            Self::Viewer => f.write_str("viewer"),
        }
    }
}

impl FromStr for Identity {
    type Err = IdentityError;

    fn from_str(text: &str) -> Result<Self, IdentityError> {
        let impossible = |source| IdentityError::Name { text: text.to_owned(), source };
        if let Some(name) = text.strip_prefix(CAMERA) {
            return name.parse().map(Self::Camera).map_err(impossible);
        }
        if let Some(area) = text.strip_prefix(CENTRE) {
            return area.parse().map(|area| Self::Fusion(Some(area))).map_err(impossible);
        }
        match text {
            "fusion" => Ok(Self::Fusion(None)),
            "recorder" => Ok(Self::Recorder),
            "router" => Ok(Self::Router),
            "viewer" => Ok(Self::Viewer),
            _ => Err(IdentityError::Unknown(text.to_owned())),
        }
    }
}

impl TryFrom<String> for Identity {
    type Error = IdentityError;

    fn try_from(text: String) -> Result<Self, IdentityError> {
        text.parse()
    }
}

impl From<Identity> for String {
    fn from(identity: Identity) -> Self {
        identity.to_string()
    }
}
