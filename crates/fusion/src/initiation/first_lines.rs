//! The lines that a possible target begins with, and how well they are one target's.

use std::sync::{Arc, OnceLock};

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::Point3;

use super::joint::{Flown, JointFilter};
use super::speeds::{BySpeed, SPEEDS, SpeedCase};
use crate::spatial::TimedLine;
use crate::track::TrackBearing;
use crate::uncertainty::CameraUncertainty;

/// Most lines that are kept until it is known how far clocks shift them: a second of two cameras
/// of 12 Hz. With half of it targets of quick cameras, whose lines tell of the velocity more
/// slowly, are found later where clocks are 0.1 s off.
const MAX_LATER: usize = 24;

/// A line of a seed.
#[derive(Clone, Debug)]
pub(super) struct FirstLine {
    pub(super) camera: CameraName,
    pub(super) line: SightLine,
    pub(super) uncertainty: CameraUncertainty,
    /// The same line as the seed was solved from it: with all that is uncertain of its camera as
    /// noise.
    pub(super) solved: TimedLine,
}

/// A line that came after those of the seed.
#[derive(Clone, Debug)]
pub(super) struct LaterLine {
    camera: CameraName,
    time: Timestamp,
    line: SightLine,
    uncertainty: CameraUncertainty,
    /// How many times its reported covariance counts.
    factor: f64,
    /// Density of the target's acceleration before it, m^2/s^3.
    density: f64,
    /// Logarithm of its probability density if the camera alone sees what gives it, 1/sr; `None`
    /// for the camera's first line.
    alone: Option<f64>,
    /// Its log-likelihood ratio against clutter.
    ratio: f64,
}

impl LaterLine {
    pub(super) fn new(
        TrackBearing { camera, time, line, uncertainty }: &TrackBearing<'_>,
        factor: f64,
        density: f64,
        alone: Option<f64>,
        ratio: f64,
    ) -> Self {
        let (line, uncertainty) = (**line, **uncertainty);
        let camera = (*camera).clone();
        Self { camera, time: *time, line, uncertainty, factor, density, alone, ratio }
    }

    /// What it says for one target, of which it has this log probability density.
    fn gained(&self, together: Option<f64>) -> f64 {
        let gained = self.alone.map(|alone| together.map_or(0.0, |together| together - alone));
        gained.map_or(self.ratio, |gained| gained.min(self.ratio))
    }
}

/// What gives all lines, if that is one target.
#[derive(Clone, Debug)]
pub(super) struct JointTarget {
    /// By the speed that it may have.
    pub(super) by_speed: BySpeed<JointFilter>,
    /// The log-likelihood ratio of the lines.
    pub(super) log_ratio: f64,
}

/// The lines of a seed, and those after them for as long as it is not known how far uncertain
/// clocks shift them.
///
/// A seed is solved as if an uncertain clock shifted each line by what a target of typical speed
/// flies in that time. Of a target at rest, whose lines no clock shifts, they say more than that;
/// and of one that flies, as soon as its velocity is known.
#[derive(Clone, Debug)]
pub(super) struct FirstLines {
    /// Where the target is about.
    place: Point3<f64>,
    /// Its speed before any line, m/s (standard deviation per axis).
    speed: f64,
    /// The log-likelihood ratio of the seed.
    score: f64,
    /// Shared, as what follows is, by all hypotheses that grow from the seed.
    lines: Arc<[FirstLine]>,
    /// What the seed's lines alone are, once it has been asked for.
    begun: Arc<OnceLock<Option<JointTarget>>>,
    later: Vec<Arc<LaterLine>>,
    /// Variance to which the velocity was known when the lines were last taken in, m^2/s^2.
    known: f64,
}

impl FirstLines {
    /// The lines of a seed of this log-likelihood ratio, of a target about this place; before any
    /// line its speed was `speed`, m/s (standard deviation per axis).
    pub(super) fn of_seed(
        lines: impl Iterator<Item = FirstLine>,
        place: Point3<f64>,
        speed: f64,
        score: f64,
    ) -> Self {
        let (begun, later) = (Arc::default(), Vec::new());
        Self { place, speed, score, lines: lines.collect(), begun, later, known: speed.powi(2) }
    }

    pub(super) fn score(&self) -> f64 {
        self.score
    }

    /// Each camera's line, with the greatest rate at which the target may move across it, rad/s
    /// (standard deviation).
    pub(super) fn sights(&self) -> impl Iterator<Item = (&CameraName, &TimedLine, f64)> {
        self.lines.iter().map(|FirstLine { camera, solved, .. }| {
            // A speed of v across the line turns it at v / r.
            let range = (self.place - solved.line.origin).norm();
            (camera, solved, self.speed / range)
        })
    }

