//! The messages in which an agent describes itself.

use std::time::{Duration, Instant};

use crossfix_message::{Counter, Health};

use super::stream_health::StreamHealth;
use super::{Agent, BEHIND};
use crate::{health, service};

/// How often the calibration is published again, for receivers that joined late. With twice as much
/// the bearings of a camera are of no use to such a receiver for up to four seconds.
pub const CALIBRATION_PERIOD: Duration = Duration::from_secs(2);

impl Agent {
    /// Publishes calibration and health again when they are due.
    pub(super) fn keep_up(&mut self) -> anyhow::Result<()> {
        let due =
            |at: Option<Instant>, period: Duration| at.is_none_or(|at| at.elapsed() >= period);
        if due(self.calibrated_at, CALIBRATION_PERIOD) {
            self.calibrations.put(self.calibration.clone())?;
            self.calibrated_at = Some(Instant::now());
        }
        if due(self.healthy_at, health::PERIOD) {
            service::alive();
            self.lookout.check(Instant::now());
            self.repeats.remind(Instant::now());
            // The reload of a live camera's file happens where the camera is watched.
            if self.stream.is_none() && self.shutdown.take_reload() {
                tracing::warn!("a source that is played keeps its configuration to its end");
            }
            self.say_health(false)?;
            self.healthy_at = Some(Instant::now());
        }
        Ok(())
    }

    pub(super) fn say_health(&mut self, ended: bool) -> anyhow::Result<()> {
        let mut counters = vec![
            ("bad_frames", self.bad_frames),
            ("behind_ms", u64::try_from(self.behind.as_millis()).unwrap_or(u64::MAX)),
            ("frames_without_pointing", self.without_pointing),
            ("unseen_bearings", self.unseen_bearings),
        ];
        counters.extend(self.stream.as_mut().map(StreamHealth::counters).unwrap_or_default());
        counters.sort_unstable();
        let health = Health {
            component: self.identity.name.to_string(),
            time_ns: self.now.nanos(),
            handled: self.frames,
            counters: counters
                .into_iter()
                .map(|(name, value)| Counter { name: name.to_owned(), value })
                .collect(),
            ended,
            problems: self.problems(),
            scene_begins_ns: self.scene_begins.nanos(),
            tracks: if self.stream.as_ref().is_some_and(StreamHealth::is_lost) {
                0
            } else {
                self.tracks
            },
            ..Default::default()
        };
        let health = self.health.completed(health);
        self.health.say(&health)
    }

    fn problems(&self) -> Vec<String> {
        let behind = (self.behind > BEHIND).then(|| {
            format!(
                "{:.1} s behind its source: this host is too slow for it",
                self.behind.as_secs_f64()
            )
        });
        let stream = self.stream.as_ref().map(|stream| stream.problems(Instant::now()));
        let mount = self.trouble_of_mount();
        behind.into_iter().chain(mount).chain(stream.unwrap_or_default()).collect()
    }

    /// Notes how far behind the source the agent is.
    pub(super) fn note_behind(&mut self, behind: Duration) {
        self.behind = behind;
        if behind > BEHIND {
            let name = self.identity.name.clone();
            self.repeats.warn("behind", Instant::now(), || {
                format!(
                    "camera `{name}` is {:.1} s behind its source: this host is too slow for it",
                    behind.as_secs_f64()
                )
            });
        }
    }
}
