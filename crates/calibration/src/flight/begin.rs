//! Start of the adjustment: each camera's pose and clock, and the target's trajectory.

use super::align;
use super::course::Course;
use super::error::{FlightError, LEAST_LABELS, LONGEST_FLIGHT_H, Refusal};
use super::model::{CameraLabels, CameraUnknowns, FlightLog, frame_time, hours};
use super::pairs::{self, RelativePose, Sights};
use super::spline::{KNOT_S, TrajectorySpline};
use super::start::{self, StartPose};
use super::state::{CameraPriors, FlightState, Priors, RATE_SD};
use super::would_fit::WouldFit;
use super::{things, triangulation, would_fit};
use crate::label_noise::LabelNoise;
use crate::survey::Survey;
use crossfix_geometry::turn_vector;
use crossfix_message::CameraName;
use nalgebra::Rotation3;

/// Labels whose median misfit to the log is above this are not of its target, rad: lens files and
/// clocks that are not known yet leave up to 4 mrad. With half of it phones are refused.
const MOST_MISFIT_RAD: f64 = 8e-3;
/// ... plus this many deviations of the log's own errors, as they are seen from the camera. With
/// half of it a camera near the target is refused for the errors of a log good to metres.
const LOG_DEVIATIONS: f64 = 3.0;
/// A start whose median misfit to the log is above this is compared with the mirror image, rad
/// (with half of it the same, as a second search for more cameras; with twice as much the mirror
/// image of a short flight may pass), ...
const DOUBTED_RAD: f64 = 2e-3;
/// ... which is taken to be what was flown if it fits this many times better. With half of it
/// chance decides for a level flight, which both fit.
const CLEARLY_BETTER: f64 = 3.0;
/// The trajectory extends beyond the labels by this, s: their times may still move. With half of it
/// labels of a clock that moves by more than a second end beside the trajectory and count as
/// unseen.
const MARGIN_S: f64 = 2.0;
/// Two cameras see the target together if they do so within this time, s: that of a knot of the
/// trajectory. With half of it labels are lost where the other cameras have fewer than five a
/// second.
const TOGETHER_S: f64 = KNOT_S;
/// Without a log, this many pairs of cameras are tried as a start, those of least range
/// uncertainty: one that saw a short or a flat piece of the trajectory leads astray. With half of
/// it such a pair may be the only one.
const PAIRS_TRIED: usize = 3;
/// Two relative poses fit alike if the misfit of one is at most this many times the other's: the
/// two of a flight in a plane fit to within their noise (with half of it only the better one
/// counts, which may be the wrong one), ...
const AS_GOOD_TIMES: f64 = 2.0;
/// ... and are different if cameras are turned differently by more than this, rad: starts from two
/// pairs of cameras that lead to one solution differ by less. With half of it starts of one
/// solution may count as two, and the flight is refused.
const OTHERWISE_RAD: f64 = 0.1;
/// Label errors that are assumed before anything is known, pixels: a hand's or a tracker's, and
/// what a lens file leaves. With half of it the first round gives labels that a rough start misses
/// less weight; later rounds find the noise.
const FIRST_NOISE: LabelNoise = LabelNoise { white_px: 0.5, lasting_px: 1.4, lasting_s: 0.5 };
/// Power of a clock's wander in the first round, s^2/s: a phone's, which is large. Begun with too
/// small a value it would not be found.
const FIRST_WANDER: f64 = 2e-5;

/// The cameras that take part, and the states they begin with.
pub(super) struct BegunFlight {
    pub(super) cameras: Vec<CameraLabels>,
    states: Vec<CameraUnknowns>,
    course: Course,
    /// Number of each camera's labels that are of something other than the target.
    pub(super) of_others: Vec<(CameraName, usize)>,
    /// The cameras that take no part.
    pub(super) refused: Vec<(CameraName, Refusal)>,
}

impl BegunFlight {
    fn new(course: Course) -> Self {
        let (cameras, states) = (Vec::new(), Vec::new());
        Self { cameras, states, course, of_others: Vec::new(), refused: Vec::new() }
    }

