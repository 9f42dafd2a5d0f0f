//! A flight that was made up: cameras, what they label, and the target's log.

#![allow(dead_code, reason = "each test uses what it needs")]

use crossfix_calibration::{
    CameraLabels, FlightLog, FlightResult, Label, LensFreedom, LogErrors, LogSample,
};
use crossfix_geometry::{Camera, Distortion, ImageSize, Intrinsics, Pixel, Pose};
use nalgebra::{Point3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

pub const LOG: LogErrors = LogErrors { sd_m: 0.02, drift_sd_m: 0.02, drift_time_s: 200.0 };
pub const SECONDS: f64 = 120.0;
pub const FRAME_S: f64 = 0.04;

/// A way through the whole volume: up to 8 m/s, 20 to 45 m high.
pub fn way(t: f64) -> Point3<f64> {
    Point3::new(
        30.0 * (0.11 * t).sin() + 8.0 * (0.53 * t).sin(),
        25.0 * (0.17 * t).cos() + 6.0 * (0.71 * t).cos(),
        32.0 + 12.0 * (0.23 * t).sin(),
    )
}

/// A camera as it is, and as its file and its clock say that it is.
pub struct Truth {
    pub name: &'static str,
    pub camera: Camera,
    pub file: Intrinsics,
    /// The common time less the camera's.
    pub offset_s: f64,
    pub rate: f64,
}

pub fn cameras() -> Vec<Truth> {
    let places = [[60.0, 10.0, 1.5], [-50.0, 35.0, 2.0], [5.0, -65.0, 4.0]];
    let names = ["north", "east", "south"];
    let truth = |(k, place): (usize, [f64; 3])| {
        let pose = Pose::looking_at(place.into(), Point3::new(0.0, 0.0, 30.0)).unwrap();
        let file = Intrinsics {
            size: ImageSize { width: 1920, height: 1080 },
            fx: 1100.0,
            fy: 1102.0,
            cx: 958.0,
            cy: 541.0,
            distortion: Distortion::BrownConrady([-0.05, 0.02, 0.0, 0.0, 0.0]),
        };
        // The lens is shorter at a distance than near the checkerboard.
        let shorter = 1.0 - 0.004 * (k as f64 + 1.0);
        let real = Intrinsics { fx: file.fx * shorter, fy: file.fy * shorter, ..file };
        let camera = Camera::new(real, pose).unwrap();
        let offset_s = 7.3 * k as f64 - 4.0;
        Truth { name: names[k], camera, file, offset_s, rate: 2e-5 * k as f64 }
    };
    places.into_iter().enumerate().map(truth).collect()
}

/// What it labels of [`way`].
pub fn labels(truth: &Truth, random: &mut ChaCha8Rng) -> CameraLabels {
    labels_of(truth, way, random)
}

/// What it labels of a way: errors of 0.1 pixels that are new in every frame, and of 0.4 that last
/// for half a second.
pub fn labels_of(
    truth: &Truth,
    way: impl Fn(f64) -> Point3<f64>,
    random: &mut ChaCha8Rng,
) -> CameraLabels {
    let mut normal = || -> f64 { StandardNormal.sample(random) };
    let kept = (-FRAME_S / 0.5_f64).exp();
    let mut lasting = [normal(), normal()].map(|n| 0.4 * n);
    let mut labels = Vec::new();
    let mut common_s = 1.0;
    while common_s < SECONDS - 1.0 {
        common_s += FRAME_S;
        let own = (common_s - truth.offset_s + truth.rate * SECONDS / 2.0) / (1.0 + truth.rate);
        lasting = lasting.map(|error| kept * error + 0.4 * (1.0 - kept * kept).sqrt() * normal());
        let place = way(common_s);
        if let Some(pixel) = truth.camera.project(place).filter(|_| truth.camera.sees(place)) {
            let [x, y] = lasting.map(|error| error + 0.1 * normal());
            labels.push(Label { time_s: own, pixel: Pixel::new(pixel.x() + x, pixel.y() + y) });
        }
    }
    CameraLabels {
        name: truth.name.parse().unwrap(),
        intrinsics: truth.file,
        freedom: LensFreedom::All,
        labels,
    }
}

/// A log of [`way`] in other axes.
pub fn log(random: &mut ChaCha8Rng, axes: impl Fn(Point3<f64>) -> Point3<f64>) -> FlightLog {
    log_of(random, |time_s| axes(way(time_s)), 0.2)
}

/// A log of a way, a place each so many seconds.
pub fn log_of(random: &mut ChaCha8Rng, way: impl Fn(f64) -> Point3<f64>, step_s: f64) -> FlightLog {
    let mut noisy = |place: Point3<f64>| {
        place + Vector3::from_fn(|_, _| -> f64 { StandardNormal.sample(random) }) * LOG.sd_m
    };
    let sample = |k: u32| {
        let time_s = step_s * f64::from(k);
        LogSample { time_s, position: noisy(way(time_s)) }
    };
    FlightLog { samples: (0..(SECONDS / step_s) as u32).map(sample).collect(), errors: LOG }
}

pub fn flight(seed: u64) -> (Vec<Truth>, Vec<CameraLabels>, FlightLog) {
    flight_of(way, seed)
}

pub fn flight_of(
    way: impl Fn(f64) -> Point3<f64> + Copy,
    seed: u64,
) -> (Vec<Truth>, Vec<CameraLabels>, FlightLog) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let truths = cameras();
    let labels = truths.iter().map(|truth| labels_of(truth, way, &mut random)).collect();
    let log = log_of(&mut random, way, 0.2);
    (truths, labels, log)
}

/// What pose and lens make of the middle of the image is compared, as both may be off together.
pub fn pointing_error_mrad(truth: &Truth, result: &FlightResult, index: usize) -> f64 {
    let found = &result.cameras[index].camera;
    let seen = (0..40).map(|k| way(3.0 * f64::from(k))).filter(|place| truth.camera.sees(*place));
    let errors: Vec<f64> = seen
        .map(|place| {
            let pixel = truth.camera.project(place).unwrap();
            let there = found.project(place).unwrap();
            (there.x() - pixel.x()).hypot(there.y() - pixel.y()) / truth.file.fx * 1e3
        })
        .collect();
    (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt()
}
