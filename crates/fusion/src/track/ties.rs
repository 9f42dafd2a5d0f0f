//! What ties a track to the errors that all bearings of a camera share, and what its bearings tell
//! of them.

use crossfix_geometry::SightLine;
use crossfix_message::{CameraName, Timestamp};
use nalgebra::{Matrix2, Matrix2x3, Matrix2x6, Unit, Vector2, Vector3};

use super::learnt::LearntTies;
use super::{Innovation, Track};
use crate::cameras::{ClockChange, LastThree, Sample};
use crate::motion::Motion;
use crate::uncertainty::{CameraUncertainty, LASTING, LastingNoise, OF_CLOCK, OF_POSE, SharedTies};
use crate::update::{Told, Updated};
use crate::visibility::Visibility;

/// Bearings further apart than this share of the time for which one holds a track tell no noise
/// from jerks.
const CLOSE_BEARINGS: f64 = 0.1;
/// A draw of the cameras' errors lasts this long, s: some bearings of each camera, and a sway of a
/// mast is seen.
const DRAW_S: f64 = 0.3;

/// A camera's bearing holds a track for so many times what has lain between its last two, so that
/// it may miss none and come late, ...
const HOLDING_PERIODS: f64 = 1.5;
/// ... where these lay no further apart than so many times what a bearing holds a track for.
const LONGEST_PERIOD: f64 = 2.0;

/// A camera that sees a target misses it without having lost it for this share of the time for which
/// one bearing holds a track: 0.3 s by default. In that time a small drone's speed changes by a metre
/// a second or two, unseen along the sight line of the other camera; with half of it a detector's
/// misses are taken for that.
const MISSED: f64 = 0.2;

/// Something beside a target is steady if it moves by less than this share of how far away it is
/// from draw to draw, ...
const STEADY: f64 = 0.2;
/// ... for so many draws, a second and a half. With half of it what flies by in the same direction
/// is taken for the target.
const STEADY_DRAWS: u32 = 5;
/// So many cameras must have it beside the target: one may be turned, and it is for the others to
/// accuse it.
const LEAST_BESIDE: usize = 2;

/// What ties a track to the shared errors of a camera that has seen it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Ties {
    /// Covariance of position and velocity with the errors, each in its own deviations.
    pub(super) covariance: SharedTies,
    /// Covariance of what the track learns of errors that last with them.
    pub(super) learnt: LearntTies,
    /// How long those last that pass, s.
    pub(super) lasting_s: f64,
    /// Whether the camera can see the target, when it was exposed last.
    pub(super) visibility: Visibility,
    /// When it gave the track its last bearing, ...
    seen: Option<Timestamp>,
    /// ... and how long after the one before, s.
    period_s: f64,
    pub(super) last_three: LastThree,
    pub(super) drawn: Option<Drawn>,
    /// The same of what it has seen beside the target, where it has not seen that.
    beside: Option<Drawn>,
    /// Where that was in the last draw (rad), and for how many draws it has been there.
    steady: (Vector2<f64>, u32),
}

/// What a camera has seen of the target since the last draw: see [`crate::pose_scale`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Drawn {
    offsets: Vector2<f64>,
    count: f64,
    by_position: Matrix2x3<f64>,
    /// Covariance of each bearing's noise, rad^2.
    noise: Matrix2<f64>,
    /// What lasts of it, and so is no less in the mean.
    lasting: LastingNoise,
    pose: Matrix2<f64>,
    by_pose: Matrix2x6<f64>,
    clock: Vector2<f64>,
    /// What the clock may be off by, s.
    time_sd_s: f64,
}

