//! Detects a camera that has been moved since it was calibrated, by where the others see the
//! targets.
//!
//! The errors of all cameras' poses and clocks are estimated at once from how the sight lines of
//! one target miss each other, each with a prior as narrow as its calibration says. The error of a
//! camera that somebody has turned is far larger than that: with a prior as wide as a knock for
//! this camera alone, the lines become many times more likely. The estimated errors correct
//! nothing; a new calibration does. But a pose is only as sure as it is that nobody has moved its
//! camera: what the chance of that adds to the pose's variance is passed on to the tracks.

mod knock;
mod memory;
mod survey;

use std::collections::BTreeMap;

use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix6, SMatrix, Unit, Vector3};

use super::meeting::Meeting;
use super::pose_scale::{Moved, Surveyed};
use super::{Cameras, ScaleSample};
use crate::evidence::ONE_IN_A_HUNDRED;
use knock::{Knocks, Watched};
use memory::{ErrorEstimate, Memory};

/// Time constants of the memories, s in which targets are seen: a camera was moved that long ago,
/// or longer, each as likely. A large turn shows in the shorter time, while most of the longer one
/// would be from before it; a small turn, or that of a camera whose bearings are noisy, takes the
/// longer time to be sure. With half of both a turn must be 1.4 times as large to be sure of.
const MEMORIES_S: [f64; 2] = [20.0, 100.0];
/// Longest time that counts between two successive draws, s: in a pause without a target nothing is
/// learnt. With half of it the same: a draw lasts a third of a second.
const LONGEST_DRAW_S: f64 = 1.0;
/// Degrees of freedom of Student's t: lines that miss each other by far more than anything explains
/// are of two targets, and have the weight that this distribution gives them. With half of it such
/// lines count a quarter less.
const FREEDOM: f64 = 4.0;
/// A camera is said to have been moved if the lines are this many times (logarithm) more likely by
/// it: a thousand times, as one of a site's is moved about once in a thousand minutes, a day. Of
/// the 62 ways of taking two, three, four or six cameras of the real flights, two name one that
/// stands where it stood. With clocks declared exact that were off by up to a tenth of a second, 39
/// did. With half of it 30 times would do, against odds of a thousand.
const SURE: f64 = 6.9;

/// How often the chance that a camera has been moved is computed, s: 64 cameras cost 27 ms, and
/// the cost grows with the third power. With half of it twice that, and tracks say half a second
/// earlier how unsure they are.
const ASKED_EVERY_S: f64 = 1.0;

/// Fewer cameras do not check one another: with two, an error in the plane of their sight lines
/// shows in neither.
const LEAST_TOGETHER: usize = 3;

/// Number of errors of a camera: rotation, place and clock, each in units of its own deviation.
const ERRORS: usize = 7;
/// Index of the clock's error among them.
const CLOCK: usize = 6;

/// What the lines say about whether a camera has been moved.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseFinding {
    /// How long the camera has been watched beside two others, of the last minutes, s.
    pub watched_s: f64,
    /// By how much it would have been turned, about the world's axes, rad.
    pub turn: Vector3<f64>,
    /// Standard deviation of that along the axis that is known worst, rad.
    pub turn_sd: f64,
    /// Log-likelihood ratio of the lines: that the camera has been moved, against that none has.
    pub log_odds: f64,
    /// Whether it has been moved for sure: this camera, or one of those that are as likely.
    pub is_moved: bool,
    /// The other cameras that may have been moved in its place, if it has.
    pub or_else: Vec<CameraName>,
}

impl PoseFinding {
    /// Whether it has been moved for sure, and no other in its place.
    pub fn is_moved_alone(&self) -> bool {
        self.is_moved && self.or_else.is_empty()
    }
}

/// What the lines say about the errors of all cameras.
#[derive(Clone, Debug, Default)]
pub(super) struct ErrorWatch {
    cameras: Vec<Watched>,
    memories: [Memory; MEMORIES_S.len()],
    drawn: Option<Timestamp>,
    /// When it was last computed who may have been moved.
    asked: Option<Timestamp>,
}

