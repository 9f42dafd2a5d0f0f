//! Test whether lines of several cameras belong to one target, or each camera sees a target of its
//! own.

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::Point3;

use super::NamedLine;
use super::joint::JointFilter;
use super::sight::DirectionFilter;
use super::speeds::{BySpeed, SPEEDS, SpeedCase};
use crate::evidence::ONE_IN_A_HUNDRED;
use crate::spatial::{LineId, TYPICAL_SPEED, TimedLine};
use crate::track::{FusedTrack, TrackBearing};

/// If the clock's uncertainty shifts a camera's bearings by a variance of more than this many times
/// their own, the test says nothing. With half of it clocks that are 0.7 times as uncertain let
/// lines that cross by chance pass untested.
const INCONCLUSIVE: f64 = 10.0;

/// How a target may move.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mobility {
    /// Density of its acceleration, m^2/s^3.
    pub(super) density: f64,
    /// Standard deviation of its speed, m/s.
    pub(super) speed: f64,
}

/// A first line of something that one camera alone sees, and that may move across the line at up to
/// `rate_sd` (rad/s, standard deviation).
fn first_sight(line: &SightLine, time: Timestamp, rate_sd: f64) -> BySpeed<DirectionFilter> {
    BySpeed::new(SPEEDS.map(|SpeedCase { share, log_prior }| {
        (DirectionFilter::first(line, time, share * rate_sd), log_prior)
    }))
}

/// A target as its track knows it, by the speed that it may have; before any line that was `speed`,
/// m/s (standard deviation per axis).
fn joint_of(track: &FusedTrack, speed: f64) -> BySpeed<JointFilter> {
    let fastest = JointFilter::of_track(track);
    let slowed = SPEEDS.iter().filter(|case| case.share < 1.0).filter_map(|case| {
        let (slowed, log_ratio) = fastest.slowed(case.share, speed)?;
        Some((slowed, case.log_prior + log_ratio))
    });
    let slowed: Vec<_> = slowed.collect();
    BySpeed::new(slowed.into_iter().chain([(fastest, 0.0)]))
}

/// Log-likelihood ratio of all lines being one target's against every camera seeing a target of its
/// own that no other camera sees, or clutter.
///
/// Against clutter, any line that continues smoothly is a target's. But if there are many targets
/// that one camera each sees, their lines cross, and only how well the lines agree with one
/// position and velocity decides: one target has six numbers, two independent lines have four each.
///
/// Both are predictive likelihoods: of models that are right, the ratio would exceed T with a
/// probability of 1 / T at most where each camera sees something of its own, however long one
/// looks. Not all of it is counted so: a camera's first line is compared with clutter, and a line
/// outside the gate is a miss.
#[derive(Clone, Debug)]
pub(super) struct OneTargetTest {
    /// Each camera's lines, followed as if that camera alone saw the target.
    sights: Vec<(CameraName, BySpeed<DirectionFilter>)>,
    /// All lines, followed as one target's; from the second ones on.
    joint: Option<BySpeed<JointFilter>>,
    /// Cameras that should see the target and have given one line at most, with the log-likelihood
    /// of their misses.
    silent: Vec<(CameraName, f64)>,
    log_ratio: f64,
    /// Whether clocks are so uncertain that the test says nothing.
    inconclusive: bool,
}

impl OneTargetTest {
    /// The test for the lines of a seed, with its log-likelihood ratio; at `place` the target may
    /// have a speed of `speed` (m/s, standard deviation).
    pub(super) fn begin(
        lines: &[NamedLine],
        place: Point3<f64>,
        speed: f64,
        log_ratio: f64,
    ) -> Self {
        let sights = lines.iter().map(|(LineId { camera, .. }, TimedLine { line, time, .. })| {
            // A speed of v across the line turns it at v / r.
            let range = (place - line.origin).norm();
            (camera.clone(), first_sight(line, *time, speed / range))
        });
        Self {
            sights: sights.collect(),
            joint: None,
            silent: Vec::new(),
            log_ratio,
            inconclusive: false,
        }
    }