impl Drawn {
    /// What is gathered with one bearing more.
    fn with(
        before: Option<Self>,
        (innovation, velocity): (&Innovation, Vector3<f64>),
        line: &SightLine,
        uncertainty: &CameraUncertainty,
    ) -> Self {
        let (offsets, count) =
            before.map_or((Vector2::zeros(), 0.0), |drawn| (drawn.offsets, drawn.count));
        Self {
            offsets: offsets + innovation.offset,
            count: count + 1.0,
            by_position: innovation.model.by_position(),
            noise: innovation.model.covariance_of(line) * uncertainty.factor,
            lasting: uncertainty.lasting,
            pose: uncertainty.declared_pose(&innovation.model),
            by_pose: innovation.model.by_pose(),
            clock: innovation.model.by_time(velocity) * uncertainty.time_sd_s,
            time_sd_s: uncertainty.time_sd_s,
        }
    }

    /// The mean, of a target whose velocity is known to `speed`, m/s.
    fn sample(self, camera: &CameraName, speed: f64) -> Sample {
        let moved = self.by_position * (speed * DRAW_S / 10.0);
        let white = self.noise / self.count + moved * moved.transpose();
        // What the clock shifts it by is reckoned with a velocity that is no better known.
        let by_speed = self.by_position * (speed * self.time_sd_s);
        let lasting = Matrix2::identity() * self.lasting.as_white(DRAW_S);
        Sample {
            camera: camera.clone(),
            offset: self.offsets / self.count,
            by_position: self.by_position,
            noise: white + Matrix2::identity() * self.lasting.variance(),
            pose: self.pose,
            by_pose: self.by_pose,
            clock: self.clock,
            slow_noise: white + lasting + by_speed * by_speed.transpose(),
        }
    }
}

impl Ties {
    /// What the camera has seen beside the target since the last draw, if it has long been in the
    /// same place.
    fn steady_beside(&mut self) -> Option<Drawn> {
        let beside = self.beside.take().filter(|_| self.drawn.is_none());
        let place = beside.map(|drawn| drawn.offsets / drawn.count);
        let (before, draws) = self.steady;
        let stays = place.is_some_and(|place| (place - before).norm() < STEADY * before.norm());
        self.steady =
            place.map_or((Vector2::zeros(), 0), |place| (place, if stays { draws + 1 } else { 0 }));
        beside.filter(|_| self.steady.1 >= STEADY_DRAWS)
    }

    pub(super) fn new(time: Timestamp) -> Self {
        Self {
            covariance: SharedTies::zeros(),
            learnt: LearntTies::zeros(0),
            lasting_s: LastingNoise::NONE.time_s,
            visibility: Visibility::new(time),
            seen: None,
            period_s: 0.0,
            last_three: LastThree::default(),
            drawn: None,
            beside: None,
            steady: (Vector2::zeros(), 0),
        }
    }

    /// Of a camera that has given the bearing with which the track begins.
    pub(super) fn begun(time: Timestamp, covariance: SharedTies, lasting: LastingNoise) -> Self {
        let lasting_s = lasting.time_s;
        Self {
            covariance,
            lasting_s,
            visibility: Visibility::seen(time),
            seen: Some(time),
            ..Self::new(time)
        }
    }

    /// All clocks have stepped by so much, s.
    pub(super) fn step_time(&mut self, step_s: f64) {
        self.visibility.step_time(step_s);
        self.seen = self.seen.map(|seen| seen.plus_seconds(step_s));
        self.last_three = LastThree::default();
    }

    /// For how long the camera has given the track no bearing, s.
    pub(super) fn silent_s(&self, now: Timestamp) -> Option<f64> {
        Some(now.seconds_since(self.seen?))
    }

    /// Takes the velocity for tied to none of the errors.
    pub(super) fn forget_velocity(&mut self) {
        self.covariance.fixed_rows_mut::<3>(3).fill(0.0);
    }

    /// The camera has given the track a bearing.
    pub(super) fn see(&mut self, time: Timestamp) {
        self.period_s = self.seen.map_or(0.0, |seen| time.seconds_since(seen).abs());
        self.seen = Some(time);
    }