    /// Start of each camera against a log.
    pub(super) fn by_log(cameras: &[CameraLabels], log: &FlightLog) -> Result<Self, FlightError> {
        let mut begun = Self::new(Course::of(log).ok_or(FlightError::NoSolution)?);
        for camera in cameras {
            let (own, start) = target_of(camera, &begun.course);
            let others = camera.labels.len() - own.labels.len();
            begun.of_others.push((camera.name.clone(), others));
            begun.take(&own, start.map_err(|why| with_cure(camera, &begun.course, cameras, why)));
        }
        // Only now is each clock known well enough to say which labels are of one time.
        begun.leave_lonely_out(true);
        if begun.cameras.is_empty() {
            let (camera, why) = begun.refused.into_iter().next().ok_or(FlightError::NoSolution)?;
            return Err(FlightError::NoCamera { camera, why });
        }
        Ok(begun)
    }

    /// Start from two cameras that saw the target together, and of the others against the
    /// trajectory that these two give.
    pub(super) fn by_pairs(
        cameras: &[CameraLabels],
        survey: &Survey,
    ) -> Result<(Self, FlightState), FlightError> {
        let (usable, unusable): (Vec<_>, Vec<_>) =
            cameras.iter().map(|camera| (camera, usable(camera))).partition(|(_, is)| is.is_ok());
        let usable: Vec<&CameraLabels> = usable.into_iter().map(|(camera, _)| camera).collect();
        if usable.len() < 2
            && let Some((camera, Err(why))) = unusable.first()
        {
            return Err(FlightError::NoCamera { camera: camera.name.clone(), why: why.clone() });
        }
        let own = things::of_one_target(&usable, survey);
        let mut begun = best_of_pairs(&own.iter().collect::<Vec<_>>(), survey)?;
        let of_others = usable
            .iter()
            .zip(&own)
            .map(|(all, own)| (own.name.clone(), all.labels.len() - own.labels.len()));
        begun.of_others = of_others.collect();
        for (camera, why) in unusable {
            begun.refused.extend(why.err().map(|why| (camera.name.clone(), why)));
        }
        begun.order_as(cameras);
        begun.leave_lonely_out(false);
        let state = begun.unknowns(false);
        let aligned = align::to_survey(&state, &begun.cameras, survey);
        let (state, growth) = aligned.map_err(|untold| FlightError::NoSize { untold })?;
        // From here on the aligned state is used; of the start only the jerk is, which grows with
        // the square of the scale.
        begun.course.jerk *= growth * growth;
        Ok((begun, state))
    }

    fn take(&mut self, camera: &CameraLabels, start: Result<CameraUnknowns, Refusal>) {
        match start {
            Ok(state) => {
                self.cameras.push(camera.clone());
                self.states.push(state);
            }
            Err(why) => self.refused.push((camera.name.clone(), why)),
        }
    }

    /// Puts the cameras into the order that they were given in.
    fn order_as(&mut self, cameras: &[CameraLabels]) {
        let (names, states) = (self.cameras.drain(..), self.states.drain(..));
        let mut both: Vec<(CameraLabels, CameraUnknowns)> = names.zip(states).collect();
        both.sort_by_key(|(own, _)| cameras.iter().position(|camera| camera.name == own.name));
        (self.cameras, self.states) = both.into_iter().unzip();
    }

    /// Removes labels made where neither the log nor another camera tells how far away the target
    /// was: the jerk's prior would draw the target up to the camera.
    fn leave_lonely_out(&mut self, has_log: bool) {
        let times: Vec<Vec<f64>> = self
            .cameras
            .iter()
            .zip(&self.states)
            .map(|(camera, state)| {
                let mut times: Vec<f64> =
                    camera.labels.iter().map(|label| state.time_s(label)).collect();
                times.sort_unstable_by(f64::total_cmp);
                times
            })
            .collect();
        for (index, camera) in self.cameras.iter_mut().enumerate() {
            let state = &self.states[index];
            camera.labels.retain(|label| {
                let time_s = state.time_s(label);
                let mut others = times.iter().enumerate().filter(|(other, _)| *other != index);
                (has_log && self.course.weights(time_s).is_some())
                    || others.any(|(_, times)| is_near(times, time_s))
            });
        }
        let (cameras, states) =
            (std::mem::take(&mut self.cameras), std::mem::take(&mut self.states));
        for (camera, state) in cameras.into_iter().zip(states) {
            // Too few labels may be left.
            let start = usable(&camera).map(|()| state);
            self.take(&camera, start);
        }
    }

