//! When an agent begins: once its receivers are present, and in step with the other cameras.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use crossfix_message::{AreaName, CameraName, Channel, Health, Key, Timestamp, decode};
use crossfix_transport::NetworkConfig;

use super::{Agent, BEHIND};
use crate::config::{CameraFile, SourceConfig};
use crate::pace::{Pace, wall_seconds};
use crate::service;

/// How often it is checked who is present, and whether to stop. With twice as much a begin or a
/// stop comes up to a tenth of a second late.
const POLL: Duration = Duration::from_millis(50);
/// After this long an agent without a fusion centre begins for the recorder alone. With half of it
/// a fusion centre that is started by hand after the agent would miss the beginning.
const FUSION_PATIENCE: Duration = Duration::from_secs(10);
/// How long cameras wait for absent cameras of the network's file: time to start three of them by
/// hand. With half of it the last of them would miss the beginning.
const CAMERA_PATIENCE: Duration = Duration::from_secs(20);
/// A source farther than this from what the site plays belongs to another time altogether, s: a
/// day. With half of it nobody could join a source that has been played for twelve hours.
const FARTHEST_S: f64 = 86_400.0;

/// Where in the data, and when, an agent begins.
#[derive(Clone, Copy, Debug)]
pub struct Start {
    /// Wall time at which the data begin, seconds since the Unix epoch: the zero of a scene's time.
    pub wall_s: f64,
    /// How far the site is in the data already, s: earlier data are not published.
    pub joined_s: f64,
    /// Whether the data begin at `wall_s`; otherwise the agent is at `joined_s` now.
    is_at_wall_time: bool,
}

impl Start {
    /// Start at the beginning of the data, now.
    pub fn now() -> Self {
        Self { wall_s: wall_seconds(), joined_s: 0.0, is_at_wall_time: false }
    }

    /// Start at the beginning of the data, half a second or more from now at a whole second of the
    /// wall clock. Agents that decide so at the same moment begin a scene at the same time, if
    /// their hosts' clocks agree.
    fn together() -> Self {
        Self::at_wall_time((wall_seconds() + 0.5).ceil())
    }

    /// Start at the beginning of the data, at a wall time.
    pub fn at_wall_time(wall_s: f64) -> Self {
        Self { wall_s, joined_s: 0.0, is_at_wall_time: true }
    }

    /// Whether data at `data_s` are to be published: an agent that joins others is silent until it
    /// has caught up with them.
    pub fn is_caught_up(&self, data_s: f64, behind: Duration) -> bool {
        let has_joined = self.joined_s > 0.0;
        !has_joined || data_s >= self.joined_s && (self.is_at_wall_time || behind < BEHIND)
    }

    /// Pace of data that run `speed` times as fast as real time.
    pub fn pace(&self, speed: f64) -> Pace {
        if self.is_at_wall_time {
            Pace::beginning_at(self.wall_s, speed)
        } else {
            Pace::beginning_in(-self.joined_s / speed.max(f64::MIN_POSITIVE), speed)
        }
    }
}

/// What the site plays, by the fusion centre's health.
#[derive(Clone, Copy, Debug, PartialEq)]
enum ScenePlayback {
    /// The site's time runs and is `now`; if it plays a scene, the scene began at `scene_begins`.
    Plays { now: Timestamp, scene_begins: Timestamp },
    /// The site's time stands still, and all cameras are present.
    IsComplete,
    /// The site's time stands still, and cameras are missing.
    Waits,
}

fn playback_of(health: &Health, cameras: &[CameraName]) -> ScenePlayback {
    if health.is_playing {
        return ScenePlayback::Plays {
            now: Timestamp::from_nanos(health.time_ns),
            scene_begins: Timestamp::from_nanos(health.scene_begins_ns),
        };
    }
    let is_present =
        |camera: &CameraName| health.present.iter().any(|name| name == camera.as_str());
    if cameras.iter().all(is_present) { ScenePlayback::IsComplete } else { ScenePlayback::Waits }
}

