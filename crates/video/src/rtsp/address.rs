use std::fmt;

use percent_encoding::percent_decode_str;
use url::Url;

use crate::VideoError;

/// Address of a network camera's stream (RTSP), without user and password.
#[derive(Clone, PartialEq, Eq)]
pub struct StreamAddress(Url);

/// User and password for a camera. The password is never displayed.
#[derive(Clone, PartialEq, Eq)]
pub struct Login {
    user: String,
    password: String,
}

impl Login {
    /// A user with a password.
    pub fn new(user: impl Into<String>, password: impl Into<String>) -> Self {
        Self { user: user.into(), password: password.into() }
    }

    /// The user's name.
    pub fn user(&self) -> &str {
        &self.user
    }

    /// The password, to be sent to the camera alone.
    pub fn password(&self) -> &str {
        &self.password
    }
}

impl fmt::Debug for Login {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Login").field("user", &self.user).finish_non_exhaustive()
    }
}

impl StreamAddress {
    /// Reads `rtsp://HOST[:PORT]/PATH`; a user and a password before the host are split off.
    ///
    /// # Errors
    /// [`VideoError::Address`] if the text is not such an address.
    pub fn parse(text: &str) -> Result<(Self, Option<Login>), VideoError> {
        let wrong = |what: &str| VideoError::Address { what: what.to_owned() };
        let mut url = Url::parse(text).map_err(|error| wrong(&error.to_string()))?;
        if url.scheme() != "rtsp" {
            return Err(wrong("it does not begin with rtsp://"));
        }
        if url.host_str().is_none_or(str::is_empty) {
            return Err(wrong("it names no host"));
        }
        let decoded = |part: &str| percent_decode_str(part).decode_utf8_lossy().into_owned();
        let login = (!url.username().is_empty()).then(|| {
            Login::new(decoded(url.username()), decoded(url.password().unwrap_or_default()))
        });
        // Neither call fails for an address with a host.
        let _ = url.set_username("");
        let _ = url.set_password(None);
        Ok((Self(url), login))
    }

    pub(crate) fn url(&self) -> &Url {
        &self.0
    }
}

impl fmt::Display for StreamAddress {
    /// Leaves out what follows a `?`, and a path that holds a password: some makes want it there.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut url = self.0.clone();
        let path = url.path().to_ascii_lowercase();
        if ["pass", "pwd"].iter().any(|word| path.contains(word)) {
            url.set_path("...");
        }
        if url.query().is_some() {
            url.set_query(Some("..."));
        }
        write!(f, "{url}")
    }
}

impl fmt::Debug for StreamAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "StreamAddress({self})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_asks_is_taken_out_of_the_address_and_shown_nowhere() {
        let (address, login) =
            StreamAddress::parse("rtsp://admin:p%40ss@10.0.0.5:8554/live?password=hunter2")
                .unwrap();
        assert_eq!(address.url().as_str(), "rtsp://10.0.0.5:8554/live?password=hunter2");
        assert_eq!(login, Some(Login::new("admin", "p@ss")));
        let shown = format!("{address} {address:?} {login:?}");
        assert!(!shown.contains("p@ss") && !shown.contains("p%40") && !shown.contains("hunter2"));
        assert!(shown.contains("rtsp://10.0.0.5:8554/live?..."), "{shown}");
        let (address, _) =
            StreamAddress::parse("rtsp://h/user=a&password=hunter2&channel=1").unwrap();
        assert_eq!(address.to_string(), "rtsp://h/...");
        for wrong in ["", "10.0.0.5/live", "http://10.0.0.5/", "rtsp:///live"] {
            assert!(StreamAddress::parse(wrong).is_err(), "{wrong}");
        }
    }
}
