#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

use crossfix_message::{AreaName, CameraName, Channel, Key, SiteName};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::security::{Identity, Security};

/// Which components connect to which.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// Each component connects to those that are listed before it.
    #[default]
    Peer,
    /// Each component connects to a Zenoh router.
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
    /// Metres above the ellipsoid. For a GNSS receiver that gives heights above the sea, add its
    /// geoid height.
    pub height_m: f64,
}

/// A part of a site that has a fusion centre of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Area {
    /// The fusion centre's endpoint.
    pub fusion: String,
    /// The cameras that it uses. A camera that sees into two areas belongs to both: where it sees
    /// a target, the target is handed over from one area to the other.
    pub cameras: Vec<CameraName>,
}

impl Area {
    /// Whether it names fewer than two cameras, or one of them twice.
    fn has_too_few_cameras(&self) -> bool {
        let distinct: BTreeSet<&CameraName> = self.cameras.iter().collect();
        distinct.len() < self.cameras.len() || distinct.len() < 2
    }
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
    /// `true`: components listen beyond their own host although nothing is encrypted and anybody
    /// may publish anything. Without it and without `[security]` they listen on loopback only.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub unsecured: bool,
    /// The fusion centre's endpoint, e.g. `tcp/127.0.0.1:7450`; absent where there are `areas`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fusion: Option<String>,
    /// Each camera's endpoint.
    pub cameras: BTreeMap<CameraName, String>,
    /// The areas of a site that is too large for one fusion centre.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub areas: BTreeMap<AreaName, Area>,
    /// Where on Earth the site is; needed by outlets, which tell other programs where its targets
    /// are.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub anchor: Option<Anchor>,
    /// Certificates: with them every link is mutual TLS, even if its endpoint says `tcp/`, and each
    /// component may publish only its own messages.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub security: Option<Security>,
}

/// Errors in a network's configuration.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum NetworkError {
    /// An endpoint of a wrong form.
    #[error(
        "the endpoint `{endpoint}` of `{of}` is not of the form tcp/HOST:PORT, nor tls/HOST:PORT \
         with [security]"
    )]
    Endpoint {
        /// Whose endpoint.
        of: String,
        /// The endpoint.
        endpoint: String,
    },
    /// Two components on one endpoint.
    #[error("`{one}` and `{other}` have the same endpoint `{endpoint}`")]
    Shared {
        /// The first.
        one: String,
        /// The second.
        other: String,
        /// Their endpoint.
        endpoint: String,
    },
    /// A client without a router.
    #[error("mode = \"client\" needs at least one endpoint in `routers`")]
    NoRouter,
    /// A camera that the network does not know.
    #[error("camera `{0}` has no endpoint: add it to [cameras] of the network file")]
    UnknownCamera(CameraName),
    /// Neither `fusion` nor areas, or both.
    #[error("name the fusion centre's endpoint as `fusion`, or each area's in [areas], not both")]
    Centres,
    /// An area that the network does not know.
    #[error("the network has no area `{0}`: add it as [areas.{0}]")]
    UnknownArea(AreaName),
    /// It is not said which of several areas.
    #[error("the network has areas: say by `area` of the fusion centre's file which is its own")]
    WhichArea,
    /// An area's camera that the network does not know.
    #[error("camera `{camera}` of area `{area}` has no endpoint: add it to [cameras]")]
    CameraOfArea {
        /// The area.
        area: AreaName,
        /// The camera.
        camera: CameraName,
    },
    /// An area with fewer than two distinct cameras, which could place no target.
    #[error("area `{0}` needs two cameras or more, each named once: one alone places no target")]
    CamerasOfArea(AreaName),
    /// A camera that no fusion centre uses.
    #[error("camera `{0}` is in no area: nobody would hear it")]
    CameraOfNoArea(CameraName),
    /// Components would listen beyond their host although anybody could publish anything.
    #[error(
        "{0} can be reached from other hosts, and the network has no [security]: anybody there \
         could add cameras and tracks. Run `crossfix enroll`, or set `unsecured = true` in the \
         network file"
    )]
    Unsecured(String),
    /// A replay into a secured network.
    #[error(
        "a replay stands in for all cameras, which a network with [security] takes from nobody: \
         replay into a network of its own"
    )]
    NobodysIdentity,
}

/// The component that a session is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Role {
    /// A camera's agent.
    Camera(CameraName),
    /// The fusion centre: an area's, or the only one.
    Fusion(Option<AreaName>),
    /// A recorder: does not listen, receives everything, publishes its health.
    Recorder,
    /// A viewer, a status display or an outlet: does not listen, receives everything, publishes
    /// nothing.
    Observer,
    /// A Zenoh router, which listens at its own endpoints and carries all messages.
    Router {
        /// Where it listens.
        listen: Vec<String>,
    },
    /// A replay, which stands in for all cameras and, if it has tracks too, for the fusion centre.
    Cameras {
        /// Whether it stands in for the fusion centre as well.
        and_fusion: bool,
    },
}

