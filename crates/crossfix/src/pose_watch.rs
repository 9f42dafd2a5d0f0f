//! Checks now and then, by asking the fusion, whether cameras still stand as they were calibrated.

use std::collections::BTreeMap;
use std::fmt;

use crossfix_fusion::{Fusion, PoseFinding};
use crossfix_message::{CameraName, Timestamp};

/// Interval between checks, s of data time: a finding covers the last minute, and for 64 cameras it
/// costs 25 ms. With half of it that is spent twice as often; with twice as much a camera that was
/// moved is named up to ten seconds later.
const ASKED_EVERY_S: f64 = 10.0;

/// Findings within this time are ascribed to one knock, s: the fusion remembers 100 s with targets,
/// and there are periods without any. With half of it findings that lie three minutes apart make
/// two moved cameras of one.
const SAME_KNOCK_S: f64 = 300.0;

/// Findings of each camera that has been watched together with others.
#[derive(Debug, Default)]
pub struct PoseWatch {
    asked: Option<Timestamp>,
    cameras: BTreeMap<CameraName, CameraWatch>,
}

/// Findings of one camera.
#[derive(Clone, Debug)]
pub struct CameraWatch {
    /// The newest finding; `None` if there has been none since the camera was last calibrated.
    pub now: Option<PoseFinding>,
    /// The finding with the strongest evidence that the camera has been moved, ...
    pub worst: PoseFinding,
    /// ... and its time.
    worst_at: Timestamp,
    /// When it was first certain that the camera had been moved.
    pub moved_at: Option<Timestamp>,
    /// The longest time that the camera was watched within the fusion's memory, s.
    pub watched_s: f64,
    /// The least standard deviation with which its turn was known, rad.
    pub least_turn_sd: f64,
}

impl CameraWatch {
    fn new(found: PoseFinding, time: Timestamp) -> Self {
        let least_turn_sd = found.turn_sd;
        Self {
            now: None,
            worst: found,
            worst_at: time,
            moved_at: None,
            watched_s: 0.0,
            least_turn_sd,
        }
    }

    fn take(&mut self, found: PoseFinding, time: Timestamp) {
        if found.is_moved {
            self.moved_at.get_or_insert(time);
        }
        if rank(&found) > rank(&self.worst) {
            (self.worst, self.worst_at) = (found.clone(), time);
        }
        self.watched_s = self.watched_s.max(found.watched_s);
        self.least_turn_sd = self.least_turn_sd.min(found.turn_sd);
        self.now = Some(found);
    }

    /// Whether it was found to be the only one moved, at about that time.
    fn moved_alone_about(&self, time: Timestamp) -> bool {
        self.worst.is_moved_alone() && self.worst_at.seconds_since(time).abs() < SAME_KNOCK_S
    }
}

/// Order of findings: certain ones come before uncertain ones, and those that only this camera
/// explains before those that another might explain, however strong the evidence there.
fn rank(finding: &PoseFinding) -> (bool, bool, f64) {
    (finding.is_moved, finding.or_else.is_empty(), finding.log_odds)
}

impl PoseWatch {
    /// Asks the fusion if a check is due; returns whether it was.
    pub fn check(&mut self, fusion: &Fusion) -> bool {
        let Some(now) = fusion.now() else { return false };
        let asked = *self.asked.get_or_insert(now);
        let is_due = now.seconds_since(asked).abs() >= ASKED_EVERY_S;
        if is_due {
            self.ask(fusion, now);
        }
        is_due
    }

    /// Asks the fusion once more at its end.
    pub fn finish(&mut self, fusion: &Fusion) {
        if let Some(now) = fusion.now() {
            self.ask(fusion, now);
        }
    }

    fn ask(&mut self, fusion: &Fusion, now: Timestamp) {
        self.asked = Some(now);
        self.cameras.values_mut().for_each(|camera| camera.now = None);
        for (name, found) in fusion.pose_findings() {
            let camera =
                self.cameras.entry(name).or_insert_with(|| CameraWatch::new(found.clone(), now));
            camera.take(found, now);
        }
    }

    /// Whether a camera has been moved, by all findings. Not if the finding might also have been
    /// due to another camera that at about that time was found to be the only one moved.
    pub fn has_moved(&self, name: &CameraName) -> bool {
        let Some(camera) = self.cameras.get(name) else { return false };
        let mut others = camera.worst.or_else.iter().filter_map(|other| self.cameras.get(other));
        camera.worst.is_moved && !others.any(|other| other.moved_alone_about(camera.worst_at))
    }

    /// Findings of each camera, by name.
    pub fn cameras(&self) -> &BTreeMap<CameraName, CameraWatch> {
        &self.cameras
    }

    /// Messages about the cameras that have been moved.
    pub fn problems(&self) -> impl Iterator<Item = (&CameraName, String)> {
        let moved = |camera: &'_ CameraWatch| camera.now.clone().filter(|now| now.is_moved);
        self.cameras.iter().filter_map(move |(name, camera)| {
            let now = moved(camera)?;
            let what = "has been moved since it was calibrated";
            Some((name, format!("camera `{name}` {what}: {}", TurnText(&now))))
        })
    }
}

/// Text of how far a camera has been turned.
pub struct TurnText<'a>(pub &'a PoseFinding);

impl fmt::Display for TurnText<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let PoseFinding { turn, turn_sd, or_else, .. } = self.0;
        write!(f, "turned by {:.1} mrad (± {:.1})", 1e3 * turn.norm(), 1e3 * turn_sd)?;
        for (k, other) in or_else.iter().enumerate() {
            write!(f, "{} `{other}`", if k == 0 { ", or it was" } else { " or" })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Adds a certain finding of a camera at a time, s.
    fn found(watch: &mut PoseWatch, name: &str, at_s: f64, or_else: &[&str]) {
        let finding = PoseFinding {
            watched_s: 60.0,
            turn: nalgebra::Vector3::new(0.002, 0.0, 0.0),
            turn_sd: 1e-4,
            log_odds: 9.0,
            is_moved: true,
            or_else: or_else.iter().map(|name| name.parse().unwrap()).collect(),
        };
        let time = Timestamp::EPOCH.plus_seconds(at_s);
        let name: CameraName = name.parse().unwrap();
        let camera =
            watch.cameras.entry(name).or_insert_with(|| CameraWatch::new(finding.clone(), time));
        camera.take(finding, time);
    }

    fn moved(watch: &PoseWatch) -> Vec<&str> {
        watch.cameras.keys().filter(|name| watch.has_moved(name)).map(CameraName::as_str).collect()
    }

    #[test]
    fn who_might_have_been_in_anothers_place_is_acquitted_when_that_is_found_alone() {
        let mut watch = PoseWatch::default();
        found(&mut watch, "east", 100.0, &["north"]);
        found(&mut watch, "north", 100.0, &["east"]);
        assert_eq!(moved(&watch), ["east", "north"]);
        found(&mut watch, "north", 120.0, &[]);
        assert_eq!(moved(&watch), ["north"]);
    }

    #[test]
    fn a_knock_of_an_hour_later_is_another() {
        let mut watch = PoseWatch::default();
        found(&mut watch, "north", 100.0, &[]);
        found(&mut watch, "east", 3700.0, &["north"]);
        assert_eq!(moved(&watch), ["east", "north"]);
        found(&mut watch, "south", 200.0, &[]);
        assert_eq!(moved(&watch), ["east", "north", "south"]);
    }
}
