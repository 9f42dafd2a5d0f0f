use std::collections::BTreeMap;
use std::net::IpAddr;

use crossfix_message::{CameraName, SiteName};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::security::{Identity, Security};

/// Who connects to whom.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// Everybody to those who are listed before him.
    #[default]
    Peer,
    /// Everybody to a Zenoh router.
    Client,
}

/// Where on the Earth the origin of a site's axes (east, north, up) is: WGS84.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Anchor {
    /// Degrees north, -90 to 90.
    pub latitude_deg: f64,
    /// Degrees east, -180 to 180.
    pub longitude_deg: f64,
    /// Metres above the ellipsoid: what a GNSS receiver says plus its geoid height, if it says heights
    /// above the sea.
    pub height_m: f64,
}

/// The network of a site: a name and the endpoints of all components.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Name of the site, part of every key.
    pub site: SiteName,
    /// `peer` (default) or `client`.
    #[serde(default)]
    pub mode: Mode,
    /// Endpoints of Zenoh routers, with `mode = "client"`, e.g. `tcp/10.0.0.1:7447`.
    #[serde(default)]
    pub routers: Vec<String>,
    /// `true`: components listen beyond their own host although nothing is encrypted and anybody may
    /// say anything. Without it and without `[security]` they listen on loopback only.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unsecured: bool,
    /// The fusion centre's endpoint, e.g. `tcp/127.0.0.1:7450`.
    pub fusion: String,
    /// Each camera's endpoint.
    pub cameras: BTreeMap<CameraName, String>,
    /// Where on the Earth the site is: what tells others where its targets are needs it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub anchor: Option<Anchor>,
    /// Certificates: with them every link is mutual TLS, also where its endpoint says `tcp/`, and
    /// each component may say only what is its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security: Option<Security>,
}

/// What is wrong with a network's configuration.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum NetworkError {
    /// An endpoint that is none.
    #[error(
        "the endpoint `{endpoint}` of `{of}` is not of the form tcp/HOST:PORT, nor tls/HOST:PORT with [security]"
    )]
    Endpoint {
        /// Whose.
        of: String,
        /// What it is.
        endpoint: String,
    },
    /// Two components on one endpoint.
    #[error("`{one}` and `{other}` have the same endpoint `{endpoint}`")]
    Shared {
        /// The first.
        one: String,
        /// The second.
        other: String,
        /// Theirs.
        endpoint: String,
    },
    /// A client without a router.
    #[error("mode = \"client\" needs at least one endpoint in `routers`")]
    NoRouter,
    /// A camera that the network does not know.
    #[error("camera `{0}` has no endpoint: add it to [cameras] of the network file")]
    UnknownCamera(CameraName),
    /// Anybody could say anything.
    #[error(
        "{0} can be reached from other hosts, and the network has no [security]: anybody there could \
         add cameras and tracks. Run `crossfix enroll`, or set `unsecured = true` in the network file"
    )]
    Unsecured(String),
    /// A replay into a secured network.
    #[error(
        "a replay stands in for all cameras, which a network with [security] takes from nobody: \
         replay into a network of its own"
    )]
    NobodysIdentity,
}

/// What a session is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Role {
    /// A camera's agent.
    Camera(CameraName),
    /// The fusion centre.
    Fusion,
    /// A recorder: listens nowhere, hears everybody, says how it does.
    Recorder,
    /// A viewer, a status, an outlet: listens nowhere, hears everybody, says nothing.
    Observer,
    /// A Zenoh router that listens at some endpoints: carries everybody's messages.
    Router {
        /// Where it listens.
        listen: Vec<String>,
    },
    /// Stands in for all cameras, and where it brings tracks too for the fusion centre: a replay.
    Cameras {
        /// Whether it stands in for the fusion centre as well.
        and_fusion: bool,
    },
}

/// The host and the port of an endpoint: what follows `tcp/` or `tls/`.
///
/// ```
/// assert_eq!(crossfix_transport::address("tcp/10.0.0.1:7450"), "10.0.0.1:7450");
/// ```
pub fn address(endpoint: &str) -> &str {
    endpoint.split_once('/').map_or(endpoint, |(_, address)| address)
}

