//! The cameras' clocks, from the tracks themselves: a moving target seen by several cameras lies
//! off their sight lines by its velocity times their clocks' offsets.
//!
//! The bearings of a few tracks are gathered for some seconds ([`window`]) by the cameras' own
//! clocks, and the target's way ([`curve`]) and all clocks are fitted to them at once
//! ([`adjustment`]); what that tells of the clocks goes into what is believed of them ([`belief`]).
//! A recursive filter was here before: an offset of 200 ms times a velocity not yet known is no
//! linear matter, and in one flight of three it was sure of a wrong answer.

mod adjustment;
mod belief;
mod curve;
mod window;

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::DMatrix;

use self::adjustment::{Adjusted, Adjustment, Prior};
use self::belief::Belief;
use self::curve::Curve;
use self::window::Window;
use crate::config::Clocks;
use crate::ingress::Exposure;
use crate::track::{Track, TrackId};
use crate::tracker::Tracker;

/// Targets looked at at a time.
const MAX_WINDOWS: usize = 3;
/// A target slower than this says next to nothing of clocks, m/s.
const LEAST_SPEED: f64 = 2.0;
/// How long the bearings of a target are gathered before what they say is kept, s.
const WINDOW_S: f64 = 8.0;
/// Bearings of less than this say nothing that can be checked, s.
const LEAST_WINDOW_S: f64 = 1.0;
/// As long as a clock is worse known than this, s, ...
const SURE_S: f64 = 0.002;
/// ... what has been gathered so far is looked at so often, s.
const LOOK_EVERY_S: f64 = 1.0;
/// Residuals larger than this (squared, over what was reported) are not the noise's but a mistake's.
const MAX_MISFIT: f64 = 4.0;
/// When more than this share of a camera's bearings do not fit, the camera does not.
const MAX_STRANGERS: f64 = 0.3;
/// Clocks farther than this from what was believed of them (squared, in standard deviations, for
/// each degree of freedom) have jumped.
const MAX_PULL: f64 = 12.0;
/// So many windows one after the other that fit nothing say that what is believed of the clocks is wrong.
const MAX_REFUSED: u32 = 3;
/// A curve reaches beyond its bearings as far as the clocks may move, and no farther than this, s.
const MAX_MARGIN_S: f64 = 1.0;
/// Density of jerk that is tried first, m^2/s^5, as a power of ten.
const FIRST_DENSITY: i32 = 0;

/// What is known of a camera's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockEstimate {
    /// How far the clock is ahead, s: taken off its capture times.
    pub offset_s: f64,
    /// Standard deviation of the offset against true time, s. What all clocks may have in common
    /// nobody can see: it stays as large as the clocks' reported deviations leave it.
    pub sd_s: f64,
    /// Standard deviation of the offset against what all clocks of the site say together, s.
    pub relative_sd_s: f64,
    /// How fast the clock gains, s/s.
    pub drift: f64,
    /// Standard deviation of the drift, s/s.
    pub drift_sd: f64,
}

/// Estimates the clocks of all cameras.
#[derive(Clone, Debug)]
pub(crate) struct ClockEstimator {
    config: Clocks,
    /// What closed windows have told.
    belief: Belief,
    /// The same with what the open windows tell so far.
    provisional: Option<Belief>,
    windows: Vec<Window>,
    now: Timestamp,
    looked: Timestamp,
    needed: bool,
    /// Windows one after the other that fitted nothing.
    refused: u32,
}

impl ClockEstimator {
    pub(crate) fn new(config: Clocks) -> Self {
        Self {
            config,
            belief: Belief::default(),
            provisional: None,
            windows: Vec::new(),
            now: Timestamp::MIN,
            looked: Timestamp::MIN,
            needed: false,
            refused: 0,
        }
    }

    /// Whether any clock is uncertain enough to be estimated.
    pub(crate) fn is_needed(&self) -> bool {
        self.needed
    }

