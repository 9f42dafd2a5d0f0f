//! Which component of a site a certificate is of.

use std::fmt;
use std::str::FromStr;

use crossfix_message::{CameraName, NameError};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Which component of a site a certificate is of. Its text is the certificate's common name and the
/// name of its files: `camera-north`, `fusion`, `recorder`, `router`, `viewer`.
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
    /// A camera's agent: says what its camera sees, and hears the fusion centre.
    Camera(CameraName),
    /// The fusion centre: hears all, says the tracks.
    Fusion,
    /// The recorder: hears all, says how it does.
    Recorder,
    /// A Zenoh router: carries everything, and holds the others to what each may say.
    Router,
    /// Whoever looks on (`view`, `status`, `outlet`): hears all, says nothing.
    Viewer,
}

/// Why a text names no component.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum IdentityError {
    /// None of the components.
    #[error("`{0}` is none of camera-NAME, fusion, recorder, router, viewer")]
    Unknown(String),
    /// An impossible camera.
    #[error("`{text}` names an impossible camera")]
    Camera {
        /// The text.
        text: String,
        /// What is wrong with the name.
        #[source]
        source: NameError,
    },
}

/// What precedes a camera's name, so that a camera may be called `viewer`.
const CAMERA: &str = "camera-";

impl fmt::Display for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Camera(name) => write!(f, "{CAMERA}{name}"),
            Self::Fusion => f.write_str("fusion"),
            Self::Recorder => f.write_str("recorder"),
            Self::Router => f.write_str("router"),
            Self::Viewer => f.write_str("viewer"),
        }
    }
}

impl FromStr for Identity {
    type Err = IdentityError;

    fn from_str(text: &str) -> Result<Self, IdentityError> {
        if let Some(name) = text.strip_prefix(CAMERA) {
            let camera = name.parse();
            return camera
                .map(Self::Camera)
                .map_err(|source| IdentityError::Camera { text: text.to_owned(), source });
        }
        match text {
            "fusion" => Ok(Self::Fusion),
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