impl ErrorWatch {
    /// Index of a camera, which looks `forward`, among those watched.
    fn place_of(
        &mut self,
        name: &CameraName,
        declared: &Matrix6<f64>,
        forward: Unit<Vector3<f64>>,
    ) -> usize {
        if let Some(place) = self.known(name) {
            return place;
        }
        self.cameras.push(Watched::new(name.clone(), declared, forward));
        let errors = ERRORS * self.cameras.len();
        self.memories.iter_mut().for_each(|memory| memory.widen(errors));
        self.cameras.len() - 1
    }

    /// Index of a camera among those watched.
    fn known(&self, name: &CameraName) -> Option<usize> {
        self.cameras.iter().position(|camera| camera.name == *name)
    }

    /// Forgets a camera that stands elsewhere, or is known otherwise: what was seen is of before.
    pub(super) fn forget(&mut self, name: &CameraName) {
        if let Some(place) = self.known(name) {
            self.cameras.remove(place);
            self.memories.iter_mut().for_each(|memory| memory.remove(ERRORS * place));
        }
    }

    /// Forgets the error of a clock that is known otherwise than it was: it is another error from
    /// now on. Taken for the same one before and after, it would turn the camera.
    pub(super) fn forget_clock(&mut self, name: &CameraName) {
        if let Some(place) = self.known(name) {
            let clock = ERRORS * place + CLOCK;
            self.memories.iter_mut().for_each(|memory| memory.forget(clock, 1));
        }
    }

    /// Takes in whether part of a camera's noise is known to last. What was learnt of its errors
    /// before that was found is forgotten: such noise was taken to average out, and two lines of it
    /// passed for an error of the pose that no later line could disprove.
    fn note_noise(&mut self, place: usize, lasts: bool) {
        let camera = &mut self.cameras[place];
        if lasts && !camera.noise_lasts {
            camera.noise_lasts = true;
            camera.watched_s = 0.0;
            self.memories.iter_mut().for_each(|memory| memory.forget(ERRORS * place, ERRORS));
        }
    }

    /// Discounts the memories by the time since the last draw.
    fn age(&mut self, now: Timestamp) {
        let last = self.drawn.replace(now);
        let since = last.map_or(0.0, |last| now.seconds_since(last).clamp(0.0, LONGEST_DRAW_S));
        for (memory, memory_s) in self.memories.iter_mut().zip(MEMORIES_S) {
            memory.fade((-since / memory_s).exp());
        }
        let longest_s = MEMORIES_S.into_iter().fold(0.0, f64::max);
        let kept = (-since / longest_s).exp();
        self.cameras.iter_mut().for_each(|camera| camera.watched_s *= kept);
    }

    /// Takes in what cameras have seen of one target; `places` are their indices among those
    /// watched.
    fn learn(&mut self, samples: &[ScaleSample], places: &[usize], now: Timestamp) -> Option<()> {
        let by_errors: Vec<_> = samples
            .iter()
            .zip(places)
            .map(|(sample, place)| self.cameras[*place].by_errors(sample))
            .collect();
        // Weights by noise alone, and by noise and the errors that poses may have.
        let weights = samples.iter().map(|sample| sample.slow_noise.try_inverse());
        let weights: Vec<_> = weights.collect::<Option<_>>()?;
        // The misfit allows for pose errors: a camera that is off is no reason to doubt the target.
        let loose = samples
            .iter()
            .zip(&by_errors)
            .map(|(sample, by)| (sample.slow_noise + by * by.transpose()).try_inverse());
        let loose: Vec<_> = loose.collect::<Option<_>>()?;
        let squares = Meeting::of(samples, &loose)?.squares;
        // Student's t: weight (nu + n) / (nu + max(q, n)), with n = 2 m - 3 degrees of freedom.
        let count = 2.0 * samples.len() as f64 - 3.0;
        let weight = (FREEDOM + count) / (FREEDOM + squares.max(count));
        let meeting = Meeting::of(samples, &weights)?;
        let memories = self.memories.iter_mut();
        memories.for_each(|memory| memory.add_squares(meeting.squares * weight, count * weight));
        // With the target's place x eliminated (covariance S): pull_i = B_i' W_i (z_i - A_i x) and
        // I_ij = [i = j] B_i' W_i B_i - B_i' W_i A_i S A_j' W_j B_j.
        for (i, one) in places.iter().enumerate() {
            let own = by_errors[i].transpose() * weights[i];
            let away = samples[i].residual - samples[i].by_position * meeting.place;
            let pull = own * away * weight;
            self.memories.iter_mut().for_each(|memory| memory.add_pull(ERRORS * one, pull));
            for (j, other) in places.iter().enumerate() {
                let across = own
                    * samples[i].by_position
                    * meeting.spread
                    * samples[j].by_position.transpose()
                    * weights[j]
                    * by_errors[j];
                let direct = if i == j { own * by_errors[j] } else { SMatrix::zeros() };
                let (block, told) = ([one, other].map(|place| ERRORS * place), direct - across);
                for memory in &mut self.memories {
                    memory.add_information(block, told * weight);
                }
            }
        }
        for (sample, place) in samples.iter().zip(places) {
            self.cameras[*place].see(sample);
        }
        if places.len() >= LEAST_TOGETHER {
            places.iter().for_each(|place| self.cameras[*place].draw(now));
        }
        Some(())
    }

