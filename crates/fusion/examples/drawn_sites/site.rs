//! A site of which everything is drawn.

use std::f64::consts::PI;
use std::fmt;

use crossfix_geometry::{
    Camera, Distortion, GeometryError, ImageSize, Intrinsics, Pixel, Pose, tangent_basis,
};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, ImageTrackState, Timestamp,
};
use nalgebra::{Point3, Rotation3, Unit, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};

use super::Wishes;
use super::flight::Flight;
use super::hardship::Hardship;

/// How long each site is looked at, s.
pub const DURATION_S: f64 = 40.0;
/// The cameras' clocks begin here, s: none reads a time before zero.
const BEGINS_S: f64 = 1000.0;
/// Standard deviation of clocks that are not exact, s.
const CLOCK_SD_S: f64 = 0.03;

/// How good the poses are, and what is said of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Poses {
    /// Exact, and nobody says so.
    Exact,
    /// Off by a milliradian and 5 cm per axis, as a careful survey leaves them, and nobody says so.
    Careful,
    /// Off by 3 mrad and 20 cm per axis, and declared to be.
    Declared,
}

impl Poses {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Exact, Self::Careful, Self::Declared];

    /// Standard deviations of the rotation, rad, and of the position, m, per axis.
    fn deviations(self) -> [f64; 2] {
        match self {
            Self::Exact => [0.0, 0.0],
            Self::Careful => [1e-3, 0.05],
            Self::Declared => [3e-3, 0.2],
        }
    }
}

/// A camera as it stands and as it is said to stand.
pub struct DrawnCamera {
    name: CameraName,
    truth: Camera,
    said: Camera,
    rate_hz: f64,
    phase_s: f64,
    /// Standard deviation of its bearings, rad per axis.
    sd_rad: f64,
    /// Probability that a target in its view is reported.
    detection: f64,
    /// False bearings an image, on average.
    clutter: f64,
    /// How far its clock is ahead, s.
    clock_s: f64,
    hardship: Hardship,
}

/// A site of which everything is drawn: its cameras, what flies before it, and what goes wrong.
pub struct DrawnSite {
    /// How good its poses are.
    pub poses: Poses,
    /// Its cameras.
    pub cameras: Vec<DrawnCamera>,
    /// Where they look.
    middle: Point3<f64>,
    clock_sd_s: f64,
    flights: Vec<Flight>,
    random: ChaCha8Rng,
}

impl DrawnSite {
    /// The site of a seed, with what is wished in place of what is drawn: with other poses it is
    /// the same site.
    pub fn draw(seed: u64, wishes: &Wishes) -> Result<Self, GeometryError> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let poses = Poses::ALL[random.random_range(0..3)];
        let cameras = random.random_range(2..=6);
        let targets = random.random_range(1..=3);
        let radius_m = between(60.0, 2500.0, &mut random);
        let clock_sd_s = if random.random() { CLOCK_SD_S } else { 0.0 };
        let poses = wishes.poses.unwrap_or(poses);
        let middle = Point3::new(0.0, 0.0, radius_m * random.random_range(0.15..0.5));
        let mut cameras = (0..wishes.cameras.unwrap_or(cameras))
            .map(|index| camera(index, poses, clock_sd_s, radius_m, middle, &mut random))
            .collect::<Result<Vec<_>, _>>()?;
        let fly = if wishes.hard { Flight::draw_hard } else { Flight::draw };
        let flights = (0..wishes.targets.unwrap_or(targets))
            .map(|_| fly(middle, radius_m, &mut random))
            .collect();
        if wishes.hard {
            cameras.iter_mut().for_each(|camera| camera.hardship = Hardship::draw(&mut random));
        }
        Ok(Self { poses, cameras, middle, clock_sd_s, flights, random })
    }

    /// Where each target is when the clocks on average read a time. Without a better clock nobody
    /// can know that they are all ahead. One that is ahead without a word is not counted in this.
    pub fn targets_at(&self, time: Timestamp) -> Vec<Point3<f64>> {
        let ahead_s: f64 = self.cameras.iter().map(|camera| camera.clock_s).sum();
        let t = time.seconds() - BEGINS_S - ahead_s / self.cameras.len() as f64;
        self.flights.iter().map(|flight| flight.at(t)).collect()
    }

    /// How many cameras have a place in their view at a time.
    pub fn seen_by(&self, place: Point3<f64>, time: Timestamp) -> usize {
        let t = time.seconds() - BEGINS_S;
        let sees = |camera: &&DrawnCamera| camera.truth.sees(place) && !camera.hardship.hides_at(t);
        self.cameras.iter().filter(sees).count()
    }

    /// All frames, in the order of their exposures.
    pub fn frames(&mut self) -> Vec<BearingFrame> {
        let mut frames = Vec::new();
        for camera in &self.cameras {
            let count = ((DURATION_S - camera.phase_s) * camera.rate_hz) as u64;
            let mut lasting = vec![None; self.flights.len()];
            for sequence in 0..count {
                let t = camera.phase_s + sequence as f64 / camera.rate_hz;
                let places: Vec<_> = self.flights.iter().map(|flight| flight.at(t)).collect();
                let reported = Timestamp::from_seconds(
                    BEGINS_S + t + camera.clock_s + camera.hardship.clock_s,
                );
                let frame = BearingFrame {
                    camera: camera.name.to_string(),
                    sequence,
                    capture_time_ns: reported.nanos(),
                    capture_time_sd_s: self.clock_sd_s,
                    tracks: camera.bearings(t, &places, &mut lasting, &mut self.random),
                    ..Default::default()
                };
                frames.push((t, frame));
            }
        }
        frames.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        frames.into_iter().map(|(_, frame)| frame).collect()
    }
}

