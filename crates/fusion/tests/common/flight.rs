//! A scene flown before a fusion centre, step by step, with its tracks compared with the truth.

use std::vec::IntoIter;

use crossfix_fusion::{FusedTrack, Fusion, FusionConfig, TrackStatus};
use crossfix_message::BearingFrame;
use nalgebra::{Vector3, Vector6};

use crate::common::{Path, Scene, found, fusion_of};

/// The 99.999 % point of chi-square with three degrees of freedom: an error beyond it is no chance.
const IMPOSSIBLE: f64 = 25.9;

/// A scene on its way through a fusion centre.
pub struct Flight {
    /// The fusion centre, for its counters.
    pub fusion: Fusion,
    paths: Vec<Path>,
    frames: std::iter::Peekable<IntoIter<BearingFrame>>,
}

impl Flight {
    /// The scene's frames with what a seed makes of them, before a fusion centre of the defaults.
    pub fn new(scene: Scene, seed: u64) -> Self {
        Self::with(FusionConfig::default(), scene, seed, |_| true)
    }

    /// The same with another configuration, the frames as they arrive, and without those that get
    /// lost.
    pub fn with(
        config: FusionConfig,
        scene: Scene,
        seed: u64,
        arrives: impl Fn(&mut BearingFrame) -> bool,
    ) -> Self {
        let mut frames = scene.frames(seed);
        frames.retain_mut(arrives);
        let fusion = fusion_of(config, &scene.eyes);
        Self { fusion, paths: scene.paths, frames: frames.into_iter().peekable() }
    }

    /// Goes on with all frames taken before `seconds`.
    pub fn until(&mut self, seconds: f64) -> &mut Self {
        while let Some(frame) = self.frames.next_if(|f| (f.capture_time_ns as f64) < seconds * 1e9)
        {
            self.fusion.ingest(&frame);
        }
        self
    }

    /// The track of a target.
    pub fn track(&self, target: usize) -> Option<&FusedTrack> {
        found(&self.fusion, &self.paths[target])
    }

    /// The numbers of the targets' tracks, in the targets' order.
    pub fn ids(&self) -> Vec<Option<u64>> {
        (0..self.paths.len()).map(|target| Some(self.track(target)?.id.0)).collect()
    }

    /// How many tracks are confirmed and live.
    pub fn confirmed(&self) -> usize {
        self.fusion.tracks().filter(|track| track.status == TrackStatus::Confirmed).count()
    }

    /// How far a target's track is off, m, having checked that its covariance can be true.
    pub fn error(&self, target: usize) -> f64 {
        let track = self.track(target).unwrap();
        let truth = self.paths[target](track.updated_at.seconds()).unwrap();
        let error: Vector3<f64> = track.state().position() - truth;
        let spread = track.state().position_covariance();
        let squared = error.dot(&spread.cholesky().unwrap().solve(&error));
        assert!(squared < IMPOSSIBLE, "{error} with {spread}");
        error.norm()
    }

    /// Squared error of position and velocity normalised by the covariance: NEES, six degrees of
    /// freedom. The velocity's truth is the path's difference over a millisecond.
    pub fn nees(&self, target: usize) -> f64 {
        let track = self.track(target).unwrap();
        let at = |t: f64| self.paths[target](t).unwrap();
        let now = track.updated_at.seconds();
        let (position, velocity) = (at(now), (at(now + 5e-4) - at(now - 5e-4)) / 1e-3);
        let truth = Vector6::from_iterator(position.iter().chain(velocity.iter()).copied());
        let error = track.state().mean - truth;
        error.dot(&track.state().covariance.cholesky().unwrap().solve(&error))
    }
}