    /// All cameras' errors by each of the memories, the longest last; none if the numbers of one
    /// fail.
    fn estimates(&self) -> Vec<ErrorEstimate> {
        self.memories.iter().map(Memory::estimate).collect::<Option<_>>().unwrap_or_default()
    }

    /// What the lines say of each camera if it has been moved.
    fn knocks(&self, estimates: &[ErrorEstimate]) -> impl Iterator<Item = (&Watched, Knocks)> {
        self.cameras.iter().enumerate().filter_map(move |(place, camera)| {
            Some((camera, camera.knocks(estimates, ERRORS * place)?))
        })
    }

    /// What all lines together say of each pose whose deviation nobody has declared: those of the
    /// shorter memory. Errors of image trackers that last for seconds pass for errors of a pose,
    /// and the longer memory would keep them for minutes.
    fn survey(
        &self,
        estimates: &[ErrorEstimate],
        is_declared: impl Fn(&CameraName) -> bool,
    ) -> BTreeMap<CameraName, Surveyed> {
        let cameras = self.cameras.iter().enumerate();
        let undeclared = cameras.filter(|(_, camera)| !is_declared(&camera.name));
        let judged = undeclared.map(|(place, camera)| survey::Judged {
            first: ERRORS * place,
            clock_sd_s: camera.clock_sd_s,
        });
        let judged = judged.collect();
        let found = estimates.first().and_then(|latest| survey::survey(latest, judged));
        let name = |first: usize| self.cameras[first / ERRORS].name.clone();
        found.into_iter().flatten().map(|(first, said)| (name(first), said)).collect()
    }

    /// The chance that each camera has been moved. Where the lines do not tell which of two cameras
    /// it was, it is even.
    fn chances(&self, estimates: &[ErrorEstimate]) -> Vec<(CameraName, Moved)> {
        let knocks: Vec<_> = self.knocks(estimates).collect();
        // One camera has been moved, or none: P(k) = e^w_k / (1 + sum e^w), with w_k the log odds
        // of the lines less the logarithm of the odds against it beforehand.
        let weight = |own: &Knocks| own.log_odds - SURE;
        let most = knocks.iter().map(|(_, own)| weight(own)).fold(0.0, f64::max);
        let all =
            knocks.iter().map(|(_, own)| (weight(own) - most).exp()).sum::<f64>() + (-most).exp();
        let chances = knocks.iter().map(|(camera, own)| {
            let log_probability = weight(own) - most - all.ln();
            // What is less likely than one in a hundred counts as none.
            let is_possible = log_probability > ONE_IN_A_HUNDRED;
            let probability = if is_possible { log_probability.exp() } else { 0.0 };
            (camera.name.clone(), Moved { probability, factor: own.factor })
        });
        chances.collect()
    }

    /// What the lines say of each camera that has been watched.
    fn findings(&self) -> BTreeMap<CameraName, PoseFinding> {
        let estimates = self.estimates();
        let found = self.knocks(&estimates);
        let found = found.map(|(camera, knocks)| (camera.name.clone(), camera.finding(&knocks)));
        let mut found: BTreeMap<CameraName, PoseFinding> = found.collect();
        let most = found.values().map(|own| own.log_odds).fold(f64::NEG_INFINITY, f64::max);
        // Every camera that explains the lines nearly as well as the likeliest one stays a suspect.
        let likely =
            |own: &PoseFinding| own.log_odds > SURE && own.log_odds > most + ONE_IN_A_HUNDRED;
        let suspects: Vec<CameraName> =
            found.iter().filter(|(_, own)| likely(own)).map(|(name, _)| name.clone()).collect();
        for (name, own) in &mut found {
            if likely(own) {
                own.is_moved = true;
                own.or_else = suspects.iter().filter(|other| *other != name).cloned().collect();
            }
        }
        found
    }
}

