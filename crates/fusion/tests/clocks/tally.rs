//! Clocks that are wrong, and what a fusion centre makes of them over a series of flights.

use std::collections::BTreeMap;
use std::time::Instant;

use crossfix_fusion::{ClockEstimate, Fusion, FusionConfig};
use crossfix_geometry::{Camera, Pose};
use crossfix_message::{BearingFrame, CameraCalibration, Timestamp};
use nalgebra::{Rotation3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use crate::common::{Scene, found, fusion_of};

/// Frames between two looks at the tracks.
const LOOK_EVERY: usize = 7;
/// A clock off by more than this is not settled, s.
const SETTLED_S: f64 = 5e-3;
/// A clock off by more than this in the end is lost, s.
const LOST_S: f64 = 10e-3;

/// A clock that is wrong: ahead by so much at time 0, and gaining; and what its camera says of it.
#[derive(Clone, Debug)]
pub struct Clock {
    pub camera: &'static str,
    pub offset_s: f64,
    pub drift: f64,
    pub sd_s: f64,
    /// From when on it is ahead by so much more, s.
    pub jump: Option<(f64, f64)>,
}

impl Clock {
    pub fn offset_at(&self, time: f64) -> f64 {
        let jumped = self.jump.filter(|(from, _)| time >= *from).map_or(0.0, |(_, by)| by);
        self.offset_s + self.drift * time + jumped
    }
}

/// Clocks of these cameras: up to 200 ms wrong, gaining or losing up to 50 ppm, reported to 0.1 to
/// 0.2 s.
pub fn random_clocks(cameras: &[&'static str], seed: u64) -> Vec<Clock> {
    let mut rng = ChaCha8Rng::seed_from_u64(10_000 + seed);
    let clock = |&camera: &&'static str| Clock {
        camera,
        offset_s: rng.random_range(-0.2..0.2),
        drift: rng.random_range(-5e-5..5e-5),
        sd_s: rng.random_range(0.1..0.2),
        jump: None,
    };
    cameras.iter().map(clock).collect()
}

/// The frames with the times that these clocks give them, in the order in which they are taken.
fn with_clocks(mut frames: Vec<BearingFrame>, clocks: &[Clock]) -> Vec<BearingFrame> {
    for frame in &mut frames {
        if let Some(clock) = clocks.iter().find(|clock| clock.camera == frame.camera) {
            let time = frame.capture_time_ns as f64 / 1e9;
            frame.capture_time_ns += (clock.offset_at(time) * 1e9).round() as i64;
            frame.capture_time_sd_s = clock.sd_s;
        }
    }
    frames
}

/// How long an error of a bearing lasts, s.
const LASTS_S: f64 = 1.0;

/// Displaces the bearings by an error of each camera of this deviation, rad per axis, that is
/// `exp(-t / LASTS_S)` of what it was after a time t.
fn displace(frames: &mut [BearingFrame], sd: f64, seed: u64) {
    let mut rng = ChaCha8Rng::seed_from_u64(30_000 + seed);
    let mut errors: BTreeMap<String, (i64, Vector3<f64>)> = BTreeMap::new();
    for frame in frames {
        let mut drawn = Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(&mut rng) }) * sd;
        if let Some((before_ns, error)) = errors.get(&frame.camera) {
            let kept = (-(frame.capture_time_ns - before_ns) as f64 / 1e9 / LASTS_S).exp();
            drawn = error * kept + drawn * (1.0 - kept.powi(2)).sqrt();
        }
        errors.insert(frame.camera.clone(), (frame.capture_time_ns, drawn));
        for track in &mut frame.tracks {
            let direction = Vector3::from(track.bearing.unwrap());
            track.bearing = Some((direction + drawn).normalize().into());
            track.covariance_xx += sd.powi(2);
            track.covariance_yy += sd.powi(2);
        }
    }
}

