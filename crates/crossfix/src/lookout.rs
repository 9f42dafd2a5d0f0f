//! Which of the needed components are present, and log lines about those that are not.

use std::time::{Duration, Instant};

use crossfix_message::{AreaName, CameraName, Channel, Key, SiteName};
use crossfix_transport::{Link, NetworkConfig, OwnCertificate, Presence};

/// How long a component may be missing before that is logged. With half of it a component that is
/// starting is said to be missing.
const PATIENCE: Duration = Duration::from_secs(3);
/// How often it is logged again while none is present. With half of it a camera that is alone logs
/// twice as much.
const PERIOD: Duration = Duration::from_secs(60);
/// Most names in a line; the rest is given as a number. With half as many the fifth and further
/// ones would not be named.
const NAMED: usize = 8;

/// Watches which of the components that this one needs are present, and logs who comes, who goes,
/// and who is missing.
pub struct Lookout {
    presence: Presence,
    site: String,
    others: Vec<Other>,
    absence: Absence,
    /// Certificate to test the connection to missing components with, where the network has
    /// certificates.
    certificate: Option<OwnCertificate>,
}

/// Decides when to log who is missing.
#[derive(Debug, Default)]
struct Absence {
    since: Option<Instant>,
    said: Option<Instant>,
}

impl Absence {
    /// Whether to log now, with `here` of `of` components present. `changed`: one of them has just
    /// come or gone, so others may be about to follow.
    fn is_due(&mut self, here: usize, of: usize, changed: bool, now: Instant) -> bool {
        if changed || here == of {
            *self = Self::default();
        }
        if here == of {
            return false;
        }
        let since = *self.since.get_or_insert(now);
        // A complete absence is repeated; one of several missing may be intended and is logged
        // once.
        let again = |said: Instant| here == 0 && now.saturating_duration_since(said) >= PERIOD;
        let is_due =
            now.saturating_duration_since(since) >= PATIENCE && self.said.is_none_or(again);
        if is_due {
            self.said = Some(now);
        }
        is_due
    }
}

struct Other {
    name: String,
    endpoint: String,
    key: Key,
    is_here: bool,
    /// Whether it was present at the previous check, too.
    was_here: bool,
    /// Whether it was ever present.
    has_been_here: bool,
}

impl Other {
    fn new(name: String, endpoint: String, key: Key) -> Self {
        Self { name, endpoint, key, is_here: false, was_here: false, has_been_here: false }
    }

    /// The fusion centre of an area, or the only one.
    fn centre(site: &SiteName, area: Option<AreaName>, endpoint: &str) -> Self {
        let name = match &area {
            None => "the fusion centre".to_owned(),
            Some(area) => format!("the fusion centre of area `{area}`"),
        };
        let key = Key::of_centre(site.clone(), area, Channel::FusionAlive);
        Self::new(name, endpoint.to_owned(), key)
    }
}

impl Lookout {
    /// Watches the cameras that a component needs.
    pub fn for_cameras(
        link: &Link,
        network: &NetworkConfig,
        cameras: &[CameraName],
    ) -> anyhow::Result<Self> {
        let others = cameras.iter().map(|camera| {
            let endpoint = network.cameras.get(camera).cloned().unwrap_or_default();
            let key = Key::new(link.site().clone(), Channel::Alive(camera.clone()));
            Other::new(format!("camera `{camera}`"), endpoint, key)
        });
        Self::new(link, others.collect())
    }

    /// Watches the fusion centres that a camera needs.
    pub fn for_centres_of(
        link: &Link,
        network: &NetworkConfig,
        camera: &CameraName,
    ) -> anyhow::Result<Self> {
        let needed = network.centres_of(camera);
        let centres = network.centres().filter(|(area, _)| needed.contains(area));
        let centres = centres.map(|(area, endpoint)| Other::centre(link.site(), area, endpoint));
        Self::new(link, centres.collect())
    }

    fn new(link: &Link, others: Vec<Other>) -> anyhow::Result<Self> {
        let (presence, site) = (link.presence()?, link.site().to_string());
        let certificate = link.certificate().cloned();
        Ok(Self { presence, site, others, absence: Absence::default(), certificate })
    }

