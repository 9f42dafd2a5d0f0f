//! Sites of many cameras and many targets, as bearings without images: test input for fusion
//! centres.

use std::f64::consts::TAU;

use crossfix_geometry::{
    Bearing, Camera, Distortion, GeometryError, ImageSize, Intrinsics, Pixel, Pose, tangent_basis,
};
use crossfix_message::{
    BearingFrame, BearingTrack, CameraCalibration, CameraName, ClockSource, ImageTrackState,
    Payload, Timestamp,
};
use nalgebra::{Matrix2, Point3, Unit, Vector2, Vector3};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};

use crate::circuit::{Airspace, Circuit};
use crate::scene::check_range;
use crate::{SceneError, TargetState};

/// Track numbers per exposure: the bearings of an exposure are numbered from its sequence number
/// times this. An exposure with more bearings than this uses numbers of the next one; with half of
/// it, from 32 769 on.
const NUMBERS_PER_EXPOSURE: u64 = 1 << 16;
/// Height of the lowest cameras above the ground, m; others stand at two and three times this. With
/// half of it the heights differ by 4 m and not by 8, and the cameras are nearer to one plane,
/// which is poorly observable.
const MAST_M: f64 = 4.0;

/// Arrangement of the cameras of a site.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Layout {
    /// On the ellipse inscribed in the area, all looking at the middle of the volume.
    Ring,
    /// In rows and columns from border to border. Each block of two by two looks inwards, so that
    /// coverage by the whole grid is much the same everywhere.
    Grid,
}

/// Description of a site: cameras, targets and how the cameras detect them. World frame (ENU) with
/// its origin on the ground in the middle of the area.
#[derive(Clone, Debug, PartialEq)]
pub struct Site {
    /// Seed of everything random. The same site gives the same bytes.
    pub seed: u64,
    /// How long it lasts, s. Default 20.
    pub duration_s: f64,
    /// Sides of the area that targets stay within, east and north, m; in a corner they may go
    /// beyond it by three quarters of the radius of their turn. Default 600 x 600.
    pub area_m: [f64; 2],
    /// Lowest and highest altitude of the targets, m. Default 40 to 160.
    pub heights_m: [f64; 2],
    /// Number of targets. Default 10.
    pub targets: usize,
    /// Slowest and fastest speed of the targets, m/s. Default 5 to 20.
    pub speeds_mps: [f64; 2],
    /// Greatest rate of turn away from the border, rad/s. Default 0: straight, except at the
    /// border, where every target turns back at 0.2 rad/s or at this rate, whichever is greater.
    pub turn_rps: f64,
    /// Number of cameras, 1 to 999. Default 4. They are named `cam0`, `cam1` ...
    pub cameras: usize,
    /// Arrangement of the cameras. Default: [`Layout::Ring`].
    pub layout: Layout,
    /// Columns and rows of their images. Default 1920 x 1080.
    pub size_px: [u32; 2],
    /// Focal length, pixels. Default 960: a field of view of 90 degrees across.
    pub focal_px: f64,
    /// Range beyond which a camera sees nothing, m. Default 2000.
    pub range_m: f64,
    /// Exposures per second of each camera; those of different cameras are spread evenly in time.
    /// Default 30.
    pub rate_hz: f64,
    /// Probability that a target in the image is reported. Default 0.95.
    pub detection_probability: f64,
    /// Expected number of false bearings per exposure (Poisson), anywhere in the image. Default 1.
    pub false_bearings: f64,
    /// Standard deviation of a bearing, rad per axis. Default 0.0005.
    pub noise_rad: f64,
}

impl Default for Site {
    fn default() -> Self {
        Self {
            seed: 1,
            duration_s: 20.0,
            area_m: [600.0, 600.0],
            heights_m: [40.0, 160.0],
            targets: 10,
            speeds_mps: [5.0, 20.0],
            turn_rps: 0.0,
            cameras: 4,
            layout: Layout::Ring,
            size_px: [1920, 1080],
            focal_px: 960.0,
            range_m: 2000.0,
            rate_hz: 30.0,
            detection_probability: 0.95,
            false_bearings: 1.0,
            noise_rad: 5e-4,
        }
    }
}