fn clock_of(fusion: &Fusion, camera: &str) -> Option<ClockEstimate> {
    fusion.cameras().find(|report| report.camera.as_str() == camera)?.clock
}

/// Standard deviations of poses.
#[derive(Clone, Copy, Debug, Default)]
pub struct PoseSd {
    /// Of the rotation, rad per axis.
    pub rotation_sd: f64,
    /// Of the position, m per axis.
    pub position_sd: f64,
}

/// What a series of flights has shown.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    pub flights: usize,
    /// Error of each clock at the end, s, and the standard deviation that was stated of it.
    pub errors: Vec<(f64, f64)>,
    /// Flights after which a clock was lost.
    pub lost: usize,
    /// Looks at a target that all cameras saw, ...
    pub asked: usize,
    /// ... and those of them at which its track was there.
    pub there: usize,
    /// Squared distances of tracks from the truth in the last half minute, m^2.
    pub distances: Vec<f64>,
    pub confirmed: u64,
    pub excluded: u64,
    /// Latest time at which a clock was not settled, s, of each flight.
    pub settled: Vec<f64>,
    /// How far the cameras' poses are off: calibrations say so.
    pub pose_sd: PoseSd,
    /// Standard deviation of what lasts of the bearings' errors, rad per axis. It counts in the
    /// covariances, but nobody says that it lasts.
    lasting_sd: f64,
    frames: u32,
    seconds: f64,
    slowest: f64,
}