    /// Makes a camera's clock known by the deviation it reports; later reports change nothing.
    pub(crate) fn see(&mut self, camera: &CameraName, reported_sd_s: f64) {
        if !self.config.estimate || self.belief.knows(camera) {
            return;
        }
        let uncertain = reported_sd_s >= self.config.least_sd_s && !self.config.trusted.contains(camera);
        self.needed |= uncertain;
        let (sd, drift_sd) = if uncertain { (reported_sd_s, self.config.drift_sd) } else { (0.0, 0.0) };
        self.belief.add(camera, sd, drift_sd);
        self.provisional = None;
    }

    fn newest(&self) -> &Belief {
        self.provisional.as_ref().unwrap_or(&self.belief)
    }

    /// The estimate of a camera's clock.
    pub(crate) fn estimate(&self, camera: &CameraName) -> Option<ClockEstimate> {
        self.newest().estimate(camera, self.now)
    }

    /// The largest offset of all clocks, s, at least 0: no camera's corrected time lies farther
    /// behind its reported one.
    pub(crate) fn largest_offset(&self) -> f64 {
        self.newest().largest_offset(self.now)
    }

    /// Moves on to a time: closes windows that are full or whose target too few cameras see, and
    /// looks at the others now and then.
    pub(crate) fn advance(&mut self, time: Timestamp, tracker: &Tracker) {
        self.now = self.now.max(time);
        let followed = |id: TrackId| tracker.track(id).is_some_and(|t| t.is_confirmed() && t.is_held());
        let now = self.now;
        let full = |window: &Window| now.seconds_since(window.start) >= WINDOW_S;
        let mut closed = 0;
        while let Some(index) = self.windows.iter().position(|w| full(w) || !followed(w.track)) {
            let window = self.windows.remove(index);
            self.close(&window);
            closed += 1;
        }
        if closed > 0 || self.now.seconds_since(self.looked) >= LOOK_EVERY_S {
            self.looked = self.now;
            self.look();
        }
    }

    /// Takes a bearing of a track in, by the time that the camera gave it.
    pub(crate) fn update(&mut self, track: &Track, exposure: &Exposure, line: &SightLine) {
        let time = exposure.time.plus_seconds(exposure.correction_s);
        let camera = &exposure.camera;
        let index = self.windows.iter().position(|window| window.track == track.id).or_else(|| {
            let fast = track.state().velocity().norm() >= LEAST_SPEED;
            let worth = fast && track.is_confirmed() && track.is_held();
            (worth && self.windows.len() < MAX_WINDOWS).then(|| {
                self.windows.push(Window::new(track.id, time));
                self.windows.len() - 1
            })
        });
        if let Some(window) = index.and_then(|index| self.windows.get_mut(index)) {
            let line = SightLine { covariance: line.covariance * exposure.uncertainty.factor, ..*line };
            window.add(camera, time, line, track.position_at(exposure.time).coords);
        }
    }

    /// A camera's bearings do not fit the others': its clock may have jumped. What was learnt of it
    /// is forgotten, and with it the windows that it may have spoilt.
    pub(crate) fn doubt(&mut self, camera: &CameraName) {
        if self.belief.is_uncertain(camera) {
            self.belief.doubt(camera);
            self.provisional = None;
            self.windows.clear();
        }
    }

    /// Keeps what a window has told.
    fn close(&mut self, window: &Window) {
        match learnt(&self.belief, window) {
            Outcome::Learnt(belief) => {
                self.belief = *belief;
                self.refused = 0;
            }
            Outcome::Nothing => {}
            Outcome::Refused => {
                self.refused += 1;
                if self.refused >= MAX_REFUSED {
                    self.refused = 0;
                    self.belief.begin_anew();
                }
            }
        }
    }