    /// All unknowns at the start: each camera in its state, the trajectory as the course shows it.
    pub(super) fn unknowns(&self, has_log: bool) -> FlightState {
        let labels = self.cameras.iter().zip(&self.states);
        let times = labels
            .flat_map(|(camera, state)| camera.labels.iter().map(|label| state.time_s(label)));
        let (from, to) = times.fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), time_s| {
            (from.min(time_s), to.max(time_s))
        });
        let mut way = TrajectorySpline::over(from - MARGIN_S, to + MARGIN_S);
        self.course.lead(&mut way);
        let mut states = self.states.clone();
        states.iter_mut().for_each(|camera| camera.clock.wander = way.drift());
        // Clocks and bias drift between knots that stand with the trajectory's.
        let bias = vec![way.drift(); if has_log { 3 } else { 0 }];
        FlightState { way, cameras: states, bias }
    }

    /// Priors and noise of the first round.
    pub(super) fn priors(&self) -> Priors {
        let cameras = self.cameras.iter().map(first_priors).collect();
        Priors { jerk: self.course.jerk, rate_sd: RATE_SD, cameras }
    }

    /// Places cameras that have no pose yet against the trajectory that the placed ones give, until
    /// no more fit.
    fn place_the_rest(&mut self, cameras: &[&CameraLabels], sights: &[Sights]) -> Option<()> {
        loop {
            let placed: Vec<_> = self
                .cameras
                .iter()
                .zip(&self.states)
                .filter_map(|(camera, state)| Some((sights_of(camera, cameras, sights)?, state)))
                .collect();
            // Each camera that is placed makes the trajectory better, and cameras that did not fit
            // before may fit it.
            self.course = Course::of(&triangulation::log(&placed))?;
            let before = self.cameras.len();
            self.refused.clear();
            for camera in cameras {
                if self.cameras.iter().all(|placed| placed.name != camera.name) {
                    let start = placed_against(camera, &self.course).map(|(state, _)| state);
                    self.take(camera, start);
                }
            }
            if self.cameras.len() == before {
                return Some(());
            }
        }
    }

    /// Whether it fits about as well as the best start, but with other relative poses.
    fn rivals(&self, best: &Self) -> bool {
        let names = best.cameras.iter().map(|camera| &camera.name);
        let turns: Vec<[Rotation3<f64>; 2]> = names
            .filter_map(|name| Some([self.rotation_of(name)?, best.rotation_of(name)?]))
            .collect();
        // The two starts have different worlds: only the turn of one camera against the next can be
        // compared.
        let stand_otherwise = turns.windows(2).any(|pair| {
            let [own, bests] = [0, 1].map(|k| pair[0][k].inverse() * pair[1][k]);
            turn_vector(&(own.inverse() * bests)).norm() > OTHERWISE_RAD
        });
        self.fits_as(best) && stand_otherwise
    }

    fn rotation_of(&self, camera: &CameraName) -> Option<Rotation3<f64>> {
        let index = self.cameras.iter().position(|own| own.name == *camera)?;
        Some(self.states[index].rotation)
    }

    /// Whether it fits about as well as the best start.
    fn fits_as(&self, best: &Self) -> bool {
        self.cameras.len() == best.cameras.len() && self.misfit() <= AS_GOOD_TIMES * best.misfit()
    }

    /// Sum of all cameras' median misfits to the course, rad.
    fn misfit(&self) -> f64 {
        let both = self.cameras.iter().zip(&self.states);
        both.map(|(camera, state)| start::misfit_of(camera, state, &self.course)).sum()
    }
}

/// Whether one of these times, which are in order, is about the same.
fn is_near(times: &[f64], time_s: f64) -> bool {
    // The first that is not too early is the only one that has to be looked at.
    let next = times.partition_point(|other| *other < time_s - TOGETHER_S);
    times.get(next).is_some_and(|other| *other < time_s + TOGETHER_S)
}

/// What a camera, one of these, saw of the target.
fn sights_of<'a>(
    camera: &CameraLabels,
    cameras: &[&CameraLabels],
    sights: &'a [Sights],
) -> Option<&'a Sights> {
    sights.get(cameras.iter().position(|other| other.name == camera.name)?)
}

/// Whether a camera has enough labels, and of one flight.
fn usable(camera: &CameraLabels) -> Result<(), Refusal> {
    let labels = camera.labels.len();
    if labels < LEAST_LABELS {
        return Err(Refusal::FewLabels { labels });
    }
    let hours = hours(camera.labels.iter().map(|label| label.time_s));
    if hours > LONGEST_FLIGHT_H {
        return Err(Refusal::LongFlight { hours });
    }
    Ok(())
}

