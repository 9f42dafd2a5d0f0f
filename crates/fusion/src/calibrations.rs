//! Which calibration of a camera holds when.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use crossfix_message::{CameraName, Timestamp};

use crate::ingress::KnownCamera;

/// Calibrations of a camera that wait for their time. One that is moved by hand has one at most; of a
/// clock that runs wild, those that lie farthest in the future are forgotten.
const MAX_UPCOMING: usize = 8;

/// The cameras as they stand at the exposure that is handled, and as they will stand later.
///
/// A frame waits for others that were captured before it. If its camera is calibrated anew meanwhile, it
/// must still be read with the calibration that held when it was captured, or a recording would give
/// other tracks than the flight did.
#[derive(Debug, Default)]
pub(crate) struct KnownCameras {
    now: BTreeMap<CameraName, KnownCamera>,
    upcoming: BTreeMap<CameraName, BTreeMap<Timestamp, KnownCamera>>,
}

impl KnownCameras {
    /// Takes a calibration in; says whether it is the camera's first one, which holds for all that it captured
    /// before it, too.
    pub(crate) fn insert(&mut self, name: CameraName, valid_from: Timestamp, known: KnownCamera) -> bool {
        if let Entry::Vacant(place) = self.now.entry(name.clone()) {
            place.insert(known);
            return true;
        }
        let upcoming = self.upcoming.entry(name).or_default();
        upcoming.insert(valid_from, known);
        if upcoming.len() > MAX_UPCOMING {
            upcoming.pop_last();
        }
        false
    }

    /// A camera as it stood at a capture time.
    pub(crate) fn at(&self, name: &CameraName, time: Timestamp) -> Option<&KnownCamera> {
        let upcoming = self.upcoming.get(name).and_then(|later| later.range(..=time).next_back());
        upcoming.map(|(_, known)| known).or_else(|| self.now.get(name))
    }

    /// Goes on to a time; returns the cameras that stand elsewhere from now on.
    pub(crate) fn advance(&mut self, time: Timestamp) -> Vec<CameraName> {
        let mut moved = Vec::new();
        self.upcoming.retain(|name, later| {
            while let Some(entry) = later.first_entry().filter(|entry| *entry.key() <= time) {
                let known = entry.remove();
                let before = self.now.insert(name.clone(), known.clone());
                if before.is_some_and(|before| before.is_elsewhere(&known)) {
                    moved.push(name.clone());
                }
            }
            !later.is_empty()
        });
        moved
    }

    /// The cameras as they stand now, by name.
    pub(crate) fn now(&self) -> &BTreeMap<CameraName, KnownCamera> {
        &self.now
    }
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pose};
    use nalgebra::Point3;

    use super::*;

    fn standing_at(x: f64) -> KnownCamera {
        let intrinsics = Intrinsics {
            size: ImageSize { width: 640, height: 480 },
            fx: 600.0,
            fy: 600.0,
            cx: 319.5,
            cy: 239.5,
            distortion: Distortion::None,
        };
        let pose = Pose::looking_at(Point3::new(x, 0.0, 0.0), Point3::new(0.0, 100.0, 10.0)).unwrap();
        KnownCamera {
            camera: Camera::new(intrinsics, pose).unwrap(),
            pose_covariance: None,
            is_declared: false,
        }
    }

    #[test]
    fn a_calibration_holds_from_its_time_on_and_the_first_one_before_it_too() {
        let name: CameraName = "north".parse().unwrap();
        let at = |seconds: f64| Timestamp::from_seconds(seconds);
        let mut cameras = KnownCameras::default();
        assert!(cameras.at(&name, at(0.0)).is_none());
        cameras.insert(name.clone(), at(10.0), standing_at(1.0));
        cameras.insert(name.clone(), at(20.0), standing_at(2.0));
        let x = |cameras: &KnownCameras, seconds: f64| {
            cameras.at(&name, at(seconds)).unwrap().camera.pose().position().x
        };
        assert_eq!([x(&cameras, 5.0), x(&cameras, 19.9), x(&cameras, 20.0)], [1.0, 1.0, 2.0]);
        assert!(cameras.advance(at(19.9)).is_empty());
        assert_eq!(cameras.now()[&name].camera.pose().position().x, 1.0);
        assert_eq!(cameras.advance(at(20.0)), std::slice::from_ref(&name));
        assert_eq!(cameras.now()[&name].camera.pose().position().x, 2.0);
        // Said again: nothing moves.
        cameras.insert(name.clone(), at(20.0), standing_at(2.0));
        assert!(cameras.advance(at(20.1)).is_empty());
    }
}
