//! Test whether lines of several cameras belong to one target, or each camera sees a target of its
//! own.

use crossfix_message::CameraName;

use super::first_lines::{FirstLines, JointTarget, LaterLine};
use super::joint::JointFilter;
use super::own_sights::OwnSights;
use super::sight::DirectionFilter;
use super::speeds::{BySpeed, SPEEDS};
use crate::evidence::ONE_IN_A_HUNDRED;
use crate::spatial::TYPICAL_SPEED;
use crate::track::{FusedTrack, TrackBearing};

/// Where one camera sees a target after the other, and the clock's uncertainty shifts its bearings
/// by a variance of more than this many times their own, the test says nothing. With half of it
/// targets are handed over only by clocks that are 0.7 times as uncertain; with a hundred times as
/// much, of ten targets before three cameras with clocks of 30 ms two things at rest become one.
const INCONCLUSIVE: f64 = 10.0;

/// How a target may move.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mobility {
    /// Density of its acceleration, m^2/s^3.
    pub(super) density: f64,
    /// Standard deviation of its speed, m/s.
    pub(super) speed: f64,
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
/// looks. Not all of it is counted so: a camera's first line is compared with clutter, as is one
/// that continues nothing that the camera has seen before, a line outside the gate is a miss, and
/// lines that an uncertain clock shifts are taken in anew by what later ones tell of the velocity.
#[derive(Clone, Debug, Default)]
pub(super) struct OneTargetTest {
    /// Each camera's lines, followed as if that camera alone saw what gives them.
    own: OwnSights,
    /// The lines that it began with: until there is another, or it is known how far uncertain
    /// clocks shift them.
    first: Option<FirstLines>,
    /// All lines, followed as one target's; from the second ones on.
    joint: Option<BySpeed<JointFilter>>,
    /// Cameras that should see the target and have given no two lines of an object, with the
    /// log-likelihood of their misses.
    silent: Vec<(CameraName, f64)>,
    log_ratio: f64,
    /// Whether one camera has followed the target before the others see it.
    is_handed_over: bool,
    /// Whether clocks are so uncertain that the test says nothing.
    inconclusive: bool,
}

impl OneTargetTest {
    /// The test for the lines of a seed.
    pub(super) fn begin(first: FirstLines) -> Self {
        let mut own = OwnSights::default();
        for (camera, seen, rate_sd) in first.sights() {
            own.begin(camera, &seen.line, seen.time, rate_sd);
        }
        let log_ratio = first.score();
        let test = Self { own, log_ratio, ..Self::default() };
        Self { first: Some(first), ..test }
    }

    /// The test for what one camera alone has followed so far.
    pub(super) fn of_one(camera: &CameraName, sight: DirectionFilter) -> Self {
        let own = OwnSights::of_one(camera, sight);
        Self { own, is_handed_over: true, ..Self::default() }
    }

    /// Whether a line of this camera has been used.
    pub(super) fn knows(&self, camera: &CameraName) -> bool {
        self.own.knows(camera)
    }

    /// Adds a camera's first line of an object, with its log-likelihood ratio; the target may move
    /// across it at `rate_sd` (rad/s, standard deviation).
    pub(super) fn see_first(
        &mut self,
        TrackBearing { camera, time, line, .. }: &TrackBearing<'_>,
        rate_sd: f64,
        first_ratio: f64,
    ) {
        self.log_ratio += first_ratio;
        self.own.begin(camera, line, *time, rate_sd);
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
        // The shift by an uncertain clock is not known before the velocity is: use a typical speed.
        // Var = (v sd(t) / r)^2 per tangent.
        let clock = (speed * TYPICAL_SPEED * uncertainty.time_sd_s / range).powi(2);
        let is_unsure = clock > INCONCLUSIVE * line.covariance.trace() / 2.0;
        self.inconclusive |= self.is_handed_over && is_unsure;
        let turning = density / range.powi(2);
        let own = self.own.likeliest(camera, line, time, turning, uncertainty.factor);
        let factor = own.map_or(uncertainty.factor, |own| own.factor);
        let joint = self.joint(before, speed);
        joint.each(|joint| joint.predict(time, density));
        let together = joint.see(|joint| joint.see(bearing, factor));
        let gained = |log_density: f64| together.map_or(0.0, |together| together - log_density);
        let alone = own.map(|own| own.log_density);
        if let Some(own) = own.filter(|own| gained(own.log_density) <= ratio) {
            self.log_ratio += gained(own.log_density);
            self.own.go_on(own, line);
        } else {
            // It continues nothing that the camera alone sees.
            self.see_first(bearing, speed / range, ratio);
        }
        if self.first.is_some() {
            self.learn_clocks(LaterLine::new(bearing, factor, density, alone, ratio));
        }
    }

    /// The target that gives all lines, by the speed that it may have.
    fn joint(&mut self, before: &FusedTrack, speed: f64) -> &mut BySpeed<JointFilter> {
        self.joint.get_or_insert_with(|| {
            let begun = self.first.as_ref().and_then(FirstLines::begun);
            self.first.take_if(|_| begun.is_none());
            let Some(JointTarget { by_speed, log_ratio }) = begun else {
                return joint_of(before, speed);
            };
            self.log_ratio = log_ratio;
            by_speed
        })
    }

    /// Takes in all lines once more where this one has made the velocity, by which uncertain clocks
    /// shift them, twice as well known; and a last time when it is known well enough.
    fn learn_clocks(&mut self, later: LaterLine) {
        let (Some(first), Some(joint)) = (&mut self.first, &self.joint) else { return };
        let has_room = first.keep(later);
        let Some(fastest) = joint.fastest() else { return };
        let is_last = first.are_shifts_known(fastest) || !has_room;
        if first.learn_velocity(fastest, is_last)
            && let Some(JointTarget { by_speed, log_ratio }) = first.by_speed(Some(joint))
        {
            (self.joint, self.log_ratio) = (Some(by_speed), log_ratio);
        }
        self.first.take_if(|_| is_last);
    }

    /// Notes that the track has taken in a line that says nothing here.
    pub(super) fn pass_over(&mut self) {
        // What the track knows by then is begun with anew.
        self.joint = None;
        self.first = None;
    }

    /// Notes that a camera that should have seen the target has not; this look tells a `share` of
    /// what one tells that is independent of the camera's look before.
    pub(super) fn miss(&mut self, camera: &CameraName, log_miss: f64, share: f64) {
        if self.own.follows(camera) {
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
        let silent = self.silent.iter().filter(|(camera, _)| !self.own.follows(camera));
        Some(self.log_ratio + silent.map(|(_, log)| log).sum::<f64>())
    }
}
