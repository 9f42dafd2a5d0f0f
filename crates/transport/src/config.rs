use std::collections::BTreeMap;

use crossfix_message::{CameraName, SiteName};
use serde::{Deserialize, Serialize};
use thiserror::Error;

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
    /// The fusion centre's endpoint, e.g. `tcp/127.0.0.1:7450`.
    pub fusion: String,
    /// Each camera's endpoint.
    pub cameras: BTreeMap<CameraName, String>,
}

/// What is wrong with a network's configuration.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum NetworkError {
    /// An endpoint that is none.
    #[error("the endpoint `{endpoint}` of `{of}` is not of the form tcp/HOST:PORT")]
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
}

/// What a session is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Role {
    /// A camera's agent.
    Camera(CameraName),
    /// The fusion centre.
    Fusion,
    /// A recorder, a viewer, a check: listens to nobody, hears everybody.
    Observer,
    /// Stands in for all cameras, and where it brings tracks too for the fusion centre: a replay.
    Cameras {
        /// Whether it stands in for the fusion centre as well.
        and_fusion: bool,
    },
}

fn is_endpoint(text: &str) -> bool {
    let Some((host, port)) = text.strip_prefix("tcp/").and_then(|rest| rest.rsplit_once(':'))
    else {
        return false;
    };
    !host.is_empty() && !host.contains('/') && port.parse::<u16>().is_ok_and(|port| port > 0)
}

impl NetworkConfig {
    /// Checks the endpoints.
    ///
    /// # Errors
    /// The first [`NetworkError`].
    pub fn validate(&self) -> Result<(), NetworkError> {
        if self.mode == Mode::Client && self.routers.is_empty() {
            return Err(NetworkError::NoRouter);
        }
        if let Some(router) = self.routers.iter().find(|router| !is_endpoint(router)) {
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
            if !is_endpoint(endpoint) {
                return Err(NetworkError::Endpoint { of, endpoint: endpoint.clone() });
            }
            if let Some(one) = seen.insert(endpoint, of.clone()) {
                return Err(NetworkError::Shared { one, other: of, endpoint: endpoint.clone() });
            }
        }
        Ok(())
    }

    /// Where a session listens and whom it connects to.
    pub(crate) fn endpoints(
        &self,
        role: &Role,
    ) -> Result<(Vec<String>, Vec<String>), NetworkError> {
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
            Role::Observer => {
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
    fn impossible_endpoints_are_named() {
        let mut bad = network();
        bad.fusion = "127.0.0.1:7450".into();
        assert!(matches!(bad.validate(), Err(NetworkError::Endpoint { of, .. }) if of == "fusion"));
        for endpoint in ["tcp/:7451", "tcp/a/b:7451", "udp/127.0.0.1:7451", "tcp/127.0.0.1:99999"] {
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