impl fmt::Display for DrawnSite {
    /// Its cameras (distance to the middle, frames a second, deviation, share of targets seen,
    /// false bearings an image), clocks and targets.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for camera in &self.cameras {
            let DrawnCamera { rate_hz, sd_rad, detection, clutter, .. } = camera;
            let (away, mrad) = ((camera.said.pose().position() - self.middle).norm(), sd_rad * 1e3);
            write!(f, "{away:.0} m {rate_hz:.0} Hz {mrad:.1} mrad {detection:.2} {clutter:.1}")?;
            write!(f, "{}; ", camera.hardship)?;
        }
        write!(f, "clocks {} s;", self.clock_sd_s)?;
        for flight in &self.flights {
            let speed = (flight.at(20.1) - flight.at(20.0)).norm() / 0.1;
            write!(f, " {} {speed:.1} m/s", flight.kind())?;
        }
        Ok(())
    }
}

/// A number of which each factor is as likely as any other.
pub fn between(least: f64, most: f64, random: &mut ChaCha8Rng) -> f64 {
    random.random_range(least.ln()..most.ln()).exp()
}

/// A camera at about that distance from the middle, that looks there.
fn camera(
    index: usize,
    poses: Poses,
    clock_sd_s: f64,
    radius_m: f64,
    middle: Point3<f64>,
    random: &mut ChaCha8Rng,
) -> Result<DrawnCamera, GeometryError> {
    let towards = random.random_range(-PI..PI);
    let away_m = radius_m * random.random_range(0.6..1.4);
    let height_m = random.random_range(0.0..0.1) * radius_m;
    let at = Point3::new(towards.cos() * away_m, towards.sin() * away_m, height_m);
    let [width, height] = [1920.0, 1080.0];
    let focal_px = width / 2.0 / (random.random_range(40.0..90.0_f64).to_radians() / 2.0).tan();
    let lens = Intrinsics {
        size: ImageSize { width: width as u32, height: height as u32 },
        fx: focal_px,
        fy: focal_px,
        cx: (width - 1.0) / 2.0,
        cy: (height - 1.0) / 2.0,
        distortion: Distortion::None,
    };
    let said = Pose::looking_at(at, middle)?;
    let [turn, shift] = poses.deviations();
    let turned = Rotation3::new(normal(random) * turn) * said.rotation();
    let truth = Pose::new(turned.into_inner(), said.position() + normal(random) * shift)?;
    let rate_hz = between(5.0, 60.0, random);
    Ok(DrawnCamera {
        name: format!("cam{index}").parse().unwrap_or_else(|_| unreachable!("a plain word")),
        truth: Camera::new(lens, truth)?,
        said: Camera::new(lens, said)?,
        rate_hz,
        phase_s: random.random_range(0.0..1.0) / rate_hz,
        sd_rad: between(1e-4, 2e-3, random),
        detection: random.random_range(0.5..0.98),
        clutter: between(0.05, 2.0, random),
        clock_s: normal(random).x * clock_sd_s,
        hardship: Hardship::NONE,
    })
}

/// Three normal numbers.
pub fn normal(random: &mut ChaCha8Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| StandardNormal.sample(random))
}

impl DrawnCamera {
    /// What it says of itself.
    pub fn calibration(&self, poses: Poses) -> CameraCalibration {
        let message = CameraCalibration::new(&self.name, &self.said, Timestamp::EPOCH);
        let [turn, shift] = poses.deviations();
        if poses == Poses::Declared { message.with_pose_sd(turn, shift) } else { message }
    }

    /// What it reports of these places at a time after the beginning, s, and what is nothing;
    /// `lasting` are the errors of its bearings of each that last.
    fn bearings(
        &self,
        t: f64,
        places: &[Point3<f64>],
        lasting: &mut [Option<Vector2<f64>>],
        random: &mut ChaCha8Rng,
    ) -> Vec<BearingTrack> {
        let is_hidden = self.hardship.hides_at(t);
        let mut directions = Vec::new();
        for (place, lasting) in places.iter().zip(lasting) {
            let noise = self.hardship.noise(self.sd_rad, 1.0 / self.rate_hz, lasting, random);
            if !is_hidden && random.random::<f64>() < self.detection && self.truth.sees(*place) {
                let exact = Unit::new_normalize(self.truth.pose().camera_from_world(*place));
                directions.push(exact.into_inner() + tangent_basis(&exact) * noise);
            }
        }
        let ImageSize { width, height } = self.truth.model().intrinsics().size;
        let size = [width, height].map(f64::from);
        let clutter = Poisson::new(self.clutter).map_or(0.0, |poisson| poisson.sample(random));
        for _ in 0..clutter as usize {
            let [x, y] = size.map(|side| random.random_range(0.0..side));
            directions
                .extend(self.truth.model().direction(Pixel::new(x, y)).ok().map(Unit::into_inner));
        }
        directions.into_iter().zip(1..).map(|(towards, id)| self.bearing(towards, id)).collect()
    }

    fn bearing(&self, towards: Vector3<f64>, track_id: u64) -> BearingTrack {
        BearingTrack {
            track_id,
            bearing: Some(towards.normalize().into()),
            covariance_xx: self.sd_rad.powi(2),
            covariance_yy: self.sd_rad.powi(2),
            state: ImageTrackState::Tracking.into(),
            score: 1.0,
            ..Default::default()
        }
    }
}