impl Cameras {
    /// Takes in what cameras have seen of one target at a time; returns the cameras whose pose's
    /// factor has changed by that, each with the ratio.
    pub(crate) fn watch(
        &mut self,
        samples: &[ScaleSample],
        now: Timestamp,
    ) -> Vec<(CameraName, f64)> {
        let Self { by_name, watch, .. } = self;
        watch.age(now);
        let mut places = Vec::with_capacity(samples.len());
        for sample in samples {
            let Some(camera) = by_name.get(&sample.camera) else { return Vec::new() };
            let known = camera.known();
            let forward = Unit::new_normalize(known.camera.pose().rotation() * Vector3::z());
            let place = watch.place_of(&sample.camera, &known.pose_covariance, forward);
            watch.note_noise(place, sample.noise_lasts);
            places.push(place);
        }
        watch.learn(samples, &places, now);
        let lately = |asked: Timestamp| now.seconds_since(asked).abs() < ASKED_EVERY_S;
        if watch.asked.is_some_and(lately) {
            return Vec::new();
        }
        watch.asked = Some(now);
        let estimates = watch.estimates();
        let is_declared =
            |name: &CameraName| by_name.get(name).is_none_or(|own| own.pose_scale.is_declared());
        let surveyed = watch.survey(&estimates, is_declared);
        let changed = watch.chances(&estimates).into_iter().filter_map(|(name, moved)| {
            let scale = &mut by_name.get_mut(&name)?.pose_scale;
            let ratio = scale.judge(moved, surveyed.get(&name).copied())?;
            Some((name, ratio))
        });
        changed.collect()
    }

    /// What the lines say of each camera that has been watched beside others.
    pub(crate) fn pose_findings(&self) -> BTreeMap<CameraName, PoseFinding> {
        self.watch.findings()
    }
}

#[cfg(test)]
mod tests {
    use crossfix_geometry::BearingModel;
    use nalgebra::{Matrix2, Point3, Vector2};

    use super::*;

    /// What two cameras see of a target at a place, where the first one is turned.
    fn samples(turn: Vector3<f64>, place: Point3<f64>) -> Vec<ScaleSample> {
        let sample = |name: &str, origin: Point3<f64>, turn: Vector3<f64>| {
            let model = BearingModel::new(origin, place).unwrap();
            ScaleSample {
                camera: name.parse().unwrap(),
                residual: model.by_pose().fixed_columns::<3>(0) * turn,
                by_position: model.by_position(),
                noise: Matrix2::identity() * 1e-8,
                pose: Matrix2::identity() * 3e-4,
                by_pose: model.by_pose(),
                by_time: Vector2::zeros(),
                clock_sd_s: 0.0,
                slow_noise: Matrix2::identity() * 1e-8,
                noise_lasts: false,
            }
        };
        vec![
            sample("a", Point3::new(-60.0, 0.0, 2.0), turn),
            sample("b", Point3::new(60.0, -80.0, 2.0), Vector3::zeros()),
        ]
    }

    /// A minute of a target that moves by `moves_m`, m, seen by two cameras of which one is turned,
    /// rad.
    fn watched(turn: Vector3<f64>, moves_m: f64) -> ErrorWatch {
        let declared = Matrix6::from_diagonal_element(9e-8);
        let mut watch = ErrorWatch::default();
        for k in 0..200u32 {
            let t = f64::from(k) * 0.3;
            watch.age(Timestamp::from_seconds(t));
            let (east, north) = ((0.2 * t).sin(), (0.3 * t).cos());
            let place = Point3::new(moves_m * east, moves_m * north, 25.0);
            let seen = samples(turn, place);
            let places: Vec<usize> = seen
                .iter()
                .map(|one| watch.place_of(&one.camera, &declared, Vector3::z_axis()))
                .collect();
            watch.learn(&seen, &places, Timestamp::from_seconds(t)).unwrap();
        }
        watch
    }