    /// Whether the camera has given the track a bearing so lately that it holds it, as one does for
    /// `holding_s` seconds: a camera that sees the target every two seconds has not lost it after
    /// one and a half.
    pub(super) fn has_seen_lately(&self, now: Timestamp, holding_s: f64) -> bool {
        let period_s = self.period_s.min(LONGEST_PERIOD * holding_s);
        self.seen.is_some_and(|seen| {
            now.seconds_since(seen) <= holding_s.max(HOLDING_PERIODS * period_s)
        })
    }

    /// Whether the camera sees the target now: it has not missed it for longer than a detector may,
    /// or than its bearings lie apart.
    pub(super) fn sees(&self, now: Timestamp, holding_s: f64) -> bool {
        let period_s = self.period_s.min(LONGEST_PERIOD * holding_s);
        let missed_s = (MISSED * holding_s).max(HOLDING_PERIODS * period_s);
        self.seen.is_some_and(|seen| now.seconds_since(seen) <= missed_s)
    }

    /// The same `interval` seconds on: the position goes on with the velocity, and what lasts is
    /// partly gone.
    pub(super) fn predicted(&self, interval: f64) -> SharedTies {
        let mut covariance = self.covariance;
        let velocity = covariance.fixed_rows::<3>(3).into_owned();
        let mut position = covariance.fixed_rows_mut::<3>(0);
        position += velocity * interval;
        let mut lasting = covariance.fixed_columns_mut::<2>(LASTING);
        lasting *= self.kept(interval);
        covariance
    }

    /// How much of what lasts is left after an interval, s.
    pub(super) fn kept(&self, interval: f64) -> f64 {
        (-interval.abs() / self.lasting_s).exp()
    }
}

impl Track {
    /// Keeps a bearing for the next draw.
    pub(super) fn gather(
        &mut self,
        camera: &CameraName,
        innovation: &Innovation,
        line: &SightLine,
        uncertainty: &CameraUncertainty,
    ) {
        let velocity = self.state().velocity();
        if let Some(ties) = self.ties.get_mut(camera) {
            ties.drawn = Some(Drawn::with(ties.drawn, (innovation, velocity), line, uncertainty));
        }
    }

    /// Keeps a bearing for the next draw that a camera has beside the target, and none of it.
    pub(crate) fn gather_beside(
        &mut self,
        camera: &CameraName,
        (line, time): (&SightLine, Timestamp),
        uncertainty: &CameraUncertainty,
    ) {
        let velocity = self.state().velocity();
        if let (Some(innovation), Some(ties)) =
            (self.innovation(time, line), self.ties.get_mut(camera))
        {
            let seen = (&innovation, velocity);
            ties.beside = Some(Drawn::with(ties.beside, seen, line, uncertainty));
        }
    }

    /// What the cameras have seen of the target since the last draw, if it is time for the next.
    /// Where as many cameras as see it have long had something beside it in the same place, it is
    /// the target, and the poses are worse than they say.
    pub(crate) fn draw(&mut self) -> Vec<Sample> {
        if self.updated.seconds_since(self.drawn) < DRAW_S {
            return Vec::new();
        }
        self.drawn = self.updated;
        // Cameras see it at other times within a draw: a velocity that is not known moves it in
        // between.
        let speed = self.state().covariance.diagonal().fixed_rows::<3>(3).sum().max(0.0).sqrt();
        let (mut samples, mut beside) = (Vec::new(), Vec::new());
        for (camera, ties) in &mut self.ties {
            let steady = ties.steady_beside();
            match ties.drawn.take() {
                Some(drawn) => samples.push(drawn.sample(camera, speed)),
                None => beside.extend(steady.map(|drawn| drawn.sample(camera, speed))),
            }
        }
        if beside.len() >= samples.len().max(LEAST_BESIDE) {
            samples.extend(beside);
        }
        samples
    }

    /// A camera's pose errors have been found to be larger or smaller (`ratio` of the variances):
    /// what they have done to the track is as well.
    pub(crate) fn rescale_pose(&mut self, camera: &CameraName, ratio: f64) {
        if let Some(change) = self.rescale::<OF_POSE>(camera, 0, (ratio, ratio.sqrt())) {
            self.imm.add_covariance(&change);
        }
    }

