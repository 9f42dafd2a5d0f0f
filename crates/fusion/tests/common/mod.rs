//! A small site to test the fusion centre on: cameras, targets of which everything is known, and
//! the bearings that the cameras report of them, with noise, misses and clutter from a seed.

use std::ops::Range;

use crossfix_fusion::{FusedTrack, Fusion, FusionConfig};
use crossfix_geometry::{
    Bearing, Camera, Distortion, ImageSize, Intrinsics, Pixel, Pose, tangent_basis,
};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, ImageTrackState, Timestamp,
};
use nalgebra::{Matrix2, Point3, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};

/// Standard deviation of the bearings along each tangent, rad: 7.5 cm at 150 m.
pub const SD_RAD: f64 = 5e-4;

/// Where a target is at a time (s); `None` while there is none.
pub type Path = Box<dyn Fn(f64) -> Option<Point3<f64>>>;

/// A camera that takes a picture every so often.
#[derive(Clone, Debug)]
pub struct Eye {
    /// Its name.
    pub name: CameraName,
    /// Its place and lens.
    pub camera: Camera,
    /// Pictures a second.
    pub rate_hz: f64,
    /// Time of the first after a whole period, s.
    pub phase_s: f64,
}

/// Cameras, targets and what goes wrong.
pub struct Scene {
    /// The cameras.
    pub eyes: Vec<Eye>,
    /// The targets.
    pub paths: Vec<Path>,
    /// From when until when, s.
    pub time_s: Range<f64>,
    /// Probability that a camera reports a target that it sees.
    pub detection: f64,
    /// False bearings of a frame, on average.
    pub clutter: f64,
}

/// A camera of 1920 x 1080 pixels, 69 degrees wide, that looks at a point; ten pictures per second.
pub fn eye(name: &str, at: [f64; 3], looking_at: [f64; 3], phase_s: f64) -> Eye {
    let size = ImageSize { width: 1920, height: 1080 };
    let lens = Intrinsics {
        size,
        fx: 1400.0,
        fy: 1400.0,
        cx: 959.5,
        cy: 539.5,
        distortion: Distortion::None,
    };
    let pose = Pose::looking_at(at.into(), looking_at.into()).unwrap();
    Eye {
        name: name.parse().unwrap(),
        camera: Camera::new(lens, pose).unwrap(),
        rate_hz: 10.0,
        phase_s,
    }
}

/// Three cameras about 150 m from where they all look, one after the other within a period.
pub fn site() -> Vec<Eye> {
    let middle = [0.0, 0.0, 40.0];
    vec![
        eye("a", [-150.0, -20.0, 2.0], middle, 0.0),
        eye("b", [90.0, -120.0, 5.0], middle, 0.033),
        eye("c", [60.0, 140.0, 3.0], middle, 0.067),
    ]
}

/// A target that flies straight through a point at time 0.
pub fn straight(through: [f64; 3], velocity: [f64; 3]) -> Path {
    Box::new(move |t| Some(Point3::from(through) + Vector3::from(velocity) * t))
}

/// A fusion centre that knows these cameras.
pub fn fusion_of(config: FusionConfig, eyes: &[Eye]) -> Fusion {
    let mut fusion = Fusion::new(config).unwrap();
    eyes.iter().for_each(|eye| fusion.calibrate(&calibration(eye)).unwrap());
    fusion
}

/// The message that makes a camera known.
pub fn calibration(eye: &Eye) -> CameraCalibration {
    CameraCalibration::new(&eye.name, &eye.camera, Timestamp::EPOCH).with_pose_sd(0.0, 0.0)
}

/// The confirmed track within three metres of a path at its own time, the nearest if there are
/// more.
pub fn found<'a>(fusion: &'a Fusion, path: &Path) -> Option<&'a FusedTrack> {
    let distance = |track: &FusedTrack| {
        Some((track.state().position() - path(track.updated_at.seconds())?).norm())
    };
    let near = fusion.tracks().filter(|track| track.is_confirmed());
    let near = near.filter_map(|track| Some((distance(track)?, track))).filter(|(d, _)| *d < 3.0);
    near.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, track)| track)
}

impl Scene {
    /// These targets before the three cameras of [`site`] for some seconds; no misses, no clutter.
    pub fn new(paths: Vec<Path>, seconds: f64) -> Self {
        Self { eyes: site(), paths, time_s: 0.0..seconds, detection: 1.0, clutter: 0.0 }
    }

    /// All frames in the order of their capture times.
    pub fn frames(&self, seed: u64) -> Vec<BearingFrame> {
        let mut exposures: Vec<(i64, usize, u64)> = Vec::new();
        for (i, Eye { rate_hz, phase_s, .. }) in self.eyes.iter().enumerate() {
            let first = ((self.time_s.start - phase_s) * rate_hz - 1e-9).ceil().max(0.0) as u64;
            let time_s = |k: u64| phase_s + k as f64 / rate_hz;
            let times = (first..).take_while(|&k| time_s(k) < self.time_s.end);
            exposures.extend(times.map(|k| ((time_s(k) * 1e9).round() as i64, i, k)));
        }
        exposures.sort_unstable();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        exposures
            .into_iter()
            .map(|(time, i, k)| self.frame(&self.eyes[i], time, k, &mut rng))
            .collect()
    }

    fn frame(
        &self,
        eye: &Eye,
        capture_time_ns: i64,
        sequence: u64,
        rng: &mut ChaCha8Rng,
    ) -> BearingFrame {
        let seconds = capture_time_ns as f64 / 1e9;
        let mut tracks = Vec::new();
        for place in self.paths.iter().filter_map(|path| path(seconds)) {
            // Drawn whether it is seen or not: a target out of sight changes no other's noise.
            let noise = Vector2::from_fn(|_, _| -> f64 { StandardNormal.sample(rng) }) * SD_RAD;
            let detected = rng.random::<f64>() < self.detection;
            if detected && eye.camera.sees(place) {
                let exact =
                    nalgebra::Unit::new_normalize(eye.camera.pose().camera_from_world(place));
                tracks.push(exact.into_inner() + tangent_basis(&exact) * noise);
            }
        }
        let false_ones = Poisson::new(self.clutter).map_or(0.0, |poisson| poisson.sample(rng));
        tracks.extend(clutter(&eye.camera, false_ones as usize, rng));
        let tracks =
            tracks.into_iter().zip(1..).map(|(towards, id)| bearing(towards, id)).collect();
        let camera = eye.name.to_string();
        BearingFrame { camera, sequence, capture_time_ns, tracks, ..Default::default() }
    }
}

/// Directions anywhere in a camera's image.
pub fn clutter(camera: &Camera, count: usize, rng: &mut ChaCha8Rng) -> Vec<Vector3<f64>> {
    let ImageSize { width, height } = camera.model().intrinsics().size;
    let [width, height] = [f64::from(width), f64::from(height)];
    let mut pixel = || Pixel::new(rng.random_range(0.0..width), rng.random_range(0.0..height));
    (0..count).map(|_| camera.model().direction(pixel()).unwrap().into_inner()).collect()
}

/// A bearing along a direction of any length, with the covariance that it has.
pub fn bearing(towards: Vector3<f64>, track_id: u64) -> BearingTrack {
    let covariance = Matrix2::identity() * SD_RAD.powi(2);
    let bearing = Bearing::new(towards.normalize(), covariance).unwrap();
    BearingTrack {
        track_id,
        bearing: Some(bearing.direction().into_inner().into()),
        covariance_xx: covariance.m11,
        covariance_yy: covariance.m22,
        state: ImageTrackState::Tracking.into(),
        ..Default::default()
    }
}