    /// The target that gives the seed's lines; `None` if the numbers fail.
    pub(super) fn begun(&self) -> Option<JointTarget> {
        self.begun.get_or_init(|| self.by_speed(None)).clone()
    }

    /// Whether the velocity is known so well that it is known how far the clocks shift all lines,
    /// to better than the lines' own noise.
    pub(super) fn are_shifts_known(&self, joint: &JointFilter) -> bool {
        let is_known = |line: &SightLine, uncertainty: &CameraUncertainty| {
            let time_sd_s = uncertainty.time_sd_s;
            time_sd_s == 0.0 || joint.knows_shift(line, time_sd_s)
        };
        self.lines.iter().all(|first| is_known(&first.line, &first.uncertainty))
            && self.later.iter().all(|later| is_known(&later.line, &later.uncertainty))
    }

    /// Whether the velocity is known twice as well as when the lines were last taken in, or if this
    /// is the last time, better at all.
    pub(super) fn learn_velocity(&mut self, joint: &JointFilter, is_last: bool) -> bool {
        let has_unsure = |uncertainty: &CameraUncertainty| uncertainty.time_sd_s > 0.0;
        let is_needed = self.lines.iter().any(|first| has_unsure(&first.uncertainty))
            || self.later.iter().any(|later| has_unsure(&later.uncertainty));
        let known = joint.flown().variance();
        let is_better = is_needed && known < self.known * if is_last { 1.0 } else { 0.25 };
        if is_better {
            self.known = known;
        }
        is_better
    }

    /// Keeps a later line; returns whether there is room for another.
    pub(super) fn keep(&mut self, line: LaterLine) -> bool {
        self.later.push(Arc::new(line));
        self.later.len() < MAX_LATER
    }

    /// The target that gives these lines; `known` is the same as it was found before, which tells
    /// how fast it flies: by that clocks shift the lines. `None` if the numbers fail.
    pub(super) fn by_speed(&self, known: Option<&BySpeed<JointFilter>>) -> Option<JointTarget> {
        let flown = known.map_or_else(Vec::new, |known| {
            known.filters().map(|joint| Some(joint.flown())).collect()
        });
        let cases = SPEEDS.iter().enumerate().map(|(case, SpeedCase { share, log_prior })| {
            let flown = flown.get(case).copied().flatten();
            let own = |first: &FirstLine| (first.line, first.uncertainty);
            let (joint, log) = self.followed(share * self.speed, flown, own)?;
            Some((joint, log_prior + log))
        });
        let mut cases = BySpeed::new(cases.collect::<Option<Vec<_>>>()?);
        let as_solved = |FirstLine { solved, .. }: &FirstLine| {
            let range = (self.place - solved.line.origin).norm();
            let covariance = solved.noise_at(range, self.speed);
            (SightLine { covariance, ..solved.line }, CameraUncertainty::of_time(0.0))
        };
        let (_, solved) = self.followed(self.speed, None, as_solved)?;
        let mut log_ratio = self.score + cases.log_total()? - SpeedCase::log_all() - solved;
        for later in &self.later {
            let LaterLine { camera, time, line, uncertainty, factor, density, .. } = &**later;
            let bearing = TrackBearing { camera, time: *time, line, uncertainty };
            cases.each(|joint| joint.predict(*time, *density));
            log_ratio += later.gained(cases.see(|joint| joint.see(&bearing, *factor)));
        }
        cases.each(|joint| joint.assume_flown(None));
        Some(JointTarget { by_speed: cases, log_ratio })
    }

    /// A target of at most this speed (m/s) that gives the seed's lines, each taken in a certain
    /// way, and the logarithm of their probability density, up to a constant that is the same for
    /// all speeds and ways.
    fn followed(
        &self,
        speed: f64,
        flown: Option<Flown>,
        taken: impl Fn(&FirstLine) -> (SightLine, CameraUncertainty),
    ) -> Option<(JointFilter, f64)> {
        let solved = &self.lines.first()?.solved;
        // Anywhere between the camera and twice as far: two lines leave far less of it.
        let range = (self.place - solved.line.origin).norm();
        let mut joint = JointFilter::at(self.place, range, speed, solved.time);
        joint.assume_flown(flown);
        let mut sum = 0.0;
        for first @ FirstLine { camera, solved: TimedLine { time, .. }, .. } in &*self.lines {
            let (line, uncertainty) = &taken(first);
            joint.predict(*time, 0.0);
            let bearing = TrackBearing { camera, time: *time, line, uncertainty };
            sum += joint.see(&bearing, uncertainty.factor)?;
        }
        Some((joint, sum))
    }
}