impl Agent {
    /// Waits for those who must receive every frame, and for the other cameras; `None` if it was
    /// asked to stop before.
    pub(super) fn wait(
        &mut self,
        recorder: bool,
        file: &CameraFile,
        network: &NetworkConfig,
        begins: Timestamp,
        has_start: bool,
    ) -> anyhow::Result<Option<Start>> {
        let recorder_alive = self.link.key(Channel::RecorderAlive);
        let begun = Instant::now();
        // A component's token comes with its other declarations, but its subscription may arrive
        // later.
        let has_ears = |agent: &Self| agent.bearings.has_subscribers();
        while !self.shutdown.requested() {
            self.lookout.check(Instant::now());
            service::alive();
            let recording = self.lookout.is_here(&recorder_alive);
            // Where several areas listen, one is enough if the others do not come in time.
            let is_long = begun.elapsed() >= FUSION_PATIENCE;
            let fusion = self.lookout.all_are_here() || is_long && self.lookout.any_is_here();
            if fusion && (recording || !recorder) && has_ears(self)? {
                break;
            }
            if !fusion && recording && begun.elapsed() >= FUSION_PATIENCE {
                tracing::warn!(
                    "no fusion centre is there: beginning all the same, the recorder hears it"
                );
                self.appear()?;
                return Ok(Some(Start::now()));
            }
            std::thread::sleep(POLL);
        }
        if self.shutdown.requested() {
            return Ok(None);
        }
        if has_start || file.source.is_unpaced() {
            self.appear()?;
            return Ok(Some(Start::now()));
        }
        self.wait_for_cameras(file, network, begins)
    }

    /// Waits until all cameras of the network are present, or joins those that play already.
    fn wait_for_cameras(
        &mut self,
        file: &CameraFile,
        network: &NetworkConfig,
        begins: Timestamp,
    ) -> anyhow::Result<Option<Start>> {
        // A camera of several areas begins when all of them are complete, or joins the one that
        // plays.
        let key = |area: &Option<AreaName>| {
            Key::of_centre(self.link.site().clone(), area.clone(), Channel::FusionHealth)
        };
        let areas = network.centres_of(&self.identity.name);
        let keys: Vec<String> = areas.iter().map(|area| key(area).to_string()).collect();
        let reports = self.link.subscribe(&keys)?;
        let mut complete: BTreeSet<Option<AreaName>> = BTreeSet::new();
        self.appear()?;
        let begun = Instant::now();
        tracing::info!(
            "camera `{}` waits for the other cameras, {} s at most",
            self.identity.name,
            CAMERA_PATIENCE.as_secs()
        );
        while !self.shutdown.requested() {
            service::alive();
            if begun.elapsed() >= CAMERA_PATIENCE {
                tracing::warn!(
                    "camera `{}` begins without cameras that are not there",
                    self.identity.name
                );
                return Ok(Some(Start::now()));
            }
            let Some(received) = reports.next(POLL) else { continue };
            let Ok(health) = decode::<Health>(&received.data) else { continue };
            let area = received.key.area;
            match playback_of(&health, &network.cameras_of(area.as_ref())?) {
                ScenePlayback::Plays { now, scene_begins } => {
                    return Ok(Some(self.join(file, begins, now, scene_begins)));
                }
                ScenePlayback::IsComplete => drop(complete.insert(area)),
                ScenePlayback::Waits => drop(complete.remove(&area)),
            }
            if areas.iter().all(|area| complete.contains(area)) {
                return Ok(Some(Start::together()));
            }
        }
        Ok(None)
    }

    /// Begins at the time that the site has reached.
    fn join(
        &self,
        file: &CameraFile,
        begins: Timestamp,
        now: Timestamp,
        scene_begins: Timestamp,
    ) -> Start {
        let name = &self.identity.name;
        let is_scene = matches!(file.source, SourceConfig::Simulation { .. });
        let begins = self.common_begin(file, begins);
        let joined_s = now.seconds_since(if is_scene { scene_begins } else { begins });
        if !(0.0..FARTHEST_S).contains(&joined_s) {
            tracing::warn!(
                "camera `{name}` begins at its beginning: the site's data are of another time"
            );
            return Start::now();
        }
        tracing::info!(
            "camera `{name}` joins the others, {joined_s:.1} s after its source's beginning"
        );
        Start { wall_s: scene_begins.seconds(), joined_s, is_at_wall_time: is_scene }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agents_begin_together_and_one_that_is_late_joins() {
        let cameras = ["a", "b"].map(|name| name.parse().unwrap());
        let at = Timestamp::from_seconds(4.0);
        let health = |is_playing: bool, present: &[&str]| Health {
            time_ns: at.nanos(),
            present: present.iter().map(|name| (*name).to_owned()).collect(),
            is_playing,
            ..Default::default()
        };
        assert_eq!(playback_of(&health(false, &["a"]), &cameras), ScenePlayback::Waits);
        // A file may have been played to its end before.
        assert_eq!(playback_of(&health(false, &["b", "a"]), &cameras), ScenePlayback::IsComplete);
        let plays = playback_of(&health(true, &["b", "a"]), &cameras);
        assert!(matches!(plays, ScenePlayback::Plays { now, .. } if now == at));
    }
}