    /// Checks again who is present; to be called about once a second.
    pub fn check(&mut self, now: Instant) {
        let mut changed = false;
        for other in &mut self.others {
            let is_here = self.presence.is_alive(&other.key);
            if is_here != other.is_here {
                let what = if is_here { "is there" } else { "is gone" };
                tracing::info!("{} {what}", other.name);
            }
            changed |= is_here != other.is_here;
            other.was_here = other.is_here;
            other.is_here = is_here;
            other.has_been_here |= is_here;
        }
        let here = self.others.iter().filter(|other| other.is_here).count();
        if self.absence.is_due(here, self.others.len(), changed, now) {
            tracing::warn!("{}", self.missing());
            self.ask_why();
        }
    }

    /// Logs of each missing component whether its certificate is the reason, which Zenoh does not
    /// tell. On a thread of its own, as they may answer slowly.
    fn ask_why(&self) {
        let Some(certificate) = self.certificate.clone() else { return };
        let missing: Vec<(String, String)> = self
            .others
            .iter()
            .filter(|other| !other.is_here)
            .take(NAMED)
            .map(|other| (other.name.clone(), other.endpoint.clone()))
            .collect();
        std::thread::spawn(move || {
            for (name, endpoint) in missing {
                if let Some(why) = certificate.why_no_link(&endpoint) {
                    tracing::warn!("{name} at {endpoint}: {why}");
                }
            }
        });
    }

    /// Whether all watched components are present.
    pub fn all_are_here(&self) -> bool {
        self.others.iter().all(|other| self.presence.is_alive(&other.key))
    }

    /// Whether at least one watched component is present.
    pub fn any_is_here(&self) -> bool {
        self.others.iter().any(|other| self.presence.is_alive(&other.key))
    }

    /// Whether a component is present, be it watched or not.
    pub fn is_here(&self, key: &Key) -> bool {
        self.presence.is_alive(key)
    }

    /// The watched cameras that were present at the last two looks, by name: by the second look
    /// they receive what is published for them.
    pub fn cameras_here(&self) -> Vec<String> {
        let here = self.others.iter().filter(|other| other.is_here && other.was_here);
        here.filter_map(|other| other.key.channel.camera()).map(ToString::to_string).collect()
    }

    /// The watched cameras that were present earlier and are not now.
    pub fn cameras_gone(&self) -> impl Iterator<Item = &CameraName> {
        let gone = self.others.iter().filter(|other| other.has_been_here && !other.is_here);
        gone.filter_map(|other| other.key.channel.camera())
    }

    fn missing(&self) -> String {
        let missing: Vec<&Other> = self.others.iter().filter(|other| !other.is_here).collect();
        let mut named: Vec<String> = missing
            .iter()
            .take(NAMED)
            .map(|other| format!("{} at {}", other.name, other.endpoint))
            .collect();
        if missing.len() > NAMED {
            named.push(format!("{} more", missing.len() - NAMED));
        }
        let named = named.join(", ");
        let are_cameras = missing.iter().any(|other| other.key.channel.camera().is_some());
        if missing.len() == self.others.len() && !are_cameras {
            format!(
                "nobody of site `{}` fuses what this camera sees: waiting for {named}",
                self.site
            )
        } else if missing.len() == self.others.len() {
            format!("nobody of site `{}` is there: waiting for {named}", self.site)
        } else {
            format!("waiting for {named}; the others of site `{}` are there", self.site)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn that_nobody_is_there_is_said_again_and_who_is_missing_beside_others_once() {
        let begun = Instant::now();
        let mut absence = Absence::default();
        let mut said = |here, changed, seconds| {
            absence.is_due(here, 3, changed, begun + Duration::from_secs(seconds))
        };
        assert!(!said(0, false, 0), "they may be on their way");
        assert!(said(0, false, 3));
        assert!(!said(0, false, 4) && said(0, false, 63), "again after a minute");
        assert!(!said(2, true, 70), "the third may be on its way");
        assert!(said(2, false, 73));
        assert!(!said(2, false, 500), "one that is switched off is no reason for a line a minute");
        assert!(!said(3, true, 510) && !said(2, true, 511) && said(2, false, 514), "it has gone");
        assert!(!said(0, true, 515) && said(0, false, 518), "and so have the others");
    }
}