/// A camera of a site.
#[derive(Clone, Debug)]
pub struct SiteCamera {
    /// Its name.
    pub name: CameraName,
    /// Its model and pose.
    pub camera: Camera,
    /// True time of its first exposure, s.
    pub phase_s: f64,
}

impl SiteCamera {
    /// Its calibration, exact.
    fn calibration(&self) -> CameraCalibration {
        CameraCalibration::new(&self.name, &self.camera, Timestamp::EPOCH).with_pose_sd(0.0, 0.0)
    }
}

/// One exposure of one camera: the bearings that it reports at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct SiteExposure {
    /// The camera, as its index in [`SimulatedSite::cameras`].
    pub camera: usize,
    /// True time, s from the start; the frame's capture time, without error.
    pub time_s: f64,
    /// The message.
    pub frame: BearingFrame,
    /// For each bearing of the frame its target, and `None` for a false one: for scoring only.
    pub sources: Vec<Option<u64>>,
}

/// A built site with the flights of its targets.
#[derive(Clone, Debug)]
pub struct SimulatedSite {
    description: Site,
    cameras: Vec<SiteCamera>,
    flights: Vec<Circuit>,
}

impl Site {
    /// Checks the description and builds the site.
    ///
    /// # Errors
    /// [`SceneError`] naming the number that makes no sense.
    pub fn build(&self) -> Result<SimulatedSite, SceneError> {
        self.check()?;
        let cameras =
            (0..self.cameras).map(|index| self.camera(index)).collect::<Result<_, _>>()?;
        let flights = (0..self.targets).map(|target| self.flight(target)).collect();
        Ok(SimulatedSite { description: self.clone(), cameras, flights })
    }

    fn flight(&self, target: usize) -> Circuit {
        let airspace = Airspace {
            half: Vector2::from(self.area_m) / 2.0,
            heights: self.heights_m,
            speeds: self.speeds_mps,
            turn: self.turn_rps,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(target as u64);
        Circuit::random(&airspace, self.duration_s, &mut rng)
    }

    fn check(&self) -> Result<(), SceneError> {
        check_range("duration_s", self.duration_s, 1e-3..=1e5, "from 0.001 to 100000 s")?;
        for side in self.area_m {
            check_range("area_m", side, 1.0..=1e5, "from 1 to 100000 m")?;
        }
        let [low, high] = self.heights_m;
        check_range("heights_m", low, 0.0..=high, "from 0 to the greatest height")?;
        check_range("heights_m", high, low..=1e4, "from the least height to 10000 m")?;
        let [slow, fast] = self.speeds_mps;
        check_range("speeds_mps", slow, 0.0..=fast, "from 0 to the greatest speed")?;
        check_range("speeds_mps", fast, slow..=1e3, "from the least speed to 1000 m/s")?;
        check_range("turn_rps", self.turn_rps, 0.0..=3.0, "from 0 to 3 rad/s")?;
        check_range("targets", self.targets as f64, 0.0..=1e5, "at most 100000")?;
        check_range("cameras", self.cameras as f64, 1.0..=999.0, "from 1 to 999")?;
        check_range("range_m", self.range_m, 1.0..=1e5, "from 1 to 100000 m")?;
        check_range(
            "rate_hz",
            self.rate_hz,
            0.01..=1000.0,
            "from 0.01 to 1000 exposures a second",
        )?;
        check_range("detection_probability", self.detection_probability, 0.0..=1.0, "from 0 to 1")?;
        check_range("clutter", self.false_bearings, 0.0..=1000.0, "from 0 to 1000 an exposure")?;
        check_range("noise_rad", self.noise_rad, 1e-7..=0.1, "from 0.0000001 to 0.1 rad")
    }

    fn camera(&self, index: usize) -> Result<SiteCamera, SceneError> {
        let text = format!("cam{index}");
        let name: CameraName = text.parse().map_err(|_| SceneError::Number {
            what: "cameras".to_owned(),
            value: self.cameras as f64,
            must: "from 1 to 999",
        })?;
        let camera = self
            .pose(index)
            .and_then(|pose| Camera::new(self.intrinsics(), pose))
            .map_err(|source| SceneError::Camera { camera: name.clone(), source })?;
        let phase_s = index as f64 / (self.cameras as f64 * self.rate_hz);
        Ok(SiteCamera { name, camera, phase_s })
    }

    fn intrinsics(&self) -> Intrinsics {
        let [width, height] = self.size_px;
        Intrinsics {
            size: ImageSize { width, height },
            fx: self.focal_px,
            fy: self.focal_px,
            cx: (f64::from(width) - 1.0) / 2.0,
            cy: (f64::from(height) - 1.0) / 2.0,
            distortion: Distortion::None,
        }
    }

    fn pose(&self, index: usize) -> Result<Pose, GeometryError> {
        let [low, high] = self.heights_m;
        let middle = (low + high) / 2.0;
        // Three heights in turn, so that not all cameras lie in one plane: that is poorly
        // observable.
        let mast = MAST_M * (1 + index % 3) as f64;
        let half = Vector2::from(self.area_m) / 2.0;
        match self.layout {
            Layout::Ring => {
                let angle = TAU * index as f64 / self.cameras as f64;
                let place = Point3::new(half.x * angle.cos(), half.y * angle.sin(), mast);
                Pose::looking_at(place, Point3::new(0.0, 0.0, middle))
            }
            Layout::Grid => {
                let columns = (self.cameras as f64).sqrt().ceil() as usize;
                let rows = self.cameras.div_ceil(columns);
                let (column, row) = (index % columns, index / columns);
                let along =
                    |i: usize, n: usize| if n < 2 { 0.5 } else { i as f64 / (n - 1) as f64 };
                let east = half.x * (2.0 * along(column, columns) - 1.0);
                let north = half.y * (2.0 * along(row, rows) - 1.0);
                let inwards = |i: usize| if i.is_multiple_of(2) { 1.0 } else { -1.0 };
                let aim = Vector2::new(inwards(column), inwards(row)) * (self.range_m / 3.0);
                let target = Point3::new(east + aim.x, north + aim.y, middle);
                Pose::looking_at(Point3::new(east, north, mast), target)
            }
        }
    }
}

impl SimulatedSite {
    /// The description it was built from.
    pub fn description(&self) -> &Site {
        &self.description
    }