/// The host of an endpoint, without the brackets of an IPv6 address.
pub fn host_of(endpoint: &str) -> &str {
    let address = address(endpoint);
    address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']'])
}

/// Whether an endpoint can be reached from this host alone.
fn is_loopback(endpoint: &str) -> bool {
    let host = host_of(endpoint);
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

impl Role {
    /// Whose certificate it shows; `None` of what stands in for several.
    pub fn identity(&self) -> Option<Identity> {
        match self {
            Self::Camera(name) => Some(Identity::Camera(name.clone())),
            Self::Fusion => Some(Identity::Fusion),
            Self::Recorder => Some(Identity::Recorder),
            Self::Observer => Some(Identity::Viewer),
            Self::Router { .. } => Some(Identity::Router),
            Self::Cameras { .. } => None,
        }
    }
}

impl NetworkConfig {
    /// Whether an endpoint is of a form that this network can have.
    fn is_endpoint(&self, text: &str) -> bool {
        let known =
            text.starts_with("tcp/") || (text.starts_with("tls/") && self.security.is_some());
        let Some((host, port)) = address(text).rsplit_once(':').filter(|_| known) else {
            return false;
        };
        // Behind a `#` or `?` Zenoh would take settings, such as to do without certificates.
        let is_host = |c: char| c.is_ascii_alphanumeric() || "-._:[]%".contains(c);
        let is_named = !host.is_empty() && host.chars().all(is_host);
        is_named && port.parse::<u16>().is_ok_and(|port| port > 0)
    }

    /// An endpoint as it is spoken: by TLS where there are certificates.
    fn spoken(&self, endpoint: &str) -> String {
        let protocol = if self.security.is_some() { "tls" } else { "tcp" };
        format!("{protocol}/{}", address(endpoint))
    }

    /// Checks that who listens is not there for everybody.
    fn check_reach(&self, listen: &[String]) -> Result<(), NetworkError> {
        if self.security.is_some() || self.unsecured {
            return Ok(());
        }
        match listen.iter().find(|endpoint| !is_loopback(endpoint)) {
            Some(endpoint) => Err(NetworkError::Unsecured(endpoint.clone())),
            None => Ok(()),
        }
    }

    /// Checks the endpoints.
    ///
    /// # Errors
    /// The first [`NetworkError`].
    pub fn validate(&self) -> Result<(), NetworkError> {
        if self.mode == Mode::Client && self.routers.is_empty() {
            return Err(NetworkError::NoRouter);
        }
        if let Some(router) = self.routers.iter().find(|router| !self.is_endpoint(router)) {
            return Err(NetworkError::Endpoint {
                of: "routers".to_owned(),
                endpoint: router.clone(),
            });
        }
        let mut seen: BTreeMap<&str, String> = BTreeMap::new();
        let fusion = std::iter::once(("fusion".to_owned(), &self.fusion));
        for (of, endpoint) in
            fusion.chain(self.cameras.iter().map(|(name, e)| (name.to_string(), e)))
        {
            if !self.is_endpoint(endpoint) {
                return Err(NetworkError::Endpoint { of, endpoint: endpoint.clone() });
            }
            if let Some(one) = seen.insert(endpoint, of.clone()) {
                return Err(NetworkError::Shared { one, other: of, endpoint: endpoint.clone() });
            }
        }
        Ok(())
    }

    /// The first endpoint beyond this host that a session connects to with nothing encrypted; `None`
    /// where there is none.
    pub fn unencrypted(&self, role: &Role) -> Option<String> {
        let (_, connect) = self.declared(role).ok().filter(|_| self.security.is_none())?;
        connect.into_iter().find(|endpoint| !is_loopback(endpoint))
    }

    /// Where a session listens and whom it connects to.
    pub(crate) fn endpoints(
        &self,
        role: &Role,
    ) -> Result<(Vec<String>, Vec<String>), NetworkError> {
        let (listen, connect) = self.declared(role)?;
        self.check_reach(&listen)?;
        let spoken =
            |endpoints: Vec<String>| endpoints.iter().map(|e| self.spoken(e)).collect::<Vec<_>>();
        Ok((spoken(listen), spoken(connect)))
    }

    /// The same as the file says them.
    fn declared(&self, role: &Role) -> Result<(Vec<String>, Vec<String>), NetworkError> {
        if let Role::Router { listen } = role {
            let others = self.routers.iter().filter(|router| !listen.contains(router));
            return Ok((listen.clone(), others.cloned().collect()));
        }
        if self.mode == Mode::Client {
            return Ok((Vec::new(), self.routers.clone()));
        }
        let cameras = || self.cameras.values().cloned().collect::<Vec<_>>();
        Ok(match role {
            Role::Camera(name) => {
                let own = self.cameras.get(name);
                (
                    vec![own.cloned().ok_or_else(|| NetworkError::UnknownCamera(name.clone()))?],
                    Vec::new(),
                )
            }
            Role::Fusion => (vec![self.fusion.clone()], cameras()),
            Role::Recorder | Role::Observer | Role::Router { .. } => {
                let mut all = cameras();
                all.push(self.fusion.clone());
                (Vec::new(), all)
            }
            Role::Cameras { and_fusion } => {
                let mut all = cameras();
                all.extend(and_fusion.then(|| self.fusion.clone()));
                (all, Vec::new())
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network() -> NetworkConfig {
        NetworkConfig {
            site: "field".parse().unwrap(),
            mode: Mode::Peer,
            routers: vec![],
            unsecured: false,
            security: None,
            anchor: None,
            fusion: "tcp/127.0.0.1:7450".into(),
            cameras: [("a", 7451), ("b", 7452)]
                .map(|(name, port)| (name.parse().unwrap(), format!("tcp/127.0.0.1:{port}")))
                .into(),
        }
    }

    #[test]
    fn every_pair_has_exactly_one_side_that_connects() {
        let network = network();
        let (listen, connect) = network.endpoints(&Role::Fusion).unwrap();
        assert_eq!((listen.len(), connect.len()), (1, 2));
        let (listen, connect) = network.endpoints(&Role::Observer).unwrap();
        assert_eq!((listen.len(), connect.len()), (0, 3));
        let unknown = Role::Camera("c".parse().unwrap());
        assert!(matches!(network.endpoints(&unknown), Err(NetworkError::UnknownCamera(_))));
    }

    #[test]
    fn who_listens_for_other_hosts_has_certificates_or_was_told_to_do_without() {
        let there = |network: &NetworkConfig| network.endpoints(&Role::Fusion).map(|(l, _)| l);
        let open = NetworkConfig { fusion: "tcp/10.0.0.1:7450".into(), ..network() };
        assert_eq!(there(&open), Err(NetworkError::Unsecured("tcp/10.0.0.1:7450".into())));
        assert!(open.endpoints(&Role::Observer).is_ok(), "who looks on listens nowhere");
        let told = NetworkConfig { unsecured: true, ..open.clone() };
        assert_eq!(there(&told), Ok(vec!["tcp/10.0.0.1:7450".to_owned()]));
        let security = Security { certificates: "c".into(), revoked: BTreeMap::new() };
        let secured = NetworkConfig { security: Some(security), ..open };
        assert_eq!(there(&secured), Ok(vec!["tls/10.0.0.1:7450".to_owned()]));
    }

    #[test]
    fn impossible_endpoints_are_named() {
        let mut bad = network();
        bad.fusion = "127.0.0.1:7450".into();
        assert!(matches!(bad.validate(), Err(NetworkError::Endpoint { of, .. }) if of == "fusion"));
        for endpoint in [
            "tcp/:7451",
            "tcp/a/b:7451",
            "tcp/a:1#iface=x;x=:2",
            "udp/127.0.0.1:7451",
            "tcp/127.0.0.1:99999",
        ] {
            let bad = NetworkConfig { fusion: endpoint.into(), ..network() };
            assert!(matches!(bad.validate(), Err(NetworkError::Endpoint { .. })), "{endpoint}");
            let bad = NetworkConfig { routers: vec![endpoint.into()], ..network() };
            assert!(matches!(bad.validate(), Err(NetworkError::Endpoint { .. })), "{endpoint}");
        }
        let mut shared = network();
        shared.fusion = "tcp/127.0.0.1:7451".into();
        assert!(matches!(shared.validate(), Err(NetworkError::Shared { .. })));
    }
}