    /// Looks at what the open windows tell so far, as long as a clock in them is not well known.
    fn look(&mut self) {
        let unsure = |camera: &CameraName| {
            self.belief.estimate(camera, self.now).is_some_and(|clock| clock.relative_sd_s > SURE_S)
        };
        let worth: Vec<&Window> =
            self.windows.iter().filter(|window| window.cameras.iter().any(unsure)).collect();
        let mut belief = None;
        for window in worth {
            if let Outcome::Learnt(next) = learnt(belief.as_ref().unwrap_or(&self.belief), window) {
                belief = Some(*next);
            }
        }
        self.provisional = belief;
    }
}

/// What a window says to a belief.
enum Outcome {
    Learnt(Box<Belief>),
    /// It is too short, or sees no clock that could be learnt.
    Nothing,
    /// Its bearings fit no target of any clocks.
    Refused,
}

/// A belief after a window. If the window does not fit it, the clock of a camera may have jumped, or
/// a camera does not fit at all.
fn learnt(belief: &Belief, window: &Window) -> Outcome {
    let long = window.span().is_some_and(|(first, last)| last - first >= LEAST_WINDOW_S);
    if !long || window.cameras.len() < 2 {
        return Outcome::Nothing;
    }
    let mut before = belief.clone();
    before.advance(window.start.plus_seconds(window.span().map_or(0.0, |(_, last)| last)));
    let Some(components) = components(&before, window) else {
        return Outcome::Nothing;
    };
    if let Some(adjusted) = adjust(&before, window, &components).filter(fits) {
        before.learn(&components, &adjusted.clocks, &adjusted.covariance);
        return Outcome::Learnt(Box::new(before));
    }
    for camera in window.cameras.iter().filter(|camera| before.is_uncertain(camera)) {
        let mut doubting = before.clone();
        doubting.doubt(camera);
        if let Some(adjusted) = adjust(&doubting, window, &components).filter(fits) {
            doubting.learn(&components, &adjusted.clocks, &adjusted.covariance);
            return Outcome::Learnt(Box::new(doubting));
        }
    }
    Outcome::Refused
}

fn fits(adjusted: &Adjusted) -> bool {
    adjusted.misfit < MAX_MISFIT
        && adjusted.strangers.iter().all(|share| *share < MAX_STRANGERS)
        && adjusted.pulled < MAX_PULL * adjusted.clocks.len() as f64
}

/// The components of the belief that a window's cameras tell of; `None` if there are none.
fn components(belief: &Belief, window: &Window) -> Option<Vec<usize>> {
    let places = window.cameras.iter().filter_map(|camera| belief.place(camera));
    let components: Vec<usize> = places.flat_map(|place| [place, place + 1]).collect();
    (!components.is_empty()).then_some(components)
}

/// Fits a window with what is believed of the clocks.
fn adjust(belief: &Belief, window: &Window, components: &[usize]) -> Option<Adjusted> {
    let (mean, covariance) = belief.marginal(components);
    let sd = |i: usize| covariance[(i, i)].max(0.0).sqrt();
    let widest = (0..components.len()).step_by(2).map(sd).fold(0.0, f64::max);
    let margin = (2.0 * widest).min(MAX_MARGIN_S);
    let mut next = 0;
    let places: Vec<Option<usize>> = window
        .cameras
        .iter()
        .map(|camera| {
            let place = belief.place(camera).map(|_| next);
            next += 2 * usize::from(place.is_some());
            place
        })
        .collect();
    let offsets: Vec<f64> = places.iter().map(|place| place.map_or(0.0, |place| mean[place])).collect();
    let times = || window.sights.iter().map(|sight| sight.time_s - offsets[sight.camera]);
    let first = times().fold(f64::INFINITY, f64::min) - margin;
    let last = times().fold(f64::NEG_INFINITY, f64::max) + margin;
    let precision: DMatrix<f64> = covariance.cholesky()?.inverse();
    let epoch_s = belief.epoch()?.seconds_since(window.start);
    let prior = Prior { mean, precision, epoch_s, places };
    let reach = WINDOW_S + 4.0 * MAX_MARGIN_S;
    let curve = Curve::over(first, last.min(first + reach));
    Adjustment::new(&window.sights, curve, &prior).solve(FIRST_DENSITY)
}