fn root_mean(squares: impl Iterator<Item = f64>) -> f64 {
    let squares: Vec<f64> = squares.collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

impl Tally {
    /// A series of flights before cameras whose poses are off.
    pub fn of_wrong_poses(rotation_sd: f64, position_sd: f64) -> Self {
        Self { pose_sd: PoseSd { rotation_sd, position_sd }, ..Self::default() }
    }

    /// A series of flights whose bearings err by as much, rad per axis, for a second or so.
    pub fn of_lasting_errors(lasting_sd: f64) -> Self {
        Self { lasting_sd, ..Self::default() }
    }

    /// Root mean square of the errors, s.
    pub fn rms(&self) -> f64 {
        root_mean(self.errors.iter().map(|(error, _)| error.powi(2)))
    }

    /// Root mean square of what was stated, s.
    pub fn stated(&self) -> f64 {
        root_mean(self.errors.iter().map(|(_, sd)| sd.powi(2)))
    }

    /// Mean square of the errors over the stated deviations: 1 is honest.
    pub fn normalised(&self) -> f64 {
        root_mean(self.errors.iter().map(|(error, sd)| (error / sd).powi(2))).powi(2)
    }

    /// Root mean square of the tracks' distances from the truth, m.
    pub fn distance(&self) -> f64 {
        root_mean(self.distances.iter().copied())
    }

    /// One flight before a fusion centre of the defaults.
    pub fn fly(&mut self, scene: &Scene, clocks: &[Clock], seed: u64) {
        let mut fusion = fusion_of(FusionConfig::default(), &scene.eyes);
        self.knock(&mut fusion, scene, seed);
        let mut frames = scene.frames(seed);
        if self.lasting_sd > 0.0 {
            displace(&mut frames, self.lasting_sd, seed);
        }
        let truths: Vec<f64> =
            frames.iter().map(|frame| frame.capture_time_ns as f64 / 1e9).collect();
        let mut settled: f64 = 0.0;
        for (k, (frame, time)) in with_clocks(frames, clocks).iter().zip(truths).enumerate() {
            let start = Instant::now();
            fusion.ingest(frame);
            let took = start.elapsed().as_secs_f64();
            self.seconds += took;
            self.slowest = self.slowest.max(took);
            self.frames += 1;
            if k % LOOK_EVERY == 0 && time > 3.0 {
                self.look(&fusion, scene, time);
                let off = |c: &Clock| {
                    clock_of(&fusion, c.camera)
                        .map_or(0.0, |e| (e.offset_s - c.offset_at(time)).abs())
                };
                if clocks.iter().any(|clock| off(clock) > SETTLED_S) {
                    settled = time;
                }
            }
        }
        fusion.flush();
        self.flights += 1;
        self.settled.push(settled);
        self.confirmed += fusion.counters().get("tracks_confirmed");
        self.excluded += fusion.counters().get("cameras_excluded");
        let end = scene.time_s.end;
        let error = |clock: &Clock| {
            let estimate = clock_of(&fusion, clock.camera).unwrap();
            (estimate.offset_s - clock.offset_at(end), estimate.sd_s)
        };
        let errors: Vec<(f64, f64)> = clocks.iter().map(error).collect();
        self.lost += usize::from(errors.iter().any(|(error, _)| error.abs() > LOST_S));
        self.errors.extend(errors);
    }

    /// Calibrates the cameras anew, with poses that are wrong.
    fn knock(&self, fusion: &mut Fusion, scene: &Scene, seed: u64) {
        let PoseSd { rotation_sd, position_sd } = self.pose_sd;
        if rotation_sd <= 0.0 {
            return;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(20_000 + seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        for eye in &scene.eyes {
            let pose = eye.camera.pose();
            let turn = Rotation3::new(Vector3::from_fn(|_, _| rotation_sd * normal()));
            let step = Vector3::from_fn(|_, _| position_sd * normal());
            let wrong =
                Pose::new(*(pose.rotation() * turn).matrix(), pose.position() + step).unwrap();
            let camera = Camera::new(*eye.camera.model().intrinsics(), wrong).unwrap();
            let message = CameraCalibration::new(&eye.name, &camera, Timestamp::EPOCH);
            fusion.calibrate(&message.with_pose_sd(rotation_sd, position_sd)).unwrap();
        }
    }

    fn look(&mut self, fusion: &Fusion, scene: &Scene, time: f64) {
        for path in &scene.paths {
            let place = path(time).unwrap();
            if scene.eyes.iter().all(|eye| eye.camera.sees(place)) {
                self.asked += 1;
                let track = found(fusion, path);
                self.there += usize::from(track.is_some());
                if let Some(track) = track.filter(|_| time > 30.0) {
                    let truth = path(track.updated_at.seconds()).unwrap();
                    self.distances.push((track.state().position() - truth).norm_squared());
                }
            }
        }
    }

    /// The heads of [`Self::line`].
    pub const HEADS: &str = "| scene | RMS ms | worst ms | stated ms | norm. square | in 2 sd | lost | \
        settled s, median, last | track there | track m | tracks | excluded | us a frame, mean, longest |";

    /// A line of a table.
    pub fn line(&self, name: &str) -> String {
        let flights = self.flights as f64;
        let worst = self.errors.iter().map(|(error, _)| error.abs()).fold(0.0, f64::max);
        let within = self.errors.iter().filter(|(error, sd)| error.abs() < 2.0 * sd).count();
        let mut settled = self.settled.clone();
        settled.sort_unstable_by(f64::total_cmp);
        format!(
            "| {name} | {:.2} | {:.2} | {:.2} | {:.2} | {:.0} % | {} | {:.0}, {:.0} | {:.1} % | {:.3} | {:.1} | {:.1} \
             | {:.0}, {:.0} |",
            1e3 * self.rms(),
            1e3 * worst,
            1e3 * self.stated(),
            self.normalised(),
            100.0 * within as f64 / self.errors.len().max(1) as f64,
            self.lost,
            settled[settled.len() / 2],
            settled[settled.len() - 1],
            100.0 * self.there as f64 / self.asked.max(1) as f64,
            self.distance(),
            self.confirmed as f64 / flights,
            self.excluded as f64 / flights,
            1e6 * self.seconds / f64::from(self.frames),
            1e6 * self.slowest,
        )
    }
}