    #[test]
    fn where_a_target_hovers_between_two_cameras_either_may_have_been_moved() {
        let mut watch = watched(Vector3::new(0.0, 0.04, 0.0), 0.0);
        let found = watch.findings();
        assert!(found.values().all(|own| own.is_moved), "{found:?}");
        for (name, own) in &found {
            assert_eq!(own.or_else.len(), 1, "{found:?}");
            assert_ne!(own.or_else[0], *name);
        }
        // One is calibrated again: nothing is left of what was seen of it.
        let name: CameraName = "a".parse().unwrap();
        watch.forget(&name);
        let found = watch.findings();
        assert!(!found.contains_key(&name));
        assert!(found.values().all(|own| !own.is_moved) && found.len() == 1, "{found:?}");
    }

    /// By hand: a turn of 5 mrad about an axis across the view shifts lines by 5 mrad / sqrt 2 in
    /// the mean of both tangents, and the declared pose by 0.3 mrad or what `declared_rad` says.
    #[test]
    fn the_factor_is_what_a_turn_does_to_the_lines_over_what_the_declared_pose_does() {
        for declared_rad in [3e-4, 3e-5] {
            let mut watch = watched(Vector3::new(5e-3, 0.0, 0.0), 20.0);
            let mut seen = samples(Vector3::zeros(), Point3::new(0.0, 0.0, 25.0));
            seen[0].pose = Matrix2::identity() * declared_rad;
            watch.cameras[0].see(&seen[0]);
            let expected = 5e-3_f64.powi(2) / 2.0 / declared_rad.powi(2);
            let factor = watch.chances(&watch.estimates())[0].1.factor;
            assert!((factor / expected - 1.0).abs() < 0.05, "{factor} {expected}");
        }
    }

    /// The probability that each of the two cameras has been moved.
    fn chances(watch: &ErrorWatch) -> [f64; 2] {
        let chances = watch.chances(&watch.estimates());
        ["a", "b"]
            .map(|name| chances.iter().find(|one| one.0.as_str() == name).unwrap().1.probability)
    }

    #[test]
    fn the_chance_of_a_move_is_none_where_none_is_turned_and_shared_where_either_may_be() {
        assert_eq!(chances(&watched(Vector3::zeros(), 20.0)), [0.0; 2]);
        let mut either = watched(Vector3::new(0.0, 0.04, 0.0), 0.0);
        let [a, b] = chances(&either);
        assert!((a + b - 1.0).abs() < 1e-6 && a.min(b) > 0.05, "{a} {b}");
        let [a, b] = chances(&watched(Vector3::new(5e-3, 0.0, 0.0), 20.0));
        assert!(a > 0.99 && b < 0.01, "{a} {b}");
        // What was seen long ago fades, by the time in which targets were seen.
        for k in 0..3000 {
            either.age(Timestamp::from_seconds(60.0 + 0.3 * f64::from(k)));
        }
        assert_eq!(chances(&either), [0.0; 2]);
    }

    #[test]
    fn what_was_learnt_before_noise_was_known_to_last_is_forgotten_once() {
        let turned = Vector3::new(5e-3, 0.0, 0.0);
        let mut watch = watched(turned, 20.0);
        watch.note_noise(0, true);
        assert_eq!(chances(&watch), [0.0; 2]);
        // What is learnt from then on stays, even if the noise is white for a while.
        let (mut watch, before) = (watched(turned, 20.0), watched(turned, 20.0));
        watch.cameras[0].noise_lasts = true;
        [false, true].into_iter().for_each(|lasts| watch.note_noise(0, lasts));
        assert_eq!(chances(&watch), chances(&before));
    }

    #[test]
    fn where_it_moves_it_tells_which() {
        let found = watched(Vector3::new(5e-3, 0.0, 0.0), 20.0).findings();
        let [a, b] = ["a", "b"].map(|name| &found[&name.parse::<CameraName>().unwrap()]);
        assert!(a.is_moved && a.or_else.is_empty() && !b.is_moved, "{found:?}");
        assert!((a.turn - Vector3::new(5e-3, 0.0, 0.0)).norm() < a.turn_sd, "{a:?}");
    }
}