/// The host and port of an endpoint: what follows `tcp/` or `tls/`.
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

/// Whether an endpoint can be reached from this host only.
fn is_loopback(endpoint: &str) -> bool {
    let host = host_of(endpoint);
    host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
}

impl Role {
    /// The identity whose certificate it shows; `None` if it stands in for several components.
    pub fn identity(&self) -> Option<Identity> {
        match self {
            Self::Camera(name) => Some(Identity::Camera(name.clone())),
            Self::Fusion(area) => Some(Identity::Fusion(area.clone())),
            Self::Recorder => Some(Identity::Recorder),
            Self::Observer => Some(Identity::Viewer),
            Self::Router { .. } => Some(Identity::Router),
            Self::Cameras { .. } => None,
        }
    }
}

impl NetworkConfig {
    /// Whether an endpoint has a form that is allowed in this network.
    fn is_endpoint(&self, text: &str) -> bool {
        let known =
            text.starts_with("tcp/") || (text.starts_with("tls/") && self.security.is_some());
        let Some((host, port)) = address(text).rsplit_once(':').filter(|_| known) else {
            return false;
        };
        // After a `#` or `?` Zenoh would read settings, such as one that turns certificates off.
        let is_host = |c: char| c.is_ascii_alphanumeric() || "-._:[]%".contains(c);
        let is_named = !host.is_empty() && host.chars().all(is_host);
        is_named && port.parse::<u16>().is_ok_and(|port| port > 0)
    }

    /// An endpoint with the protocol that is used: TLS if there are certificates.
    fn spoken(&self, endpoint: &str) -> String {
        let protocol = if self.security.is_some() { "tls" } else { "tcp" };
        format!("{protocol}/{}", address(endpoint))
    }