/// A camera's start against a course.
fn placed_against(
    camera: &CameraLabels,
    course: &Course,
) -> Result<(CameraUnknowns, f64), Refusal> {
    let (state, misfit) = start::find(camera, course, frame_time(camera)).ok_or(Refusal::NoTime)?;
    tracing::debug!(
        "camera `{}` starts at {:.2} with the clock {:.3} s behind, {:.2} mrad off",
        camera.name,
        state.centre,
        state.clock.offset_s,
        misfit * 1e3
    );
    if fits(misfit, &state, course) {
        return Ok((state, misfit));
    }
    Err(Refusal::Misfit { misfit_mrad: misfit * 1e3, would_fit: None })
}

/// A camera's start against a log, unless the mirror image fits far better: in a short flight the
/// mirror image may lie near enough to be begun with.
fn proven(
    camera: &CameraLabels,
    course: &Course,
    state: CameraUnknowns,
    misfit: f64,
) -> Result<CameraUnknowns, Refusal> {
    let mirrored = || start::find(camera, &course.mirrored(), frame_time(camera));
    if misfit > DOUBTED_RAD && mirrored().is_some_and(|(_, other)| other * CLEARLY_BETTER < misfit)
    {
        let would_fit = Some(WouldFit::MirrorImage);
        return Err(Refusal::Misfit { misfit_mrad: misfit * 1e3, would_fit });
    }
    Ok(state)
}

/// A camera's labels of the log's target, and its start: it may have followed other things as well.
fn target_of(
    camera: &CameraLabels,
    course: &Course,
) -> (CameraLabels, Result<CameraUnknowns, Refusal>) {
    let started =
        |camera: &CameraLabels| usable(camera).and_then(|()| placed_against(camera, course));
    let start = started(camera);
    let own = match &start {
        Ok((state, _)) => Some(start::without_others(camera, state, course)),
        Err(Refusal::Misfit { .. }) => start::among_others(camera, course, frame_time(camera)),
        Err(_) => None,
    };
    let fewer = own.filter(|own| own.labels.len() < camera.labels.len());
    let (own, start) = match fewer.map(|own| (started(&own), own)) {
        Some((Ok(start), own)) => (own, Ok(start)),
        _ => (camera.clone(), start),
    };
    // Fewer labels are taken only if they give a start; the mirror image is tried with what is
    // left.
    let start = start.and_then(|(state, misfit)| proven(&own, course, state, misfit));
    tracing::debug!(
        "camera `{}`: {} of {} labels are of the log's target",
        own.name,
        own.labels.len(),
        camera.labels.len()
    );
    (own, start)
}

fn first_priors(camera: &CameraLabels) -> CameraPriors {
    CameraPriors {
        noise: FIRST_NOISE,
        lens: camera.intrinsics,
        freedom: camera.freedom,
        frame_s: frame_time(camera),
        wander: FIRST_WANDER,
    }
}

/// Whether a start lies near enough to a course.
fn fits(misfit: f64, state: &CameraUnknowns, course: &Course) -> bool {
    // m / m = rad: an error of the log, seen across from the median distance.
    let of_errors = LOG_DEVIATIONS * course.errors.sd_m.hypot(course.errors.drift_sd_m);
    misfit <= MOST_MISFIT_RAD + of_errors / course.middle_distance(state.centre)
}

/// Why a camera does not fit a log, with what would make it fit.
fn with_cure(
    camera: &CameraLabels,
    course: &Course,
    cameras: &[CameraLabels],
    why: Refusal,
) -> Refusal {
    let Refusal::Misfit { misfit_mrad, would_fit: None } = why else { return why };
    let would_fit = would_fit::find(camera, course, cameras, misfit_mrad * 1e-3);
    Refusal::Misfit { misfit_mrad, would_fit }
}

/// Two cameras to begin with: their possible poses, and the second's clock.
struct BeginWith<'a> {
    cameras: [&'a CameraLabels; 2],
    /// The common time is that of the first's clock.
    poses: [StartPose; 2],
    /// As [`RelativePose::range_uncertainty`].
    range_uncertainty: f64,
    /// Whether the poses are those of an earlier calibration.
    is_known: bool,
}