    /// The test for what one camera alone has followed so far.
    pub(super) fn of_one(camera: &CameraName, sight: DirectionFilter) -> Self {
        Self {
            sights: vec![(camera.clone(), BySpeed::new([(sight, 0.0)]))],
            joint: None,
            silent: Vec::new(),
            log_ratio: 0.0,
            inconclusive: false,
        }
    }

    /// Whether a line of this camera has been used.
    pub(super) fn knows(&self, camera: &CameraName) -> bool {
        self.sights.iter().any(|(name, _)| name == camera)
    }

    /// Whether a camera has given more than one line: a first one may be clutter, whatever it fits.
    fn follows(&self, camera: &CameraName) -> bool {
        let own = self.sights.iter().find(|(name, _)| name == camera);
        own.and_then(|(_, sight)| sight.fastest()).is_some_and(|sight| !sight.is_first())
    }

    /// Adds a camera's first line, with its log-likelihood ratio; the target may move across it at
    /// `rate_sd` (rad/s, standard deviation).
    pub(super) fn see_first(
        &mut self,
        TrackBearing { camera, time, line, .. }: &TrackBearing<'_>,
        rate_sd: f64,
        first_ratio: f64,
    ) {
        self.log_ratio += first_ratio;
        self.sights.push(((*camera).clone(), first_sight(line, *time, rate_sd)));
    }

    /// Adds a line that continues the target, whose track is as before that line. `ratio` is its
    /// log-likelihood ratio against clutter (where a target is handed over, against another thing
    /// in the view). It is all that a camera's first line says, and no later one says more: what
    /// continues no object that the camera alone sees may still be clutter.
    pub(super) fn see(
        &mut self,
        bearing: &TrackBearing<'_>,
        before: &FusedTrack,
        Mobility { density, speed }: Mobility,
        ratio: f64,
    ) {
        let TrackBearing { camera, time, line, uncertainty } = *bearing;
        let range = (before.position_at(time) - line.origin).norm();
        let joint = self.joint.get_or_insert_with(|| joint_of(before, speed));
        joint.each(|joint| joint.predict(time, density));
        let Some((_, sight)) = self.sights.iter_mut().find(|(name, _)| name == camera) else {
            joint.see(|joint| joint.see(bearing, uncertainty.factor));
            return self.see_first(bearing, speed / range, ratio);
        };
        sight.each(|sight| sight.predict(time, density / range.powi(2)));
        let shown = sight.fastest().map_or(1.0, DirectionFilter::factor);
        let factor = shown.max(uncertainty.factor);
        let together = joint.see(|joint| joint.see(bearing, factor));
        let alone = sight.see(|sight| sight.log_density(line, factor));
        self.log_ratio += together.zip(alone).map_or(0.0, |(one, own)| one - own).min(ratio);
        // The shift by an uncertain clock is not known before the velocity is: use a typical speed.
        // Var = (v sd(t) / r)^2 per tangent.
        let clock = (speed * TYPICAL_SPEED * uncertainty.time_sd_s / range).powi(2);
        self.inconclusive |= clock > INCONCLUSIVE * line.covariance.trace() / 2.0;
        sight.each(|sight| sight.update(line));
    }

    /// Notes that the track has taken in a line that says nothing here.
    pub(super) fn pass_over(&mut self) {
        // What the track knows by then is begun with anew.
        self.joint = None;
    }

    /// Notes that a camera that should have seen the target has not; this look tells a `share` of
    /// what one tells that is independent of the camera's look before.
    pub(super) fn miss(&mut self, camera: &CameraName, log_miss: f64, share: f64) {
        if self.follows(camera) {
            return;
        }
        // All of them tell no more than that the camera never detects this target.
        let more = log_miss * share;
        match self.silent.iter_mut().find(|(name, _)| name == camera) {
            Some((_, log)) => *log = (*log + more).max(ONE_IN_A_HUNDRED),
            None => self.silent.push((camera.clone(), more.max(ONE_IN_A_HUNDRED))),
        }
    }

    /// The log-likelihood ratio; `None` if the clocks are too uncertain for it.
    pub(super) fn log_ratio(&self) -> Option<f64> {
        if self.inconclusive {
            return None;
        }
        let silent = self.silent.iter().filter(|(camera, _)| !self.follows(camera));
        Some(self.log_ratio + silent.map(|(_, log)| log).sum::<f64>())
    }
}