    /// Checks that an unsecured component does not listen beyond its host.
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
        self.validate_areas()?;
        let mut seen: BTreeMap<&str, String> = BTreeMap::new();
        let centres = self.centres().map(|(area, e)| (Identity::Fusion(area).to_string(), e));
        for (of, endpoint) in
            centres.chain(self.cameras.iter().map(|(name, e)| (name.to_string(), e.as_str())))
        {
            if !self.is_endpoint(endpoint) {
                return Err(NetworkError::Endpoint { of, endpoint: endpoint.to_owned() });
            }
            if let Some(one) = seen.insert(endpoint, of.clone()) {
                let endpoint = endpoint.to_owned();
                return Err(NetworkError::Shared { one, other: of, endpoint });
            }
        }
        Ok(())
    }

    fn validate_areas(&self) -> Result<(), NetworkError> {
        if self.fusion.is_some() != self.areas.is_empty() {
            return Err(NetworkError::Centres);
        }
        let unknown = self.areas.iter().find_map(|(area, of)| {
            let camera = of.cameras.iter().find(|camera| !self.cameras.contains_key(camera))?;
            Some(NetworkError::CameraOfArea { area: area.clone(), camera: camera.clone() })
        });
        let too_few = self.areas.iter().find(|(_, of)| of.has_too_few_cameras());
        let too_few = too_few.map(|(area, _)| NetworkError::CamerasOfArea(area.clone()));
        let unheard =
            |camera: &&CameraName| !self.areas.is_empty() && self.areas_of(camera).is_empty();
        let unheard = self.cameras.keys().find(unheard);
        unknown
            .or(too_few)
            .or_else(|| unheard.map(|camera| NetworkError::CameraOfNoArea(camera.clone())))
            .map_or(Ok(()), Err)
    }

    /// The fusion centres, each with its area if there are several, and their endpoints.
    pub fn centres(&self) -> impl Iterator<Item = (Option<AreaName>, &str)> {
        let only = self.fusion.iter().map(|endpoint| (None, endpoint.as_str()));
        let of_areas = self.areas.iter();
        only.chain(of_areas.map(|(area, of)| (Some(area.clone()), of.fusion.as_str())))
    }

    /// Whether a key belongs to a camera or fusion centre of this network, or to neither kind of
    /// component.
    pub fn names(&self, key: &Key) -> bool {
        match &key.channel {
            channel if channel.camera().is_some() => {
                channel.camera().is_some_and(|camera| self.cameras.contains_key(camera))
            }
            Channel::Truth | Channel::RecorderHealth | Channel::RecorderAlive => true,
            _ => self.centres().any(|(area, _)| area == key.area),
        }
    }

    /// The areas that use a camera, by name; empty if there is one fusion centre for all. The
    /// first area is the one that cues the camera.
    pub fn areas_of(&self, camera: &CameraName) -> Vec<AreaName> {
        let uses = |(_, of): &(&AreaName, &Area)| of.cameras.contains(camera);
        self.areas.iter().filter(uses).map(|(area, _)| area.clone()).collect()
    }

    /// The areas of the fusion centres that use a camera; `None` stands for the only one.
    pub fn centres_of(&self, camera: &CameraName) -> Vec<Option<AreaName>> {
        let areas = self.areas_of(camera);
        let uses = |area: &Option<AreaName>| area.as_ref().is_none_or(|a| areas.contains(a));
        self.centres().map(|(area, _)| area).filter(uses).collect()
    }

    /// The cameras that a fusion centre uses.
    ///
    /// # Errors
    /// [`NetworkError::UnknownArea`], or [`NetworkError::WhichArea`] where there are several.
    pub fn cameras_of(&self, area: Option<&AreaName>) -> Result<Vec<CameraName>, NetworkError> {
        match area {
            None if self.areas.is_empty() => Ok(self.cameras.keys().cloned().collect()),
            None => Err(NetworkError::WhichArea),
            Some(area) => {
                let of = self.areas.get(area);
                Ok(of.ok_or_else(|| NetworkError::UnknownArea(area.clone()))?.cameras.clone())
            }
        }
    }

    /// The areas that share a camera with `area`: targets are handed over to them.
    pub fn neighbours(&self, area: &AreaName) -> Vec<AreaName> {
        let Some(own) = self.areas.get(area) else { return Vec::new() };
        let is_beside = |(name, of): &(&AreaName, &Area)| {
            *name != area && of.cameras.iter().any(|camera| own.cameras.contains(camera))
        };
        self.areas.iter().filter(is_beside).map(|(name, _)| name.clone()).collect()
    }

    /// The first endpoint beyond this host that a session connects to without encryption; `None` if
    /// there is none.
    pub fn unencrypted(&self, role: &Role) -> Option<String> {
        let (_, connect) = self.declared(role).ok().filter(|_| self.security.is_none())?;
        connect.into_iter().find(|endpoint| !is_loopback(endpoint))
    }

    /// The endpoints at which a session listens, and those that it connects to.
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

    /// The same endpoints as the file states them, before the protocol is chosen.
    fn declared(&self, role: &Role) -> Result<(Vec<String>, Vec<String>), NetworkError> {
        if let Role::Router { listen } = role {
            let others = self.routers.iter().filter(|router| !listen.contains(router));
            return Ok((listen.clone(), others.cloned().collect()));
        }
        if self.mode == Mode::Client {
            return Ok((Vec::new(), self.routers.clone()));
        }
        let cameras = || self.cameras.values().cloned().collect::<Vec<_>>();
        let centres = || self.centres().map(|(_, endpoint)| endpoint.to_owned());
        Ok(match role {
            Role::Camera(name) => {
                let own = self.cameras.get(name);
                (
                    vec![own.cloned().ok_or_else(|| NetworkError::UnknownCamera(name.clone()))?],
                    Vec::new(),
                )
            }
            Role::Fusion(area) => self.declared_of_centre(area.as_ref())?,
            Role::Recorder | Role::Observer | Role::Router { .. } => {
                (Vec::new(), cameras().into_iter().chain(centres()).collect())
            }
            Role::Cameras { and_fusion } => {
                let fusion = and_fusion.then(centres).into_iter().flatten();
                (cameras().into_iter().chain(fusion).collect(), Vec::new())
            }
        })
    }

    /// A fusion centre connects to its cameras, and to neighbouring fusion centres whose area comes
    /// before its own by name: so each pair has one link.
    fn declared_of_centre(
        &self,
        area: Option<&AreaName>,
    ) -> Result<(Vec<String>, Vec<String>), NetworkError> {
        let cameras = self.cameras_of(area)?;
        let cameras = cameras.iter().filter_map(|camera| self.cameras.get(camera)).cloned();
        let Some(area) = area else {
            return Ok((self.fusion.iter().cloned().collect(), cameras.collect()));
        };
        let earlier = self.neighbours(area).into_iter().filter(|beside| beside < area);
        let endpoint = |area: &AreaName| self.areas.get(area).map(|of| of.fusion.clone());
        let connect = cameras.chain(earlier.filter_map(|beside| endpoint(&beside)));
        Ok((endpoint(area).into_iter().collect(), connect.collect()))
    }
}