    /// A camera's clock has been found to be `ahead` (in the deviations that it had) of what was
    /// taken off its times, and its variance to be `ratio` times what it was: the track lies by as
    /// much beside where it was thought to be. What makes a variance smaller has been learnt of the
    /// error that the track holds; what makes it larger is an error that has come since, of which
    /// the track holds nothing.
    pub(crate) fn set_clock(
        &mut self,
        camera: &CameraName,
        ClockChange { ahead, ratio }: ClockChange,
    ) {
        let Some(ties) = self.ties.get(camera) else {
            return;
        };
        let moved = ties.covariance.column(OF_CLOCK) * ahead;
        self.imm.shift(&moved);
        self.shift_learnt(camera, OF_CLOCK, ahead);
        self.shift_past(camera, OF_CLOCK, ahead);
        let scale = ratio.min(ratio.recip()).sqrt();
        if let Some(change) = self.rescale::<1>(camera, OF_CLOCK, (ratio.min(1.0), scale)) {
            self.imm.add_covariance(&change);
        }
    }

    /// A camera's mount has turned it: what of its errors lasts until then is drawn anew.
    pub(crate) fn turn_camera(&mut self, camera: &CameraName) {
        self.renew(camera);
        let learns = self.learns(camera);
        if let Some(ties) = self.ties.get_mut(camera) {
            ties.last_three = LastThree::default();
            if !learns {
                ties.covariance.fixed_columns_mut::<2>(LASTING).fill(0.0);
                ties.learnt.fixed_columns_mut::<2>(LASTING).fill(0.0);
            }
        }
    }

    pub(super) fn third_difference(
        &mut self,
        camera: &CameraName,
        line: &SightLine,
        motion: &Motion,
    ) -> Option<f64> {
        let (now, state) = (self.updated, self.imm.combined());
        let (place, velocity) = (state.position(), state.velocity());
        let expected = |time: Timestamp| {
            Unit::try_new(place + velocity * time.seconds_since(now) - line.origin, 1e-6)
        };
        let last_three = &mut self.ties.get_mut(camera)?.last_three;
        last_three.see(now, line, motion.holding_s * CLOSE_BEARINGS, expected)
    }

    /// Carries what is known of all cameras' errors through an update, by the mean over the models;
    /// returns the mean squared distance of the bearing.
    pub(super) fn carry(
        &mut self,
        (camera, lasting): (&CameraName, LastingNoise),
        (time, interval): (Timestamp, f64),
        results: &[Option<Updated>],
    ) -> f64 {
        let models = results.iter().zip(self.imm.probabilities().iter().copied());
        let models = models.filter_map(|(result, weight)| Some((result.as_ref()?, weight)));
        let nis = models.clone().map(|(after, weight)| after.nis * weight).sum();
        let told = Told::over(models);
        self.note(camera, self.updated);
        self.pass_past(time);
        self.pass(interval);
        self.begin_to_learn(camera, lasting, time);
        self.look_back(camera, &told);
        self.learn(camera, &told);
        if let Some(ties) = self.ties.get_mut(camera) {
            ties.lasting_s = lasting.time_s;
        }
        self.keep_ties_possible();
        nis
    }

    /// Has ties to a camera's errors from now on.
    pub(super) fn note(&mut self, camera: &CameraName, time: Timestamp) {
        if !self.ties.contains_key(camera) {
            let learnt = self.untied();
            self.ties.insert(camera.clone(), Ties { learnt, ..Ties::new(time) });
        }
    }

    /// The ties are carried by the mean over the models: where one model alone is surer than they
    /// allow, it is not believed.
    pub(super) fn keep_ties_possible(&mut self) {
        let shared = self.shared_part();
        if shared.amax() > 0.0 {
            self.imm.exceed(&shared);
        }
    }
}
