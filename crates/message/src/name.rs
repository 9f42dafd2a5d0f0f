use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// The component name of the fusion centre in key expressions, where cameras have their names.
pub(crate) const FUSION: &str = "fusion";
/// The component name under which ground truth is published.
pub(crate) const TRUTH: &str = "truth";
/// The component name of the recorder.
pub(crate) const RECORDER: &str = "recorder";

/// Why a text is not a name.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum NameError {
    /// Nothing, or more than 64 bytes.
    #[error("a name has 1 to 64 characters, `{0}` has {len}", len = .0.len())]
    Length(String),
    /// A character that has a meaning in key expressions or file names.
    #[error("`{name}` holds `{character}`: a name has letters, digits, `_` and `-` only")]
    Character {
        /// The text.
        name: String,
        /// The first character that does not belong.
        character: char,
    },
    /// A name that is reserved for Crossfix itself.
    #[error("`{0}` is kept for Crossfix itself: choose another name")]
    Reserved(String),
}

fn check(text: &str) -> Result<(), NameError> {
    if text.is_empty() || text.len() > 64 {
        return Err(NameError::Length(text.to_owned()));
    }
    let belongs = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    match text.chars().find(|&c| !belongs(c)) {
        Some(character) => Err(NameError::Character { name: text.to_owned(), character }),
        None => Ok(()),
    }
}

macro_rules! name_type {
    ($(#[$doc:meta])* $name:ident, $reserved:expr) => {
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(Arc<str>);

        impl $name {
            /// The name as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $name {
            type Err = NameError;

            fn from_str(text: &str) -> Result<Self, NameError> {
                check(text)?;
                let reserved: &[&str] = &$reserved;
                if reserved.contains(&text) {
                    return Err(NameError::Reserved(text.to_owned()));
                }
                Ok(Self(text.into()))
            }
        }

        impl TryFrom<String> for $name {
            type Error = NameError;

            fn try_from(text: String) -> Result<Self, NameError> {
                text.parse()
            }
        }

        impl From<$name> for String {
            fn from(name: $name) -> Self {
                name.0.as_ref().to_owned()
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }
    };
}

name_type!(
    /// The name of a camera, unique within its site.
    ///
    /// ```
    /// use crossfix_message::CameraName;
    /// assert!("north-2".parse::<CameraName>().is_ok());
    /// assert!("north/2".parse::<CameraName>().is_err());
    /// assert!("fusion".parse::<CameraName>().is_err());
    /// ```
    CameraName,
    [FUSION, RECORDER, TRUTH]
);
name_type!(
    /// The name of a site: a set of cameras and everything that is derived from them.
    SiteName,
    []
);
name_type!(
    /// The name of an area: a part of a site that has a fusion centre of its own.
    AreaName,
    []
);
