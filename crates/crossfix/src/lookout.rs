//! Who is there, and a word where nobody is.

use std::time::{Duration, Instant};

use crossfix_message::{CameraName, Channel};
use crossfix_transport::{Link, NetworkConfig, Presence};

/// How long nobody may be there before that is said, and how often it is said again.
const PATIENCE: Duration = Duration::from_secs(3);
const PERIOD: Duration = Duration::from_secs(60);
/// Names in a line; the rest is a number.
const NAMED: usize = 8;

/// Looks who of those that a component needs is there, and says who comes, who goes, and that
/// nobody is.
pub struct Lookout {
    presence: Presence,
    site: String,
    others: Vec<Other>,
    alone_since: Option<Instant>,
    said: Option<Instant>,
}

struct Other {
    name: String,
    endpoint: String,
    channel: Channel,
    is_here: bool,
    /// Whether it was there at the look before, too.
    was_here: bool,
}

impl Lookout {
    /// For those who need cameras.
    pub fn for_cameras(
        link: &Link,
        network: &NetworkConfig,
        cameras: &[CameraName],
    ) -> anyhow::Result<Self> {
        let others = cameras.iter().map(|camera| Other {
            name: format!("camera `{camera}`"),
            endpoint: network.cameras.get(camera).cloned().unwrap_or_default(),
            channel: Channel::Alive(camera.clone()),
            is_here: false,
            was_here: false,
        });
        Self::new(link, others.collect())
    }

    /// For those who need the fusion centre.
    pub fn for_fusion(link: &Link, network: &NetworkConfig) -> anyhow::Result<Self> {
        let fusion = Other {
            name: "the fusion centre".to_owned(),
            endpoint: network.fusion.clone(),
            channel: Channel::FusionAlive,
            is_here: false,
            was_here: false,
        };
        Self::new(link, vec![fusion])
    }

    fn new(link: &Link, others: Vec<Other>) -> anyhow::Result<Self> {
        let (presence, site) = (link.presence()?, link.site().to_string());
        Ok(Self { presence, site, others, alone_since: None, said: None })
    }

    /// Looks again; to be called about once a second.
    pub fn look(&mut self, now: Instant) {
        for other in &mut self.others {
            let is_here = self.presence.is_alive(&other.channel);
            if is_here != other.is_here {
                let what = if is_here { "is there" } else { "is gone" };
                tracing::info!("{} {what}", other.name);
            }
            other.was_here = other.is_here;
            other.is_here = is_here;
        }
        if self.others.iter().any(|other| other.is_here) {
            (self.alone_since, self.said) = (None, None);
            return;
        }
        let since = *self.alone_since.get_or_insert(now);
        let is_due = self.said.is_none_or(|said| now.saturating_duration_since(said) >= PERIOD);
        if is_due && now.saturating_duration_since(since) >= PATIENCE {
            self.said = Some(now);
            tracing::warn!("{}", self.nobody());
        }
    }

    /// Whether one of them is there.
    pub fn is_here(&self, channel: &Channel) -> bool {
        self.presence.is_alive(channel)
    }

    /// The cameras of them that were there at the last two looks, by name: by the second, they hear
    /// what is said of them.
    pub fn cameras_here(&self) -> Vec<String> {
        let here = self.others.iter().filter(|other| other.is_here && other.was_here);
        here.filter_map(|other| other.channel.camera()).map(ToString::to_string).collect()
    }

    fn nobody(&self) -> String {
        let mut named: Vec<String> = self
            .others
            .iter()
            .take(NAMED)
            .map(|other| format!("{} at {}", other.name, other.endpoint))
            .collect();
        if self.others.len() > NAMED {
            named.push(format!("{} more", self.others.len() - NAMED));
        }
        format!("nobody of site `{}` is there: waiting for {}", self.site, named.join(", "))
    }
}
