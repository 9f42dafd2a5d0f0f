//! A camera's calibrations, and from when on each holds.

use std::collections::BTreeMap;

use crossfix_geometry::{Camera, PanTilt};
use crossfix_message::Timestamp;
use nalgebra::{Matrix6, Point3};

use crate::uncertainty::{CameraUncertainty, CorrelatedNoise, PoseUncertainty};

/// Most calibrations of a camera that wait for their time. A camera that is moved by hand has one
/// at most; of a clock that runs wild, those that lie farthest in the future are forgotten. With
/// half of it a camera whose moves are announced in advance loses the fifth and those after it.
const MAX_UPCOMING: usize = 8;

/// A camera as its calibration describes it.
#[derive(Clone, Debug)]
pub(crate) struct KnownCamera {
    /// With both angles of its mount at zero; in what [`Self::pointed`] returns, as it points.
    pub(crate) camera: Camera,
    /// The mount that turns it, if there is one.
    pub(crate) mount: Option<PanTilt>,
    /// Whether it looks for what it is told to look for (takes cues).
    pub(crate) takes_cues: bool,
    /// Whether it is being turned, so that it measures nothing.
    pub(crate) is_turning: bool,
    /// Covariance of the pose in the world's axes: rotation (rad), then position (m).
    pub(crate) pose_covariance: Matrix6<f64>,
    /// The part of its bearings' noise that lasts.
    pub(crate) lasting: CorrelatedNoise,
    /// Random walk of its clock, beside offset and drift, s^2/s.
    pub(crate) clock_walk: f64,
    /// Whether somebody has stated the uncertainty of the pose.
    pub(crate) is_declared: bool,
}

impl KnownCamera {
    /// Whether its pose, or what is known of the pose, differs from another's.
    pub(crate) fn is_elsewhere(&self, other: &Self) -> bool {
        let (one, two) = (self.camera.pose(), other.camera.pose());
        one.position() != two.position()
            || one.rotation() != two.rotation()
            || self.pose_covariance != other.pose_covariance
            || self.mount != other.mount
    }

    /// What is uncertain of it as a whole, without its clock.
    pub(crate) fn uncertainty(&self) -> CameraUncertainty {
        CameraUncertainty {
            pose: Some(PoseUncertainty::new(self.pose_covariance)),
            clock_walk: self.clock_walk,
            lasting: self.lasting,
            declared_lasting: self.lasting,
            axes: *self.camera.pose().rotation(),
            ..CameraUncertainty::of_time(0.0)
        }
    }

    /// Whether the camera should report a target at a place: in its image, and not too far away.
    pub(crate) fn expects(&self, place: Point3<f64>, max_range_m: f64) -> bool {
        !self.is_turning
            && (place - self.camera.pose().position()).norm() <= max_range_m
            && self.camera.sees(place)
    }
}

/// A camera as it stands at the exposure that is handled, and as it will stand later.
///
/// A frame waits for others that were captured before it. If its camera is calibrated again
/// meanwhile, the frame must still be read with the calibration that held when it was captured, or
/// a recording would give other tracks than the flight did.
#[derive(Clone, Debug)]
pub(super) struct Calibrations {
    now: KnownCamera,
    upcoming: BTreeMap<Timestamp, KnownCamera>,
}

impl Calibrations {
    /// Starts with the first calibration, which also holds for all that was captured before it.
    pub(super) fn first(known: KnownCamera) -> Self {
        Self { now: known, upcoming: BTreeMap::new() }
    }

    /// Takes in a calibration that holds from a capture time on.
    pub(super) fn expect(&mut self, valid_from: Timestamp, known: KnownCamera) {
        self.upcoming.insert(valid_from, known);
        if self.upcoming.len() > MAX_UPCOMING {
            self.upcoming.pop_last();
        }
    }

    /// The camera as it stands now.
    pub(super) fn now(&self) -> &KnownCamera {
        &self.now
    }

    /// The camera as it stood at a capture time.
    pub(super) fn at(&self, time: Timestamp) -> &KnownCamera {
        self.upcoming.range(..=time).next_back().map_or(&self.now, |(_, known)| known)
    }

    /// Moves on to a time; returns whether the camera stands elsewhere from now on.
    pub(super) fn advance(&mut self, time: Timestamp) -> bool {
        let mut has_moved = false;
        while let Some(entry) = self.upcoming.first_entry().filter(|entry| *entry.key() <= time) {
            let before = std::mem::replace(&mut self.now, entry.remove());
            has_moved |= before.is_elsewhere(&self.now);
        }
        has_moved
    }
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pose};

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
        let pose =
            Pose::looking_at(Point3::new(x, 0.0, 0.0), Point3::new(0.0, 100.0, 10.0)).unwrap();
        KnownCamera {
            mount: None,
            takes_cues: false,
            is_turning: false,
            camera: Camera::new(intrinsics, pose).unwrap(),
            pose_covariance: Matrix6::identity(),
            lasting: CorrelatedNoise::NONE,
            clock_walk: 0.0,
            is_declared: false,
        }
    }

    #[test]
    fn a_calibration_holds_from_its_time_on_and_the_first_one_before_it_too() {
        let at = |seconds: f64| Timestamp::from_seconds(seconds);
        let mut camera = Calibrations::first(standing_at(1.0));
        camera.expect(at(20.0), standing_at(2.0));
        let x = |known: &KnownCamera| known.camera.pose().position().x;
        assert_eq!([5.0, 19.9, 20.0].map(|s| x(camera.at(at(s)))), [1.0, 1.0, 2.0]);
        assert!(!camera.advance(at(19.9)));
        assert_eq!(x(camera.now()), 1.0);
        assert!(camera.advance(at(20.0)));
        assert_eq!(x(camera.now()), 2.0);
        // The same calibration once more: nothing moves.
        camera.expect(at(20.0), standing_at(2.0));
        assert!(!camera.advance(at(20.1)));
    }
}