impl<'a> BeginWith<'a> {
    fn found(cameras: [&'a CameraLabels; 2], sights: [&Sights; 2]) -> Vec<Self> {
        pairs::find(sights[0], sights[1]).iter().map(|pair| Self::of_pair(cameras, pair)).collect()
    }

    fn of_pair(cameras: [&'a CameraLabels; 2], pair: &RelativePose) -> Self {
        Self {
            cameras,
            poses: pair.start_poses(),
            range_uncertainty: pair.range_uncertainty,
            is_known: false,
        }
    }

    fn known(
        cameras: [&'a CameraLabels; 2],
        sights: [&Sights; 2],
        survey: &Survey,
    ) -> Option<Self> {
        let pose = |camera: &CameraLabels| Some(survey.known(&camera.name)?.camera.pose());
        let both = [pose(cameras[0])?, pose(cameras[1])?];
        let pair = pairs::known(sights[0], sights[1], both)?;
        let poses = [(both[0], 0.0), (both[1], pair.ahead_s)].map(|(pose, offset_s)| StartPose {
            rotation: *pose.rotation(),
            centre: pose.position(),
            offset_s,
        });
        Some(Self { cameras, poses, range_uncertainty: pair.range_uncertainty, is_known: true })
    }

    /// All cameras, begun with these two; `None` if what the two saw gives no trajectory.
    fn begun(&self, cameras: &[&CameraLabels], sights: &[Sights]) -> Option<BegunFlight> {
        tracing::debug!(
            "`{}` and `{}` are {:.3} s apart (range uncertainty {:.1e}){}",
            self.cameras[0].name,
            self.cameras[1].name,
            self.poses[1].offset_s,
            self.range_uncertainty,
            if self.is_known { ", where they were" } else { "" }
        );
        // Their trajectory is not known yet: the clocks' knots are made with it.
        let mut begun = BegunFlight::new(Course::nowhere());
        for (camera, pose) in self.cameras.into_iter().zip(self.poses) {
            let state = start::state(camera, &begun.course, pose);
            begun.take(camera, Ok(state));
        }
        begun.place_the_rest(cameras, sights)?;
        Some(begun)
    }
}

/// The least range uncertainty of the ways to begin with a pair of cameras, which has up to three
/// poses: pairs are ranked by it.
fn least_uncertainty(ways: &[BeginWith<'_>]) -> f64 {
    ways.iter().map(|way| way.range_uncertainty).fold(f64::INFINITY, f64::min)
}

/// Of the best pairs the one that most cameras fit, and fit best; poses of an earlier calibration
/// are preferred if they fit about as well.
fn best_of_pairs(cameras: &[&CameraLabels], survey: &Survey) -> Result<BegunFlight, FlightError> {
    let sights: Vec<Sights> = cameras.iter().map(|camera| Sights::of(camera)).collect();
    let (mut found, mut known) = (Vec::new(), Vec::new());
    for first in 0..cameras.len() {
        for second in first + 1..cameras.len() {
            let both = [cameras[first], cameras[second]];
            let seen = [&sights[first], &sights[second]];
            found.push(BeginWith::found(both, seen));
            known.extend(BeginWith::known(both, seen, survey));
        }
    }
    found.sort_by(|a, b| least_uncertainty(a).total_cmp(&least_uncertainty(b)));
    known.sort_by(|a, b| a.range_uncertainty.total_cmp(&b.range_uncertainty));
    let tried = found.into_iter().take(PAIRS_TRIED).flatten();
    let ways = tried.chain(known.into_iter().take(PAIRS_TRIED));
    let begun = ways.filter_map(|way| Some((way.begun(cameras, &sights)?, way.is_known)));
    let mut begun: Vec<(BegunFlight, bool)> = begun.collect();
    begun.sort_by(|(a, _), (b, _)| {
        // Most cameras first; of as many, the least misfit.
        let fewer = b.cameras.len().cmp(&a.cameras.len());
        fewer.then_with(|| a.misfit().total_cmp(&b.misfit()))
    });
    let ((best, _), others) = begun.split_first().ok_or(FlightError::NoPair)?;
    // Before the rivals: an earlier calibration says which of two that fit alike is true.
    let as_good = |(other, is_known): &(BegunFlight, bool)| *is_known && other.fits_as(best);
    if let Some(index) = begun.iter().position(as_good) {
        return Ok(begun.swap_remove(index).0);
    }
    if others.iter().any(|(other, _)| other.rivals(best)) {
        return Err(FlightError::TwoWays);
    }
    Ok(begun.swap_remove(0).0)
}