    /// The cameras, `cam0` first.
    pub fn cameras(&self) -> &[SiteCamera] {
        &self.cameras
    }

    /// The calibrations that a fusion centre needs, one per camera.
    pub fn calibrations(&self) -> Vec<CameraCalibration> {
        self.cameras.iter().map(SiteCamera::calibration).collect()
    }

    /// The state of every target at a true time, s from the start; their ids are 0, 1 ...
    pub fn truth(&self, t: f64) -> impl Iterator<Item = TargetState> + '_ {
        self.flights.iter().zip(0..).map(move |(flight, id)| {
            let (position, velocity) = flight.state(t);
            TargetState { id, position, velocity }
        })
    }

    /// Number of cameras that have a place in their field of view and within their range.
    pub fn cameras_that_see(&self, place: Point3<f64>) -> usize {
        self.cameras.iter().filter(|c| self.sees(&c.camera, place)).count()
    }

    /// Total number of exposures of all cameras.
    pub fn exposures(&self) -> u64 {
        let Site { duration_s, rate_hz, .. } = self.description;
        let of = |c: &SiteCamera| ((duration_s - c.phase_s) * rate_hz).ceil().max(0.0) as u64;
        self.cameras.iter().map(of).sum()
    }

    /// Everything that the cameras report, in order of time.
    pub fn bearings(&self) -> impl Iterator<Item = SiteExposure> + '_ {
        (0..self.exposures()).map(|index| self.exposure(index))
    }

    /// The exposure with this index, counted over all cameras in order of time. Each call gives the
    /// same.
    pub fn exposure(&self, index: u64) -> SiteExposure {
        let cameras = self.cameras.len() as u64;
        let (sequence, which) = (index / cameras, (index % cameras) as usize);
        let SiteCamera { name, camera, phase_s } = &self.cameras[which];
        let time_s = phase_s + sequence as f64 / self.description.rate_hz;
        let mut rng = ChaCha8Rng::seed_from_u64(self.description.seed);
        // The lower streams belong to the targets' flights.
        rng.set_stream((1 << 32) + index);
        let mut bearings = self.detections(camera, time_s, &mut rng);
        bearings.extend(
            self.false_directions(camera, &mut rng).into_iter().map(|direction| (direction, None)),
        );
        // Shuffled, so that false bearings cannot be distinguished from targets by their order.
        bearings.shuffle(&mut rng);
        let numbered = (sequence * NUMBERS_PER_EXPOSURE..).zip(&bearings);
        let tracks = numbered.map(|(number, (bearing, _))| self.track(number, camera, bearing));
        let frame = BearingFrame {
            camera: name.to_string(),
            sequence,
            capture_time_ns: Timestamp::from_seconds(time_s).nanos(),
            clock_source: ClockSource::Simulated.into(),
            tracks: tracks.collect(),
            ..Default::default()
        };
        let sources = bearings.into_iter().map(|(_, source)| source).collect();
        SiteExposure { camera: which, time_s, frame: frame.stamped(), sources }
    }

    fn sees(&self, camera: &Camera, place: Point3<f64>) -> bool {
        (place - camera.pose().position()).norm() <= self.description.range_m && camera.sees(place)
    }

    /// Detections: measured directions in the camera's frame, with the target of each.
    fn detections(
        &self,
        camera: &Camera,
        time_s: f64,
        rng: &mut ChaCha8Rng,
    ) -> Vec<(Unit<Vector3<f64>>, Option<u64>)> {
        let Site { detection_probability, noise_rad, .. } = self.description;
        let mut found = Vec::new();
        for target in self.truth(time_s) {
            if !self.sees(camera, target.position) || !rng.random_bool(detection_probability) {
                continue;
            }
            let exact = Unit::new_normalize(camera.pose().camera_from_world(target.position));
            let noise = Vector2::from_fn(|_, _| {
                let deviation: f64 = StandardNormal.sample(rng);
                noise_rad * deviation
            });
            // u + E n, scaled to length 1, with the noise n on the tangents E of the direction u.
            let measured = Unit::new_normalize(exact.into_inner() + tangent_basis(&exact) * noise);
            found.push((measured, Some(target.id)));
        }
        found
    }

    /// False bearings: random directions in the camera's frame.
    fn false_directions(&self, camera: &Camera, rng: &mut ChaCha8Rng) -> Vec<Unit<Vector3<f64>>> {
        // For a mean of zero there is no Poisson distribution, and no false bearing.
        let count = Poisson::new(self.description.false_bearings)
            .map_or(0.0, |poisson| poisson.sample(rng));
        (0..count as u64).filter_map(|_| self.random_direction(camera, rng)).collect()
    }

    /// Direction of a random pixel of a camera; `None` where the lens has none for it.
    fn random_direction(
        &self,
        camera: &Camera,
        rng: &mut ChaCha8Rng,
    ) -> Option<Unit<Vector3<f64>>> {
        let [width, height] = self.description.size_px.map(|side| f64::from(side) - 1.0);
        let pixel = Pixel::new(rng.random_range(0.0..=width), rng.random_range(0.0..=height));
        camera.model().direction(pixel).ok()
    }

    fn track(&self, number: u64, camera: &Camera, direction: &Unit<Vector3<f64>>) -> BearingTrack {
        let variance = self.description.noise_rad.powi(2);
        let bearing = Bearing::new(direction.into_inner(), Matrix2::identity() * variance);
        let pixel = bearing.ok().and_then(|bearing| camera.model().project(&bearing.direction()));
        BearingTrack {
            track_id: number,
            bearing: Some(direction.into_inner().into()),
            covariance_xx: variance,
            covariance_yy: variance,
            pixel_x: pixel.map_or(0.0, |pixel| pixel.x()),
            pixel_y: pixel.map_or(0.0, |pixel| pixel.y()),
            score: 1.0,
            state: ImageTrackState::Tracking.into(),
            ..Default::default()
        }
    }
}

#[cfg(test)]
mod tests;
