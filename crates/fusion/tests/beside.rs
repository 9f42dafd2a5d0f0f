//! Bearings beside the target: an image tracker, or a person who draws labels, sits at the edge of
//! what it follows for seconds, and reports the noise of a good fit.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

#[allow(dead_code, reason = "each test uses a part of it")]
mod common;

use std::collections::BTreeMap;

use common::{Scene, site};
use crossfix_fusion::{Fusion, FusionConfig};
use crossfix_message::{BearingFrame, CameraCalibration, Timestamp};
use nalgebra::{Point3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard deviation of what lasts, rad per axis: six times what is reported of all errors.
const BESIDE_RAD: f64 = 3e-3;
/// Its decay time, s.
const LASTS_S: f64 = 2.0;
/// What is reported of the clocks, which are right, s.
const CLOCK_SD_S: f64 = 0.015;

/// What flights have shown.
#[derive(Debug, Default)]
struct Shown {
    /// Distances of the tracks from the target, m.
    off: Vec<f64>,
    /// How many of them are more than four of the deviations that the tracks state, ...
    beyond: usize,
    /// ... and the largest, in these deviations.
    largest: f64,
    /// Errors of the clocks' estimates, s.
    clocks_s: Vec<f64>,
}

impl Shown {
    fn look(&mut self, fusion: &Fusion) {
        let clocks = fusion.cameras().filter_map(|camera| camera.clock);
        self.clocks_s.extend(clocks.map(|clock| clock.offset_s));
        for track in fusion.tracks().filter(|track| track.is_confirmed()) {
            let off = (track.state().position() - flight(track.updated_at.seconds())).norm();
            let stated = track.state().position_covariance().trace().sqrt();
            self.off.push(off);
            self.beyond += usize::from(off > 4.0 * stated);
            self.largest = self.largest.max(off / stated);
        }
    }
}

fn root_mean_square(errors: &[f64]) -> f64 {
    (errors.iter().map(|error| error.powi(2)).sum::<f64>() / errors.len() as f64).sqrt()
}

/// Figures of eight at up to 18 m/s.
fn flight(t: f64) -> Point3<f64> {
    Point3::new(30.0 * (0.35 * t).sin(), 20.0 * (0.7 * t).sin(), 40.0 + 5.0 * (0.2 * t).sin())
}

/// Errors of the cameras that last: Ornstein-Uhlenbeck processes.
struct Beside {
    rng: ChaCha8Rng,
    errors: BTreeMap<String, (i64, Vector3<f64>)>,
}

impl Beside {
    fn displace(&mut self, frame: &mut BearingFrame) {
        let mut normal = || -> f64 { StandardNormal.sample(&mut self.rng) };
        let drawn = Vector3::from_fn(|_, _| BESIDE_RAD * normal());
        let now = frame.capture_time_ns;
        let before = self.errors.get(&frame.camera).copied();
        let error = before.map_or(drawn, |(then, error)| {
            let kept = (-(now - then) as f64 / 1e9 / LASTS_S).exp();
            error * kept + drawn * (1.0 - kept.powi(2)).sqrt()
        });
        self.errors.insert(frame.camera.clone(), (now, error));
        for track in &mut frame.tracks {
            let direction = Vector3::from(track.bearing.unwrap());
            track.bearing = Some((direction + error).normalize().into());
        }
    }
}

/// Five flights of a minute before so many cameras of 30 Hz, whose poses are right and undeclared.
fn flown(cameras: usize) -> Shown {
    let mut eyes = site();
    eyes.truncate(cameras);
    eyes.iter_mut().for_each(|eye| eye.rate_hz = 30.0);
    let mut shown = Shown::default();
    for seed in 0..5 {
        let path = Box::new(|t| Some(flight(t)));
        let scene = Scene { eyes: eyes.clone(), ..Scene::new(vec![path], 60.0) };
        let mut fusion = Fusion::new(FusionConfig::default()).unwrap();
        for eye in &scene.eyes {
            let calibration = CameraCalibration::new(&eye.name, &eye.camera, Timestamp::EPOCH);
            fusion.calibrate(&calibration).unwrap();
        }
        let rng = ChaCha8Rng::seed_from_u64(seed);
        let mut beside = Beside { rng, errors: BTreeMap::new() };
        for mut frame in scene.frames(seed) {
            beside.displace(&mut frame);
            frame.capture_time_sd_s = CLOCK_SD_S;
            fusion.ingest(&frame);
            shown.look(&fusion);
        }
    }
    shown
}

/// The lines of two cameras miss the target by 0.45 m each, at 150 m. That was once explained by
/// clocks that jumped by up to half a second, and a track ran away by 26 m.
///
/// Twenty-four other flights gave up to 10 deviations at most before two cameras, and 5.3 before
/// three.
#[test]
fn no_track_runs_away_and_no_clock() {
    for (cameras, rmse_m, beyond, largest) in [(2, 1.0, 0.04, 12.0), (3, 0.75, 0.003, 6.0)] {
        let shown = flown(cameras);
        let share = shown.beyond as f64 / shown.off.len() as f64;
        let (off_m, clocks_s) = (root_mean_square(&shown.off), root_mean_square(&shown.clocks_s));
        let line = format!(
            "{cameras} cameras: {off_m:.2} m, {:.2} % beyond 4 SD, {:.1} at most, clocks {clocks_s:.4} s",
            100.0 * share,
            shown.largest
        );
        println!("{line}");
        assert!(off_m < rmse_m && share < beyond && shown.largest < largest, "{line}");
        assert!(clocks_s < CLOCK_SD_S, "{line}");
    }
}
